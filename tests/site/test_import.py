"""Meshes and elevation models to rasters and boxes."""

import time

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import map_coordinates
from yards import (
    MATERIALS,
    PLATE_OBJ,
    TO_X_UP,
    TO_Y_UP,
    block,
    ground_plate,
    prism,
    ring,
    spec,
    write_collada,
    write_tiff,
    yard,
)

from swarmsim.config.errors import InputError
from swarmsim.site import ImportOptions, import_site, load_site
from swarmsim.site.importer import build
from swarmsim.site.model import VisualMesh
from swarmsim.site.raster import Grid, edges_on, faces_on, highest
from swarmsim.site.traversability import at_centres


def built(tmp_path, scene, name="yard.glb", turn=None, scale=1.0, **fields):
    """The scene, written as ``name`` with its axes turned and scaled, and imported."""
    written = scene.copy()
    turn = TO_Y_UP if turn is None and name.endswith(".glb") else np.eye(4) if turn is None else turn
    written.apply_transform(np.diag([scale, scale, scale, 1.0]) @ turn)
    path = tmp_path / name
    written.export(path)
    return build(path, spec(file=name, **fields))


def clear(raw):
    """Clearance [ny, nx] at the centres of the cells."""
    return at_centres(raw.clearance, raw.grid)


def check_yard(raw):
    """The house and the post of `sites.yard`, where and as large as they are."""
    assert (raw.grid.nx, raw.grid.ny) == (80, 60)
    assert raw.grid.origin == pytest.approx((-19.75, -14.75), abs=1e-3)
    np.testing.assert_allclose(raw.terrain, 0.0, atol=1e-3)
    house, post = sorted(raw.boxes, key=lambda box: -box.volume)
    assert house.centre == pytest.approx((5, 3, 2.5), abs=0.01)
    assert house.half == pytest.approx((4, 3, 2.5), abs=0.01)
    assert house.axis == pytest.approx((np.cos(0.3), np.sin(0.3)), abs=1e-3)
    assert post.centre == pytest.approx((-10, -5, 1.5), abs=0.01)
    column, row = raw.grid.cell_of(np.array([5.0, 3.0])) % 80, raw.grid.cell_of(np.array([5.0, 3.0])) // 80
    assert raw.surface[row, column] == pytest.approx(5.0, abs=1e-3)
    assert clear(raw)[row, column] == pytest.approx(-3.0, abs=0.3)


@pytest.mark.parametrize("suffix", ["glb", "obj", "stl"])
def test_formats(tmp_path, suffix):
    check_yard(built(tmp_path, yard(), f"yard.{suffix}"))


@pytest.mark.parametrize(("unit", "scale"), [(0.01, 100.0), (0.3048, 1 / 0.3048)])
def test_unit_is_applied(tmp_path, unit, scale):
    check_yard(built(tmp_path, yard(), "yard.stl", scale=scale, unit_m=unit))


@pytest.mark.parametrize(("axis", "turn"), [("Y", TO_Y_UP), ("X", TO_X_UP), ("Z", np.eye(4))])
def test_up_axis_is_applied(tmp_path, axis, turn):
    check_yard(built(tmp_path, yard(), "yard.obj", turn=turn, up_axis=axis))


@pytest.mark.parametrize(("axis", "turn"), [("Y_UP", TO_Y_UP), ("X_UP", TO_X_UP), ("Z_UP", np.eye(4))])
def test_collada_says_its_unit_and_axis(tmp_path, axis, turn):
    parts = {}
    for name, mesh in yard().geometry.items():
        parts[name, "stone"] = mesh.copy().apply_transform(turn).triangles * 1000.0
    path = tmp_path / "yard.dae"
    write_collada(path, parts, {"stone": (0.5, 0.25, 0.75)})
    text = path.read_text().replace('name="meter" meter="1"', 'name="millimeter" meter="0.001"')
    path.write_text(text.replace("Z_UP", axis))
    raw = build(path, spec(file="yard.dae"))
    check_yard(raw)
    assert {tuple(c) for c in raw.mesh.colours.tolist()} == {(128, 64, 191, 255)}


