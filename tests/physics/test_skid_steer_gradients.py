"""Derivatives of the rover's motion through 1 s of driving, against central differences."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.skid_steer import wheel_speeds
from swarmsim.physics.rotations import yaw_of
from swarmsim.physics.skid_steer import rest_state
from tests.physics.rovers import DT, ENGINES, PARAMS, STEP, plane_site

STEPS = round(1.0 / DT)
NAMES = ("front left", "front right", "rear left", "rear right", "east", "north", "yaw", "mass", "friction")
COMMANDS = {"turn": (-3.0, 3.0), "sharp arc": (6.0, 1.0), "arc": (3.0, 5.0)}  # rad/s, left and right wheels
START, PARAMETERS = (0.3, -0.2, 0.4), (51.0, 0.8)
POINTS = np.array([[*command, *command, *START, *PARAMETERS] for command in COMMANDS.values()])
STEP_SIZE = 1e-5 * np.array([1.0, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 10.0, 0.1])


def slope():
    """Ground with bumps on a slope, so that the start pose, the mass and the friction matter."""
    site = plane_site(slope=(0.05, 0.1))
    bumps = 0.02 * np.random.default_rng(0).normal(size=site.terrain_m.shape)
    return dataclasses.replace(site, terrain_m=site.terrain_m + jnp.asarray(bumps, jnp.float32))


def reached(engine, params, site, values):
    """Position and heading [4] after 1 s from rest."""
    params = dataclasses.replace(params, mass_kg=values[7], friction=jnp.full(4, values[8]))
    state = rest_state(params, site, values[4:6], values[6])

    def one(state, _):
        return STEP[engine](params, state, values[:4], site), None

    body = jax.lax.scan(one, state, None, length=STEPS)[0].body
    return jnp.append(body.position_m, yaw_of(body.quaternion))


def differences(engine):
    """Central differences [point, 4, 9] in double precision."""
    with jax.enable_x64(True):
        params, site = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, (PARAMS, slope()))
        many = jax.jit(jax.vmap(jax.vmap(lambda values: reached(engine, params, site, values))))
        steps = np.diag(STEP_SIZE)
        ends = many(jnp.asarray(np.concatenate([POINTS[:, None] + steps, POINTS[:, None] - steps], axis=1)))
    after, before = np.split(np.asarray(ends), 2, axis=1)
    return np.swapaxes((after - before) / (2.0 * STEP_SIZE[:, None]), 1, 2)


@pytest.mark.parametrize("engine", ENGINES)
def test_derivatives_by_command_start_mass_and_friction_equal_differences(engine):
    """Holds where the contact solver converges; with a wheel at the border of sticking, friction's is off by some %."""
    expected = differences(engine)
    scale = np.linalg.norm(expected, axis=1)
    for mode in (jax.jacfwd, jax.jacrev):
        derivative = jax.jit(jax.vmap(mode(lambda values: reached(engine, PARAMS, slope(), values))))
        found = np.asarray(derivative(jnp.asarray(POINTS, jnp.float32)))
        assert np.isfinite(found).all()
        for name, error in zip(COMMANDS, np.linalg.norm(found - expected, axis=1) / scale, strict=True):
            assert error.max() < 0.01, (name, dict(zip(NAMES, error, strict=True)))


@pytest.mark.parametrize("engine", ENGINES)
def test_derivatives_at_rest_against_a_wall_are_finite(engine):
    site = plane_site(wall_east_m=0.3)
    values = jnp.asarray([0, 0, 0, 0, 0, 0, 0, *PARAMETERS], jnp.float32)
    assert bool(jnp.isfinite(jax.jit(jax.jacrev(lambda v: reached(engine, PARAMS, site, v)))(values)).all())


TILTS = {"flat": (0.0, 0.0), "slope": (0.12, 0.2)}


def steered(engine, params, site, yaw, values):
    """Position and heading [4] after 1 s at a speed and a yaw rate; values are these, the mass and the friction."""
    params = dataclasses.replace(params, mass_kg=values[2], friction=jnp.full(4, values[3]))

    def one(state, _):
        return STEP[engine](params, state, wheel_speeds(params, values[0], values[1], state), site), None

    body = jax.lax.scan(one, rest_state(params, site, jnp.zeros(2), yaw), None, length=STEPS)[0].body
    return jnp.append(body.position_m, yaw_of(body.quaternion))


@pytest.mark.parametrize("ground", TILTS)
@pytest.mark.parametrize("engine", ENGINES)
def test_derivatives_by_speed_and_yaw_rate_equal_differences(engine, ground):
    """Of 16 random commands and headings, at most 1 differs by more than 1 %, of mass and friction (`mjx`) at most 5.

    Those are wheels at the border of sticking, where the contact solver of `mjx` has not converged: by up to 6 %.
    """
    rng = np.random.default_rng(4)
    values = np.column_stack([rng.uniform([0.3, -0.8], [1.2, 0.8], (16, 2)), np.full(16, 51.0), np.full(16, 0.8)])
    yaw, site, size = rng.uniform(-3.0, 3.0, 16), plane_site(TILTS[ground]), 1e-5 * np.array([1.0, 1.0, 10.0, 0.1])
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, (PARAMS, site))
        ends = jax.jit(jax.vmap(jax.vmap(lambda y, v: steered(engine, *exact, y, v), (None, 0))))
        shifted = np.concatenate([values[:, None] + np.diag(size), values[:, None] - np.diag(size)], axis=1)
        after, before = np.split(np.asarray(ends(jnp.asarray(yaw), jnp.asarray(shifted))), 2, axis=1)
    expected = np.swapaxes((after - before) / (2.0 * size[:, None]), 1, 2)
    scale = np.maximum(np.linalg.norm(expected, axis=1), 1e-3 / np.array([1.0, 1.0, 51.0, 0.8]))
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(jax.vmap(lambda y, v, mode=mode: mode(partial(steered, engine, PARAMS, site, y))(v)))
        found = np.asarray(slopes(jnp.asarray(yaw, jnp.float32), jnp.asarray(values, jnp.float32)))
        assert np.isfinite(found).all()
        error = np.linalg.norm(found - expected, axis=1) / scale
        assert (error[:, :2].max(axis=1) > 0.01).sum() <= 1, error.round(3)
        assert (error[:, 2:].max(axis=1) > 0.01).sum() <= (5 if engine == "mjx" else 1), error.round(3)
        assert error.max() < 0.06
