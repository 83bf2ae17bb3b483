"""The rover's motion against closed forms: rest, slopes, walls, braking, turning, energy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.physics.rotations import rotate, yaw_of
from swarmsim.physics.skid_steer import make_skid_steer_step, rest_state
from swarmsim.physics.walls import impact_speed
from swarmsim.vehicles.skid_steer import effective_track
from tests.physics.rovers import DT, ENGINES, PARAMS, SPEC, STEP, drive, last, plane_site

G = 9.81
HALF_LENGTH = float(PARAMS.corner_m[:, 0].max())


def grade(degrees):
    return float(np.tan(np.radians(degrees)))


@pytest.mark.parametrize("engine", ENGINES)
def test_stays_at_rest_where_it_is_put(engine):
    states = drive(engine, np.zeros(4), 1.0, yaw=0.7)
    moved = states.body.position_m - states.body.position_m[0]
    assert float(jnp.abs(moved).max()) < 1e-4
    assert float(jnp.abs(last(states).body.velocity_m_s).max()) < 1e-4


@pytest.mark.parametrize("engine", ENGINES)
def test_sinks_by_the_load_over_the_tyres_stiffness(engine):
    height = float(last(drive(engine, np.zeros(4), 1.0)).body.position_m[2])
    expected = SPEC.wheels.radius_m - float(PARAMS.wheel_position_m[0, 2]) - SPEC.mass_kg * G / 4 / 40_000.0
    assert height == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 0.8])
def test_a_parked_rover_follows_the_slope_and_creeps_less_than_its_motors_give_way(engine, yaw):
    site = plane_site(slope=(grade(12.0), 0.0))
    states = drive(engine, np.zeros(4), 2.0, site, yaw=yaw)
    end = last(states)
    up = rotate(end.body.quaternion, jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(
        up, [-np.sin(np.radians(12)), 0.0, np.cos(np.radians(12))], atol=4e-3
    )  # it leans by its tyres
    along = SPEC.mass_kg * G * np.sin(np.radians(12)) * abs(np.cos(yaw))
    give = along / 4 * SPEC.wheels.radius_m**2 / SPEC.motor.speed_gain_nm_s
    assert float(jnp.linalg.norm(end.body.velocity_m_s)) < give + 5e-3


@pytest.mark.parametrize("engine", ENGINES)
def test_climbs_15_degrees(engine):
    site = plane_site(slope=(grade(15.0), 0.0))
    end = last(drive(engine, np.full(4, 5.0), 5.0, site))
    torque = SPEC.mass_kg * G * (np.sin(np.radians(15)) + 0.03 * np.cos(np.radians(15))) * SPEC.wheels.radius_m / 4
    speed = (5.0 - torque / SPEC.motor.speed_gain_nm_s) * SPEC.wheels.radius_m
    assert float(jnp.linalg.norm(end.body.velocity_m_s)) == pytest.approx(speed, rel=0.03)
    assert float(end.body.position_m[2]) > 0.2 + 5.0 * 0.8 * speed * np.sin(np.radians(15))


@pytest.mark.parametrize("engine", ENGINES)
def test_slides_down_what_friction_cannot_hold(engine):
    theta = np.arctan(SPEC.wheels.friction) + 0.12
    site = plane_site(slope=(float(np.tan(theta)), 0.0), cells=80)
    start, end = 0.5, 1.0
    states = drive(engine, np.zeros(4), end, site, yaw=np.pi / 2)  # across the slope: the wheels cannot roll
    speed = -states.body.velocity_m_s @ np.array([np.cos(theta), 0.0, np.sin(theta)])
    measured = float(speed[-1] - speed[round(start / DT)]) / (end - start)
    expected = G * (np.sin(theta) - SPEC.wheels.friction * np.cos(theta))
    assert measured == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_weak_motor_stalls_on_a_slope(engine):
    weak = dataclasses.replace(PARAMS, torque_max_nm=jnp.float32(4.0))
    site = plane_site(slope=(grade(15.0), 0.0))
    needed = SPEC.mass_kg * G * np.sin(np.radians(15)) * SPEC.wheels.radius_m / 4
    assert needed > 4.0
    end = last(drive(engine, np.full(4, 5.0), 1.0, site, params=weak))
    assert float(end.body.position_m[0]) < 0.0
    np.testing.assert_allclose(end.wheel_torque_nm, 4.0, rtol=1e-4)


@pytest.mark.parametrize("engine", ENGINES)
def test_top_speed_is_the_commanded_one_less_rolling_resistance(engine):
    end = last(drive(engine, np.full(4, 100.0), 4.0))
    torque = 0.03 * SPEC.mass_kg * G / 4 * SPEC.wheels.radius_m
    wheel = SPEC.motor.speed_max_rad_s - torque / SPEC.motor.speed_gain_nm_s
    np.testing.assert_allclose(end.wheel_speed_rad_s, wheel, rtol=2e-3)
    assert float(end.body.velocity_m_s[0]) == pytest.approx(wheel * SPEC.wheels.radius_m, rel=0.02)


@pytest.mark.parametrize("engine", ENGINES)
def test_brakes_no_harder_than_friction_and_torque_allow(engine):
    moving = last(drive(engine, np.full(4, 4.0), 2.0))
    params = dataclasses.replace(PARAMS, torque_max_nm=jnp.float32(34.0), speed_gain_nm_s=jnp.float32(50.0))
    states = drive(engine, np.zeros(4), 0.1, params=params, state=moving)
    speed = states.body.velocity_m_s[:, 0]
    slowing = float(speed[3] - speed[13]) / (10 * DT)
    limit = SPEC.wheels.friction * G
    assert 0.7 * limit < slowing < 1.03 * limit


@pytest.mark.parametrize("engine", ENGINES)
def test_coasts_to_a_stop_by_rolling_resistance(engine):
    free = dataclasses.replace(PARAMS, torque_max_nm=jnp.float32(0.0))
    moving = last(drive(engine, np.full(4, 5.0), 2.0))
    states = drive(engine, np.zeros(4), 1.0, params=free, state=moving)
    wheels = 4 * float(PARAMS.wheel_inertia_kg_m2 + PARAMS.rotor_inertia_kg_m2[0]) / SPEC.wheels.radius_m**2
    expected = 0.03 * SPEC.mass_kg * G / (SPEC.mass_kg + wheels)
    speed = states.body.velocity_m_s[:, 0]
    assert float(speed[9] - speed[-1]) / ((len(speed) - 10) * DT) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_a_wall_stops_it_and_is_neither_climbed_nor_entered(engine, yaw):
    site = plane_site(wall_east_m=2.0)
    states = drive(engine, np.full(4, 5.0), 6.0, site, yaw=yaw)
    c, s = jnp.cos(yaw_of(states.body.quaternion)), jnp.sin(yaw_of(states.body.quaternion))
    corner = (
        states.body.position_m[:, None, 0] + c[:, None] * PARAMS.corner_m[:, 0] - s[:, None] * PARAMS.corner_m[:, 1]
    )
    assert float(corner.max()) < 2.0 + 0.005
    assert float(corner.max()) > 2.0 - 0.005  # it did reach the wall
    assert float(jnp.ptp(states.body.position_m[:, 2])) < 0.02
    assert float(jnp.abs(last(states).body.velocity_m_s[0])) < 0.05


@pytest.mark.parametrize("engine", ENGINES)
def test_the_impact_speed_is_that_of_the_approach(engine):
    site = plane_site(wall_east_m=3.0)
    states = drive(engine, np.full(4, 8.0), 3.0, site)
    impact = jax.vmap(lambda state: impact_speed(PARAMS, state, site, DT))(states)
    first = int(jnp.argmax(impact > 0.0))
    approach = float(states.body.velocity_m_s[first - 1, 0])
    assert float(impact.max()) == pytest.approx(approach, rel=0.03)
    assert float(states.body.position_m[first, 0]) == pytest.approx(3.0 - HALF_LENGTH, abs=0.02)
    assert float(impact[:first].max()) == 0.0


@pytest.mark.parametrize("engine", ENGINES)
def test_turns_with_slip_on_the_effective_track(engine):
    end = last(drive(engine, [-3.0, 3.0, -3.0, 3.0], 3.0))
    rate = float(end.body.angular_velocity_rad_s[2])
    wheels = end.wheel_speed_rad_s
    geometric = float(wheels[1] - wheels[0]) * SPEC.wheels.radius_m / SPEC.wheels.track_m
    slipping = float(wheels[1] - wheels[0]) * SPEC.wheels.radius_m / float(effective_track(PARAMS.wheel_position_m))
    assert rate == pytest.approx(slipping, rel=0.03)
    assert rate < 0.55 * geometric


@pytest.mark.parametrize("engine", ENGINES)
def test_the_battery_gives_what_the_motors_do_and_the_avionics_draw(engine):
    gentle = dataclasses.replace(PARAMS, torque_max_nm=jnp.float32(10.0))  # spins no wheel
    states = drive(engine, np.full(4, 5.0), 3.0, params=gentle)
    end = last(states)
    kinetic = 0.5 * SPEC.mass_kg * float(end.body.velocity_m_s[0]) ** 2
    turning = float(PARAMS.wheel_inertia_kg_m2 + PARAMS.rotor_inertia_kg_m2[0])
    kinetic += 0.5 * turning * float(jnp.sum(end.wheel_speed_rad_s**2))
    rolled = 0.03 * SPEC.mass_kg * G * float(end.body.position_m[0])
    expected = (kinetic + rolled) / SPEC.battery.drive_efficiency + 3.0 * SPEC.battery.avionics_power_w
    assert float(end.energy_j) == pytest.approx(expected, rel=0.04)
    assert bool(jnp.all(jnp.diff(states.energy_j) > 0.0))


@pytest.mark.parametrize("engine", ENGINES)
def test_friction_never_adds_energy(engine):
    moving = last(drive(engine, [-3.0, 3.0, -3.0, 3.0], 1.0))
    free = dataclasses.replace(PARAMS, torque_max_nm=jnp.float32(0.0))
    states = drive(engine, np.zeros(4), 0.5, params=free, state=moving)
    speed = jnp.sum(states.body.velocity_m_s**2, axis=-1)
    spin = states.body.angular_velocity_rad_s[:, 2] ** 2
    energy = 0.5 * SPEC.mass_kg * speed + 0.5 * PARAMS.inertia_kg_m2[2, 2] * spin
    assert float(jnp.diff(energy[5:]).max()) < 0.01
    assert float(energy[-1]) < 0.1 * float(energy[0])


@pytest.mark.parametrize("engine", ENGINES)
def test_mass_is_swept_without_compiling_again(engine):
    site = plane_site()
    compiled = []

    def one(mass):
        compiled.append(engine)
        params = dataclasses.replace(PARAMS, mass_kg=mass, torque_max_nm=jnp.float32(10.0))
        state = rest_state(params, site, jnp.zeros(2), jnp.zeros(()))
        command = jnp.full(4, 5.0)
        return jax.lax.scan(lambda s, _: (STEP[engine](params, s, command, site), None), state, None, length=60)[0]

    sweep = jax.jit(jax.vmap(one))
    light = sweep(jnp.array([30.0, 51.0, 90.0])).body.velocity_m_s[:, 0]
    sweep(jnp.array([31.0, 52.0, 91.0]))
    assert len(compiled) == 1
    assert bool(jnp.all(jnp.diff(light) < -0.01))  # the same torque moves the heavy one more slowly


def test_an_unknown_engine_is_named_with_the_known_ones():
    with pytest.raises(ValueError, match="unknown engine 'bullet'; engines: mjx, analytic"):
        make_skid_steer_step("bullet", DT)
