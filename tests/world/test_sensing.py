"""Navigation sensors of a world that is stepped by hand, and a belief that flies by them."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.errors import InputError
from swarmsim.config.sensors import Place
from swarmsim.control.commands import go_to
from swarmsim.physics.contact import Plane
from swarmsim.physics.rotations import from_rotation_vector, multiply, normalise, rotate, rotate_inverse
from swarmsim.sensors.imu import Triad
from swarmsim.sensors.suite import Readings
from swarmsim.world.build import build_world
from swarmsim.world.sensing import Fitted, Sensors, by_group, fit_sensors, height_above, sense, switch_on
from swarmsim.world.state import WorldState
from tests.policies.sites import block_site
from tests.world.worlds import (
    BUILDING,
    TICK_S,
    UAVS,
    Track,
    airborne,
    at_tick,
    begin,
    fly,
    row,
    scenario,
    stay,
    with_group,
)

GRAVITY = 9.81
CASE = scenario(
    row("uav", "x500", UAVS, (-30.0, -20.0)) + row("rover", "orpheus", 2, (-30.0, 0.0)),
    {"nai_1p5x1p5": 1.0, "nai_2x2": 0.09},
)


@pytest.fixture(scope="module")
def world():
    """The world of `worlds.team`, whose compiled steps are found."""
    site = replace(block_site((BUILDING,)), material_names=tuple(CASE.materials))
    return build_world(CASE, SimpleNamespace(site=site), 0)


@jax.jit
def _along(sensors: Sensors, state: WorldState, track: Track) -> tuple[Readings, ...]:
    def tick(sensed, now):
        number, body = now
        vehicle = state.groups[0].vehicle
        moved = replace(vehicle, body=replace(vehicle.body, **vars(body)))
        return sense(sensors, sensed, at_tick(with_group(state, 0, vehicle=moved), number))

    return jax.lax.scan(tick, switch_on(sensors, state), (jnp.arange(len(track.position_m)), track))[1]


def sensed_along(sensors: Sensors, state: WorldState, track: Track) -> tuple[Readings, ...]:
    """Readings [T, n, …] of the state with the bodies of group 0 as in the track, tick by tick."""
    return jax.tree.map(np.asarray, _along(sensors, state, track))


def kinds(fitted: Fitted) -> list[str]:
    """Kinds of sensors that vehicles carry."""
    return [name for name, part in vars(fitted.suite).items() if part is not None]


def test_the_team_carries_what_its_types_name(world) -> None:
    sensors = fit_sensors(CASE, world)
    assert [(f.group, f.local, kinds(f)) for f in sensors.fitted] == [
        (0, (0, 1, 2, 3, 4), ["imu", "gnss", "barometer", "magnetometer"]),
        (1, (0, 1), ["imu", "gnss", "magnetometer"]),
    ]
    assert sensors.fitted[0].suite.imu.ticks == 1
    assert sensors.fitted[0].suite.gnss.ticks == 20
    own = fit_sensors(CASE, world, others={"uav1": ("icm_20948",), "uav3": ("icm_20948",), "rover0": ()}, periods=2)
    assert [(f.group, f.local, kinds(f)) for f in own.fitted] == [
        (0, (0, 2, 4), ["imu", "gnss", "barometer", "magnetometer"]),
        (0, (1, 3), ["imu"]),
        (1, (1,), ["imu", "gnss", "magnetometer"]),
    ]
    np.testing.assert_array_equal(own.fitted[1].member, (1, 3))
    assert float(own.period_s) == pytest.approx(0.02)


def test_what_cannot_be_fitted_is_told(world) -> None:
    with pytest.raises(InputError, match=r"no vehicle 'uav9'(.|\n)*did you mean"):
        fit_sensors(CASE, world, others={"uav9": ()})
    with pytest.raises(InputError, match=r"no sensor 'gps'"):
        fit_sensors(CASE, world, others={"uav0": ("gps",)})
    with pytest.raises(InputError, match="at most one imu"):
        fit_sensors(CASE, world, others={"uav0": ("bmi088", "icm_20948")})
    with pytest.raises(InputError, match="one or more control periods"):
        fit_sensors(CASE, world, periods=0)


def test_at_rest_on_the_ground_a_team_reads_gravity_its_place_and_its_height(world) -> None:
    sensors = fit_sensors(CASE, world, others={f"uav{k}": ("bmi088", "zed_f9p_rtk", "tfmini") for k in range(UAVS)})
    state = begin(world, jax.random.key(1))
    air, ground = jax.jit(lambda s: sense(sensors, switch_on(sensors, s), s)[1])(state)
    np.testing.assert_allclose(air.accel_m_s2, np.broadcast_to((0.0, 0.0, GRAVITY), (UAVS, 3)), atol=0.4)
    np.testing.assert_allclose(ground.accel_m_s2[:, 2], GRAVITY, atol=0.4)
    np.testing.assert_allclose(air.gnss_position_m[:, :2] * 0.0, 0.0)
    assert not air.gnss_fresh.any()  # its first message comes after the latency
    assert not air.range_valid.any()  # 0.2 m above ground is nearer than it measures
    assert len(np.unique(np.asarray(air.accel_m_s2), axis=0)) == UAVS  # each its own errors


def test_the_height_above_a_slope_is_along_the_vertical() -> None:
    slope = Plane(point_m=jnp.array([0.0, 0.0, 1.0]), normal=normalise(jnp.array([-0.5, 0.0, 1.0])))  # rises 1 in 2
    assert float(height_above(slope, jnp.array([4.0, 7.0, 10.0]))) == pytest.approx(7.0, rel=1e-5)


@pytest.fixture(scope="module")
def flight(world) -> tuple[WorldState, Track]:
    """5 s of the x500s that hover, go 6 m east and 2 m up, and come back half of it: start and track (numpy)."""
    start = np.array([[-30.0 + 10.0 * k, -20.0, 12.0] for k in range(UAVS)], np.float32)
    state = first = airborne(world, begin(world, jax.random.key(3)), start)
    tracks = []
    for target, seconds in (((6.0, 0.0, 2.0), 3.0), ((3.0, 2.0, 2.0), 3.0)):
        to = start + np.array(target, np.float32)
        command = jax.vmap(partial(go_to, yaw_rad=jnp.float32(0.0)))(jnp.asarray(to))
        state, track = fly(world, state, (command, stay(world, state)[1]), seconds)
        tracks.append(track[0])
    return first, jax.tree.map(lambda *parts: np.concatenate(parts), *tracks)


def test_sensors_without_errors_lead_along_the_flight(world, flight) -> None:
    """Strapdown integration of perfect gyroscopes and accelerometers ends where the vehicle is."""
    state, track = flight
    quiet = fit_sensors(CASE, world)
    imu = quiet.fitted[0].suite.imu
    perfect = replace(imu, gyroscope=without_errors(imu.gyroscope), accelerometer=without_errors(imu.accelerometer))
    perfect = replace(perfect, acceleration_std_s_m=0.0 * imu.acceleration_std_s_m)
    fitted = replace(quiet.fitted[0], suite=replace(quiet.fitted[0].suite, imu=perfect))
    readings, *_ = sensed_along(replace(quiet, fitted=(fitted,)), state, track)
    place, velocity, attitude = strapdown(readings, track)
    assert np.linalg.norm(place - track.position_m[-1], axis=-1).max() < 0.06  # over 6 s and 9 m
    assert np.linalg.norm(velocity - track.velocity_m_s[-1], axis=-1).max() < 0.03
    assert angle_deg(attitude, track.quaternion[-1]).max() < 0.4


def without_errors(triad: Triad) -> Triad:
    """The same gyroscopes or accelerometers, perfect."""
    none = {name: 0.0 * getattr(triad.errors, name) for name in ("turn_on_std", "noise", "drift_std", "resolution")}
    return replace(
        triad, errors=replace(triad.errors, **none), scale_std=0.0 * triad.scale_std, cross_std=none["noise"]
    )


def strapdown(readings: Readings, track: Track) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place, velocity and attitude [n, …] at the end by the IMU alone, from the true beginning."""

    def tick(carry, reading):
        place, velocity, attitude, last = carry
        gyro, accel = reading
        turn = jax.vmap(from_rotation_vector)(0.5 * (gyro + last) * TICK_S)
        after = jax.vmap(multiply)(attitude, turn)
        force = jax.vmap(rotate)(normalise(attitude + after), accel)
        faster = velocity + TICK_S * (force - jnp.array([0.0, 0.0, GRAVITY]))
        return (place + 0.5 * TICK_S * (velocity + faster), faster, after, gyro), None

    first = (track.position_m[0], track.velocity_m_s[0], track.quaternion[0], readings.gyro_rad_s[0])
    rest = (readings.gyro_rad_s[1:], readings.accel_m_s2[1:])
    place, velocity, attitude, _ = jax.lax.scan(tick, jax.tree.map(jnp.asarray, first), rest)[0]
    return np.asarray(place), np.asarray(velocity), np.asarray(attitude)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between attitudes [n, 4]."""
    return np.degrees(2.0 * np.arccos(np.clip(np.abs(np.sum(a * b, axis=-1)), 0.0, 1.0)))


def believed(readings: Readings) -> tuple[np.ndarray, np.ndarray]:
    """A belief of the place and the velocity [T, n, 3] by a complementary filter.

    Attitude from the gyroscopes, drawn towards the accelerometers' vertical; velocity from the accelerometers, drawn
    towards the receiver's; place from the velocity, drawn towards the receiver's.
    """
    up = jnp.array([0.0, 0.0, 1.0])

    def one(carry, reading):
        attitude, velocity, place = carry
        seen = rotate_inverse(attitude, up)
        lean = jnp.cross(reading.accel_m_s2 / jnp.linalg.norm(reading.accel_m_s2), seen)
        attitude = multiply(attitude, from_rotation_vector(TICK_S * (reading.gyro_rad_s + 0.05 * lean)))
        velocity = velocity + TICK_S * (rotate(attitude, reading.accel_m_s2) - GRAVITY * up)
        place = place + TICK_S * velocity
        new = reading.gnss_fresh
        velocity = jnp.where(new, velocity + 0.2 * (reading.gnss_velocity_m_s - velocity), velocity)
        place = jnp.where(new, place + 0.1 * (reading.gnss_position_m - place), place)
        carry = (normalise(attitude), velocity, place)
        return carry, carry[1:]

    vehicles = readings.gyro_rad_s.shape[1]
    begun = np.argmax(readings.gnss_fresh[:, 0])
    start = (
        jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (vehicles, 1)),
        jnp.zeros((vehicles, 3)),
        jnp.asarray(readings.gnss_position_m[begun]),
    )
    filtered = jax.lax.scan(jax.vmap(one), start, readings)[1]
    return np.asarray(filtered[1]), np.asarray(filtered[0])


def test_a_belief_by_readings_follows_the_flight(world, flight) -> None:
    """With RTK and a BMI088: some decimetres while it manoeuvres; the readings themselves are late and rare."""
    state, track = flight
    names = {f"uav{k}": ("bmi088", "zed_f9p_rtk") for k in range(UAVS)}
    readings, _ = sensed_along(fit_sensors(CASE, world, others=names), state, track)
    place, velocity = believed(readings)
    late = slice(200, None)
    error = np.linalg.norm(place - track.position_m, axis=-1)[late]
    drift = np.linalg.norm(strapdown(readings, track)[0] - track.position_m[-1], axis=-1)
    assert math.sqrt(np.mean(error**2)) < 0.35
    assert math.sqrt(np.mean(np.sum((velocity - track.velocity_m_s) ** 2, axis=-1)[late])) < 0.35
    assert drift.max() > error[-1].max()  # without the receiver it drifts off


def test_the_barometer_tells_a_climb(world, flight) -> None:
    state, track = flight
    readings, _ = sensed_along(fit_sensors(CASE, world, place=Place(altitude_m=0.0)), state, track)
    climbed = track.position_m[-50:, :, 2].mean(axis=0) - track.position_m[:10, :, 2].mean(axis=0)
    fallen = readings.pressure_pa[:10].mean(axis=0) - readings.pressure_pa[-50:].mean(axis=0)
    np.testing.assert_allclose(fallen / 12.0, climbed, atol=0.5)
    assert climbed.min() > 1.5


def test_readings_are_those_of_the_seed_and_of_the_vehicle(world, flight) -> None:
    state, track = flight
    short = jax.tree.map(lambda x: x[:5], track)
    sensors = fit_sensors(CASE, world)
    one, again = (sensed_along(sensors, state, short)[0] for _ in range(2))
    other = sensed_along(sensors, replace(state, key=jax.random.key(99)), short)[0]
    np.testing.assert_array_equal(one.gyro_rad_s, again.gyro_rad_s)
    assert not np.array_equal(one.gyro_rad_s, other.gyro_rad_s)
    alone = fit_sensors(CASE, world, others={f"uav{k}": () for k in range(UAVS) if k != 3})
    np.testing.assert_allclose(sensed_along(alone, state, short)[0].gyro_rad_s[:, 0], one.gyro_rad_s[:, 3], rtol=1e-6)


@pytest.mark.slow
def test_a_group_whose_vehicles_differ_reads_zero_for_what_one_lacks(world) -> None:
    others = {"uav0": (), "uav1": ("icm_20948",), "uav3": ("tfmini",), "rover0": (), "rover1": ()}
    sensors = fit_sensors(CASE, world, others=others)
    state = begin(world, jax.random.key(1))
    air, ground = by_group(sensors, world, sense(sensors, switch_on(sensors, state), state)[1])
    assert ground is None
    assert air.differential_pressure_pa is None
    assert [bool(new) for new in air.imu_fresh] == [False, True, True, False, True]
    assert [bool(new) for new in air.rangefinder_fresh] == [False, False, False, True, False]
    np.testing.assert_array_equal(np.asarray(air.accel_m_s2)[[0, 3]], 0.0)
    np.testing.assert_allclose(np.asarray(air.accel_m_s2)[[1, 2, 4], 2], GRAVITY, atol=0.4)
