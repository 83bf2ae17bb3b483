"""The part of a segment below the terrain, against closed forms and dense sampling."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.site import crossed, path_lengths, sample
from swarmsim.site.rays import crossed_from
from swarmsim.site.terrain_crossing import ceilings, clear_until, share_below
from tests.site.yards import MATERIALS, make_site

HALF = 40.0
SOIL = MATERIALS.index("soil")
BOXES = [
    ((0, 0, 1), (3, 2, 4), 0.3, 0.2, "brick"), ((12, 1, 0), (1, 1, 6), 0.0, 0.0, "steel"),
    ((-14, 3, 1), (2, 0.1, 3), 1.2, 0.0, "concrete"),
]  # fmt: skip


def hills(seed, boxes=()):
    """A site of 81 m with random hills of up to some metres, and one cell raised to a bank."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-HALF, HALF + 1), np.arange(-HALF, HALF + 1))
    terrain = np.zeros_like(x)
    for _ in range(6):
        cx, cy = rng.uniform(-HALF, HALF, 2)
        terrain += rng.uniform(-3.0, 5.0) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / rng.uniform(1.0, 15.0) ** 2)
    return make_site(list(boxes), terrain=terrain, cell=1.0, origin=(-HALF, -HALF))


def ends(seed, n):
    """Places [n, 3] from below the ground to far above it, some beyond the border."""
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform([-50.0, -50.0, -3.0], [50.0, 50.0, 12.0], (n, 3)), jnp.float32)


_shares = jax.jit(jax.vmap(lambda site, a, b: share_below(site, ceilings(site.terrain_m), a, b), (None, 0, 0)))
_gradient = jax.jit(
    jax.vmap(jax.grad(lambda p, site: share_below(site, ceilings(site.terrain_m), p[:3], p[3:])[0]), (0, None))
)


@jax.jit
def _sampled(site, a, b):
    """Share [n] and mean place [n] of the parts below ground, from 20,000 points."""
    t = (jnp.arange(20_000) + 0.5) / 20_000

    def one(a, b):
        points = a + t[:, None] * (b - a)
        under = sample(site.terrain_m, site, points[:, :2]) > points[:, 2]
        share = jnp.mean(under)
        return share, jnp.mean(under * t) / jnp.maximum(share, 1e-9)

    return jax.lax.map(lambda pair: one(*pair), (a, b))


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31))
def test_it_is_what_dense_sampling_finds(seed):
    site, a, b = hills(seed), ends(seed + 1, 64), ends(seed + 2, 64)
    share, place = _shares(site, a, b)
    expected, mean = _sampled(site, a, b)
    np.testing.assert_allclose(share, expected, atol=6e-4)
    seen = np.asarray(expected) > 0.02
    np.testing.assert_allclose(np.asarray(place)[seen], np.asarray(mean)[seen], atol=5e-3)


@jax.jit
def _clear(site, a, b):
    return jax.vmap(lambda a, b: clear_until(site, ceilings(site.terrain_m), a, b))(a, b)


def test_what_counts_as_clear_is_above_the_ground():
    """A thousand segments, many of them just above the ground: none is below it before the share told."""
    for seed in range(4):
        site, a, b = hills(seed), ends(seed + 10, 250), ends(seed + 20, 250)
        heights = np.random.default_rng(seed).uniform(0.05, 2.0, (2, 250))
        on = jax.vmap(partial(sample, site.terrain_m, site))
        a, b = (x.at[:, 2].set(on(x[:, :2]) + h) for x, h in zip((a, b), heights, strict=True))
        until = _clear(site, a, b)
        below, _ = _sampled(site, a, a + until[:, None] * (b - a))
        assert float(below.max()) == 0.0
        assert 0.3 < float(jnp.mean(until >= 1.0)) < 1.0
        share, _ = _shares(site, a, b)
        assert float(share[until >= 1.0].max()) == 0.0


