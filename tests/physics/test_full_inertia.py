"""A body whose principal axes are not its own: against MuJoCo C, by what is conserved, and beside ordinary ones."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from swarmsim.config.vehicle_checks import effectiveness
from swarmsim.config.vehicles import Multirotor, inertia_tensor
from swarmsim.control.commands import BodyRateCommand, PositionCommand, multirotor_command
from swarmsim.control.multirotor import control, control_start
from swarmsim.physics.multirotor import longest_time_step, make_multirotor_step, rest_state, step_loads
from swarmsim.vehicles.multirotor import multirotor_mjcf, multirotor_params
from swarmsim.world.build import build_world
from swarmsim.world.multirotor import knocked
from tests.flights import (
    CALM,
    DT,
    ENGINES,
    PLAIN,
    airborne,
    angle_deg,
    attitude,
    fly,
    fly_controlled,
    hover_speed,
    plane,
    spec_of,
)
from tests.policies.sites import block_site
from tests.world.worlds import row, scenario

LOPSIDED = (0.12, 0.13, 0.19, 0.02, -0.02, 0.015)  # Ixx, Iyy, Izz, Ixy, Ixz, Iyz
TENSOR = inertia_tensor(LOPSIDED)
engines = pytest.mark.parametrize("engine", ENGINES)


def lopsided(numbers=LOPSIDED, name="tarot_t650") -> Multirotor:
    return spec_of(name).model_copy(update={"inertia_kg_m2": numbers})


def as_file(numbers) -> Multirotor:
    """The T650 with another inertia, read as from its file."""
    return Multirotor.model_validate(spec_of().model_dump() | {"inertia_kg_m2": numbers})


def test_the_parameters_make_up_the_tensor():
    params = multirotor_params(lopsided())
    axes = attitude(params.principal_axes)
    np.testing.assert_allclose(axes @ np.diag(params.inertia_kg_m2) @ axes.T, TENSOR, atol=1e-7)
    assert 20.0 < angle_deg(params.principal_axes, np.array([1.0, 0, 0, 0])) < 60.0
    model = mujoco.MjModel.from_xml_string(multirotor_mjcf(lopsided(), DT))
    np.testing.assert_allclose(np.sort(model.body_inertia[1]), np.sort(params.inertia_kg_m2), rtol=1e-5)


def test_without_products_of_inertia_it_is_the_diagonal_one():
    plain = multirotor_params(spec_of())
    padded = multirotor_params(as_file((*spec_of().inertia_kg_m2, 0.0, 0.0, 0.0)))
    assert jax.tree.structure(padded) == jax.tree.structure(plain)
    jax.tree.map(np.testing.assert_array_equal, padded, plain)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((0.1, 0.1), "at least 3"),
        ((0.1, 0.1, 0.1, 0.0), "three principal moments, or the six elements Ixx, Iyy, Izz, Ixy, Ixz, Iyz"),
        ((0.1, 0.1, -0.1), "must be positive definite: its principal moments are -0.1, 0.1, 0.1"),
        ((0.1, 0.1, 0.1, 0.2, 0.0, 0.0), "must be positive definite: its principal moments are -0.1, 0.1, 0.3"),
        ((0.1, 0.1, 0.3), "the largest of 0.1, 0.1, 0.3 exceeds the sum of the others"),
    ],
)
def test_what_no_body_has_is_refused(numbers, message):
    with pytest.raises(ValueError, match=message):
        as_file(numbers)


@pytest.mark.slow
@engines
def test_flight_is_that_of_mujoco_c_with_the_full_tensor(engine):
    """Three seconds under the loads of `step_loads`, which MuJoCo C integrates by Runge and Kutta's method."""
    spec = lopsided()
    params = multirotor_params(spec)
    hover, wind = hover_speed(params), jnp.array([3.0, 0.0, 0.0])
    time = DT * np.arange(600)[:, None]
    commands = hover * (1 + 0.03 * np.sin(3 * time + np.array([0.0, 1.0, 2.0, 3.5])))
    start = airborne(params, speed=hover)
    states = fly(params, start, commands, wind=wind, engine=engine)
    before = jax.tree.map(lambda first, rest: np.concatenate([np.asarray(first)[None], rest[:-1]]), start, states)
    found = jax.jit(jax.vmap(lambda state, command: step_loads(params, state, command, wind, plane(), DT)))
    loads = jax.tree.map(np.asarray, found(before, jnp.asarray(commands, jnp.float32)))
    model = mujoco.MjModel.from_xml_string(multirotor_mjcf(spec, DT))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, 100, 1, 0, 0, 0]
    places, turns, rates = [], [], []
    for force_n, torque_nm, momentum in zip(loads.force_n, loads.torque_nm, loads.rotor_momentum_nms, strict=True):
        rate = data.qvel[3:] + 0.5 * DT * np.linalg.solve(TENSOR, torque_nm)  # in the middle of the step
        torque_nm = torque_nm - np.cross(rate, [0.0, 0.0, momentum])
        torque_nm += 0.5 * DT * np.cross(rate, torque_nm)  # what MuJoCo is given does not turn with the body
        data.xfrc_applied[1] = [*force_n, *attitude(data.qpos[3:]) @ torque_nm]
        mujoco.mj_step(model, data)
        places.append(data.qpos[:3].copy())
        turns.append(data.qpos[3:].copy())
        rates.append(data.qvel[3:].copy())
    assert np.linalg.norm(states.body.position_m - places, axis=1).max() < 2e-4
    assert angle_deg(states.body.quaternion, np.array(turns)).max() < 0.02
    np.testing.assert_allclose(states.body.angular_velocity_rad_s, rates, atol=2e-3)
    assert angle_deg(np.array(turns), np.array([1.0, 0, 0, 0])).max() > 20.0


