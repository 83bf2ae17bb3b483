"""Sites of strangers, drawn at random: they import as they are, and no rover crosses a wall of the mesh."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from crossings import crossed, outline_crossed
from strangers import Stranger, draw, height_of, scan, with_holes, with_slab
from yards import spec, write_tiff

from swarmsim.config.errors import InputError
from swarmsim.config.load import load_all, load_named
from swarmsim.control.skid_steer import wheel_speeds
from swarmsim.physics.skid_steer import make_skid_steer_step, rest_state
from swarmsim.policies.waypoints import WaypointsPlanner
from swarmsim.site import ImportOptions, import_site
from swarmsim.site.importer import build
from swarmsim.site.material_guesses import guess, words
from swarmsim.site.traversability import at_centres
from swarmsim.vehicles.rover_body import rover_body
from swarmsim.vehicles.skid_steer import skid_steer_params
from tests.policies.assignments import assignment, situation

UTM = (447_213.0, 5_213_456.0, 300.0)
ROVERS, TICK_S, SAMPLE_TICKS, LEGS = 16, 0.005, 10, 5
WRITTEN = [
    ("obj", "X", 0.01),
    ("obj", "Y", 1.0),
    ("dae", "Y", 0.3048),
    ("dae", "X", 0.001),
    ("glb", "Y", 1.0),
    ("stl", "Z", 0.001),
]


def made(tmp_path, stranger, **more):
    """The site of a stranger's file, named as imported by hand."""
    path = stranger.write(tmp_path)
    options = ImportOptions(fields=stranger.fields() | more, preview=False, overwrite=True)
    return import_site(path, tmp_path / "site", options, tuple(load_all("materials")))


def walls_of(stranger, model):
    """Triangles [t, 3, 3] of all that stands on the ground, in the site's frame."""
    shift = np.array(stranger.shift_m) - model.report["shift_m"]
    standing = [mesh.triangles for name, mesh in stranger.meshes.items() if name not in ("terrain", "Cube")]
    return np.concatenate(standing) + shift


@pytest.mark.parametrize(("suffix", "up", "unit"), WRITTEN)
def test_the_ground_is_the_same_however_the_scene_is_written(tmp_path, suffix, up, unit):
    meshes = draw(np.random.default_rng(WRITTEN.index((suffix, up, unit))))
    far = UTM if suffix in ("obj", "dae") else (12.0, -7.0, 3.0)
    stranger = Stranger(meshes, unit, up, far, suffix)
    model = made(tmp_path, stranger)
    shift = np.array(far) - model.report["shift_m"]
    site = model.site
    assert np.abs(np.asarray(site.origin_m)).max() < 60.0
    rng = np.random.default_rng(0)
    for xy in rng.uniform(-12.0, 12.0, (40, 2)):
        column, row = np.rint((xy + shift[:2] - np.asarray(site.origin_m)) / 0.5).astype(int)
        assert site.terrain_m[row, column] == pytest.approx(height_of(meshes["terrain"], xy) + shift[2], abs=0.35)
    assert ("moved to the origin" in " ".join(model.report["warnings"])) == (far == UTM)


@pytest.mark.parametrize(("suffix", "height"), [("obj", 4000.25), ("dae", 1e7), ("glb", -2000.0)])
def test_a_scene_high_above_the_sea_is_moved_down(tmp_path, suffix, height):
    house = draw(np.random.default_rng(8))
    plain = made(tmp_path, Stranger(house, suffix=suffix))
    moved = made(tmp_path, Stranger(house, shift_m=(0.0, 0.0, height), suffix=suffix))
    up = moved.report["shift_m"][2]
    assert moved.report["shift_m"][:2] == [0.0, 0.0]
    assert np.abs(np.asarray(moved.site.terrain_m)).max() < 10.0
    np.testing.assert_allclose(moved.site.terrain_m, plain.site.terrain_m + (height - up), atol=2e-3)
    assert f"a height of 0 m is {up:.0f} m in the file" in " ".join(moved.report["warnings"])
    level = {"plane": {"margin_m": 5.0, "height_m": 4010.0}}
    alone = {"house": house["house"]}
    if suffix == "obj":
        planed = made(tmp_path, Stranger(alone, shift_m=(0.0, 0.0, 4010.0)), **level)
        assert planed.site.terrain_m == pytest.approx(4010.0 - planed.report["shift_m"][2])


