"""A made-up site and a made-up mission on it: what the tests of playback and of the written files read.

Nothing here is simulated: vehicles move along prescribed curves and counts follow an inverse-square law, so that every
number a test asks for has a closed form.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from swarmsim.config.site import SiteSpec
from swarmsim.results.record import (
    Estimate,
    Event,
    MissionRecord,
    Phase,
    RadiationMap,
    Samples,
    Shape,
    Spectrum,
    TrueSource,
    VehicleRecord,
    carried_m,
)
from swarmsim.site.model import Obstacles, Site, SiteModel, VisualMesh

SOURCE_M = np.array([12.0, 4.0, 1.0])
ACTIVITY_MBQ = 170.0
BACKGROUND_CPS = 94.0
SOURCE_CPS_M2 = 48_000.0  # 120 cps net at 20 m
WEST, SOUTH, WIDTH, DEPTH, CELL = -75.0, -60.0, 150.0, 120.0, 1.0
BUILDINGS = (  # centre east, north, length, width, height
    (-30.0, 25.0, 24.0, 12.0, 7.0),
    (20.0, 10.0, 18.0, 10.0, 6.0),
    (40.0, -25.0, 14.0, 20.0, 8.0),
    (-25.0, -25.0, 20.0, 14.0, 5.0),
    (30.0, 38.0, 26.0, 10.0, 6.0),
    (-52.0, 5.0, 10.0, 16.0, 4.0),
    (12.0, 4.0, 3.0, 2.0, 2.5),
)


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the terrain: flat in the west, a gentle hill in the north-east."""
    return 2.5 * np.exp(-((x - 45.0) ** 2 + (y - 30.0) ** 2) / 900.0) + 0.2 * np.sin(x / 17.0) * np.cos(y / 13.0)


def site_model(mesh_step_m: float = 1.0) -> SiteModel:
    """The site: 1.8 ha, six buildings and a container; its mesh has a vertex each ``mesh_step_m``."""
    x = np.arange(WEST + CELL / 2, WEST + WIDTH, CELL)
    y = np.arange(SOUTH + CELL / 2, SOUTH + DEPTH, CELL)
    terrain = ground(*np.meshgrid(x, y))
    surface = terrain.copy()
    for cx, cy, length, width, height in BUILDINGS:
        rows, columns = np.abs(y - cy) <= width / 2, np.abs(x - cx) <= length / 2
        surface[np.ix_(rows, columns)] = ground(np.array(cx), np.array(cy)) + height
    boxes = np.array(BUILDINGS)
    site = Site(
        origin_m=jnp.array([x[0], y[0]]),
        cell_m=jnp.array(CELL),
        terrain_m=jnp.array(terrain, jnp.float32),
        surface_m=jnp.array(surface, jnp.float32),
        clearance_m=jnp.ones(terrain.shape, jnp.float32),
        cost=jnp.ones(terrain.shape, jnp.float32),
        obstacles=Obstacles(
            centre_m=jnp.array(np.c_[boxes[:, :2], ground(boxes[:, 0], boxes[:, 1]) + boxes[:, 4] / 2]),
            half_extent_m=jnp.array(boxes[:, 2:] / 2),
            axis=jnp.tile(jnp.array([1.0, 0.0]), (len(boxes), 1)),
            wall_m=jnp.full(len(boxes), 0.3),
            material=jnp.zeros(len(boxes), jnp.int32),
        ),
        survey_area_m=jnp.array([[-65.0, -50.0], [65.0, -50.0], [65.0, 50.0], [-65.0, 50.0]]),
        ground_material=jnp.array(0, jnp.int32),
        material_names=("soil",),
    )
    spec = SiteSpec(name="synthetic", file="synthetic.dae", licence="CC0-1.0", cell_m=CELL)
    return SiteModel(name="synthetic", spec=spec, site=site, mesh=_mesh(mesh_step_m), report={})


