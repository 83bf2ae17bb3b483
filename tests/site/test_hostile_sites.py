"""Source files of sites that no program writes on purpose: each is told in a sentence, without a warning of numpy."""

import os
import struct
import time

import numpy as np
import pytest
import trimesh
from rasterio.transform import Affine
from yards import (
    MATERIALS,
    PLATE_OBJ,
    PLATE_POINTS,
    ground_plate,
    refused,
    spec,
    write_plate_dae,
    write_plate_glb,
    write_tiff,
)

from swarmsim.config.errors import InputError
from swarmsim.site import ImportOptions, import_site
from swarmsim.site.importer import build


def ring_obj(radii):
    """A face around the origin."""
    angle = np.linspace(0.0, 2.0 * np.pi, len(radii), endpoint=False)
    corners = zip(radii * np.cos(angle), radii * np.sin(angle), strict=True)
    lines = [f"v {x:.6f} {y:.6f} 0" for x, y in corners]
    return "\n".join([*lines, "f " + " ".join(str(k + 1) for k in range(len(radii)))])


def test_a_face_of_many_corners(tmp_path):
    path = tmp_path / "ring.obj"
    path.write_text(ring_obj(np.full(50_000, 20.0)))
    started = time.process_time()
    raw = build(path, spec(file=path.name))
    assert time.process_time() - started < 5.0  # a fan of slivers took minutes
    assert raw.report["area_m2"] == pytest.approx(np.pi * 20.0**2, rel=0.05)
    path.write_text(ring_obj(15.0 + 5.0 * np.cos(np.linspace(0.0, 4.0 * np.pi, 3000, endpoint=False))))
    started = time.process_time()
    raw = build(path, spec(file=path.name))
    assert time.process_time() - started < 5.0
    assert raw.report["area_m2"] == pytest.approx(np.pi * (15.0**2 + 0.5 * 5.0**2), rel=0.05)
    path.write_text(ring_obj(np.tile([20.0, 10.0], 2500)))
    refused(path, ["concave faces have too many corners, one of them 5,000", "triangulate"])
    path.write_text(ring_obj(np.tile([20.0, np.nan], 2500)))
    refused(path, ["not finite"])


OBJ_FACES = {
    "0 1 2": "names a vertex before the first",
    "-5 -1 -2": "names a vertex before the first",
    "1 2 9": "names vertex 9, but there are 4",
    "1 2": "fewer than three corners",
    "1 2.5 3": "something else than whole numbers",
}


@pytest.mark.parametrize(("face", "words"), OBJ_FACES.items())
def test_faces_of_an_obj_that_name_no_vertex(tmp_path, face, words):
    path = tmp_path / "plate.obj"
    path.write_text(f"{PLATE_OBJ}f {face}\n")
    refused(path, ["plate.obj:7", words])


def without_data(header):
    header["accessors"].append({"componentType": 5126, "count": 10**9, "type": "VEC3"})


def shared_views(header):
    header["bufferViews"] += [{"buffer": 0, "byteOffset": 0, "byteLength": 60}] * 2000
    header["accessors"] += [{"bufferView": 0, "componentType": 5126, "count": 10**9, "type": "SCALAR"}]


def sparse(header):
    header["accessors"][0]["sparse"] = {"count": 1, "indices": {"bufferView": 1}, "values": {"bufferView": 0}}


GLB_HEADERS = {
    "without data": (without_data, "3,000,000,000 values without data"),
    "shared": (shared_views, "bytes of data, but has"),
    "sparse": (sparse, "sparse positions"),
    "negative": (lambda h: h["accessors"][0].update(count=-4), "negative count"),
    "infinite": (lambda h: h["accessors"][0].update(count=float("inf")), "header is damaged"),
    "no data": (lambda h: h.update(accessors=[], bufferViews=[]), "meshes without data"),
    "elsewhere": (lambda h: h["buffers"][0].update(uri="../../../../../dev/zero"), "other files"),
    "compressed": (lambda h: h.update(extensionsRequired=["EXT_meshopt_compression"]), "is compressed"),
    "fans": (lambda h: h["meshes"][0]["primitives"][0].update(mode=6), "fans"),
    "fractions": (lambda h: h["accessors"][0].update(normalized=True), "fractions"),
    "circle": (lambda h: h["nodes"][0].update(children=[0]), "nodes within nodes"),
    "instances": (
        lambda h: h.update(nodes=[{"children": list(range(1, 100_001))}] + [{"mesh": 0}] * 100_000),
        "100,000 parts",
    ),
    "far": (lambda h: h["nodes"][0].update(scale=[1e300] * 3), "coordinates go up to 2e+301 m"),
}


