"""What one box scatters: limits, symmetries, continuity, and floats that could fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.site.surfaces import Box
from swarmsim.site.wall_network import COEFFICIENTS, scattered

HOUSE, WALL_M = (5.0, 4.0, 2.0), 0.2


@jax.jit
def _shares(start, end, half, wall):
    start, end, half = ([x[:, k] for k in range(3)] for x in (start, end, half))
    of_photons, around = scattered(Box(start, end, half, wall))
    return jnp.exp(of_photons[::COEFFICIENTS]), around.closed, around.walls, around.thin_m


def shares(start, end, half=HOUSE, wall=WALL_M):
    """Of lines [n, 3] to [n, 3], or of one."""
    start, end = (np.atleast_2d(np.asarray(x, np.float32)) for x in (start, end))
    n = max(len(start), len(end))
    rows = [np.broadcast_to(x, (n, 3)) for x in (start, end, np.asarray(half, np.float32))]
    return [np.asarray(x) for x in _shares(*rows, np.broadcast_to(np.float32(wall), n))]


@pytest.mark.parametrize("near", [0.5, 2.0, 5.0, 9.0])
def test_an_infinite_wall_that_is_crossed_squarely_is_the_slab(near):
    share, closed, walls, thin = shares((-near, 3.0, 1.0), (10.0 - near, 3.0, 1.0), (0.1, 3e3, 3e3), 0.0)
    np.testing.assert_allclose(share, 1.0, atol=0.02)
    assert (closed[0], walls[0]) == (0.0, 1.0)
    assert thin[0] == pytest.approx(0.2, rel=1e-4)


def test_the_axes_of_a_box_are_alike():
    rng = np.random.default_rng(1)
    start, end = rng.uniform(-1.8, 1.8, (20, 3)), rng.normal(0.0, 20.0, (20, 3))
    expected = shares(start, end)[0]
    for order in ([1, 2, 0], [2, 1, 0]):
        found = shares(start[:, order], end[:, order], np.array(HOUSE)[order])[0]
        np.testing.assert_allclose(found, expected, rtol=2e-3)
    mirrored = shares(start * (-1, 1, 1), end * (-1, 1, 1))[0]
    np.testing.assert_allclose(mirrored, expected, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "last"),
    [
        ((1.0, 0.5, 0.0), (30.0, 6.0, 1.0)),  # from beyond one wall,
        ((1.0, 0.5, 0.0), (-30.0, 3.0, 9.0)),
        ((-4.0, 3.5, -1.5), (6.0, 8.0, 6.0)),
        ((-20.0, 1.0, 0.5), (12.0, 3.0, -0.5)),  # through the whole house,
        ((-20.0, 6.0, 3.5), (24.0, 8.0, -3.0)),  # from farther out than the source as well
        ((-20.0, 6.0, 3.5), (2.0, -3.0, 1.0)),  # and into it
    ],
)
def test_shares_are_continuous_around_a_house(first, last):
    """Along circles of the detector that cross the planes of all faces, and the line all edges."""
    radius = float(np.linalg.norm(last))
    angle = np.linspace(0.0, 2.0 * np.pi, 800_001)
    for tilt in (0.0, 0.7, 1.4):
        ring = np.stack([np.cos(angle), np.sin(angle) * np.cos(tilt), np.sin(angle) * np.sin(tilt)], axis=1)
        share, _, _, thin = shares(first, radius * ring)
        met = thin > 1e-3
        both = met[1:] & met[:-1]
        assert np.isfinite(share[:, met]).all()
        assert (share[:, met] >= 0.0).all()
        # in steps of 0.03 to 0.2 mm; of the deepest walls nothing is counted but what comes around them
        one, other = share[:4, :-1][:, both], share[:4, 1:][:, both]
        assert np.max(np.minimum(np.abs(other - one) / 0.006, np.abs(np.log(other / one)) / 0.03)) < 1.0


def test_a_source_that_leaves_through_a_wall_changes_nothing_at_once():
    """From the inside of the house to 2 m behind its wall, seen from the other side."""
    place = np.stack([np.linspace(-4.0, -7.0, 30_001), np.full(30_001, 0.4), np.full(30_001, 0.2)], axis=1)
    share, closed, walls, thin = shares(place, (25.0, 1.0, 0.5))
    for each in (*np.log(share[:4]), closed, walls, thin / WALL_M):
        assert np.max(np.abs(np.diff(each))) < 0.02
    assert (closed[0], walls[0], closed[-1], walls[-1]) == (1.0, 1.0, 0.0, 2.0)


@pytest.mark.parametrize(
    ("half", "wall", "start", "end", "axis"),
    [
        # across the middle plane of a block, far outside it
        ((2.8402, 5.1625, 0.6533), 0.0, (3.1311, -1.2563, 0.0), (-4.039, 9.77, 5.204), 2),
        # in a wall, nearly along its inner face: the inside lies far ahead of the line or far behind it
        ((0.3008, 0.3309, 0.8084), 0.1643, (0.234, -0.4378, 3.1829), (0.234, 0.919, -1.845), 0),
    ],
)
def test_a_plane_that_a_source_crosses_outside_changes_nothing_at_once(half, wall, start, end, axis):
    place = np.tile(np.array(start), (4001, 1))
    place[:, axis] += np.linspace(-0.02, 0.02, 4001)
    share, _, _, _ = shares(place, end, half, wall)
    assert np.max(np.abs(np.diff(np.log(share[:4])))) < 0.02


def test_walls_that_meet_in_the_middle_are_a_block():
    rng = np.random.default_rng(3)
    half, start = rng.uniform(0.1, 3.0, (200, 3)), rng.normal(0.0, 1.0, (200, 3))
    start, end = (d / np.linalg.norm(d, axis=1)[:, None] * 8.0 for d in (start, rng.normal(0.0, 1.0, (200, 3))))
    block = shares(start, end, half, 0.0)
    for times in (1.0, 1.05, 5.0):
        walls = np.float32(times * half.min(axis=1))
        for found, expected in zip(shares(start, end, half, walls), block, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_smaller_walls_scatter_less():
    size = np.array([0.5, 1.0, 2.0, 4.0, 20.0])
    found = np.stack([shares((-3.0, 0, 0), (6.0, 0, 0), (0.1, s, s), 0.0)[0][:, 0] for s in size])
    assert np.all(np.diff(found[:, :3], axis=0) > 0.0)
    assert found[0, :4].max() < 0.3
    assert found[-1, :4].min() > 0.9


PLACES = [
    (0.0, 0.0, 0.0), (5.0, 4.0, 2.0), (4.8, 0.0, 0.0), (4.8, 3.8, 1.8), (4.9, 0.0, 0.0), (5.0, 9.0, 0.0),
    (-1e5, 3.0, 1.9), (0.0, 0.0, 1e4), (1e-8, -1e-8, 2.0),
]  # fmt: skip


@pytest.mark.parametrize(("half", "wall"), [(HOUSE, 0.2), (HOUSE, 0.0), ((0, 0, 0), 0.0), ((0.05, 9.0, 9.0), 1e-3)])
def test_no_place_gives_no_number(half, wall):
    pairs = np.array([(a, b) for a in PLACES for b in PLACES], np.float32)
    for found in shares(pairs[:, 0], pairs[:, 1], half, wall):
        assert np.isfinite(found).all()
