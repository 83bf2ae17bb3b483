"""Many rays from one place: the same lengths as one by one, and no ground missed."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.site import path_lengths
from swarmsim.site.horizon import GROUP, VECTOR, ceilings, clear_of_ground, path_lengths_from
from swarmsim.site.rays import ground_fraction
from tests.site.yards import make_site

HALF = 40.0
BOXES = [
    ((0, 0, 1), (3, 2, 4), 0.3, 0.2, "brick"), ((12, 1, 0), (1, 1, 6), 0.0, 0.0, "steel"),
    ((-14, 3, 1), (2, 0.1, 3), 1.2, 0.0, "concrete"),
]  # fmt: skip


def hills(seed):
    """A site of 81 m with random hills of up to some metres."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-HALF, HALF + 1), np.arange(-HALF, HALF + 1))
    terrain = np.zeros_like(x)
    for _ in range(6):
        cx, cy = rng.uniform(-HALF, HALF, 2)
        terrain += rng.uniform(-3.0, 5.0) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / rng.uniform(3.0, 15.0) ** 2)
    return make_site(BOXES, terrain=terrain, cell=1.0, origin=(-HALF, -HALF))


def ends(seed, n):
    """Places [n, 3] from below the ground to far above it, some beyond the border."""
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform([-50.0, -50.0, -3.0], [50.0, 50.0, 30.0], (n, 3)), jnp.float32)


_many = jax.jit(lambda site, a, b: path_lengths_from(site, ceilings(site), a, b))
_one_by_one = jax.jit(jax.vmap(path_lengths, (None, None, 0)))
_clear = jax.jit(lambda site, a, b: clear_of_ground(site, ceilings(site), a, b))
_below = jax.jit(jax.vmap(lambda site, a, b: ground_fraction(site, a, b - a), (None, None, 0)))


@settings(max_examples=30)
@given(seed=st.integers(0, 2**31))
def test_many_lengths_are_those_of_one_by_one(seed):
    site, (a, *_), b = hills(seed), ends(seed + 1, 1), ends(seed + 2, 3 * GROUP + 5)
    np.testing.assert_allclose(_many(site, a, b), _one_by_one(site, a, b), atol=2e-4)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**31))
def test_what_is_called_clear_never_touches_the_ground(seed):
    site, (a, *_), b = hills(seed), ends(seed + 3, 1), ends(seed + 4, 400)
    a = a.at[2].add(5.0)
    clear = np.asarray(_clear(site, a, b))
    assert np.all(np.asarray(_below(site, a, b))[clear] == 0.0)


def test_rays_to_aircraft_are_seen_to_be_clear():
    """Otherwise nothing would be gained: from a metre above a slope of 10 % to 20 m above it."""
    x = np.arange(-HALF, HALF + 1)
    site = make_site(terrain=np.tile(0.1 * x, (len(x), 1)), cell=1.0, origin=(-HALF, -HALF))
    grid = np.stack(np.meshgrid(np.linspace(-38, 38, 12), np.linspace(-38, 38, 12)), -1).reshape(-1, 2)
    b = jnp.asarray(np.column_stack([grid, 0.1 * grid[:, 0] + 20.0]), jnp.float32)
    assert np.mean(_clear(site, jnp.array([3.0, -2.0, 1.3]), b)) > 0.97
    assert not np.any(_clear(site, jnp.array([3.0, -2.0, -1.0]), b))


def test_a_segment_straight_up_and_one_of_no_length():
    site, a = hills(4), jnp.array([1.0, 2.0, 20.0])
    b = jnp.stack([a + jnp.array([0.0, 0.0, 9.0]), a])
    found = _many(site, a, b)
    np.testing.assert_allclose(found.sum(axis=1), [9.0, 0.0], atol=1e-5)
    assert np.all(np.isfinite(found))


def test_boxes_that_fill_up_a_register_cut_nothing():
    """Zero boxes at the origin are added up to a multiple of `VECTOR`: a ray through the origin is not cut by them."""
    assert len(BOXES) % VECTOR
    site = make_site([((30, 30, 0), (1, 1, 1), 0.0, 0.0, "steel")], cell=100.0)
    found = _many(site, jnp.array([-5.0, 0.0, 0.0]), jnp.array([[5.0, 0.0, 0.0], [5.0, 1.0, 0.0]]))
    np.testing.assert_allclose(found[:, 0], [10.0, np.hypot(10.0, 1.0)], rtol=1e-6)


def test_lengths_of_many_are_differentiable_in_the_place():
    site, b = hills(7), ends(8, GROUP)
    weights = jnp.arange(1.0, len(site.material_names) + 1.0)
    a = jnp.array([5.0, -3.0, 4.0])
    above = ceilings(site)
    gradient = jax.jit(jax.grad(lambda p: jnp.sum(path_lengths_from(site, above, p, b) @ weights)))(a)
    expected = jax.jit(jax.grad(lambda p: jnp.sum(jax.vmap(path_lengths, (None, None, 0))(site, p, b) @ weights)))(a)
    np.testing.assert_allclose(gradient, expected, rtol=2e-3, atol=0.05)