def test_single_precision_far_from_the_origin_is_refused(tmp_path):
    stranger = Stranger(draw(np.random.default_rng(1)), shift_m=UTM, suffix="stl")
    with pytest.raises(InputError, match=r"rounded to 0\.5 m"):
        build(stranger.write(tmp_path), spec(file="stranger.stl"))


def test_a_slab_under_the_scene_is_no_ground(tmp_path):
    meshes = draw(np.random.default_rng(2))
    plain, on_slab = (made(tmp_path, Stranger(m, suffix="glb")) for m in (meshes, with_slab(meshes, 0.0, 3.0)))
    np.testing.assert_allclose(on_slab.site.terrain_m, plain.site.terrain_m, atol=0.02)
    assert any("slab under the scene" in warning for warning in on_slab.report["warnings"])
    assert on_slab.report["traversable_share"] > 0.8
    named = made(tmp_path, Stranger(with_slab(meshes, 0.0, 3.0), suffix="glb"), ground=["Cube"])
    assert float(named.site.terrain_m.max()) < float(plain.site.terrain_m.min())


def test_a_scan_with_holes_is_filled_and_told(tmp_path):
    model = made(tmp_path, Stranger({"scan": scan(np.random.default_rng(3))}))
    assert any("holes in the source" in warning for warning in model.report["warnings"])
    assert 0.5 < model.report["traversable_share"] < 0.99
    sparse = with_holes(draw(np.random.default_rng(4)), 0.4, np.random.default_rng(4))
    with pytest.raises(InputError, match="holes") as caught:
        made(tmp_path, Stranger(sparse))
    said = str(caught.value).split("--set holes_max=")[1].split(")")[0]
    assert made(tmp_path, Stranger(sparse), holes_max=float(said)).report["filled_cells"] > 0


def test_lines_beside_triangles_are_left_out(tmp_path):
    path = Stranger(draw(np.random.default_rng(5)), suffix="dae").write(tmp_path)
    text = path.read_text()
    head, tail = text.split("<triangles", 1)
    source = tail.split('source="', 1)[1].split('"', 1)[0]
    lines = f'<lines count="1"><input semantic="VERTEX" source="{source}" offset="0"/><p>0 1</p></lines>'
    path.write_text(head + lines + "<triangles" + tail)
    report = build(path, spec(file=path.name)).report
    assert any("1 sets of lines" in warning for warning in report["warnings"])


def test_a_building_alone_gets_level_ground(tmp_path):
    house = {"house": draw(np.random.default_rng(6))["house"].apply_translation((0.0, 0.0, 1.0))}
    model = made(tmp_path, Stranger(house, suffix="glb"), plane={"margin_m": 15.0})
    assert model.report["traversable_share"] > 0.8
    assert len(model.report["start_places_m"]) >= 4
    np.testing.assert_allclose(model.site.terrain_m, 0.0, atol=1e-6)


def test_walls_without_a_ground_are_told(tmp_path):
    """Their tops, and a flat roof, would be all of the site."""
    sizes = {
        "south": ((30.0, 0.4, 2.5), (0.0, -15.0)),
        "north": ((30.0, 0.4, 2.5), (0.0, 15.0)),
        "house": ((8.0, 6.0, 2.5), (3.0, 2.0)),
    }
    boxes = {
        name: trimesh.creation.box(size).apply_translation((*place, 1.25)) for name, (size, place) in sizes.items()
    }
    model = made(tmp_path, Stranger(boxes, suffix="glb"), holes_max=1.0)
    assert any("of the model's extent only" in warning for warning in model.report["warnings"])
    meshes = draw(np.random.default_rng(2))
    whole = made(tmp_path, Stranger(meshes, suffix="glb"))
    assert not any("of the model's extent only" in warning for warning in whole.report["warnings"])


def hills(*shape):
    north, east = np.mgrid[: shape[0], : shape[1]]
    return (900.0 + 6.0 * np.sin(east / 25.0) * np.cos(north / 20.0)).astype(np.float32)


