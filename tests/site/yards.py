"""Small sites and files for the tests of the site room."""

import copy
import json
import struct

import jax.numpy as jnp
import numpy as np
import pytest
import rasterio
import trimesh
from rasterio.transform import Affine

from swarmsim.config.errors import InputError
from swarmsim.config.site import SiteSpec
from swarmsim.site import Obstacles, Site
from swarmsim.site.importer import build
from tests.generator_scripts import script

polygon_prism = script("sites/mesh_shapes.py").polygon_prism
write_collada = script("sites/collada_writer.py").write_collada

MATERIALS = ("air", "brick", "concrete", "soil", "steel", "vegetation", "wood")
TO_Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
TO_X_UP = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)


def make_site(boxes=(), terrain=None, cell=100.0, origin=(-300.0, -300.0), materials=MATERIALS):
    """A site with ``boxes`` (centre, half, yaw, wall, material) on ``terrain`` [ny, nx]; deep below zero by default."""
    terrain = np.full((7, 7), -1e3) if terrain is None else np.asarray(terrain)
    boxes = boxes or (((0, 0, 0), (0, 0, 0), 0.0, 0.0, materials[0]),)
    centre, half, yaw, wall, names = zip(*boxes, strict=True)
    yaw = np.array(yaw)
    raster = jnp.asarray(terrain, jnp.float32)
    return Site(
        origin_m=jnp.array(origin, jnp.float32),
        cell_m=jnp.float32(cell),
        terrain_m=raster,
        surface_m=raster,
        clearance_m=jnp.ones_like(raster),
        cost=jnp.ones_like(raster),
        obstacles=Obstacles(
            centre_m=jnp.array(centre, jnp.float32),
            half_extent_m=jnp.array(half, jnp.float32),
            axis=jnp.asarray(np.stack([np.cos(yaw), np.sin(yaw)], -1), jnp.float32),
            wall_m=jnp.array(wall, jnp.float32),
            material=jnp.array([materials.index(n) for n in names], jnp.int32),
        ),
        survey_area_m=jnp.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
        ground_material=jnp.int32(materials.index("soil")),
        material_names=tuple(materials),
    )


def spec(**fields) -> SiteSpec:
    """A specification with cells of half a metre."""
    return SiteSpec(**{"name": "here", "file": "here.glb", "licence": "made for a test", "cell_m": 0.5} | fields)


def refused(path, words, **fields):
    """The import is refused with one readable problem that holds all ``words``."""
    with pytest.raises(InputError) as caught:
        build(path, spec(file=path.name, **fields))
    text = str(caught.value)
    assert "Traceback" not in text
    for word in words:
        assert word in text
    return text


def ground_plate(size=(40.0, 30.0), slope=0.0, pieces=20) -> trimesh.Trimesh:
    """A plate around the origin that rises towards the east."""
    x, y = (np.linspace(-0.5 * s, 0.5 * s, pieces + 1) for s in size)
    points = np.stack(np.meshgrid(x, y), -1)
    points = np.concatenate([points, slope * points[..., :1]], -1)
    index = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return trimesh.Trimesh(points.reshape(-1, 3), faces, process=False)


def block(size, centre, yaw=0.0) -> trimesh.Trimesh:
    """A closed box."""
    mesh = trimesh.creation.box(size)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(yaw, [0, 0, 1]))
    mesh.apply_translation(centre)
    return mesh


def yard(slope=0.0) -> trimesh.Scene:
    """A plate of 40 m x 30 m, a house of 8 x 6 x 5 m at (5, 3) turned by 0.3 rad, and a post of 3 m at (-10, -5)."""
    scene = trimesh.Scene()
    scene.add_geometry(ground_plate(slope=slope), geom_name="plate")
    scene.add_geometry(block((8, 6, 5), (5, 3, 2.5), 0.3), geom_name="house")
    scene.add_geometry(block((0.4, 0.4, 3), (-10, -5, 1.5)), geom_name="post")
    return scene


def prism(outline, height) -> trimesh.Trimesh:
    """A solid over a polygon."""
    return trimesh.Trimesh(**trimesh.triangles.to_kwargs(polygon_prism(np.array(outline, float), 0.0, height)))


def ring(size, wall) -> trimesh.Trimesh:
    """Four walls without floor or roof, one closed solid."""
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    outer, inner = square * size[:2], square * (np.array(size[:2]) - 2 * wall)
    corners = np.concatenate([np.column_stack([xy, np.full(4, z)]) for xy in (outer, inner) for z in (0.0, size[2])])
    loops = [(0, 4), (4, 12), (12, 8), (8, 0)]  # outside, top, inside, bottom
    faces = []
    for low, high in loops:
        for k in range(4):
            n = (k + 1) % 4
            faces += [[low + k, low + n, high + n], [low + k, high + n, high + k]]
    return trimesh.Trimesh(corners, faces, process=False)


def write_tiff(path, rows, cell=5.0, **more):
    profile = {"driver": "GTiff", "height": rows.shape[-2], "width": rows.shape[-1], "count": 1, "dtype": rows.dtype}
    profile |= {"crs": "EPSG:32632", "transform": Affine(cell, 0.0, 500_000.0, 0.0, -cell, 5_200_000.0)} | more
    with rasterio.open(path, "w", **profile) as file:
        file.write(rows if rows.ndim == 3 else rows[None])


PLATE_OBJ = "v -20 -20 0\nv 20 -20 0\nv 20 20 0\nv -20 20 0\nf 1 2 3\nf 1 3 4\n"
"""A square of 40 m."""
PLATE_POINTS = "-20 -20 0 20 -20 0 20 20 0 -20 20 0"
PLATE_TRIANGLES = "<triangles count='2'>{inputs}<p>0 1 2 0 2 3</p></triangles>"
PLATE_GLTF = {
    "asset": {"version": "2.0"},
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "accessors": [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
    ],
    "bufferViews": [
        {"buffer": 0, "byteOffset": 0, "byteLength": 48},
        {"buffer": 0, "byteOffset": 48, "byteLength": 12},
    ],
    "buffers": [{"byteLength": 60}],
}


def write_plate_glb(path, change=lambda header: None):
    """The same square as glTF, its header changed."""
    header = copy.deepcopy(PLATE_GLTF)
    change(header)
    corners = np.array([[-20, 0, 20], [20, 0, 20], [20, 0, -20], [-20, 0, -20]], "<f4")
    data = corners.tobytes() + np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)


def write_plate_dae(path, asset="<up_axis>Z_UP</up_axis>", points=PLATE_POINTS, faces=PLATE_TRIANGLES, stride=3):
    """The same square, or other ``faces``, as COLLADA."""
    named = "".join(f"<param name='{axis}' type='float'/>" for axis in "XYZ")
    path.write_text(
        f"<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema' version='1.4.1'><asset>{asset}</asset>"
        f"<library_geometries><geometry id='g'><mesh><source id='s'><float_array id='a'>{points}</float_array>"
        f"<technique_common><accessor source='#a' count='0' stride='{stride}'>{named}</accessor></technique_common>"
        "</source><vertices id='v'><input semantic='POSITION' source='#s'/></vertices>"
        + faces.format(inputs="<input semantic='VERTEX' source='#v' offset='0'/>")
        + "</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id='w'><node>"
        "<instance_geometry url='#g'/></node></visual_scene></library_visual_scenes>"
        "<scene><instance_visual_scene url='#w'/></scene></COLLADA>"
    )
