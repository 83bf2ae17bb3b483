"""Houses of thin walls, drawn at random as one mesh: walls, doors and rooms are imported as drawn."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from houses import WAYS, draw_house
from scipy import ndimage
from strangers import Stranger
from yards import block, ground_plate, prism, spec

from swarmsim.config.load import load_all
from swarmsim.site import ImportOptions, import_site, path_lengths
from swarmsim.site.columns import closed_volume
from swarmsim.site.drawn_walls import drawn_walls
from swarmsim.site.importer import build

SEEDS = range(12)
ROVER_HALF_M = 0.3
TO_SEE_M = 0.02  # walls are exact but for the corners, where boxes overlap


def made(folder, mesh, **fields):
    """The site with a house or other thing on level ground, imported from an OBJ file."""
    path = Stranger({"terrain": ground_plate((60.0, 60.0)), "house": mesh}).write(folder)
    return build(path, spec(file=path.name, **fields))


def matter(raw):
    """Matter of the boxes, m3."""
    return sum(box.volume - (8.0 * np.prod(np.array(box.half) - box.wall) if box.wall else 0.0) for box in raw.boxes)


@pytest.mark.parametrize("seed", SEEDS)
def test_walls_and_doors_are_as_drawn(tmp_path, seed):
    rng = np.random.default_rng(seed)
    house = draw_house(rng, WAYS[seed % len(WAYS)])
    raw = made(tmp_path, house.mesh(rng), default_wall_m=0.2)
    assert matter(raw) == pytest.approx(house.drawn_m3(), rel=0.02), house.said
    fine = raw.grid.refined(len(raw.clearance) // raw.grid.ny)
    region, _ = ndimage.label(raw.clearance > ROVER_HALF_M)
    inside, outside = (region.ravel()[fine.cell_of(house.place(xy))] for xy in (house.room, (house.door[0], -4.0)))
    assert inside == outside != 0, house.said


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 7])
def test_rays_meet_the_walls_that_the_mesh_has(tmp_path, seed):
    rng = np.random.default_rng(seed)
    house = draw_house(rng, "one mesh")
    path = Stranger({"terrain": ground_plate((60.0, 60.0)), "house": house.mesh(rng)}).write(tmp_path)
    model = import_site(path, tmp_path / "site", ImportOptions(preview=False), tuple(load_all("materials")))
    start = np.column_stack(
        [house.place(np.array(house.room) + rng.uniform(-0.5, 0.5, (60, 2))), rng.uniform(0.5, 2, 60)]
    )
    turn = rng.uniform(0.0, 2.0 * np.pi, 60)
    way = np.column_stack([np.cos(turn), np.sin(turn), np.full(60, 0.01)])
    end = start + 25.0 * way
    air = model.site.material_names.index("air")
    found = jax.vmap(lambda a, b: path_lengths(model.site, a, b))(jnp.asarray(start), jnp.asarray(end))
    solid = np.delete(np.asarray(found), air, axis=1).sum(axis=1)
    np.testing.assert_allclose(solid, through(house.mesh(rng), start, way, 25.0), atol=TO_SEE_M)


def through(mesh, start, way, reach):
    """Length [n] of rays within a closed mesh, by its own triangles."""
    place, ray, _ = mesh.ray.intersects_location(start, way, multiple_hits=True)
    found = np.zeros(len(start))
    for k in range(len(start)):
        far = np.unique(np.round(((place[ray == k] - start[k]) * way[k]).sum(axis=1) / (way[k] ** 2).sum(), 6))
        far = np.clip(far[far > 0.0], 0.0, reach)
        assert len(far) % 2 == 0
        found[k] = (far[1::2] - far[::2]).sum() * np.linalg.norm(way[k])
    return found


def test_blocks_are_left_to_the_rules():
    for solid in (
        block((8.0, 6.0, 5.0), (0.0, 0.0, 2.5)),
        prism([[0, 0], [9, 0], [9, 4], [4, 4], [4, 9], [0, 9]], 3.0),
    ):
        assert drawn_walls(solid.triangles) is None


def test_oblique_and_sloping_walls():
    outline = [[0, 0], [12, 0], [18, 8], [17.76, 8.18], [11.85, 0.3], [0.3, 0.3], [0.3, 7], [0, 7]]
    walls = prism(outline, 2.5)
    boxes = drawn_walls(walls.triangles)
    assert sum(box.volume for box in boxes) == pytest.approx(walls.volume, rel=0.1)
    lowest = walls.copy()
    lowest.vertices[:, 2] += 0.05 * lowest.vertices[:, 0]
    boxes = drawn_walls(lowest.triangles)
    assert sum(box.volume for box in boxes) == pytest.approx(walls.volume, rel=0.1)
    assert len(boxes) < 24


def test_volumes_of_closed_meshes():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
    assert closed_volume(ball.triangles) == pytest.approx(ball.volume)
    turned = ball.triangles.copy()
    turned[::2] = turned[::2, ::-1]
    assert closed_volume(turned) == pytest.approx(ball.volume)
    assert closed_volume(ball.triangles[1:]) is None
    box = block((2.0, 3.0, 4.0), (0.0, 0.0, 2.0))
    box.update_faces(box.triangles[..., 2].max(axis=1) > 0.0)
    assert closed_volume(box.triangles) == pytest.approx(24.0)


def test_what_boxes_do_not_follow_is_told(tmp_path):
    cone = trimesh.creation.cone(radius=3.0, height=8.0)
    told = " ".join(made(tmp_path, cone).report["warnings"])
    said = re.search(r"boxes do not follow the shape of: house \((\d+) m3 for ([\d.]+) m3\)", told)
    assert float(said[1]) == pytest.approx(288.0, rel=0.02)  # a polygon for a circle
    assert float(said[2]) == pytest.approx(cone.volume, rel=0.01)
    plain = made(tmp_path, block((8.0, 6.0, 5.0), (0.0, 0.0, 2.5))).report["warnings"]
    assert not any("do not follow" in warning for warning in plain)


@pytest.mark.parametrize(("said", "found"), [(None, 0.2), (0.1, 0.2), (0.05, 0.05), (0.001, 0.001)])
def test_sheets_are_as_thick_as_their_rule_says(tmp_path, said, found):
    """Walls of 0.2 m: a rule that says about as much leaves these as drawn; planks and sheets are thinner."""
    inner = [[0, 4], [0.2, 4], [0.2, 5.8], [7.8, 5.8], [7.8, 0.2], [0.2, 0.2], [0.2, 2], [0, 2]]
    outline = [[0, 0], [8, 0], [8, 6], [0, 6], *inner]
    rule = {"match": "house", "material": "steel"} | ({} if said is None else {"wall_m": said})
    raw = made(tmp_path, prism(outline, 3.0), obstacles=(rule,))
    south = {box.wall for box in raw.boxes if abs(box.centre[1] - 0.1) < 0.01}
    assert [2.0 * wall if wall else 0.2 for wall in south] == pytest.approx([found])