@pytest.mark.parametrize("value", [-9999.0, -32768.0, 3.4028235e38, 1e20, 0.0, -500.0])
def test_no_data_that_the_file_does_not_declare(tmp_path, value):
    rows = hills(60, 80)
    rows[:5], rows[30:32, 40:43] = value, value
    write_tiff(tmp_path / "dem.tif", rows)
    raw = build(tmp_path / "dem.tif", spec(file="dem.tif", cell_m=5.0))
    assert (raw.report["filled_cells"], raw.report["outside_cells"]) == (6, 5 * 80)
    assert raw.report["relief_m"] < 13.0
    assert any("taken as no data" in warning for warning in raw.report["warnings"])


def test_lengths_are_those_on_the_ground_and_heights_have_their_unit(tmp_path):
    where = {"crs": "EPSG:3857", "transform": (2.0, 0.0, 1_096_000.0, 0.0, -2.0, 5_905_000.0)}
    from rasterio import Affine

    write_tiff(tmp_path / "web.tif", hills(60, 80), crs=where["crs"], transform=Affine(*where["transform"]))
    latitude = 2.0 * np.arctan(np.exp(5_904_940.0 / 6_378_137.0)) - 0.5 * np.pi
    raw = build(tmp_path / "web.tif", spec(file="web.tif", cell_m=1.0))
    assert raw.report["georeference"]["metres_per_projected_metre"] == pytest.approx(np.cos(latitude), rel=4e-3)
    assert any("EPSG:3857" in warning for warning in raw.report["warnings"])
    california = Affine(6.0, 0.0, 6_480_000.0, 0.0, -6.0, 1_840_000.0)
    write_tiff(tmp_path / "feet.tif", hills(60, 80) / 0.3048, crs="EPSG:2229", transform=california)
    feet = build(tmp_path / "feet.tif", spec(file="feet.tif", cell_m=1.8))
    metres = build(tmp_path / "feet.tif", spec(file="feet.tif", cell_m=1.8, height_unit_m=1.0))
    assert feet.report["relief_m"] == pytest.approx(0.3048 * metres.report["relief_m"], rel=1e-3)
    assert any("height_unit_m (--height-unit 1)" in warning for warning in feet.report["warnings"])
    assert feet.report["size_m"][0] == pytest.approx(80 * 6 * 0.3048, rel=0.02)


@pytest.mark.parametrize(
    ("name", "material", "wall_m"),
    [("MetalCorrugatedIronSheet002_3K", "steel", 0.001), ("WoodPlanksWorn33Red_3K", "wood", 0.025),
     ("tree_trunk", "wood", None),
     ("SolarPanelsPolycrystallineTypeBFramedClean001", "glass", 0.004), ("brick_house", "brick", 0.36),
     ("__auto_1", None, None), ("leader", None, None)],
)  # fmt: skip
def test_materials_are_guessed_from_names(name, material, wall_m):
    found = guess(name, load_all("materials"))
    assert (material, wall_m) == (None, None) if found is None else (found.material, found.wall_m) == (material, wall_m)


def test_a_solid_building_is_asked_about():
    materials = load_all("materials")
    assert str(guess("wooden_house", materials)) == "wooden_house: wood, solid: say wall_m if it is hollow"
    assert str(guess("tree_trunk", materials)).endswith("solid")
    assert str(guess("planks", materials)) == "planks: wood, 0.025 m"


def test_words_of_names():
    assert words("HTMLRoof_tiles02-RED") == ["html", "roof", "tiles", "red"]


def test_guesses_are_rules_of_the_site_and_what_is_not_known_is_told(tmp_path):
    model = made(tmp_path, Stranger(draw(np.random.default_rng(7))))
    assert {rule.material for rule in model.spec.obstacles} == {"wood", "brick"}
    assert all(any(name in said for said in model.report["guesses"]) for name in ("fence_wood_0", "brick_wall0"))
    told = " ".join(model.report["warnings"])
    assert "house" in told
    assert "concrete, in shells of 0.2 m" in told
    assert "fence_wood" not in told