@pytest.mark.slow
def test_a_bank_of_a_metre_on_a_ray_of_a_hundred():
    """Closed form: a ridge one cell to each side, 2 m high, crossed half way up, has half its width of 2 m there."""
    ny, nx = 9, 241
    terrain = np.zeros((ny, nx), np.float32)
    terrain[:, 150] = 2.0
    site = make_site([], terrain=terrain, cell=0.5, origin=(-60.0, -2.0))
    a, b = jnp.array([-50.0, 0.0, 1.0]), jnp.array([50.0, 0.0, 1.0])
    found = crossed(site, a, b)
    assert float(found.length_m[SOIL]) == pytest.approx(0.5, rel=1e-3)
    assert float(found.place[SOIL]) == pytest.approx((150 * 0.5 - 60.0 + 50.0) / 100.0, abs=1e-4)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**31))
def test_its_gradient_is_that_of_differences(seed):
    site, a, b = hills(seed), ends(seed + 3, 32), ends(seed + 4, 32)
    both, step = jnp.concatenate([a, b], axis=1), 2e-2
    found = np.asarray(_gradient(both, site))
    for axis in range(6):
        shift = jnp.zeros(6).at[axis].set(step)
        up, down = (_shares(site, p[:, :3], p[:, 3:])[0] for p in (both + shift, both - shift))
        difference = np.asarray(up - down) / (2 * step)
        # a segment that begins to touch a hilltop within the step has no derivative there
        wrong = np.abs(found[:, axis] - difference) > 2e-3 + 0.1 * np.abs(difference)
        assert wrong.mean() < 0.1


@pytest.mark.slow
def test_gradients_go_through_reverse_and_forward():
    site, (a, *_), (b, *_) = hills(3), ends(5, 1), ends(6, 1)
    b = b.at[2].set(-1.0)
    reverse = jax.grad(lambda p: path_lengths(site, p, b)[SOIL])(a)
    forward = jax.jacfwd(lambda p: path_lengths(site, p, b)[SOIL])(a)
    np.testing.assert_allclose(reverse, forward, rtol=1e-5, atol=1e-6)
    assert np.any(np.asarray(reverse) != 0.0)


_many = jax.jit(crossed_from)
_one_by_one = jax.jit(jax.vmap(crossed, (None, None, 0)))


@settings(max_examples=10)
@given(seed=st.integers(0, 2**31))
def test_many_are_those_of_one_by_one(seed):
    site, (a, *_), b = hills(seed, BOXES), ends(seed + 1, 1), ends(seed + 2, 101)
    for found, expected in zip(
        jax.tree.leaves(_many(site, a, b)), jax.tree.leaves(_one_by_one(site, a, b)), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=2e-4)


def test_vertical_and_empty_segments():
    site = hills(2)
    ground = float(sample(site.terrain_m, site, jnp.array([3.3, 4.4])))
    down = path_lengths(site, jnp.array([3.3, 4.4, ground + 2.0]), jnp.array([3.3, 4.4, ground - 3.0]))
    assert float(down[SOIL]) == pytest.approx(3.0, rel=1e-4)
    place = jnp.array([3.3, 4.4, ground - 1.0])
    assert not np.isnan(np.asarray(path_lengths(site, place, place))).any()


def test_a_raster_of_many_cells_is_crossed_to_its_end():
    """A step over the border of a tile is less than float32 adds to a place near 1 of so long a segment."""
    terrain = np.zeros((2, 120_001))
    terrain[:, 100_000:] = 3.0
    site = make_site((), terrain=terrain, cell=0.01, origin=(0.0, 0.0))
    share, place = _shares(site, jnp.array([[0.0, 0.005, 1.0]]), jnp.array([[1200.0, 0.005, 1.0]]))
    assert float(share[0]) == pytest.approx(200.0 / 1200.0, abs=1e-4)
    assert float(place[0]) == pytest.approx(1100.0 / 1200.0, abs=1e-3)
