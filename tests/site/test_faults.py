"""What a user hears when a file or a specification cannot be a site."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rasterio.transform import Affine
from yards import MATERIALS, TO_Y_UP, ground_plate, refused, spec, write_tiff, yard

from swarmsim.config.errors import InputError
from swarmsim.site import ImportOptions, collada_reader, import_site, load_site
from swarmsim.site.importer import build


def test_missing_file_names_the_nearest(tmp_path):
    (tmp_path / "yard.glb").write_bytes(b"x")
    refused(tmp_path / "yrad.glb", ["no such file", "did you mean 'yard.glb'"])


@pytest.mark.parametrize("suffix", ["dae", "obj", "glb", "stl", "tif"])
def test_empty_file(tmp_path, suffix):
    path = tmp_path / f"yard.{suffix}"
    path.write_bytes(b"")
    refused(path, ["empty", str(path)])


@pytest.mark.parametrize("suffix", ["dae", "obj", "glb", "stl", "tif"])
@pytest.mark.parametrize("content", [b"\x00\x01\xffnot a mesh" * 50, b"<?xml version='1.0'?><COLLADA><broken"])
def test_corrupt_file(tmp_path, suffix, content):
    path = tmp_path / f"yard.{suffix}"
    path.write_bytes(content)
    refused(path, [str(path)])


def test_truncated_files(tmp_path):
    yard().export(tmp_path / "whole.glb")
    (tmp_path / "half.glb").write_bytes((tmp_path / "whole.glb").read_bytes()[:600])
    refused(tmp_path / "half.glb", ["half.glb"])


def test_unknown_suffix(tmp_path):
    path = tmp_path / "yard.fbx"
    path.write_bytes(b"x")
    refused(path, [".fbx", ".dae", ".glb", "export"])


def test_file_of_200_mb(tmp_path):
    path = tmp_path / "huge.stl"
    with path.open("wb") as file:
        file.truncate(200_000_000)  # sparse: takes no room
    refused(path, ["200 MB", "at most 100 MB", "decimate", "max_file_mb"])
    with pytest.raises(InputError, match="200 MB"):
        import_site(path, tmp_path / "out", material_names=MATERIALS)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("scale", "word"), [(50.0, "huge"), (0.05, "tiny"), (1000.0, "huge")])
def test_wrong_unit(tmp_path, scale, word):
    scene = yard()
    scene.apply_scale(scale)
    scene.export(tmp_path / "yard.stl")
    refused(tmp_path / "yard.stl", [word, "unit_m", "extent_m"])


def test_wrong_up_axis(tmp_path):
    scene = yard()
    scene.apply_transform(TO_Y_UP)
    scene.export(tmp_path / "yard.stl")
    refused(tmp_path / "yard.stl", ["stands on its edge", "up_axis"])


def test_no_triangles(tmp_path):
    path = tmp_path / "points.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    refused(path, ["points.obj"])


def test_vertices_that_are_not_numbers(tmp_path):
    path = tmp_path / "bad.obj"
    path.write_text("v 0 0 0\nv 40 0 nan\nv 0 40 0\nf 1 2 3\n")
    refused(path, ["bad.obj"])


def test_many_holes(tmp_path):
    plate = ground_plate()
    middle = plate.triangles_center
    plate.update_faces((np.abs(middle[:, 0]) > 10) | (np.abs(middle[:, 1]) > 10))
    trimesh.Scene(plate).export(tmp_path / "holes.stl")
    refused(tmp_path / "holes.stl", ["holes", "holes_max", "holes.stl"])
    raw = build(tmp_path / "holes.stl", spec(file="holes.stl", holes_max=0.5))
    assert raw.report["filled_cells"] > 1000


def test_misspelt_pattern_lists_the_names(tmp_path):
    yard().export(tmp_path / "yard.glb")
    text = refused(tmp_path / "yard.glb", ["'hause'", "did you mean 'house'"], up_axis="Z", ground=["lawn"], obstacles=[
        {"match": "hause", "material": "brick"}])  # fmt: skip
    assert "'lawn'" in text
    assert "plate" in text


@pytest.mark.parametrize(
    ("polygon", "words"),
    [([[-5, -5], [5, -5], [0, 0], [5, 5], [-5, 5]], "not convex"), ([[-5, -5], [5, 5], [5, -5], [-5, 5]], "not convex"),
     ([[0, 0], [1, 1], [2, 2]], "no area"), ([[-5, -5], [500, -5], [0, 5]], "beyond the site")],
)  # fmt: skip
def test_survey_area(tmp_path, polygon, words):
    yard().export(tmp_path / "yard.stl")
    options = ImportOptions(fields={"survey_area_m": polygon})
    with pytest.raises(InputError, match=words) as caught:
        import_site(tmp_path / "yard.stl", tmp_path / "out", options, MATERIALS)
    assert "survey_area_m" in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["yard.stl"]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"zones": [{"name": "pond", "polygon_m": [[900, 0], [901, 0], [900, 1]]}]},
         ["zones.0.polygon_m: the zone 'pond' lies outside the site"]),
        ({"orthophoto": "photo.png"}, ["orthophoto: is for elevation models"]),
    ],
)  # fmt: skip
def test_what_does_nothing_on_a_mesh_is_refused(tmp_path, fields, words):
    yard().export(tmp_path / "yard.stl")
    refused(tmp_path / "yard.stl", words, up_axis="Z", unit_m=1.0, **fields)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"zones": [{"name": "pond", "polygon_m": [[0, 0], [1, 0], [2, 0]]}]}, "has no area"),
        ({"zones": [{"name": "pond", "polygon_m": [[1, 1], [1, 1], [1, 1]]}]}, "has no area"),
        ({"default_wall_m": 1000.0}, "default_wall_m"),
    ],
)
def test_zones_of_no_area_and_walls_as_thick_as_a_site(fields, words):
    with pytest.raises(ValueError, match=words):
        spec(file="yard.stl", **fields)


def test_cells_too_small_and_too_large(tmp_path):
    yard().export(tmp_path / "yard.stl")
    refused(tmp_path / "yard.stl", ["larger cells"], cell_m=0.005)
    refused(tmp_path / "yard.stl", ["smaller cells"], cell_m=20.0)


def test_elevation_models_that_cannot_be_used(tmp_path):
    rows = np.zeros((20, 30), np.float32)
    write_tiff(tmp_path / "degrees.tif", rows, crs="EPSG:4326")
    refused(tmp_path / "degrees.tif", ["degrees", "gdalwarp"])
    write_tiff(tmp_path / "turned.tif", rows, transform=Affine(5.0, 1.0, 0.0, 1.0, -5.0, 0.0))
    refused(tmp_path / "turned.tif", ["north-up"])
    write_tiff(tmp_path / "mirrored.tif", rows, transform=Affine(-5.0, 0.0, 0.0, 0.0, -5.0, 0.0), crs="EPSG:32633")
    refused(tmp_path / "mirrored.tif", ["north-up"])
    write_tiff(tmp_path / "picture.tif", np.zeros((3, 20, 30), np.uint8), count=3)
    refused(tmp_path / "picture.tif", ["picture", "orthophoto"])
    write_tiff(tmp_path / "nothing.tif", np.full((20, 30), np.nan, np.float32))
    refused(tmp_path / "nothing.tif", ["no elevation"])
    rows[5:15, 5:25] = -9999.0
    write_tiff(tmp_path / "holes.tif", rows, nodata=-9999.0)
    refused(tmp_path / "holes.tif", ["holes", "holes_max"], cell_m=5.0)
    write_tiff(tmp_path / "fine.tif", np.zeros((20, 30), np.float32))
    refused(tmp_path / "fine.tif", ["no such orthophoto"], cell_m=5.0, orthophoto="absent.tif")


def test_unknown_site_and_unknown_material(tmp_path):
    with pytest.raises(InputError, match="works_yard"):
        load_site("works_yrad", MATERIALS)
    with pytest.raises(InputError, match="no such material"):
        load_site("works_yard", ("air", "brick", "concrete", "soil", "steel", "wood"))
    yard().export(tmp_path / "yard.stl")
    options = ImportOptions(fields={"default_material": "concret"})
    with pytest.raises(InputError, match="did you mean 'concrete'"):
        import_site(tmp_path / "yard.stl", tmp_path / "out", options, MATERIALS)
    with pytest.raises(InputError, match="colour"):
        import_site(tmp_path / "yard.stl", tmp_path / "out", ImportOptions(fields={"colour": "red"}), MATERIALS)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_no_site_is_never_replaced(tmp_path):
    yard().export(tmp_path / "yard.stl")
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="not a site"):
        import_site(tmp_path / "yard.stl", precious, ImportOptions(overwrite=True), MATERIALS)
    assert (precious / "thesis.txt").read_text() == "years of work"


def test_rasters_of_too_many_cells_or_of_none_are_not_read(tmp_path, monkeypatch):
    rows = np.zeros((20, 30), np.float32)
    write_tiff(tmp_path / "tiny.tif", rows, crs="EPSG:32633", transform=Affine(1e-300, 0.0, 0.0, 0.0, -1e-300, 0.0))
    refused(tmp_path / "tiny.tif", ["has cells of 1e-300"])
    monkeypatch.setattr("swarmsim.site.elevation.RASTER_MAX", 599)
    write_tiff(tmp_path / "large.tif", rows)
    refused(tmp_path / "large.tif", ["30 x 20 cells", "at most 599", "gdalwarp"])


def test_instances_of_instances_are_counted():
    class Node:
        xmlnode, transforms = None, ()

        def __init__(self, *children):
            self.children = children

    node = Node()
    for _ in range(9):
        node = Node(*[node] * 10)
    with pytest.raises(InputError, match="too many nodes"):
        list(collada_reader._geometries(node, np.eye(4), "", itertools.count(1000, -1), Path("x.dae")))
    few = Node(Node(), Node())
    assert list(collada_reader._geometries(few, np.eye(4), "", itertools.count(1000, -1), Path("x.dae"))) == []