def _mesh(step_m: float) -> VisualMesh:
    columns, rows = round(WIDTH / step_m) + 1, round(DEPTH / step_m) + 1
    x, y = np.meshgrid(np.linspace(WEST, WEST + WIDTH, columns), np.linspace(SOUTH, SOUTH + DEPTH, rows))
    vertices = [np.stack([x, y, ground(x, y)], -1).reshape(-1, 3)]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    triangles = [(corner + np.array([[0, 1, columns + 1, 0, columns + 1, columns]])).reshape(-1, 3)]
    speckle = np.random.default_rng(0).integers(-8, 8, (rows * columns, 1))
    colours = [np.c_[np.array([118, 128, 96]) + speckle, np.full(rows * columns, 255)]]
    around = "021 032 456 467 015 054 126 165 237 276 304 347"
    faces = np.array([[int(corner) for corner in face] for face in around.split()])
    signs = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    for cx, cy, length, width, height in BUILDINGS:
        base = ground(np.array(cx), np.array(cy))
        triangles.append(faces + sum(map(len, vertices)))
        vertices.append(np.array([cx, cy, base]) + signs * [length / 2, width / 2, height])
        colours.append(np.tile([178, 150, 130, 255] if height > 3 else [170, 60, 50, 255], (8, 1)))
    return VisualMesh(
        vertices_m=np.concatenate(vertices).astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.uint32),
        colours=np.concatenate(colours).clip(0, 255).astype(np.uint8),
    )


def rate_cps(position: np.ndarray, activity_mbq: float = ACTIVITY_MBQ, scale: float = 1.0) -> np.ndarray:
    """Expected count rate [n] at ``position`` [n, 3]; ``scale`` is the detector's area over the small one's."""
    squared = ((position - SOURCE_M) ** 2).sum(-1) + 0.25
    return scale * (BACKGROUND_CPS + SOURCE_CPS_M2 * activity_mbq / ACTIVITY_MBQ / squared)


def _follow(points: np.ndarray, speed: float, start_s: float, time_s: np.ndarray) -> np.ndarray:
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    travelled = np.clip((time_s - start_s) * speed, 0.0, length[-1])
    return np.stack([np.interp(travelled, length, points[:, k]) for k in range(3)], -1)


def _survey_path(index: int) -> np.ndarray:
    north = np.arange(-45.0, 46.0, 10.0).reshape(-1)
    mine = np.array_split(north, 3)[index]
    corners = [(-60.0, mine[0], 0.3), (-60.0, mine[0], 20.0)]
    for k, y in enumerate(mine):
        ends = (-60.0, 60.0) if k % 2 == 0 else (60.0, -60.0)
        corners += [(ends[0], y, 20.0), (ends[1], y, 20.0)]
    corners += [(-60.0, mine[0], 20.0), (-60.0, mine[0], 0.3)]
    return np.array(corners)


def _route() -> np.ndarray:
    angle = np.linspace(np.pi, -np.pi * 0.9, 30)
    around = SOURCE_M[:2] + 4.0 * np.c_[np.cos(angle), np.sin(angle)]
    plan = np.r_[[[-62.0, -10.0], [-40.0, -10.0], [-5.0, -8.0]], around]
    return np.c_[plan, ground(plan[:, 0], plan[:, 1])]


QUADROTOR = Shape(
    hubs_m=0.23 * np.array([[1, 1, 0.1], [-1, 1, 0.1], [-1, -1, 0.1], [1, -1, 0.1]]),
    radius_m=0.19,
    width_m=0.0,
    box_centre_m=np.zeros(3),
    box_size_m=np.array([0.26, 0.2, 0.1]),
)
ROVER = Shape(
    hubs_m=np.array([[0.3, 0.3, 0.0], [0.3, -0.3, 0.0], [-0.3, 0.3, 0.0], [-0.3, -0.3, 0.0]]),
    radius_m=0.2,
    width_m=0.12,
    box_centre_m=np.array([0.0, 0.0, 0.12]),
    box_size_m=np.array([0.9, 0.5, 0.25]),
)


def _vehicle(
    name: str, kind: str, points: np.ndarray, speed: float, start_s: float, time_s: np.ndarray
) -> VehicleRecord:
    position = _follow(points, speed, start_s, time_s)
    if kind == "skid_steer":
        position[:, 2] += 0.2
    velocity = np.gradient(position, time_s, axis=0)
    yaw = np.unwrap(np.arctan2(velocity[:, 1], np.where(np.abs(velocity[:, 0]) < 1e-6, 1e-6, velocity[:, 0])))
    tilt = 0.06 * (np.linalg.norm(velocity[:, :2], axis=1) > 0.1) * (kind == "multirotor")
    cy, sy, ct, st = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(tilt / 2), np.sin(tilt / 2)
    quaternion = np.stack([cy * ct, -sy * st, cy * st, sy * ct], -1)
    used = (time_s - time_s[0]) * (350.0 if kind == "multirotor" else 60.0) / 3600.0
    return VehicleRecord(
        name=name,
        type="tarot_t650" if kind == "multirotor" else "orpheus",
        kind=kind,
        time_s=time_s,
        position_m=position,
        quaternion=quaternion,
        velocity_m_s=velocity,
        energy_wh=used,
        battery_fraction=np.clip(1.0 - used / 110.0, 0.0, 1.0),
        crashed=False,
        shape=QUADROTOR if kind == "multirotor" else ROVER,
    )


