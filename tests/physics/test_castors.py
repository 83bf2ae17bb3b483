"""A differential drive with castors behind: the TurtleBot3 Waffle Pi, in both engines and MuJoCo C."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.load import load_named
from swarmsim.control.skid_steer import wheel_speeds
from swarmsim.physics.skid_steer import rest_state
from swarmsim.physics.skid_steer_analytic import _loads
from swarmsim.physics.wheel_contact import mass_matrix
from swarmsim.vehicles.skid_steer import skid_steer_params, turning_track
from tests.flights import attitude
from tests.physics.mujoco_scenes import Rover, plane
from tests.physics.rovers import DT, ENGINES, STEP, drive, plane_site

SPEC = load_named("vehicles", "turtlebot3_waffle_pi")
PARAMS = skid_steer_params(SPEC)
AXLE_M = 0.36 * 0.177  # ahead of the centre of mass
engines = pytest.mark.parametrize("engine", ENGINES)


def test_the_castors_carry_their_share_and_have_no_motor():
    weight = 1.8 * 9.81
    loads = np.asarray(_loads(PARAMS, jnp.array([0.0, 0.0, -weight])))
    np.testing.assert_allclose(loads, weight * np.array([0.32, 0.32, 0.18, 0.18]), rtol=1e-3)
    np.testing.assert_allclose(PARAMS.wheel_position_m[:, 0], [AXLE_M, AXLE_M, AXLE_M - 0.177, AXLE_M - 0.177])
    np.testing.assert_array_equal(PARAMS.driven, [1.0, 1.0, 0.0, 0.0])
    wheel = float(PARAMS.wheel_inertia_kg_m2)
    np.testing.assert_allclose(
        np.diag(mass_matrix(PARAMS))[6:], [wheel + 0.002, wheel + 0.002, wheel, wheel], rtol=1e-5
    )
    assert float(turning_track(PARAMS)) == pytest.approx(0.288)


@pytest.mark.parametrize("command", [(6.0,) * 4, (-4.0, 4.0, -4.0, 4.0), (3.0, 6.0, 3.0, 6.0)])
def test_it_moves_as_in_mujoco_c(command):
    expected = Rover([plane()], spec=SPEC).drive(command, 3.0)[-1]
    bodies = [jax.tree.map(lambda x: x[-1], drive(engine, command, 3.0, params=PARAMS).body) for engine in ENGINES]
    for body, near_m, near_deg in zip(bodies, (2e-3, 0.025), (0.3, 2.0), strict=True):
        np.testing.assert_allclose(body.position_m, expected[:3], atol=near_m)
        heading = np.array([expected[3], *expected[4:7]]) @ np.asarray(body.quaternion)
        assert 2.0 * np.degrees(np.arccos(min(1.0, abs(heading)))) < near_deg


@engines
def test_it_turns_about_its_driven_axle(engine):
    body = drive(engine, (-4.0, 4.0, -4.0, 4.0), 3.0, params=PARAMS).body
    axle = body.position_m + AXLE_M * attitude(body.quaternion)[..., 0]
    assert np.ptp(axle[:, :2], axis=0).max() < 0.02  # the centre of mass goes round on a circle of 13 cm
    rate = 4.0 * 0.033 / 0.144
    assert 0.94 * rate < float(body.angular_velocity_rad_s[-1, 2]) < rate


@engines
@pytest.mark.parametrize(("speed", "turn"), [(0.2, 0.0), (0.15, 0.5), (0.0, 1.0)])
def test_the_controller_keeps_speed_and_yaw_rate(engine, speed, turn):
    site = plane_site()

    def step(state, _):
        state = STEP[engine](PARAMS, state, wheel_speeds(PARAMS, jnp.float32(speed), jnp.float32(turn), state), site)
        ahead = state.body.velocity_m_s @ rotation(state.body.quaternion)
        return state, jnp.stack([ahead, state.body.angular_velocity_rad_s[2]])

    def rotation(q):
        return jnp.stack([1.0 - 2.0 * (q[2] ** 2 + q[3] ** 2), 2.0 * (q[1] * q[2] + q[0] * q[3]), 0.0])

    run = jax.jit(lambda state: jax.lax.scan(step, state, None, length=round(2.0 / DT))[1])
    reached = np.asarray(run(rest_state(PARAMS, site, jnp.zeros(2), 0.3)))[-40:].mean(axis=0)
    np.testing.assert_allclose(reached, [speed, turn], atol=0.02, rtol=0.05)