def test_slope_and_its_cost(tmp_path):
    raw = built(tmp_path, yard(slope=np.tan(np.radians(10))))
    x = raw.grid.centres[..., 0]
    np.testing.assert_allclose(raw.terrain, np.tan(np.radians(10)) * x, atol=2e-3)
    far = clear(raw) > 4.0
    tangent = (np.tan(np.radians(10)) / np.tan(np.radians(20))) ** 2
    np.testing.assert_allclose(raw.cost[far], 1 + 2 * tangent, rtol=1e-2)
    steep = built(tmp_path, yard(slope=np.tan(np.radians(25))))
    assert np.isinf(steep.cost).all()
    assert any("rover cannot drive" in warning for warning in steep.report["warnings"])


def test_named_ground_materials_and_shells(tmp_path):
    raw = built(
        tmp_path, yard(), ground=["PLATE"],
        obstacles=[{"match": "hou*", "material": "brick", "wall_m": 0.3}, {"match": "post", "material": "wood"}],
    )  # fmt: skip
    check_yard(raw)
    by_name = dict(zip(raw.box_materials, raw.boxes, strict=True))
    assert by_name["brick"].wall == 0.3
    assert by_name["wood"].wall == 0.0


def test_one_fused_surface_is_told_apart(tmp_path):
    """A photogrammetric surface: the house is a bump of the one sheet."""
    x, y = np.meshgrid(np.linspace(-20, 20, 161), np.linspace(-15, 15, 121))
    z = 0.05 * x + np.where((np.abs(x - 4) < 4) & (np.abs(y) < 3), 5.0, 0.0)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    mesh = trimesh.Trimesh(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), faces, process=False)
    raw = built(tmp_path, trimesh.Scene(mesh), "scan.stl")
    np.testing.assert_allclose(raw.terrain, 0.05 * raw.grid.centres[..., 0], atol=0.05)
    biggest = max(raw.boxes, key=lambda box: box.volume)
    assert biggest.half[:2] == pytest.approx((4, 3), abs=0.3)
    assert raw.surface.max() == pytest.approx(5.4, abs=0.1)


def test_open_ring_becomes_four_walls(tmp_path):
    pen = ring((10, 8, 2), 0.2).apply_translation((2, 1, 0))
    scene = trimesh.Scene()
    scene.add_geometry(ground_plate(), geom_name="plate")
    scene.add_geometry(pen, geom_name="pen")
    raw = built(tmp_path, scene)
    assert len(raw.boxes) == 4
    np.testing.assert_allclose([min(box.half[:2]) for box in raw.boxes], 0.1, atol=0.01)
    assert sum(box.volume for box in raw.boxes) == pytest.approx(pen.volume, rel=0.03)