@partial(jax.jit, static_argnames="engine")
def wander(site, params, start_m, yaw, key, engine):
    """Poses every `SAMPLE_TICKS` of rovers that drive about blindly."""
    step = make_skid_steer_step(engine, TICK_S)

    def leg(states, key):
        draws = jax.random.uniform(key, (2, ROVERS))
        speed = jnp.where(draws[0] < 0.2, -1.2, 1.5)
        turn = jnp.where(draws[1] < 0.5, 0.0, 6.0 * (draws[1] - 0.75))

        def tick(states, _):
            return jax.vmap(lambda s, v, w: step(params, s, wheel_speeds(params, v, w, s), site))(
                states, speed, turn
            ), None

        def sample(states, _):
            states = jax.lax.scan(tick, states, None, length=SAMPLE_TICKS)[0]
            return states, (states.body.position_m, states.body.quaternion)

        return jax.lax.scan(sample, states, None, length=40)

    states = jax.vmap(lambda p, y: rest_state(params, site, p, y))(start_m, yaw)
    return jax.lax.scan(leg, states, jax.random.split(key, LEGS))[1]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "engine"), [(0, "analytic"), (3, "analytic"), (1, "mjx")])
def test_no_rover_crosses_a_thin_wall(tmp_path, seed, engine):
    """A raster of half-metre cells let a third of them through."""
    stranger = Stranger(draw(np.random.default_rng(seed)), suffix="glb")
    model = made(tmp_path, stranger)
    kind = load_named("vehicles", "orpheus")
    rear, front, right, left = rover_body(kind).outline_m
    clear = at_centres(np.asarray(model.site.clearance_m), _grid(model.site))
    free = np.argwhere((clear > 0.7) & (clear < 2.5) & np.isfinite(model.site.cost))
    rng = np.random.default_rng(seed)
    start = np.asarray(model.site.origin_m) + 0.5 * free[rng.permutation(len(free))[:ROVERS], ::-1]
    yaw = rng.uniform(-np.pi, np.pi, ROVERS)
    given = jnp.asarray(start, jnp.float32), jnp.asarray(yaw, jnp.float32)
    positions, turns = wander(model.site, skid_steer_params(kind), *given, jax.random.key(seed), engine)
    position, q = np.asarray(positions, float).reshape(-1, ROVERS, 3), np.asarray(turns).reshape(-1, ROVERS, 4)
    heading = np.arctan2(2 * (q[..., 0] * q[..., 3] + q[..., 1] * q[..., 2]), 1 - 2 * (q[..., 2] ** 2 + q[..., 3] ** 2))
    walls = walls_of(stranger, model)
    half = np.array([min(front, -rear), min(left, -right)]) - 0.05
    for k in range(ROVERS):
        centre = position[:, k] + [0.0, 0.0, 0.2]
        assert not crossed(centre[:-1], centre[1:], walls).any()
        assert not outline_crossed(position[:, k], heading[:, k], half, walls, 0.2).any()
    assert np.linalg.norm(np.diff(position[..., :2], axis=0), axis=-1).sum(axis=0).mean() > 5.0


def _grid(site):
    from swarmsim.site.raster import Grid

    rows, columns = site.terrain_m.shape
    return Grid((0.0, 0.0), 0.5, rows, columns)


@pytest.mark.parametrize("seed", range(4))
def test_routes_lead_round_walls(tmp_path, seed):
    stranger = Stranger(draw(np.random.default_rng(seed)), suffix="glb")
    model = made(tmp_path, stranger)
    starts = model.report["start_places_m"]
    points = np.random.default_rng(seed).uniform(-10.0, 10.0, (6, 2)).tolist()
    planner = WaypointsPlanner()
    task = planner.task(assignment("waypoints", "orpheus", starts[:1], model.site, points=points, speed_m_s=1.0))
    path = jax.jit(planner.plan)(task, model.site, situation(starts[:1]))
    places = np.asarray(path.points_m[0], float) + np.array([0.0, 0.0, 0.3])
    assert float(path.length_m[0]) > 5.0
    assert not crossed(places[:-1], places[1:], walls_of(stranger, model)).any()
