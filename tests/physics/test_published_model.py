"""The Tarot T650 against a published model of it: that of the MRS multirotor simulator, from the same rotor commands.

Its equations (ctu-mrs/mrs_multirotor_simulator, multirotor_model.hpp and config/uavs/t650.yaml; BSD 3-Clause), written
down here anew in float64: thrust and torques by the squares of the rotor speeds, a drag by the square of the velocity,
Newton and Euler's equations, and rotors that follow their commands with an exact first-order lag. The simulator holds
the rotor speeds over a step; here they go on within it, which is its limit of short steps. It knows no inertia of the
rotors and none of our other effects in moving air.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.physics.multirotor import make_multirotor_step
from tests.flights import CALM, DT, ENGINES, GRAVITY, PLAIN, airborne, attitude, params_of, plane

MASS_KG, ARM_M, HEIGHT_M, PROPELLER_M = 3.5, 0.325, 0.15, 0.19
FORCE_N_RPM2, MOMENT_M, LAG_S, DRAG = 7.3385e-7, 0.07 * 3 * PROPELLER_M, 0.03, 0.30 * np.pi * ARM_M**2
INERTIA = np.array([MASS_KG * (3 * ARM_M**2 + HEIGHT_M**2) / 12] * 2 + [MASS_KG * ARM_M**2 / 2])
PLACE_M = 0.707 * ARM_M * np.array([[1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0]])  # forward, left
SPIN = np.array([1.0, 1.0, -1.0, -1.0])
HOVER_RPM = np.sqrt(MASS_KG * GRAVITY / 4 / FORCE_N_RPM2)
RPM = 2 * np.pi / 60
TIME = DT * np.arange(600)[:, None]


def _manoeuvres():
    """Rotor commands [600, 4] over the hover speed, less one, of each manoeuvre: within 70 degrees and 13 m/s."""
    up, roll, pitch, yaw = np.ones(4), np.sign(PLACE_M[:, 1]), -np.sign(PLACE_M[:, 0]), -SPIN
    wave = lambda rate, phase=0.0: np.sin(rate * TIME + phase)  # noqa: E731
    return {
        "climb": np.where(TIME < 1.5, 0.12, -0.08) * up,
        "descent": np.where(TIME < 2.0, -0.3, 0.2) * up,
        "roll": 0.01 * wave(2 * np.pi) * roll,
        "pitch": 0.01 * wave(4.2) * pitch + 0.02 * up,
        "yaw": 0.05 * wave(2.0) * yaw,
        "all": 0.05 * wave(3) * up + 0.01 * wave(4) * roll + 0.008 * wave(5, 1.6) * pitch + 0.05 * wave(2, 1) * yaw,
    }


def _derivative(velocity, turn, rate, rpm):
    """Time derivatives of position, velocity, attitude [..., 3, 3] and body rate."""
    thrust = FORCE_N_RPM2 * rpm**2
    torque = np.stack([thrust @ PLACE_M[:, 1], -thrust @ PLACE_M[:, 0], -MOMENT_M * thrust @ SPIN], -1)
    drag = DRAG * np.linalg.norm(velocity, axis=-1, keepdims=True) * velocity
    force = thrust.sum(-1)[..., None] * turn[..., :, 2] - drag
    spin = np.cross(rate[..., None, :], np.eye(3))  # rows: rate x axis, the transposed cross product matrix
    angular = (torque - np.cross(rate, INERTIA * rate)) / INERTIA
    return velocity, force / MASS_KG - [0.0, 0.0, GRAVITY], -turn @ spin, angular


def _published_flight(commands_rpm):
    """Positions, velocities and attitudes [600, B, ...] of the commands [600, B, 4]: classical Runge-Kutta steps."""
    count = commands_rpm.shape[1]
    state = [np.tile([0.0, 0.0, 100.0], (count, 1)), np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))]
    state.append(np.zeros((count, 3)))
    rpm, flown = np.full((count, 4), HOVER_RPM), []
    for command in commands_rpm:
        after = lambda share: command + (rpm - command) * np.exp(-share * DT / LAG_S)  # noqa: B023, E731
        sums, ahead = [np.zeros_like(part) for part in state], state
        for weight, share, reach in ((1, 0.0, 0.5), (2, 0.5, 0.5), (2, 0.5, 1.0), (1, 1.0, 0.0)):
            slope = _derivative(ahead[1], ahead[2], ahead[3], after(share))
            sums = [total + weight * part for total, part in zip(sums, slope, strict=True)]
            ahead = [part + reach * DT * change for part, change in zip(state, slope, strict=True)]
        state = [part + DT / 6 * total for part, total in zip(state, sums, strict=True)]
        rpm = after(1.0)
        flown.append(state[:3])
    return [np.stack(parts) for parts in zip(*flown, strict=True)]


def _our_flight(commands_rpm, engine):
    """Positions, velocities and attitudes of our model under the same commands, rotors without inertia in still air."""
    params = replace(params_of(effects=PLAIN), rotor_inertia_kg_m2=jnp.float32(0.0))
    step = make_multirotor_step(engine, DT)

    def fly(commands):
        def tick(state, command):
            state = step(params, state, command, CALM, plane())
            return state, state.body

        return jax.lax.scan(tick, airborne(params, speed=HOVER_RPM * RPM), commands)[1]

    flown = jax.jit(jax.vmap(fly, in_axes=1, out_axes=1))(jnp.asarray(commands_rpm * RPM, jnp.float32))
    return np.asarray(flown.position_m), np.asarray(flown.velocity_m_s), attitude(flown.quaternion)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_t650_flies_as_its_published_model(engine):
    commands = HOVER_RPM * (1 + np.stack(list(_manoeuvres().values()), axis=1))
    positions, velocities, turns = _published_flight(commands)
    assert np.degrees(np.arccos(turns[:, :, 2, 2].min())) > 40.0  # flights that test something
    assert np.linalg.norm(velocities, axis=-1).max() > 9.0
    ours = _our_flight(commands, engine)
    off = np.linalg.norm(ours[0] - positions, axis=-1).max(axis=0)
    gap = np.linalg.norm(ours[2] - turns, axis=(-2, -1)).max(axis=0) / np.sqrt(2)  # small angles between attitudes
    np.testing.assert_array_less(off, 2e-3)
    np.testing.assert_array_less(np.degrees(gap), 0.01)
    np.testing.assert_allclose(ours[1], velocities, atol=2e-3)
