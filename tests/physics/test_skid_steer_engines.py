"""The rover's engines against MuJoCo C and against each other."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from swarmsim.physics import wheel_contact
from swarmsim.physics.rotations import from_rotation_vector, rotation_matrix, to_body, to_world, yaw_of
from swarmsim.vehicles.rover_body import rover_body
from swarmsim.vehicles.skid_steer import skid_steer_mjcf, wheel_inverse_mass
from tests.physics.rovers import DT, PARAMS, SPEC, drive, last, mujoco_drive

COMMANDS = {
    "straight": (5.0, 5.0, 5.0, 5.0),
    "gentle arc": (4.0, 5.0, 4.0, 5.0),
    "arc": (3.0, 5.0, 3.0, 5.0),
    "sharp arc": (1.0, 3.0, 1.0, 3.0),
    "reverse": (-2.0, -4.0, -2.0, -4.0),
}
MODEL = mujoco.MjModel.from_xml_string(skid_steer_mjcf(SPEC, time_step_s=DT))
SKID_TURN = (-3.0, 3.0, -3.0, 3.0)


def turned(states):
    """Degrees turned over ``states``."""
    return float(np.degrees(np.unwrap(np.asarray(yaw_of(states.body.quaternion)))[-1]))


def test_a_skid_turn_of_5_s_ends_where_mujoco_c_ends_it_at_half_a_millisecond():
    reference = mujoco_drive(SKID_TURN, 5.0, 0.0005)
    expected = np.degrees(float(yaw_of(jnp.asarray(reference.qpos[3:7]))))
    difference = (turned(drive("mjx", SKID_TURN, 5.0)) - expected + 180.0) % 360.0 - 180.0
    assert abs(difference) < 2.0  # of 250 degrees turned


@pytest.mark.parametrize("name", ["straight", "arc", "sharp arc"])
def test_paths_end_where_mujoco_c_ends_them_at_half_a_millisecond(name):
    reference = mujoco_drive(COMMANDS[name], 5.0, 0.0005)
    states = drive("mjx", COMMANDS[name], 5.0)
    length = float(jnp.sum(jnp.linalg.norm(jnp.diff(states.body.position_m, axis=0), axis=-1)))
    assert np.linalg.norm(last(states).body.position_m[:2] - reference.qpos[:2]) < 0.01 * length
    np.testing.assert_allclose(last(states).wheel_speed_rad_s, reference.qvel[6:10], atol=0.03)


def test_the_mjcf_weighs_what_the_body_does():
    body = rover_body(SPEC)
    model = mujoco.MjModel.from_xml_string(skid_steer_mjcf(SPEC))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.body_subtreemass[0] == pytest.approx(SPEC.mass_kg)
    chassis = model.body("chassis").id
    np.testing.assert_allclose(data.subtree_com[chassis] - data.xpos[chassis], 0.0, atol=1e-7)
    assert model.body_invweight0[model.body("front_left").id, 0] == pytest.approx(
        wheel_inverse_mass(SPEC, body), rel=1e-6
    )
    full = np.zeros((10, 10))
    mujoco.mj_fullM(model, data, full)
    np.testing.assert_allclose(full, wheel_contact.mass_matrix(PARAMS), atol=1e-4)


def random_state(seed):
    """MuJoCo coordinates of a rover that moves, tilted, with tyres in and out of the ground."""
    rng = np.random.default_rng(seed)
    quaternion = np.asarray(from_rotation_vector(jnp.asarray(rng.normal(0.0, [0.01, 0.01, 1.0]), jnp.float32)), float)
    qpos = np.concatenate([rng.normal(0.0, 0.002, 3), quaternion, np.zeros(4)])
    qpos[2] -= 0.002
    qvel = np.concatenate(
        [rng.normal(0.0, [0.5, 0.5, 0.05]), rng.normal(0.0, [0.1, 0.1, 0.6]), rng.normal(0.0, 3.0, 4)]
    )
    return qpos, qvel, rng.normal(0.0, 10.0, 4)


@partial(jax.jit, static_argnums=3)
def acceleration(qpos, qvel, torque, iterations):
    """Acceleration [10] of the contact model in MuJoCo's coordinates and on the level ground of the MJCF."""
    rotation = rotation_matrix(qpos[3:7])
    hub = qpos[:3] + to_world(rotation, PARAMS.wheel_position_m)
    distance = hub[:, 2] - PARAMS.wheel_position_m[:, 2]
    normal = to_body(rotation, jnp.tile(jnp.array([0.0, 0.0, 1.0]), (4, 1)))
    twist = jnp.concatenate([to_body(rotation, qvel[:3]), qvel[3:]])
    weight = to_body(rotation, jnp.array([0.0, 0.0, -SPEC.mass_kg * 9.81]))
    smooth = wheel_contact.smooth_force(PARAMS, twist, weight, jnp.zeros(3), torque)
    found = wheel_contact.accelerations(PARAMS, twist, smooth, distance, normal, iterations)
    return jnp.concatenate([to_world(rotation, found[:3]), found[3:]])


def singles(*arrays):
    return [jnp.asarray(array, jnp.float32) for array in arrays]


@pytest.mark.parametrize("seed", range(32))
def test_accelerations_are_those_of_mujoco_c_on_the_same_mjcf(seed):
    qpos, qvel, torque = random_state(seed)
    data = mujoco.MjData(MODEL)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, torque
    mujoco.mj_forward(MODEL, data)
    assert data.ncon <= 4
    exact = acceleration(*singles(qpos, qvel, torque), 20)
    np.testing.assert_allclose(exact, data.qacc, atol=2e-3 * np.abs(data.qacc).max())
    shipped = acceleration(*singles(qpos, qvel, torque), wheel_contact.NEWTON_ITERATIONS)
    assert float(jnp.abs(shipped - exact).max()) * DT < 0.02  # m/s and rad/s


def test_accelerations_are_those_of_mjx():
    model = mujoco.MjModel.from_xml_string(skid_steer_mjcf(SPEC, time_step_s=DT))
    model.opt.iterations, model.opt.ls_iterations = 30, 30
    forward = jax.jit(partial(mjx.forward, mjx.put_model(model)))
    blank = mjx.make_data(model)
    for seed in range(7, 11):
        qpos, qvel, torque = singles(*random_state(seed))
        expected = forward(blank.replace(qpos=qpos, qvel=qvel, ctrl=torque)).qacc
        np.testing.assert_allclose(
            acceleration(qpos, qvel, torque, 20), expected, atol=2e-3 * float(jnp.abs(expected).max())
        )


@pytest.mark.parametrize("name", COMMANDS)
def test_the_engines_paths_agree_within_5_percent_of_the_distance(name):
    paths = {engine: drive(engine, COMMANDS[name], 8.0).body.position_m for engine in ("mjx", "analytic")}
    length = float(jnp.sum(jnp.linalg.norm(jnp.diff(paths["mjx"], axis=0), axis=-1)))
    apart = jnp.linalg.norm(paths["mjx"] - paths["analytic"], axis=-1)
    assert float(apart.max()) < 0.05 * length


def test_the_engines_turn_in_place_alike():
    angles = [turned(drive(engine, SKID_TURN, 8.0)) for engine in ("mjx", "analytic")]
    assert angles[1] == pytest.approx(angles[0], rel=0.05)
    assert angles[0] > 300.0
