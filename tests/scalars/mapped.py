"""Comparison of `over_vehicles` with `jax.vmap`, on arrays of a few vehicles."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.scalars import over_vehicles

N = 5
RASTER = np.random.default_rng(7).normal(size=(20, 30)).astype(np.float32)


def numbers(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(N, *shape)), jnp.float32)


def indices(high, *shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).integers(0, high, size=(N, *shape)), jnp.int32)


def assert_alike(found, expected, rtol=1e-5, atol=1e-5):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)


PLATFORMS = ("cpu", "as it is", "gpu, interpreted")  # how the program is arranged; all are run here
as_it_is = partial(over_vehicles, platform="as it is")


def check(function, *args, in_axes=0, **options):
    """Compare with `jax.vmap`; returns the results."""
    kinds = [over_vehicles(function, in_axes, platform=platform, **options) for platform in PLATFORMS]
    *found, expected = jax.jit(lambda *args: [f(*args) for f in (*kinds, jax.vmap(function, in_axes))])(*args)
    for results in found:
        assert_alike(results, expected)
    return found[0]


def primitives_of(function, *args, in_axes=0):
    """Names of the primitives that are bound."""
    return [e.primitive.name for e in jax.make_jaxpr(as_it_is(function, in_axes))(*args).eqns]


x3, x4, x34, x33 = numbers(3), numbers(4, seed=1), numbers(3, 4, seed=2), numbers(3, 3, seed=3)
MISSIONS = jnp.stack([x3, x3 + 0.3, x3 * 2.0])