@pytest.mark.parametrize(("change", "words"), GLB_HEADERS.values(), ids=GLB_HEADERS)
def test_glb_headers_that_would_be_read_wrongly_or_without_end(tmp_path, change, words):
    path = tmp_path / "plate.glb"
    write_plate_glb(path)
    assert build(path, spec(file=path.name)).report["area_m2"] == pytest.approx(1600.0)
    write_plate_glb(path, change)
    started = time.process_time()
    refused(path, ["plate.glb", words])
    assert time.process_time() - started < 2.0


@pytest.mark.parametrize("meter", ["0", "-1", "nan", "inf", "abc", "1e300"])
def test_units_of_a_collada_file_that_are_none(tmp_path, meter):
    path = tmp_path / "plate.dae"
    write_plate_dae(path, f"<unit meter='{meter}'/><up_axis>Z_UP</up_axis>")
    refused(path, ["unit of length", "--unit"])
    assert build(path, spec(file=path.name, unit_m=1.0)).report["area_m2"] == pytest.approx(1600.0)
    write_plate_dae(path, "<up_axis>UP</up_axis>")
    refused(path, ["points up as 'UP'", "--up Z"])


DAE_FACES = {
    "endless": (
        "<polylist count='1'>{inputs}<vcount>400000000</vcount><p>0 1 2 3</p></polylist>",
        "does not name them",
    ),
    "negative": ("<polylist count='1'>{inputs}<vcount>-4 8</vcount><p>0 1 2 3</p></polylist>", "does not name them"),
    "holes": ("<polygons count='1'>{inputs}<ph><p>0 1 2 3</p><h>0 1 2</h></ph></polygons>", "polygons with holes"),
}


@pytest.mark.parametrize(("faces", "words"), DAE_FACES.values(), ids=DAE_FACES)
def test_faces_of_a_collada_file_that_cannot_be_read(tmp_path, faces, words):
    path = tmp_path / "plate.dae"
    write_plate_dae(path, faces=faces)
    started = time.process_time()
    refused(path, [words])
    assert time.process_time() - started < 2.0


def test_values_between_the_positions_of_a_collada_file(tmp_path):
    path = tmp_path / "plate.dae"
    write_plate_dae(path, points=" ".join(f"{x} 9 9 9" for x in PLATE_POINTS.split()), stride=6)
    refused(path, ["stride 6"])


@pytest.mark.parametrize("meshes", ["walls", "copies", "wide"])
def test_scenes_that_cannot_be_sites(tmp_path, meshes):
    path = tmp_path / "scene.obj"
    if meshes == "walls":  # numpy warned of the mean of nothing
        path.write_text("v 0 0 0\nv 40 0 0\nv 40 0 9\nv 0 0 9\nv 20 20 0\nv 20 -20 0\nv 20 -20 9\nf 1 2 3 4\nf 5 6 7\n")
        refused(path, ["no ground found"])
    elif meshes == "copies":
        path.write_text(PLATE_OBJ + "f 1 2 3\n" * 2000)
        refused(path, ["2,002 triangles are 1,001 times as large as the site"])
    else:
        path.write_text(PLATE_OBJ.replace("20", "200000"))
        refused(
            path,
            ["single precision does not place", "of at most 200000 m, a height of at most 20000 m"],
            extent_m=(1.0, 1e9),
        )


def test_heights_beyond_all_on_earth(tmp_path):
    path = tmp_path / "high.obj"
    path.write_text(PLATE_OBJ.replace(" 0\n", " 1e30\n"))
    refused(path, ["coordinates go up to 1e+30 m"])
    trimesh.Scene(ground_plate().apply_translation([0.0, 0.0, 1e7])).export(tmp_path / "high.stl")
    refused(tmp_path / "high.stl", ["10,000,000 m", "single precision"])
    write_tiff(tmp_path / "high.tif", np.full((20, 30), 1e7, np.float32))
    refused(tmp_path / "high.tif", ["none on Earth", "height_unit_m"])


@pytest.mark.parametrize(
    "content", [b"\0" * 80 + struct.pack("<I", 99) + b"\0" * 500, b"solid x\n facet normal 0 0 1\n"]
)
def test_stl_files_that_are_cut_short(tmp_path, content):
    path = tmp_path / "short.stl"
    path.write_bytes(content)
    refused(path, ["cut short"])


