"""The sensors of a vehicle: what they measure, when, and what holds of every suite."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmsim.config.errors import InputError
from swarmsim.config.load import load_named
from swarmsim.config.sensors import Place
from swarmsim.physics.rotations import from_rotation_vector, from_yaw, multiply, rotate
from swarmsim.sensors.errors import digital, sample_ticks
from swarmsim.sensors.suite import Suite, begin, read, suite_of
from tests.sensors.parts import (
    TICK,
    airspeed,
    barometer,
    gnss,
    imu,
    magnetometer,
    rangefinder,
    record,
    scanned,
    truth,
)

PARTS = ("bmi088", "zed_f9p_rtk", "ms5611", "rm3100", "tfmini", "ms4525do")


def every(period_s: float = 0.004) -> Suite:
    """All kinds of sensors, of the catalogue."""
    return suite_of([load_named("sensors", name) for name in PARTS], period_s)


def perfect(period_s: float = 0.02) -> Suite:
    """All kinds of sensors, without errors."""
    return suite_of([imu(), gnss(), barometer(), magnetometer(), rangefinder(), airspeed()], period_s)


def test_perfect_sensors_read_the_truth_at_rest() -> None:
    (reading,) = record(perfect(), [truth()])
    np.testing.assert_allclose(reading.accel_m_s2, (0.0, 0.0, 9.81), rtol=1e-6)
    np.testing.assert_array_equal(reading.gyro_rad_s, 0.0)
    np.testing.assert_array_equal(reading.gnss_position_m, (10.0, 20.0, 5.0))
    assert float(reading.range_m) == 5.0
    assert float(reading.differential_pressure_pa) == 0.0
    assert float(reading.pressure_pa) == pytest.approx(101_325.0 * (1 - 0.0065 * 493.0 / 288.15) ** 5.25588, rel=1e-5)
    place = Place()
    assert float(jnp.linalg.norm(reading.magnetic_field_t)) == pytest.approx(1e-6 * place.field_ut, rel=1e-6)


def test_the_accelerometer_of_a_real_part_reads_gravity_within_its_bias() -> None:
    readings = scanned(every(), truth(), 5000)
    mean = readings.accel_m_s2.mean(axis=0)
    spec = load_named("sensors", "bmi088").accelerometer
    assert np.abs(mean - (0.0, 0.0, 9.81)).max() < 5 * (spec.turn_on_std_mg * 1e-3 + spec.scale_std) * 9.81


def test_a_rotating_frame() -> None:
    """At 1 rad/s about a skew axis: the gyroscopes lead to the attitude, and the field turned back is the same."""
    period, rate = 0.01, np.array([0.6, -0.48, 0.64])
    place = Place(declination_deg=10.0, inclination_deg=60.0, field_ut=50.0)
    suite = suite_of([imu(), magnetometer(rate_hz=100.0)], period, place=place)
    quaternions = [from_rotation_vector(jnp.asarray(rate * period * k, jnp.float32)) for k in range(300)]
    found = record(suite, [truth(quaternion=q, angular_velocity_rad_s=rate) for q in quaternions])
    attitude = jnp.array([1.0, 0.0, 0.0, 0.0])
    east, north, up = 25.0 * math.sin(math.radians(10)), 25.0 * math.cos(math.radians(10)), -50.0 * math.sqrt(0.75)
    for quaternion, reading in zip(quaternions, found, strict=True):
        np.testing.assert_allclose(jnp.abs(jnp.dot(attitude, quaternion)), 1.0, atol=1e-5)
        back = 1e6 * rotate(quaternion, reading.magnetic_field_t)
        np.testing.assert_allclose(back, (east, north, up), atol=1e-3)
        attitude = multiply(attitude, from_rotation_vector(reading.gyro_rad_s * period))


def test_a_compass_reads_its_heading() -> None:
    """Looking north-west: the field's horizontal part points to the right."""
    place = Place(declination_deg=0.0, inclination_deg=0.0, field_ut=40.0)
    (reading,) = record(
        suite_of([magnetometer()], 0.02, place=place), [truth(quaternion=from_yaw(jnp.float32(0.75 * math.pi)))]
    )
    np.testing.assert_allclose(
        1e6 * reading.magnetic_field_t, (40 * math.sqrt(0.5), -40 * math.sqrt(0.5), 0), atol=1e-4
    )