def _samples(
    vehicles: tuple[VehicleRecord, ...], survey_end_s: float, rate_hz: float, activity: float, rng: np.random.Generator
) -> Samples:
    parts = []
    for index, vehicle in enumerate(vehicles):
        period = 1.0 / rate_hz if vehicle.flies else 1.0
        start, end = (0.0, survey_end_s) if vehicle.flies else (survey_end_s, vehicle.time_s[-1])
        time = start + period * np.arange(1, int((end - start) / period) + 1)
        position = np.stack([np.interp(time, vehicle.time_s, vehicle.position_m[:, k]) for k in range(3)], -1)
        counts = rng.poisson(rate_cps(position, activity, 1.0 if vehicle.flies else 1.78)).astype(float)
        exposure = np.ones_like(time)
        phase = np.full(len(time), "survey" if vehicle.flies else "search")
        parts.append((np.full(len(time), index, np.int32), phase, time, position, counts, exposure, counts / exposure))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(columns[2], kind="stable")
    return Samples(*(column[order] for column in columns))


def _spectrum(rng: np.random.Generator) -> Spectrum:
    energy = (np.arange(1024) + 0.5) * 3000.0 / 1024
    background = 40.0 * np.exp(-energy / 400.0) + 0.4
    signal = 18.0 * (energy < 1118.0) * (energy > 40.0)
    for line, height in ((1173.2, 45.0), (1332.5, 40.0)):
        sigma = 0.07 * np.sqrt(661.66 * line) / 2.355
        signal = signal + height * np.exp(-0.5 * ((energy - line) / sigma) ** 2)
    fit = background + signal
    return Spectrum(
        energy_kev=energy,
        counts=rng.poisson(fit).astype(float),
        background=background,
        fit=fit,
        live_time_s=80.0,
        nuclide="Co-60",
        confidence=0.9997,
        scores={"Co-60": 0.9997, "Na-22": 0.0003, "Cs-137": 0.0},
        lines_kev=np.array([1173.2, 1332.5]),
    )


def _map(cell_m: float, found: bool) -> RadiationMap:
    x, y = np.arange(-65.0, 65.1, cell_m), np.arange(-50.0, 50.1, cell_m)
    grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), 20.0)], -1)
    mean = rate_cps(grid.reshape(-1, 3), ACTIVITY_MBQ if found else 0.0).reshape(len(y), len(x))
    hotspots = SOURCE_M[None, :2] + 0.8 if found else np.zeros((0, 2))
    return RadiationMap(
        origin_m=np.array([x[0], y[0]]), cell_m=cell_m, mean_cps=mean, std_cps=np.sqrt(mean / 30.0), hotspots_m=hotspots
    )