def test_rasters_that_are_no_elevation_models(tmp_path):
    rows = np.add.outer(np.arange(20.0), np.arange(30.0)).astype(np.float32)
    write_tiff(tmp_path / "nowhere.tif", rows, transform=Affine(np.nan, 0.0, 0.0, 0.0, -5.0, 0.0))
    refused(tmp_path / "nowhere.tif", ["finite numbers"])
    write_tiff(tmp_path / "complex.tif", rows.astype(np.complex64))
    refused(tmp_path / "complex.tif", ["complex numbers"])
    write_tiff(tmp_path / "large.tif", rows.astype(np.float64) * 1e300)
    refused(tmp_path / "large.tif", ["in one line"], cell_m=5.0)  # without a warning of numpy
    write_tiff(tmp_path / "real.tif", rows)
    (tmp_path / "other.tif").write_text(
        "<VRTDataset rasterXSize='30' rasterYSize='20'><GeoTransform>0,5,0,0,0,-5</GeoTransform>"
        "<VRTRasterBand dataType='Float32' band='1'><SimpleSource><SourceFilename relativeToVRT='1'>real.tif"
        "</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    refused(tmp_path / "other.tif", ["cannot be read as GeoTIFF"])


def test_a_raster_of_too_many_cells_is_not_read(tmp_path, monkeypatch):
    write_tiff(tmp_path / "wide.tif", np.zeros((20, 30), np.float32))
    monkeypatch.setattr("rasterio.DatasetReader.read", None, raising=False)
    refused(tmp_path / "wide.tif", ["150000 x 100000"], cell_m=0.001)


@pytest.mark.parametrize(
    ("polygon", "words"),
    [([[-5, -5], [5, 5], [5, -5], [-5, 5]], "crosses itself"), ([[0, 0], [1, 1], [2, 2]], "no area"),
     ([[0, 8], [5, -7], [-8, 3], [8, 3], [-5, -7]], "crosses itself")],
)  # fmt: skip
def test_zones_that_cross_themselves(tmp_path, polygon, words):
    (tmp_path / "plate.obj").write_text(PLATE_OBJ)
    options = ImportOptions(fields={"zones": [{"name": "pond", "polygon_m": polygon}]}, preview=False)
    with pytest.raises(InputError, match=words) as caught:
        import_site(tmp_path / "plate.obj", tmp_path / "out", options, MATERIALS)
    assert "zones.0.polygon_m" in str(caught.value)


def test_what_is_no_file_and_names_that_no_file_can_have(tmp_path):
    os.mkfifo(tmp_path / "pipe.obj")
    refused(tmp_path / "pipe.obj", ["not a regular file"])
    (tmp_path / "named.mtl").write_text("newmtl a\nmap_Kd pipe.obj\n")
    (tmp_path / "plate.obj").write_text(f"mtllib named.mtl\nmtllib {'q' * 4000}\nusemtl a\n{PLATE_OBJ}")
    options = ImportOptions(preview=False)
    import_site(tmp_path / "plate.obj", tmp_path / "out", options, MATERIALS)
    assert build(tmp_path / "plate.obj", spec(file="plate.obj")).report["area_m2"] == pytest.approx(1600.0)


@pytest.mark.parametrize("field", ["max_file_mb", "orthophoto", "unit_m"])
def test_fields_of_a_wrong_type_are_told(tmp_path, field):
    write_tiff(tmp_path / "dem.tif", np.zeros((20, 30), np.float32))
    options = ImportOptions(fields={field: ["abc"]})
    with pytest.raises(InputError, match=rf"site.yaml \S*{field}"):
        import_site(tmp_path / "dem.tif", tmp_path / "out", options, MATERIALS)


def test_the_unit_of_a_raster_without_one_gives_its_cells(tmp_path):
    crs = 'LOCAL_CS["mine",UNIT["furlong",201.168]]'
    write_tiff(tmp_path / "dem.tif", np.zeros((20, 30), np.float32), crs=crs)
    with pytest.raises(InputError, match="without a unit"):
        import_site(tmp_path / "dem.tif", tmp_path / "out", ImportOptions(), MATERIALS)
    options = ImportOptions(fields={"unit_m": 2.0}, preview=False)
    assert import_site(tmp_path / "dem.tif", tmp_path / "out", options, MATERIALS).spec.cell_m == pytest.approx(10.0)


def test_ground_of_one_line_is_no_site_and_level_ground_is_not_far_from_its_model(tmp_path):
    path = tmp_path / "road.obj"
    path.write_text(PLATE_OBJ.replace("-20 0\n", "-0.75 0\n").replace(" 20 0\n", " 0.75 0\n"))
    assert len(build(path, spec(file=path.name)).survey_area) == 4  # three cells wide
    rows = np.full((20, 30), np.nan, np.float32)
    rows[10] = 1.0
    write_tiff(tmp_path / "line.tif", rows)
    refused(tmp_path / "line.tif", ["in one line (cells: 30)"], cell_m=5.0)
    path.write_text(PLATE_OBJ.replace(" 0\n", " 4000\n"))
    refused(path, ["far from the model", "--set plane.height_m=4000"], plane={"margin_m": 20.0})


def test_the_log_of_the_reader_is_not_shown(tmp_path, caplog):
    facet = "facet normal 0 0 {z}\nouter loop\nvertex 0 0 0\nvertex 40 0 0\nvertex 0 40 0\nendloop\nendfacet\n"
    (tmp_path / "plate.stl").write_text(f"solid x\n{facet.format(z='up')}endsolid x\n")
    build(tmp_path / "plate.stl", spec(file="plate.stl"))
    assert caplog.records == []
