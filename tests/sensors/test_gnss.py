"""A satellite receiver: when its messages come, how large its errors are, and what it says of them."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.load import load_named
from swarmsim.sensors.suite import begin, read, suite_of
from tests.sensors.parts import gnss, record, scanned, truth

PERIOD_S = 0.05


def moving(count: int) -> list:
    """Truths of a vehicle that goes 2 m/s east: its place is 0.1 m times the number of the period."""
    return [truth(position_m=(0.1 * k, 0.0, 1.0), velocity_m_s=(2.0, 0.0, 0.0)) for k in range(count)]


@pytest.mark.parametrize("late", [0, 1, 3, 4, 6, 9])
def test_a_message_tells_where_the_vehicle_was_when_the_fix_was_made(late: int) -> None:
    """At 5 Hz every fourth period; the latency may be longer than the time between fixes."""
    readings = record(suite_of([gnss(latency_s=late * PERIOD_S)], PERIOD_S), moving(30))
    fresh = [bool(r.gnss_fresh) for r in readings]
    assert fresh == [k >= late and (k - late) % 4 == 0 for k in range(30)]
    for k, reading in enumerate(readings):
        if k < late:
            assert int(reading.gnss_fix) == 0
            assert math.isinf(float(reading.gnss_eph_m))
            continue
        made = (k - late) // 4 * 4
        np.testing.assert_allclose(reading.gnss_position_m, (0.1 * made, 0.0, 1.0), atol=1e-6)
        np.testing.assert_allclose(reading.gnss_velocity_m_s, (2.0, 0.0, 0.0))
        assert int(reading.gnss_fix) == 3


@pytest.mark.parametrize(
    ("name", "cep_m", "velocity_m_s"), [("ublox_m8n", 2.5, None), ("zed_f9p", 1.5, 0.05), ("zed_f9p_rtk", 0.01, 0.05)]
)
def test_half_of_all_fixes_of_a_shipped_receiver_lie_within_its_cep(
    name: str, cep_m: float, velocity_m_s: float | None
) -> None:
    """Over many receivers, because the errors of one are alike for minutes; standard error 1.1 % (and RTK fixed)."""
    suite = suite_of([load_named("sensors", name)], 0.1)

    def one(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        state = begin(suite, key)
        still = truth(position_m=(0.0, 0.0, 5.0))
        for k in range(3):
            state, readings = read(suite, state, still, key, jnp.int32(k))
        return readings.gnss_position_m, readings.gnss_velocity_m_s, readings.gnss_fix

    place, velocity, fix = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(2), 8000))
    usual = np.asarray(fix) == np.median(fix)
    assert usual.mean() > 0.99
    away = np.hypot(*np.asarray(place)[usual, :2].T)
    assert np.median(away) == pytest.approx(cep_m, rel=0.05)
    if velocity_m_s is not None:
        assert np.median(np.linalg.norm(velocity, axis=-1)) == pytest.approx(velocity_m_s, rel=0.03)


def test_the_errors_are_correlated_in_time_and_what_is_said_of_them_is_true() -> None:
    spec = gnss(horizontal_std_m=2.0, vertical_std_m=3.0, correlation_s=4.0, horizontal_noise_m=0.5, rate_hz=5.0)
    readings = scanned(suite_of([spec], 0.2), truth(), 100_000)  # 20,000 s: 2,500 independent errors
    error = readings.gnss_position_m - np.array([10.0, 20.0, 5.0])
    assert np.std(error[:, 0]) == pytest.approx(math.hypot(2.0, 0.5), rel=0.06)
    assert np.std(error[:, 2]) == pytest.approx(3.0, rel=0.06)
    for lag in (5, 20, 40):
        expected = 9.0 * math.exp(-lag * 0.2 / 4.0)
        assert np.mean(error[:-lag, 2] * error[lag:, 2]) == pytest.approx(expected, abs=0.06 * 9.0)
    assert readings.gnss_eph_m[0] == pytest.approx(math.sqrt(2.0 * (4.0 + 0.25)), rel=1e-5)
    assert readings.gnss_epv_m[0] == pytest.approx(3.0, rel=1e-5)


def test_a_fix_is_lost_now_and_then_and_comes_back() -> None:
    poorer = {
        "errors": {"fix": "rtk_float", "horizontal_std_m": 1.0},
        "mean_time_between_s": 8.0,
        "mean_duration_s": 2.0,
    }
    spec = gnss(fix="rtk_fixed", horizontal_std_m=0.01, outages=poorer)
    readings = scanned(suite_of([spec], 0.2), truth(), 60_000)
    is_float = readings.gnss_fix == 5
    assert set(np.unique(readings.gnss_fix)) == {5, 6}
    assert is_float.mean() == pytest.approx(0.2, abs=0.02)  # 2 of 10 s, 1,200 outages
    assert np.diff(np.flatnonzero(np.diff(is_float.astype(int)) == 1)).mean() * 0.2 == pytest.approx(10.0, rel=0.12)
    error = readings.gnss_position_m[:, 0] - 10.0
    assert np.std(error[is_float]) == pytest.approx(1.0, rel=0.15)
    assert np.std(error[~is_float]) == pytest.approx(0.01, rel=0.15)
    np.testing.assert_allclose(readings.gnss_eph_m, np.where(is_float, 1.0, 0.01) * math.sqrt(2.0), rtol=1e-5)


def test_a_long_baseline_adds_to_the_error() -> None:
    spec = gnss(horizontal_std_m=0.01, vertical_std_m=0.01, baseline_ppm=1.0)
    far = scanned(suite_of([spec], 0.2), truth(position_m=(30_000.0, 40_000.0, 0.0)), 2)
    assert far.gnss_epv_m[0] == pytest.approx(math.hypot(0.01, 0.05), rel=1e-4)


def test_far_from_the_origin_float32_rounds_to_millimetres() -> None:
    far = scanned(suite_of([gnss()], 0.2), truth(position_m=(10_000.0004, 0.0, 0.0)), 1)
    assert abs(float(far.gnss_position_m[0, 0]) - 10_000.0004) < 0.0005
