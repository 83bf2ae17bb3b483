"""Reverse-mode derivatives through steps of the world, against central differences."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import DriveCommand, go_to
from swarmsim.world.step import reset, step
from tests.world.worlds import airborne, row, world

SECONDS = 0.5
SOURCE = {"nuclide": "Co-60", "position_m": (-14.0, 3.0), "height_m": 0.5, "activity_mbq": 1000.0}
OUTPUTS = ("x", "y", "z", "energy", "counts")


def outcome(state):
    """Position, energy and mean counts of the vehicle: [5], in units in which changes are of like size."""
    (group,) = state.groups
    body = group.vehicle.body
    scaled = [group.vehicle.energy_j / 10.0, group.counter.expected_counts / 10.0]
    return jnp.concatenate([body.position_m[0], scaled[0], scaled[1]])


def flown(field, state, commands):
    def tick(state, _):
        return step(field, state, commands)[0], None

    return jax.lax.scan(tick, state, None, length=round(SECONDS / 0.01))[0]


def fly(field, theta):
    """A UAV that hovers 5 m above ground and is told to go elsewhere."""
    (group,) = field.groups
    group = replace(
        group,
        start_m=group.start_m + theta["start_m"],
        params=replace(group.params, mass_kg=group.params.mass_kg * (1.0 + theta["mass"])),
    )
    sources = replace(field.sources, activity_bq=field.sources.activity_bq * (1.0 + theta["activity"]))
    field = replace(field, groups=(group,), sources=sources)
    state = reset(field, jax.random.key(0))
    place = state.groups[0].vehicle.body.position_m + jnp.array([0.0, 0.0, 5.0])
    hovering = airborne(field, state, place)
    target = jnp.array([[-18.0, 1.0, 6.5]]) + theta["position_m"]
    command = jax.vmap(go_to)(target, theta["yaw_rad"][None])
    command = replace(command, velocity_m_s=theta["velocity_m_s"][None])
    return outcome(flown(field, hovering, (command,)))


UAV = {
    "position_m": jnp.zeros(3), "velocity_m_s": jnp.array([1.0, 0.5, 0.2]), "yaw_rad": jnp.float32(0.3),
    "start_m": jnp.zeros(2), "mass": jnp.float32(0.0), "activity": jnp.float32(0.0),
}  # fmt: skip


def drive(field, theta):
    """A rover that stands and is told to drive a bend."""
    (group,) = field.groups
    group = replace(
        group,
        start_m=group.start_m + theta["start_m"],
        params=replace(group.params, mass_kg=group.params.mass_kg * (1.0 + theta["mass"])),
    )
    sources = replace(field.sources, activity_bq=field.sources.activity_bq * (1.0 + theta["activity"]))
    field = replace(field, groups=(group,), sources=sources)
    command = DriveCommand(speed_m_s=theta["speed_m_s"][None], yaw_rate_rad_s=theta["yaw_rate_rad_s"][None])
    return outcome(flown(field, reset(field, jax.random.key(0)), (command,)))


ROVER = {
    "speed_m_s": jnp.float32(0.8), "yaw_rate_rad_s": jnp.float32(0.3),
    "start_m": jnp.zeros(2), "mass": jnp.float32(0.0), "activity": jnp.float32(0.0),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "engine"), [("uav", "analytic"), ("uav", "mjx"), ("rover", "analytic")])
def test_gradients_equal_central_differences(kind, engine):
    move, theta, of_type = (fly, UAV, "tarot_t650") if kind == "uav" else (drive, ROVER, "orpheus")
    field = world(row("one", of_type, 1, (-20.0, 0.0)), engine=engine, sources=[SOURCE], sample_period_s={"nai_1p5x1p5": 0.25, "nai_2x2": 0.25})

    @jax.jit
    def both(theta):
        value, pull = jax.vjp(partial(move, field), theta)
        return value, jax.vmap(lambda row: pull(row)[0])(jnp.eye(len(OUTPUTS)))

    value, gradient = both(theta)
    for name, leaf in theta.items():
        for index in np.ndindex(leaf.shape):
            step_size = 0.02
            ends = [both(theta | {name: leaf.at[index].add(sign * step_size)})[0] for sign in (1.0, -1.0)]
            difference = np.asarray(ends[0] - ends[1], np.float64) / (2.0 * step_size)
            found = np.asarray(gradient[name])[(slice(None), *index)]
            print(name, index, found, difference)
            assert np.isfinite(found).all()
    print(value)
    assert 0
