"""Steps of the ground: found in meshes where they stand, and sampled as two levels."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from swarmsim.site import Steps
from swarmsim.site.importer import build
from swarmsim.site.steps import sample_steps
from tests.site.yards import TO_Y_UP, block, make_site, spec, yard


def terrace(rise, at, yaw, slope=0.0, half=15.0):
    """Ground that rises towards the north by ``slope`` and by a vertical face beyond ``at`` metres along ``yaw``."""

    def quad(*corners):
        a, b, c, d = ((x, y, z + slope * y) for x, y, z in corners)
        return [a, b, c, a, c, d]

    points = np.array(
        [
            *quad((-half, -half, 0), (at, -half, 0), (at, half, 0), (-half, half, 0)),
            *quad((at, -half, rise), (half, -half, rise), (half, half, rise), (at, half, rise)),
            *quad((at, -half, 0), (at, -half, rise), (at, half, rise), (at, half, 0)),
        ]
    )
    mesh = trimesh.Trimesh(points, np.arange(18).reshape(-1, 3), process=False)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(yaw, [0, 0, 1]))
    return trimesh.Scene({"plate": mesh})


def imported(scene, folder, **fields):
    scene = scene.copy()
    scene.apply_transform(TO_Y_UP)
    scene.export(folder / "here.glb")
    return build(folder / "here.glb", spec(**fields))


def lines(raw):
    """Distance from the origin [n], direction [n, 2] and rise [n] of the edges."""
    edge = raw.steps.edge[raw.steps.edge[..., 3] > 0.0]
    centres = raw.grid.centres[raw.steps.edge[..., 3] > 0.0]
    return edge[:, 2] + np.sum(edge[:, :2] * centres, axis=1), edge[:, :2], edge[:, 3]


def test_a_random_vertical_face_is_found_where_it_stands_and_with_its_height(tmp_path):
    rng = np.random.default_rng(0)
    for trial in range(12):
        rise, at, yaw, slope = rng.uniform([0.05, -4.0, -3.0, -0.1], [0.3, 4.0, 3.0, 0.1])
        raw = imported(terrace(rise, at, yaw, slope), tmp_path)
        distance, direction, found = lines(raw)
        np.testing.assert_allclose(distance, at, atol=0.005, err_msg=str(trial))
        np.testing.assert_allclose(direction @ [np.cos(yaw), np.sin(yaw)], 1.0, atol=1e-4)
        np.testing.assert_allclose(found, rise, atol=0.1 * rise + 0.005)


def test_a_kerb_stone_has_edges_on_all_sides_and_is_driven_over(tmp_path):
    scene = yard()
    scene.add_geometry(block((6.0, 1.2, 0.12), (-8.0, 6.0, 0.06), 0.3), geom_name="kerb")
    raw = imported(scene, tmp_path)
    _, direction, rise = lines(raw)
    np.testing.assert_allclose(rise, 0.12, atol=0.003)
    angles = np.round(np.degrees(np.arctan2(direction[:, 1], direction[:, 0]) - 0.3)).astype(int) % 360
    assert set(angles) == {0, 90, 180, 270}
    on_top = raw.grid.cell_of(np.array([-8.0, 6.0]))
    assert raw.steps.floor.ravel()[on_top] > 0.11
    assert np.isfinite(raw.cost.ravel()[on_top])


def test_smooth_ground_and_walls_have_no_steps(tmp_path):
    assert imported(yard(slope=0.1), tmp_path).steps is None


def test_a_route_does_not_cross_a_step_higher_than_the_site_allows(tmp_path):
    low, high = (imported(terrace(rise, 0.1, 0.0), tmp_path) for rise in (0.1, 0.2))
    middle = slice(5, -5)
    assert np.isfinite(low.cost[middle, middle]).all()
    blocked = np.isinf(high.cost[middle, middle])
    assert blocked.any(axis=1).all()  # in every row
    assert blocked.mean() < 0.1


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5])
def test_both_levels_are_continuous_and_differ_by_the_rise(angle):
    axis = np.arange(-5.0, 5.5, 0.5)
    x, y = np.meshgrid(axis, axis)
    beyond = np.cos(angle) * x + np.sin(angle) * y - 0.3
    edge = np.stack(np.broadcast_arrays(np.cos(angle), np.sin(angle), -beyond, 0.2), axis=-1)
    ground = 0.05 * x - 0.02 * y
    floor = jnp.asarray(ground + 0.2 * (beyond > 0.0), jnp.float32)
    steps = Steps(floor_m=floor, edge=jnp.asarray(edge, jnp.float32))
    site = dataclasses.replace(make_site(terrain=ground, cell=0.5, origin=(-5.0, -5.0)), steps=steps)
    xy = np.random.default_rng(1).uniform(-4.9, 4.9, (200, 2))
    found = sample_steps(steps, site, jnp.asarray(xy, jnp.float32))
    np.testing.assert_allclose(found.low_m, xy @ [0.05, -0.02], atol=2e-5)
    np.testing.assert_allclose(found.beyond_m, xy @ [np.cos(angle), np.sin(angle)] - 0.3, atol=2e-5)
    np.testing.assert_allclose(found.slope, np.tile([0.05, -0.02], (200, 1)), atol=1e-4)
