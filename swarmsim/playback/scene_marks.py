"""Marks in the scene: true sources, estimates with their ellipsoids, hotspots, planned paths, colour legends."""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmsim.playback.blueprint import site_bounds
from swarmsim.playback.colours import DRIVEN, ESTIMATE, FLOWN, TRUTH, RateScale, measured_phases, rgba, scale_name
from swarmsim.playback.entities import TIMELINE, path_of, times
from swarmsim.playback.growing_map import raster_at
from swarmsim.playback.story import extent
from swarmsim.results.doubts import in_mbq
from swarmsim.results.finding import told_activity
from swarmsim.results.record import Estimate, MissionRecord, TrueSource
from swarmsim.site.model import SiteModel

CHI2_95_3 = 7.815  # 95 % quantile of chi-squared, 3 degrees of freedom (NIST/SEMATECH e-Handbook, table 1.3.6.7.4)
_ABOVE_GROUND_M = 0.5
_SURVEY_ESTIMATE = "#56B4E9"
_PATH, _HOTSPOT, _LABEL = [240, 240, 240, 255], [255, 255, 255, 255], [255, 255, 255, 255]


def send_sources(stream: rr.RecordingStream, record: MissionRecord, site_model: SiteModel) -> None:
    """Truth from the start; hotspots and the survey's estimate when they are made; the final estimate at the end."""
    for k, source in enumerate(record.sources):
        _send_truth(stream, f"truth/{k}", record, source)
    stream.set_time(TIMELINE, duration=float(record.surveyed_s))
    _send_hotspots(stream, record, site_model)
    for k, one in enumerate(record.survey_estimates):
        _estimate(stream, f"estimate/survey/{k}", one, "survey", _SURVEY_ESTIMATE)
    stream.set_time(TIMELINE, duration=float(record.end_s))
    for k, one in enumerate(record.estimates):
        _estimate(stream, f"estimate/final/{k}", one, "final", ESTIMATE)
    if record.estimates:
        # The first guess has served; two pins a metre apart only hide each other.
        for k in range(len(record.survey_estimates)):
            stream.log(f"world/estimate/survey/{k}/pin", rr.Clear(recursive=True))
            stream.log(f"world/labels/estimate/survey/{k}", rr.Clear(recursive=True))
    stream.reset_time()


def _send_truth(stream: rr.RecordingStream, path: str, record: MissionRecord, source: TrueSource) -> None:
    """A pin: at a point, at the centre of a line or an area with its outline, or going with its vehicle."""
    label = f"true {source.nuclide}, {in_mbq(source.activity_mbq)}"
    if source.carrier is not None:
        carrier = record.vehicles[source.carrier]
        _pin(stream, path, np.zeros(3), 7.0, f"{label}, on {carrier.name}", TRUTH, static=True)
        time_s, track = np.asarray(carrier.time_s, float), record.track_of(source)
        if len(time_s) and time_s[0] > record.start_s:  # it waits where it will start
            time_s, track = np.r_[record.start_s, time_s], np.concatenate([track[:1], track])
        for entity in (f"world/{path}/pin", f"world/labels/{path}"):
            stream.send_columns(entity, times(time_s), rr.Transform3D.columns(translation=track))
        return
    if source.corners_m is not None and source.points_m is not None:
        label, corners = f"{label}, {extent(source)}", np.asarray(source.corners_m, float)
        ring = corners if source.form == "line" else np.concatenate([corners, corners[:1]])
        paint = [rgba(TRUTH)]
        outline = rr.LineStrips3D([ring], colors=paint, radii=rr.Radius.ui_points(1.5))
        stream.log(f"world/{path}/outline", outline, static=True)
        # The outline cuts through uneven ground; the points lie on it.
        dots = rr.Points3D(source.points_m, radii=rr.Radius.ui_points(1.5), colors=paint)
        stream.log(f"world/{path}/points", dots, static=True)
    _pin(stream, path, source.position_m, 7.0, label, TRUTH, static=True)


def _send_hotspots(stream: rr.RecordingStream, record: MissionRecord, site_model: SiteModel) -> None:
    """A ring round each hotspot of the map."""
    if record.map is None or not len(record.map.hotspots_m):
        return
    x, y = record.map.hotspots_m.T
    z = raster_at(np.asarray(site_model.site.terrain_m), site_model.site, x, y) + _ABOVE_GROUND_M
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    ring = 2.5 * np.stack([np.cos(angle), np.sin(angle), np.zeros(40)], -1)
    rings = list(np.stack([x, y, z], -1)[:, None] + ring)
    stream.log("world/hotspots", rr.LineStrips3D(rings, colors=[_HOTSPOT], radii=rr.Radius.ui_points(1.5)))


