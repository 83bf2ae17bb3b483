"""Reverse-mode derivatives through one second of steps, against central differences."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import go_to
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.programs import Program
from swarmsim.world.step import reset, step
from tests.world.worlds import TICK_S, airborne, row, world

SECONDS = 1.0
SOURCE = {"nuclide": "Co-60", "position_m": (6.0, 3.0), "height_m": 0.5, "activity_mbq": 1000.0}
HEIGHT_M = 5.0
OUTPUTS = 5
# No limit of the controller is reached with these: a gradient across one would not be a difference quotient.
INPUTS = {
    "position_m": jnp.array([0.5, -0.3, 0.4]),  # commanded, from where the vehicle is
    "velocity_m_s": jnp.array([0.3, 0.2, 0.1]),
    "yaw_rad": jnp.array(0.1),
    "start_m": jnp.array([0.4, 0.2]),
    "mass": jnp.array(1.0),  # factors
    "activity": jnp.array(1.0),
}


def changed(field, inputs):
    """The world with the start, the mass and the activity of the inputs."""
    (group,) = field.groups
    params = replace(group.params, mass_kg=group.params.mass_kg * inputs["mass"])
    sources = replace(field.sources, activity_bq=field.sources.activity_bq * inputs["activity"])
    return replace(field, groups=(replace(group, start_m=inputs["start_m"][None], params=params),), sources=sources)


def fly(field, inputs):
    """Place (m), energy (10 J) and mean counts (10) of a UAV that hovers and is sent elsewhere; [5]."""
    field = changed(field, inputs)
    state = reset(field, jax.random.key(0))
    state = airborne(field, state, state.groups[0].vehicle.body.position_m.at[:, 2].add(HEIGHT_M))
    # the target is fixed: it does not move with the start
    rest = state.groups[0].vehicle.body.position_m[0, 2]
    target = jnp.append(INPUTS["start_m"], jax.lax.stop_gradient(rest)) + inputs["position_m"]
    command = go_to(target, inputs["yaw_rad"], inputs["velocity_m_s"])
    commands = (jax.tree.map(lambda x: x[None], command),)

    def tick(state, _):
        return step(field, state, commands)[0], None

    # With tangents on every leaf from the beginning JAX linearises the step once, and not until no more are found.
    zero = 0.0 * inputs["mass"]
    state = jax.tree.map(lambda x: x + zero if jnp.issubdtype(x.dtype, jnp.floating) else x, state)
    state, _ = jax.lax.scan(tick, state, None, length=round(SECONDS / TICK_S))
    (group,) = state.groups
    others = jnp.array([group.vehicle.energy_j[0], group.counter.expected_counts[0]])
    return jnp.concatenate([group.vehicle.body.position_m[0], 0.1 * others])


def with_gradients(field, inputs):
    """Outcome [5] of the flight and its derivatives [5, ...] with respect to every input."""
    value, pull = jax.vjp(partial(fly, field), inputs)
    return value, jax.vmap(lambda output: pull(output)[0])(jnp.eye(OUTPUTS))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["analytic", "mjx"])
def test_gradients_equal_central_differences(engine):
    uav = row("uav", "tarot_t650", 1, (0.4, 0.2))
    field = world(uav, engine=engine, sources=[SOURCE], sample_period_s={"nai_1p5x1p5": 0.25})

    both = partial(Program("flight with its gradients", with_gradients, clock=Clock()), field)
    value, gradient = both(INPUTS)
    assert np.isfinite(value).all()
    for name, leaf in INPUTS.items():
        found, difference = np.asarray(gradient[name]), np.zeros((OUTPUTS, *leaf.shape))
        for index in np.ndindex(leaf.shape):
            ends = [both(INPUTS | {name: leaf.at[index].add(h)})[0] for h in (0.02, -0.02)]
            difference[(slice(None), *index)] = np.subtract(*np.asarray(ends, np.float64)) / 0.04
        assert np.isfinite(found).all()
        largest = np.abs(difference).max(axis=tuple(range(1, difference.ndim)), keepdims=True)
        rounding = (
            2e-6 * np.abs(value).reshape(-1, *(1,) * leaf.ndim) / 0.04
        )  # of two float32 values over their distance
        assert np.all(np.abs(found - difference) < 0.01 * largest + 2e-4 + rounding), name
    assert np.abs(gradient["position_m"]).max() > 0.1
    assert gradient["activity"][4] > 1.0
    assert gradient["mass"][3] > 1.0