def test_l_shape_is_split_and_tiny_things_only_count_in_the_rasters(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(ground_plate(), geom_name="plate")
    building = prism([[-6, -2], [6, -2], [6, 2], [-2, 2], [-2, 10], [-6, 10]], 3.0)
    scene.add_geometry(building, geom_name="building")
    scene.add_geometry(block((0.4, 0.4, 0.25), (12, -10, 0.125)), geom_name="brick")
    raw = built(tmp_path, scene)
    assert len(raw.boxes) == 2
    assert sum(box.volume for box in raw.boxes) == pytest.approx(building.volume, rel=0.03)
    cell = np.unravel_index(raw.grid.cell_of(np.array([12.0, -10.0])), raw.terrain.shape)
    assert raw.surface[cell] == pytest.approx(0.25, abs=1e-6)
    assert clear(raw)[cell] < 0.1


def test_crown_above_a_rover_does_not_stop_it_but_its_trunk_does(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(ground_plate(), geom_name="plate")
    scene.add_geometry(block((0.3, 0.3, 2.0), (0, 0, 1.0)), geom_name="trunk")
    scene.add_geometry(block((4, 4, 3), (0, 0, 3.5)), geom_name="crown")
    scene.add_geometry(block((1.0, 1.0, 0.1), (10, 0, 0.05)), geom_name="kerb")
    scene.add_geometry(block((2.0, 2.0, 0.8), (-10, 0, 0.4)), geom_name="grass")
    raw = built(tmp_path, scene, obstacles=[{"match": "grass", "material": "vegetation", "traversable": True}])
    at = {
        x: clear(raw)[np.unravel_index(raw.grid.cell_of(np.array([x, 0.25])), raw.terrain.shape)]
        for x in (0.25, 1.25, 10.25, -9.75)
    }
    assert at[0.25] < 0.2
    assert at[1.25] == pytest.approx(1.1, abs=0.2)
    assert at[10.25] > 5.0
    assert at[-9.75] > 5.0


def test_surface_sampled_anywhere_is_not_below_the_mesh(tmp_path):
    scene = yard()
    raw = built(tmp_path, scene)
    points = np.random.default_rng(0).uniform([-19, -14], [19, 14], (4000, 2))
    grid = raw.grid
    true = np.array([0.0])
    for mesh in scene.geometry.values():
        fine = Grid((-19.95, -14.95), 0.1, 300, 400)
        top = highest(fine, faces_on(fine, mesh.triangles), -np.inf)
        place = fine.place(points)
        true = np.maximum(true, top[np.rint(place[:, 1]).astype(int), np.rint(place[:, 0]).astype(int)])
    at = grid.place(
        np.stack([fine.origin[0] + 0.1 * np.rint(place[:, 0]), fine.origin[1] + 0.1 * np.rint(place[:, 1])], -1)
    )
    surface = map_coordinates(raw.surface, [at[:, 1], at[:, 0]], order=1)
    assert (surface >= true - 1e-3).all()
    open_ground = clear(raw) > 1.5
    np.testing.assert_array_equal(raw.surface[open_ground], raw.terrain[open_ground])


def test_zone_bars_the_rover(tmp_path):
    raw = built(tmp_path, yard(), zones=[{"name": "pond", "polygon_m": [[-18, 5], [-12, 5], [-12, 11], [-18, 11]]}])
    inside = np.unravel_index(raw.grid.cell_of(np.array([-15.0, 8.0])), raw.terrain.shape)
    assert clear(raw)[inside] == pytest.approx(-3.0, abs=0.3)
    assert np.isinf(raw.cost[inside])


def test_small_hole_is_filled_and_reported(tmp_path):
    plate = ground_plate(slope=0.1)
    middle = plate.triangles_center
    plate.update_faces(~((np.abs(middle[:, 0] + 5) < 1) & (np.abs(middle[:, 1] - 3) < 1)))
    raw = built(tmp_path, trimesh.Scene({"plate": plate}))
    assert 0 < raw.report["filled_cells"] < 60
    assert any("filled by interpolation" in warning for warning in raw.report["warnings"])
    np.testing.assert_allclose(raw.terrain, 0.1 * raw.grid.centres[..., 0], atol=1e-2)


def test_round_outline_is_outside_and_surveyed_within(tmp_path):
    disc = trimesh.creation.cylinder(radius=20.0, height=0.01, sections=64)
    raw = built(tmp_path, trimesh.Scene({"disc": disc}))
    assert raw.report["outside_cells"] > 500
    assert len(raw.survey_area) <= 32
    radius = np.linalg.norm(raw.survey_area, axis=1)
    assert radius.max() < 20.0
    assert radius.min() > 17.0
    assert clear(raw)[0, 0] < 0.0


def test_geotiff_rows_run_north_to_south(tmp_path):
    """Height grows to the north and east; row 0 of the file is the north edge."""
    north = np.linspace(20.0, 0.0, 41)[:, None]
    rows = (1000.0 + 0.1 * 5.0 * north + 0.02 * 5.0 * np.arange(61)).astype(np.float32)
    write_tiff(tmp_path / "dem.tif", rows)
    picture = np.zeros((3, 41, 61), np.uint8)
    picture[0, :20] = 200  # the north is red
    write_tiff(tmp_path / "photo.tif", picture, count=3)
    raw = build(tmp_path / "dem.tif", spec(file="dem.tif", cell_m=5.0, orthophoto="photo.tif"))
    assert raw.terrain.shape == (41, 61)
    x, y = raw.grid.centres[..., 0], raw.grid.centres[..., 1]
    np.testing.assert_allclose(raw.terrain, 0.02 * x + 0.05 * y, atol=2e-3)
    reference = raw.report["georeference"]
    assert reference["easting_m"] == pytest.approx(500_000 + 152.5)
    assert reference["northing_m"] == pytest.approx(5_200_000 - 102.5)
    red = raw.mesh.colours[:, 0] == 200
    assert raw.mesh.vertices_m[red, 1].min() > -10.0
    finer = build(tmp_path / "dem.tif", spec(file="dem.tif", cell_m=2.0))
    np.testing.assert_allclose(
        finer.terrain[2:-2, 2:-2],
        (0.02 * finer.grid.centres[..., 0] + 0.05 * finer.grid.centres[..., 1])[2:-2, 2:-2],
        atol=2e-3,
    )


def test_visual_mesh_is_thinned(tmp_path):
    raw = built(tmp_path, trimesh.Scene({"plate": ground_plate(pieces=150)}))
    assert isinstance(raw.mesh, VisualMesh)
    assert 1000 < len(raw.mesh.triangles) <= 30_000
    assert raw.mesh.triangles.max() < len(raw.mesh.vertices_m)
    np.testing.assert_allclose(np.ptp(raw.mesh.vertices_m, axis=0)[:2], [40, 30], atol=0.5)


def test_import_site_writes_all_or_nothing(tmp_path):
    scene = yard()
    scene.apply_transform(TO_Y_UP)
    scene.export(tmp_path / "yard.glb")
    out = tmp_path / "sites" / "my_yard"
    options = ImportOptions(licence="mine", fields={"ground": ["plate"]})
    model = import_site(tmp_path / "yard.glb", out, options, MATERIALS)
    assert sorted(p.name for p in out.iterdir()) == ["preview.png", "site.yaml", "yard.glb"]
    again = load_site(out, MATERIALS)
    assert again.name == "my_yard"
    np.testing.assert_array_equal(again.site.terrain_m, model.site.terrain_m)
    with pytest.raises(InputError, match="something already"):
        import_site(tmp_path / "yard.glb", out, options, MATERIALS)
    import_site(tmp_path / "yard.glb", out, ImportOptions(overwrite=True, preview=False), MATERIALS)
    assert not (out / "preview.png").exists()
    with pytest.raises(InputError, match=r"^\S*yard.glb ground: .*matches 'lawn'") as caught:
        import_site(
            tmp_path / "yard.glb", tmp_path / "sites" / "other", ImportOptions(fields={"ground": ["lawn"]}), MATERIALS
        )
    assert caught.value.problems[0].file == str(tmp_path / "yard.glb")
    assert [p.name for p in (tmp_path / "sites").iterdir()] == ["my_yard"]


def test_damaged_cache_is_made_anew(tmp_path, own_cache):
    scene = yard()
    scene.apply_transform(TO_Y_UP)
    scene.export(tmp_path / "yard.glb")
    out = tmp_path / "my_yard"
    first = import_site(tmp_path / "yard.glb", out, ImportOptions(preview=False), MATERIALS)
    entries = list(own_cache.rglob("my_yard-*.npz"))
    assert len(entries) == 1
    good = entries[0].read_bytes()
    for damage in (b"", good[: len(good) // 2], b"nonsense"):
        entries[0].write_bytes(damage)
        model = load_site(out, MATERIALS)
        np.testing.assert_array_equal(model.site.clearance_m, first.site.clearance_m)
        assert len(entries[0].read_bytes()) == len(good)


def test_edges_reach_the_cells_that_thin_walls_stand_in():
    grid = Grid((0.5, 0.5), 1.0, 4, 6)
    wall = np.array([[[1.2, 2.5, 0.0], [4.7, 2.5, 0.0], [4.7, 2.5, 2.0]]])
    assert len(faces_on(grid, wall).cell) == 0
    top = highest(grid, edges_on(grid, wall), 0.0)
    np.testing.assert_array_equal(top[2] > 0, [False, True, True, True, True, False])


def test_collada_vertex_colours_are_kept(tmp_path):
    """A copy of the writer's mesh with one more input: a colour for every vertex."""
    path = tmp_path / "plate.dae"
    write_collada(path, {("plate", "stone"): ground_plate(pieces=4).triangles}, {"stone": (0.5, 0.5, 0.5)})
    text = path.read_text()
    source = (
        '<source id="shade"><float_array id="shades" count="3">1 0.2 0</float_array><technique_common>'
        '<accessor source="#shades" count="1" stride="3"><param name="R" type="float"/><param name="G" type="float"/>'
        '<param name="B" type="float"/></accessor></technique_common></source><vertices'
    )
    text = text.replace("<vertices", source).replace("<p>", '<input semantic="COLOR" source="#shade" offset="1"/><p>')
    head, index = text.split("<p>")
    corners, tail = index.split("</p>")
    path.write_text(head + "<p>" + " ".join(f"{i} 0" for i in corners.split()) + "</p>" + tail)
    raw = build(path, spec(file="plate.dae"))
    assert {tuple(c) for c in raw.mesh.colours.tolist()} == {(255, 51, 0, 255)}


def test_trimesh_colours_are_kept(tmp_path):
    scene = yard()
    scene.geometry["house"].visual.face_colors = [200, 60, 40, 255]
    raw = built(tmp_path, scene)
    colours = {tuple(c) for c in raw.mesh.colours.tolist()}
    assert (200, 60, 40, 255) in colours
    assert len(colours) == 3


@pytest.mark.parametrize(("side", "room"), [(200.0, 5.0), (40.0, 2.0)])
def test_lines_over_a_site_end_where_a_vehicle_can_stop_before_the_fence(tmp_path, side, room):
    plate = trimesh.creation.box(extents=(side, side, 0.01))
    area = built(tmp_path, trimesh.Scene({"plate": plate})).survey_area
    assert np.all(np.abs(0.5 * side - np.abs(area) - room) < 1.1)  # to a cell


def test_numbers_of_an_obj_count_back_from_where_they_stand(tmp_path):
    text = PLATE_OBJ.replace("f 1 2 3", "f -4 -3 \\\n -2 # half").replace("f 1 3 4", "\tf -4 -2 -1")
    (tmp_path / "plate.obj").write_text(text + "v 0 0 9\nv 1 0 9\nv 0 1 9\nf -3 -2 -1\n")
    raw = build(tmp_path / "plate.obj", spec(file="plate.obj"))
    assert raw.report["area_m2"] == pytest.approx(1600.0)
    assert raw.terrain == pytest.approx(0.0)


def test_many_slivers_are_found_row_by_row():
    grid = Grid((0.5, 0.5), 1.0, 100, 100)
    x = np.linspace(0.0, 99.0, 8001)
    slivers = np.stack([np.stack([x[:-1], 0 * x[1:], x[1:]], -1), np.stack([x[1:], 0 * x[1:] + 100.0, x[1:]], -1)], 1)
    corners = np.concatenate([slivers, slivers[:, :1] + [[1e-3, 0.0, 0.0]]], axis=1)
    corners[:, 1, 0] = 99.0 - corners[:, 1, 0]
    started = time.process_time()
    hits = faces_on(grid, corners)
    assert time.process_time() - started < 2.0
    column, row = hits.cell % 100 + 0.5, hits.cell // 100 + 0.5
    share = row / 100.0
    assert len(hits.cell) > 300
    np.testing.assert_allclose(column, x[hits.triangle] + share * (99.0 - x[1:] - x[:-1])[hits.triangle], atol=0.02)


def test_textures_are_made_small_and_those_too_large_left_out(tmp_path, monkeypatch):
    square = trimesh.Trimesh([[-20, 0, 20], [20, 0, 20], [20, 0, -20], [-20, 0, -20]], [[0, 1, 2], [0, 2, 3]])
    picture = Image.new("RGB", (3000, 2000), (200, 10, 10))
    square.visual = trimesh.visual.TextureVisuals(uv=np.eye(4)[:, :2], image=picture)
    trimesh.Scene(square).export(tmp_path / "plate.glb")
    coloured = build(tmp_path / "plate.glb", spec(file="plate.glb")).mesh.colours
    assert {tuple(c) for c in coloured.tolist()} == {(200, 10, 10, 255)}
    monkeypatch.setattr("swarmsim.site.trimesh_parts.PIXELS_MAX", 5_999_999)
    plain = build(tmp_path / "plate.glb", spec(file="plate.glb")).mesh.colours
    assert (200, 10, 10, 255) not in {tuple(c) for c in plain.tolist()}
