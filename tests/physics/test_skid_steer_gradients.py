"""Derivatives of the rover's motion through 1 s of driving, against central differences."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.skid_steer import wheel_speeds
from swarmsim.physics.rotations import yaw_of
from swarmsim.physics.skid_steer import rest_state
from tests.physics.rovers import DT, ENGINES, PARAMS, STEP, plane_site

STEPS = round(1.0 / DT)
SIZE = {  # of what the motion is differentiated by
    "front left": 1.0,  # rad/s, on top of the commanded speed of the wheel
    "front right": 1.0,
    "rear left": 1.0,
    "rear right": 1.0,
    "speed": 1.0,  # m/s
    "yaw rate": 1.0,  # rad/s
    "east": 0.1,  # m
    "north": 0.1,
    "yaw": 0.1,  # rad
    "mass": 51.0,  # kg
    "friction": 0.8,
}
SIZES = np.array(list(SIZE.values()))
RANDOM = 16  # drives on each ground
WHEELS = [(-3.0, 3.0), (6.0, 1.0), (3.0, 5.0)]  # rad/s left and right: a turn, a sharp arc and an arc


def grounds():
    """Level ground, a slope, bumps on another slope, and level ground with a wall: a site with arrays [4, ...]."""
    bumpy = plane_site((0.05, 0.1))
    bumps = 0.02 * np.random.default_rng(0).normal(size=bumpy.terrain_m.shape)
    bumpy = dataclasses.replace(bumpy, terrain_m=bumpy.terrain_m + jnp.asarray(bumps, jnp.float32))
    sites = plane_site(), plane_site((0.12, 0.2)), bumpy, plane_site(wall_east_m=0.3)
    return jax.tree.map(lambda *x: jnp.stack(x), *sites)


def drives():
    """Ground [n], whether a speed and a yaw rate are commanded (or the wheels alone) [n], and values [n, 11]."""
    rng, ends = np.random.default_rng(4), (PARAMS.mass_kg, 0.8)
    steered = [
        (ground, 1.0, [0, 0, 0, 0, *rng.uniform([0.3, -0.8], [1.2, 0.8]), *rng.uniform(-1, 1, 2), yaw, *ends])
        for ground in range(3)
        for yaw in rng.uniform(-3.0, 3.0, RANDOM)
    ]
    wheels = [(2, 0.0, [*side, *side, 0, 0, 0.3, -0.2, 0.4, *ends]) for side in WHEELS]
    at_the_wall = (3, 0.0, [0] * 9 + [*ends])
    columns = zip(*steered, *wheels, at_the_wall, strict=True)
    return tuple(np.array(column, kind) for column, kind in zip(columns, (int, float, float), strict=True))


def reached(engine, params, sites, ground, steered, values):
    """Position and heading [4] after 1 s from rest."""
    site = dataclasses.replace(sites, **{k: getattr(sites, k)[ground] for k in ("terrain_m", "clearance_m")})
    params = dataclasses.replace(params, mass_kg=values[9], friction=jnp.full(4, values[10]))
    # With tangents on every leaf from the beginning JAX linearises the step once, and not until no more are found.
    state = jax.tree.map(lambda x: x + 0.0 * values[0], rest_state(params, site, values[6:8], values[8]))

    def one(state, _):
        command = values[:4] + steered * wheel_speeds(params, values[4], values[5], state)
        return STEP[engine](params, state, command, site), None

    body = jax.lax.scan(one, state, None, length=STEPS)[0].body
    return jnp.append(body.position_m, yaw_of(body.quaternion))


def shared():
    """Parameters and sites; but for the terrain and the walls, the sites are one."""
    sites = grounds()
    first = jax.tree.map(lambda x: x[0], sites)
    return PARAMS, dataclasses.replace(first, terrain_m=sites.terrain_m, clearance_m=sites.clearance_m)


@cache
def differences(engine):
    """Central differences [drive, 4, 11] in double precision."""
    ground, steered, values = drives()
    step = 1e-7 * SIZES
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, shared())
        ends = jax.jit(jax.vmap(jax.vmap(partial(reached, engine, *exact), (None, None, 0))))
        shifted = np.concatenate([values[:, None] + np.diag(step), values[:, None] - np.diag(step)], axis=1)
        after, before = np.split(np.asarray(ends(ground, steered, shifted)), 2, axis=1)
    return np.swapaxes((after - before) / (2.0 * step[:, None]), 1, 2)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("engine", ENGINES)
def test_derivatives_equal_central_differences(engine, mode):
    """Within 1 %, or within 1 mm and 1 mrad for a change by the whole of `SIZE`; at rest against a wall, finite.

    In `mjx` the derivative jumps where a branch, such as between sticking and sliding, changes in another
    step. In double precision the derivatives of 195 random drives agree to 1e-5. In single precision those of 6 drives
    are off by 1 to 9 %; in 5 of the 6, inputs changed by 1e-5 of `SIZE` give the same derivative in double precision,
    which is on the other side of a jump. Hence the drives that may differ here.
    """
    ground, steered, values = drives()
    slopes = jax.jit(jax.vmap(mode(partial(reached, engine, *shared()), argnums=2)))
    found = np.asarray(slopes(ground, steered.astype(np.float32), values.astype(np.float32)))
    assert np.isfinite(found).all()
    expected = differences(engine)
    scale = np.maximum(np.linalg.norm(expected, axis=1), 1e-3 / SIZES)
    error = (np.linalg.norm(found - expected, axis=1) / scale)[:-1]  # the last is at the wall
    drives_off = np.flatnonzero((error > 0.01).any(axis=1))  # of 51
    assert len(drives_off) <= (3 if engine == "mjx" else 0), error[drives_off].round(3)
    assert error.max() < 0.1, error[drives_off].round(3)