def test_each_sensor_is_fresh_at_its_rate_and_holds_its_reading_between() -> None:
    specs = [imu(rate_hz=100.0), gnss(rate_hz=5.0), barometer(rate_hz=25.0), rangefinder(rate_hz=20.0, noise_m=0.1)]
    found = record(suite_of(specs, 0.01), [truth(position_m=(float(k), 0.0, 0.0)) for k in range(60)])
    for name, every_n in (("imu", 1), ("gnss", 20), ("barometer", 4), ("rangefinder", 5)):
        assert [bool(getattr(r, f"{name}_fresh")) for r in found] == [k % every_n == 0 for k in range(60)]
    assert [float(r.gnss_position_m[0]) for r in found] == [k // 20 * 20 for k in range(60)]
    ranges = [float(r.range_m) for r in found]
    assert len(set(ranges)) == 12
    assert all(ranges[k] == ranges[k // 5 * 5] for k in range(60))
    assert found[0].magnetic_field_t is None
    assert found[0].airspeed_fresh is None


@pytest.mark.parametrize(
    ("rate_hz", "period_s", "ticks"),
    [
        (1125.0, 0.004, 1),
        (50.0, 0.004, 5),
        (8.0, 0.004, 31),
        (0.5, 0.02, 100),
        (100.0, 0.004, 3),  # 83 Hz is nearer than 125 Hz
        (70.0, 0.01, 2),  # and 50 Hz than 100 Hz
        (75.0, 0.01, 1),  # 100 and 50 Hz are as near
    ],
)
def test_rates_are_whole_periods(rate_hz: float, period_s: float, ticks: int) -> None:
    assert sample_ticks(rate_hz, period_s) == ticks


@settings(max_examples=200, deadline=None)
@given(rate_hz=st.floats(0.1, 10_000.0), period_s=st.floats(1e-4, 1.0))
def test_no_number_of_periods_has_a_nearer_rate(rate_hz: float, period_s: float) -> None:
    ticks = sample_ticks(rate_hz, period_s)
    away = abs(1.0 / (ticks * period_s) - rate_hz)
    for other in (max(1, ticks - 1), ticks + 1):
        assert away <= abs(1.0 / (other * period_s) - rate_hz) * (1 + 1e-6) + 1e-6 * rate_hz


def test_the_rangefinder_looks_along_the_body_and_loses_the_ground() -> None:
    suite = suite_of([rangefinder()], 0.02)

    def reads(height_m: float, tilt_deg: float = 0.0) -> tuple[float, bool]:
        quaternion = from_rotation_vector(jnp.array([math.radians(tilt_deg), 0.0, 0.0]))
        (reading,) = record(suite, [truth(height_m=height_m, quaternion=quaternion)])
        return float(reading.range_m), bool(reading.range_valid)

    assert reads(5.0) == (5.0, True)
    assert reads(5.0, 40.0) == (pytest.approx(5.0 / math.cos(math.radians(40.0)), rel=1e-5), True)
    assert reads(5.0, 61.0) == (12.0, False)
    assert reads(5.0, 180.0) == (12.0, False)
    assert reads(11.0, 40.0) == (12.0, False)
    assert reads(0.1) == (pytest.approx(0.3), False)
    lost = scanned(suite_of([rangefinder(dropout=0.25)], 0.02), truth(), 4000).range_valid
    assert np.mean(~lost) == pytest.approx(0.25, abs=0.03)


def test_the_noise_of_a_range_grows_with_it() -> None:
    suite = suite_of([rangefinder(noise_m=0.02, noise_share=0.01)], 0.02)
    for height in (1.0, 8.0):
        ranges = scanned(suite, truth(height_m=height), 4000).range_m
        assert np.std(ranges) == pytest.approx(math.hypot(0.02, 0.01 * height), rel=0.06)


def test_the_pitot_tube_reads_dynamic_pressure() -> None:
    place = Place(altitude_m=0.0)
    suite = suite_of([airspeed()], 0.02, place=place)
    for speed in (15.0, -4.0):
        (reading,) = record(suite, [truth(air_velocity_m_s=(speed, 3.0, 0.0), position_m=(0.0, 0.0, 0.0))])
        assert float(reading.differential_pressure_pa) == pytest.approx(0.6125 * speed * abs(speed), rel=1e-4)


def test_a_suite_of_a_catalogue_runs_in_a_scan_and_differs_by_its_key_alone() -> None:
    suite = every()
    one, again, other = (scanned(suite, truth(), 50, seed) for seed in (1, 1, 2))
    for name, values in vars(one).items():
        np.testing.assert_array_equal(values, getattr(again, name))
        if not name.endswith(("fresh", "valid", "fix", "eph_m", "epv_m")) and name not in ("temperature_k",):
            assert not np.array_equal(values, getattr(other, name)), name


def test_nothing_compiles_anew_for_other_values_or_another_part_of_the_rates() -> None:
    suite = every()
    key = jax.random.key(0)
    state = begin(suite, key)
    own = jax.jit(lambda *given: read(*given))
    own(suite, state, truth(), key, jnp.int32(0))
    louder = replace(suite.imu.gyroscope.errors, noise=np.float32(1.0))
    changed = replace(suite, imu=replace(suite.imu, gyroscope=replace(suite.imu.gyroscope, errors=louder)))
    own(changed, state, truth(height_m=2.0), jax.random.key(4), jnp.int32(7))
    parts = ("icm_20948", "zed_f9p_rtk", "ms5611", "rm3100", "tfmini", "ms4525do")
    other = suite_of([load_named("sensors", n) for n in parts], 0.004, place=Place(altitude_m=3.0, field_ut=30.0))
    own(other, begin(other, key), truth(), key, jnp.int32(1))
    assert own._cache_size() == 1


def test_a_batch_reads_what_each_reads_alone() -> None:
    keys = jax.random.split(jax.random.key(3), 3)
    suites = [suite_of([imu({"noise_deg_s_sqrt_hz": n}), barometer(noise_pa=n)], 0.01) for n in (0.1, 1.0, 5.0)]
    stacked = jax.tree.map(lambda *x: np.stack(x), *suites)
    truths = [truth(height_m=h, position_m=(0.0, 0.0, h)) for h in (1.0, 2.0, 3.0)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *truths)
    states = jax.vmap(begin)(stacked, keys)
    _, readings = jax.vmap(read, in_axes=(0, 0, 0, 0, None))(stacked, states, batch, keys, jnp.int32(0))
    for i in range(3):
        _, alone = read(suites[i], begin(suites[i], keys[i]), truths[i], keys[i], jnp.int32(0))
        np.testing.assert_allclose(readings.gyro_rad_s[i], alone.gyro_rad_s, rtol=1e-6)
        np.testing.assert_allclose(readings.pressure_pa[i], alone.pressure_pa, rtol=1e-6)


def test_a_reading_has_a_gradient_in_what_it_measures() -> None:
    suite = suite_of([barometer(noise_pa=1.0), rangefinder()], 0.02)
    key = jax.random.key(0)

    def pressure(height: jax.Array) -> jax.Array:
        still = replace(truth(), position_m=jnp.array([0.0, 0.0, 1.0]) * height)
        return read(suite, begin(suite, key), still, key, jnp.int32(0))[1].pressure_pa

    assert float(jax.grad(pressure)(jnp.float32(0.0))) == pytest.approx(-11.5, abs=0.3)  # rho g at 488 m


@settings(max_examples=60, deadline=None)
@given(
    value=st.floats(-1e3, 1e3, width=32),
    resolution=st.floats(2.0**-7, 10.0, width=32),
    high=st.floats(0.5, 1e3, width=32),
)
def test_a_reading_stays_in_its_range_and_on_its_steps(value: float, resolution: float, high: float) -> None:
    read_value = float(
        digital(jnp.float32(value), resolution=jnp.float32(resolution), low=jnp.float32(-high), high=jnp.float32(high))
    )
    assert abs(read_value) <= high
    if abs(read_value) < high:
        assert abs(read_value - value) <= 0.5 * resolution * (1 + 1e-5) + 1e-4
        assert read_value / resolution == pytest.approx(round(read_value / resolution), abs=1e-2)


@settings(max_examples=25, deadline=None)
@given(
    rate=st.tuples(*[st.floats(-100.0, 100.0, width=32)] * 3),
    force=st.tuples(*[st.floats(-1e3, 1e3, width=32)] * 3),
    height=st.floats(-50.0, 5e3, width=32),
    speed=st.floats(-300.0, 300.0, width=32),
    seed=st.integers(0, 2**31 - 1),
)
def test_no_motion_makes_a_sensor_exceed_its_range_or_read_what_is_no_number(
    rate: tuple, force: tuple, height: float, speed: float, seed: int
) -> None:
    suite, key = every(), jax.random.key(seed)
    now = truth(
        angular_velocity_rad_s=rate, specific_force_m_s2=force, height_m=height, air_velocity_m_s=(speed, 0.0, 0.0),
        position_m=(0.0, 0.0, height),
    )  # fmt: skip
    _, reading = TICK(suite, begin(suite, key), now, key, jnp.int32(0))
    limit = 1 + 1e-6
    assert np.abs(reading.gyro_rad_s).max() <= math.radians(2000.0) * limit
    assert np.abs(reading.accel_m_s2).max() <= 24 * 9.80665 * limit
    assert np.abs(reading.magnetic_field_t).max() <= 800e-6 * limit
    assert 1000.0 <= float(reading.pressure_pa) <= 120_000.0
    assert 0.3 / limit <= float(reading.range_m) <= 12.0
    assert abs(float(reading.differential_pressure_pa)) <= 6894.757 * limit
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((reading.gnss_velocity_m_s, reading.temperature_k)))


def test_a_suite_that_makes_no_sense_is_told() -> None:
    with pytest.raises(InputError, match="at most one imu"):
        suite_of([load_named("sensors", "bmi088"), load_named("sensors", "icm_20948")], 0.01)
    for period in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="positive number of seconds"):
            suite_of([], period)
    with pytest.raises(InputError, match=r"no sensor 'bmi808'(.|\n)*did you mean 'bmi088'"):
        load_named("sensors", "bmi808")


def test_a_vehicle_without_sensors_reads_nothing() -> None:
    suite = suite_of([], 0.01)
    state, readings = read(suite, begin(suite, jax.random.key(0)), truth(), jax.random.key(0), jnp.int32(0))
    assert not jax.tree.leaves((state, readings))