def send_paths(stream: rr.RecordingStream, record: MissionRecord) -> None:
    """The planned path of each rover, from the beginning of its last phase; those of UAVs would hide the site."""
    for number, points in record.paths_m.items():
        starts = [phase.start_s for phase in record.phases if number in phase.vehicles]
        if record.vehicles[number].flies or len(points) < 2 or not starts:
            continue
        stream.set_time(TIMELINE, duration=float(max(starts)))
        lifted = np.asarray(points, float) + np.array([0.0, 0.0, _ABOVE_GROUND_M])
        # Thinner than the samples taken along it, which it would hide.
        path = rr.LineStrips3D([lifted], colors=[_PATH], radii=rr.Radius.ui_points(0.6))
        stream.log(path_of("world/paths", record.vehicles[number].name), path)
    stream.reset_time()


def _pin(
    stream: rr.RecordingStream,
    path: str,
    position_m: NDArray[np.floating],
    height_m: float,
    label: str,
    colour: str,
    static: bool,
) -> None:
    """A point with a mast and a label on top, so that it is found from afar and behind buildings."""
    top = np.asarray(position_m, float) + np.array([0.0, 0.0, height_m])
    paint = [rgba(colour)]
    mast = rr.LineStrips3D([[position_m, top]], colors=paint, radii=rr.Radius.ui_points(1.5))
    stream.log(f"world/{path}/pin/mast", mast, static=static)
    stream.log(f"world/{path}/pin/place", rr.Points3D([position_m], radii=[0.4], colors=paint), static=static)
    stream.log(
        f"world/{path}/pin/head", rr.Points3D([top], radii=rr.Radius.ui_points(4.0), colors=paint), static=static
    )
    label_point = rr.Points3D([top], radii=rr.Radius.ui_points(0.5), colors=[_LABEL], labels=[label], show_labels=True)
    stream.log(f"world/labels/{path}", label_point, static=static)


def _estimate(stream: rr.RecordingStream, path: str, estimate: Estimate, name: str, colour: str) -> None:
    if estimate.errors_known:
        half_sizes, quaternion = ellipsoid(estimate.covariance_m2)
        stream.log(
            f"world/{path}/ellipsoid",
            rr.Ellipsoids3D(
                centers=[estimate.position_m],
                half_sizes=[half_sizes],
                quaternions=[rr.Quaternion(xyzw=quaternion)],
                colors=[rgba(colour, 110)],
                fill_mode="solid",
            ),
        )
    label = f"{name} estimate, {told_activity(estimate)}"
    _pin(stream, path, estimate.position_m, 15.0, label, colour, static=False)


def in_cps(rate_cps: float) -> str:
    """A count rate in words, with three digits at least: a Geiger counter shows a few counts a second."""
    return f"{rate_cps:.0f} cps" if rate_cps >= 100.0 else f"{rate_cps:.3g} cps"


def ellipsoid(covariance_m2: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Half sizes [3] in m and turn [4] (x y z w) of the ellipsoid that holds 95 % of a normal distribution."""
    variances, axes = np.linalg.eigh(np.asarray(covariance_m2, float))
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0  # a rotation, not a reflection
    return np.sqrt(CHI2_95_3 * np.maximum(variances, 0.0)), quaternion_of(axes)


def quaternion_of(matrix: NDArray[np.floating]) -> NDArray[np.floating]:
    """Quaternion [4] (x y z w) of a rotation matrix [3, 3], by Bar-Itzhack (J. Guidance 23, 2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(matrix, float)
    k = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    return np.linalg.eigh(k / 3.0)[1][:, -1]


def send_legend(
    stream: rr.RecordingStream, record: MissionRecord, site_model: SiteModel, scales: dict[str, RateScale]
) -> None:
    """A bar of coloured blocks with count rates at its ends, along the site's south edge, for each colour scale."""
    low, high = site_bounds(site_model)
    length, count = 0.30 * (high[0] - low[0]), 16
    block = length / count
    for row, (name, scale) in enumerate(scales.items()):
        rates = np.asarray(scale.norm.inverse(np.linspace(0.0, 1.0, count)), float)
        start = np.array([low[0] + (0.1 + 0.5 * row) * (high[0] - low[0]), low[1] - 2.5 * block, low[2]])
        centres = start + np.arange(count)[:, None] * [block, 0.0, 0.0]
        stream.log(
            f"world/legend/{name}/scale",
            rr.Boxes3D(
                centers=centres, half_sizes=[[0.5 * block] * 2 + [0.05]], colors=scale(rates), fill_mode="solid"
            ),
            static=True,
        )
        stream.log(
            f"world/legend/{name}/ends",
            rr.Points3D(
                centres[[0, -1]],
                radii=rr.Radius.ui_points(0.5),
                colors=[_LABEL],
                labels=[f"{_legend_title(record, name)}: {in_cps(rates[0])}", in_cps(rates[-1])],
                show_labels=True,
            ),
            static=True,
        )


def _legend_title(record: MissionRecord, name: str) -> str:
    if name == DRIVEN:
        return "ground"
    return "air" if any(scale_name(record, phase) == FLOWN for phase in measured_phases(record)) else "map"