@engines
@pytest.mark.parametrize("flywheel_rad_s", [0.0, 120.0])
def test_thirty_seconds_of_tumbling_keep_energy_and_momentum(engine, flywheel_rad_s):
    """At 6.8 rad/s without torques, also with two rotors that turn the same way and touch no air."""
    params = replace(
        multirotor_params(lopsided(), PLAIN),
        thrust_coefficient_n_s2=jnp.float32(0.0),
        drag_quadratic_kg_m=jnp.float32(0.0),
        rotor_inertia_kg_m2=jnp.float32(1e-3),
        speed_min_rad_s=jnp.float32(0.0),
        time_constant_down_s=jnp.float32(1e9),
    )
    speeds = flywheel_rad_s * jnp.array([1.0, 1.0, 0.0, 0.0])
    start = airborne(params, height=6000.0, speed=speeds, rate=(5.0, -3.0, 3.5))
    step = make_multirotor_step(engine, DT)

    def hundred(state, _):
        tick = lambda s, _: (step(params, s, jnp.maximum(speeds, 1e-6), CALM, plane()), None)  # noqa: E731
        state, _ = jax.lax.scan(tick, state, None, length=100)
        return state, (state.body.angular_velocity_rad_s, state.body.quaternion)

    rates, turns = map(np.asarray, jax.jit(lambda s: jax.lax.scan(hundred, s, None, length=60)[1])(start))
    first = np.array([5.0, -3.0, 3.5])
    energy = np.einsum("ni,ij,nj->n", rates, TENSOR, rates) / (first @ TENSOR @ first)
    assert np.abs(energy - 1.0).max() < 0.01
    wheels = 1e-3 * 2 * flywheel_rad_s * np.array([0.0, 0.0, 1.0])
    momentum = np.einsum("nij,nj->ni", attitude(turns), rates @ TENSOR + wheels)
    before = TENSOR @ first + wheels
    assert np.linalg.norm(momentum - before, axis=1).max() < 0.01 * np.linalg.norm(before)


def test_the_controller_asks_for_the_torque_of_the_tensor():
    spec = lopsided()
    params, command = multirotor_params(spec, PLAIN), jnp.array([0.3, -0.2, 0.05])
    state = airborne(params, speed=hover_speed(params), rate=(0.1, 0.2, -0.05))
    wanted = multirotor_command(BodyRateCommand(body_rate_rad_s=command, thrust_n=3.5 * 9.81), 4)
    speeds, memory = control(params, control_start(), state, wanted, 0.01)
    rate = np.array([0.1, 0.2, -0.05])
    change = spec.control.rate_gain_1_s * (np.asarray(command) - rate + np.asarray(memory.rate_integral_rad_s))
    torque = effectiveness(spec)[1:] @ (spec.rotor.thrust_coefficient_n_s2 * np.asarray(speeds) ** 2)
    np.testing.assert_allclose(torque, TENSOR @ change + np.cross(rate, TENSOR @ rate), atol=1e-4)


def test_it_hovers_and_yaws_upright():
    params = multirotor_params(lopsided())
    start = airborne(params, height=20.0, speed=hover_speed(params))

    def turning(time):
        place = jnp.array([2.0, 0.0, 20.0])
        return PositionCommand(
            position_m=place, velocity_m_s=jnp.zeros(3), acceleration_m_s2=jnp.zeros(3), yaw_rad=time
        )

    states, _, _ = fly_controlled(params, turning, 8.0, state=start)
    np.testing.assert_allclose(states.body.position_m[-100:], [[2.0, 0.0, 20.0]] * 100, atol=0.05)
    np.testing.assert_allclose(states.body.angular_velocity_rad_s[-100:], [[0.0, 0.0, 1.0]] * 100, atol=0.02)


def test_a_knock_changes_the_angular_momentum_by_as_much():
    params = multirotor_params(lopsided())
    state = airborne(params, rate=(0.5, 0.2, -0.1), q=(0.8, 0.6, 0.0, 0.0))
    spin = np.array([0.02, -0.03, 0.04])
    after = knocked(params, state, jnp.array([1.0, 0.0, 0.0]), jnp.asarray(spin))
    change = np.asarray(after.body.angular_velocity_rad_s) - [0.5, 0.2, -0.1]
    np.testing.assert_allclose(attitude(state.body.quaternion) @ TENSOR @ change, spin, atol=1e-7)


@engines
def test_it_rests_on_its_feet(engine):
    spec = lopsided()
    assert DT < longest_time_step(spec) < longest_time_step(lopsided(LOPSIDED[:3]))
    params = multirotor_params(spec)
    states = fly(params, rest_state(params, plane(), 0.7), 0.0, steps=400, engine=engine)
    assert np.linalg.norm(states.body.velocity_m_s, axis=1).max() < 1e-3


def test_a_group_may_mix_it_with_ordinary_ones():
    pair = scenario(row("uav", "tarot_t650", 2, (-30.0, -20.0)))
    pair = replace(pair, vehicles=(spec_of(), lopsided()))
    (group,) = build_world(pair, SimpleNamespace(site=block_site(()))).groups
    for params in (group.params, group.params.control):
        assert params.principal_axes.shape == (2, 4)
        np.testing.assert_array_equal(params.principal_axes[0], [1.0, 0.0, 0.0, 0.0])
        np.testing.assert_allclose(params.inertia_kg_m2[0], spec_of().inertia_kg_m2)