def mission(found: bool = True, seed: int = 0, log_hz: float = 20.0, sample_hz: float = 10.8) -> MissionRecord:
    """A whole mission of about nine minutes; with ``found`` False there is no source, and nothing was found."""
    rng = np.random.default_rng(seed)
    paths = [_survey_path(k) for k in range(3)]
    survey_end = max(np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in paths) / 2.4 + 2.0
    route = _route()
    drive = np.linalg.norm(np.diff(route, axis=0), axis=1).sum() / 0.9 + 5.0 if found else 0.0
    time = np.arange(0.0, survey_end + drive, 1.0 / log_hz)
    vehicles = (
        *(_vehicle(f"uav{k + 1}", "multirotor", path, 2.4, 1.0, time) for k, path in enumerate(paths)),
        _vehicle("orpheus", "skid_steer", route, 0.9 if found else 0.0, survey_end + 1.0, time),
    )
    phases = (Phase("survey", "parallel_lines", (0, 1, 2), 0.0, survey_end, True),)
    if found:
        phases += (Phase("search", "approach_and_orbit", (3,), survey_end, survey_end + drive, True),)
    estimate = Estimate(
        position_m=SOURCE_M + np.array([0.12, -0.09, 0.2]),
        covariance_m2=np.array([[0.020, 0.006, 0.0], [0.006, 0.012, 0.0], [0.0, 0.0, 0.09]]),
        activity_mbq=166.0,
        activity_std_mbq=3.1,
        background_scale=1.01,
        nuclide="Co-60",
    )
    survey = dataclasses.replace(
        estimate,
        position_m=SOURCE_M + np.array([0.9, -0.6, -0.5]),
        covariance_m2=np.array([[1.9, 0.4, 0.0], [0.4, 1.6, 0.0], [0.0, 0.0, 0.25]]),
        activity_mbq=161.0,
        activity_std_mbq=9.0,
    )
    done = "had done its part of phase survey"
    return MissionRecord(
        name="synthetic",
        site="synthetic",
        seed=seed,
        phases=phases,
        vehicles=vehicles,
        samples=_samples(vehicles, survey_end, sample_hz, ACTIVITY_MBQ if found else 0.0, rng),
        sought="nuclide",
        map=_map(2.0, found),
        survey_estimate=survey if found else None,
        surveyed_s=survey_end,
        estimate=estimate if found else None,
        spectrum=_spectrum(rng) if found else None,
        sources=(TrueSource("Co-60", SOURCE_M, ACTIVITY_MBQ),) if found else (),
        paths_m={3: route} if found else {},
        events=tuple(Event(survey_end - 2.0 + 0.3 * k, f"uav{k + 1}", "finished", done) for k in range(3)),
        finding="Co-60 source found." if found else "No source above background.",
        status="located" if found else "none",
        covered=1.0,
        examined=0 if found else None,
    )


def swarm(count: int = 200, duration_s: float = 300.0, log_hz: float = 10.0) -> MissionRecord:
    """``count`` quadrotors without detectors, in circles of 3 to 60 m radius; nothing is sought."""
    time = np.arange(0.0, duration_s + 1e-9, 1.0 / log_hz)
    radius = np.linspace(3.0, 60.0, count)
    vehicles = []
    for k in range(count):
        angle = 2.0 * np.pi * k / count + 5.0 / radius[k] * time
        x, y = radius[k] * np.cos(angle), 0.8 * radius[k] * np.sin(angle)
        points = np.stack([x, y, 15.0 + 0.02 * x], -1)
        one = _vehicle(f"uav{k + 1}", "multirotor", points[:2], 1.0, 0.0, time)
        vehicles.append(dataclasses.replace(one, type="x500", position_m=points))
    nothing = np.zeros(0)
    return MissionRecord(
        name="swarm",
        site="synthetic",
        seed=0,
        phases=(Phase("cover", "parallel_lines", tuple(range(count)), 0.0, duration_s, True),),
        vehicles=tuple(vehicles),
        samples=Samples(np.zeros(0, np.int32), np.zeros(0, str), nothing, np.zeros((0, 3)), nothing, nothing, nothing),
        sought="nothing",
        map=None,
        survey_estimate=None,
        surveyed_s=duration_s,
        estimate=None,
        spectrum=None,
        sources=(),
        paths_m={},
        events=(),
        finding="nothing was sought",
    )


def forms(record: MissionRecord) -> MissionRecord:
    """The mission with a line, an area and a source on its rover in place of its source."""
    line = np.array([[-20.0, -30.0, 1.0], [0.0, -30.0, 1.0]])
    area = np.array([[30.0, 30.0, 1.0], [40.0, 30.0, 1.0], [40.0, 38.0, 1.0], [30.0, 38.0, 1.0]])
    rover = next(k for k, vehicle in enumerate(record.vehicles) if not vehicle.flies)
    offset = np.array([0.5, 0.0, 0.2])
    carrier = record.vehicles[rover]
    start = carried_m(carrier.position_m[:1], carrier.quaternion[:1], offset)[0]
    points = [corners.mean(axis=0) + 0.5 * (corners - corners.mean(axis=0)) for corners in (line, area)]
    sources = (
        TrueSource("Cs-137", line.mean(axis=0), 300.0, form="line", points_m=points[0], corners_m=line),
        TrueSource("I-131", area.mean(axis=0), 500.0, form="area", points_m=points[1], corners_m=area),
        TrueSource("F-18", start, 100.0, form="carried", carrier=rover, offset_m=offset),
    )
    return dataclasses.replace(record, sources=sources)
