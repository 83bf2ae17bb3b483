"""The Allan deviation against closed forms, and the densities of simulated sensors against those of their files."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import welch

from swarmsim.config.load import load_named
from swarmsim.sensors.allan import (
    AllanDeviation,
    allan_deviation,
    densities,
    gauss_markov_variance,
    walk_variance,
    white_noise_variance,
)
from swarmsim.sensors.errors import GAUSS_MARKOV_PEAK, ErrorState, error_model, gauss_markov, with_errors
from swarmsim.sensors.imu import drift_std
from swarmsim.sensors.suite import begin, read, suite_of
from tests.sensors.parts import imu, truth

PERIOD_S = 0.01
AXES = 16  # independent records: their mean has a quarter of the error of one


def mean_variance(record: np.ndarray, period_s: float = PERIOD_S) -> tuple[AllanDeviation, np.ndarray, np.ndarray]:
    """Deviation, mean variance [M] over records [N, A], and the relative bound of its error (4 standard deviations)."""
    allan = allan_deviation(record, period_s)
    error = 2.0 * allan.relative_error / math.sqrt(record.shape[1])
    return allan, np.mean(allan.deviation**2, axis=1), 4.0 * error


def test_the_definition_on_a_record_that_is_short() -> None:
    y = np.array([1.0, 4.0, 2.0, 8.0, 5.0, 7.0])
    allan = allan_deviation(y, 2.0, clusters_min=2, points=3)
    np.testing.assert_allclose(allan.tau_s, [2.0, 4.0, 6.0])
    one = np.mean(np.diff(y) ** 2) / 2.0
    pairs = (y[:-1] + y[1:]) / 2.0
    two = np.mean((pairs[2:] - pairs[:-2]) ** 2) / 2.0
    three = ((y[3:].mean() - y[:3].mean()) ** 2) / 2.0
    np.testing.assert_allclose(allan.deviation**2, [one, two, three])


def test_a_constant_has_none_and_a_ramp_has_its_slope() -> None:
    assert allan_deviation(np.full(100, 3.7), 0.1).deviation.max() == pytest.approx(0.0, abs=1e-12)
    ramp = allan_deviation(0.5 * np.arange(1000) * 0.1, 0.1)
    np.testing.assert_allclose(ramp.deviation, 0.5 * ramp.tau_s / math.sqrt(2.0), rtol=1e-9)  # R tau / sqrt(2)


@pytest.mark.parametrize("density", [1e-4, 0.02, 30.0])
def test_white_noise(density: float) -> None:
    noise = np.random.default_rng(1).normal(size=(40_000, AXES)) * density / math.sqrt(PERIOD_S)
    allan, variance, bound = mean_variance(noise)
    assert np.all(np.abs(variance / white_noise_variance(allan.tau_s, density) - 1.0) < bound)


@pytest.mark.parametrize("density", [1e-4, 5.0])
def test_a_random_walk(density: float) -> None:
    steps = np.random.default_rng(2).normal(size=(40_000, AXES)) * density * math.sqrt(PERIOD_S)
    allan, variance, bound = mean_variance(np.cumsum(steps, axis=0))
    assert np.all(np.abs(variance / walk_variance(allan.tau_s, density, PERIOD_S) - 1.0) < bound)


@pytest.mark.parametrize(("std", "time_s"), [(0.1, 3.0), (2.0, 0.7)])
def test_the_gauss_markov_process_of_the_models(std: float, time_s: float) -> None:
    draws = np.random.default_rng(3).normal(size=(40_000, AXES)).astype(np.float32)

    def step(value: jax.Array, draw: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = gauss_markov(value, draw, std=std, time_s=time_s, interval_s=PERIOD_S)
        return after, after

    record = np.asarray(jax.lax.scan(step, std * jnp.asarray(draws[0]), jnp.asarray(draws))[1], np.float64)
    allan, variance, bound = mean_variance(record)
    expected = gauss_markov_variance(allan.tau_s, std, time_s)
    seen = allan.tau_s > 20 * PERIOD_S  # below, samples are no integrals
    assert np.all(np.abs(variance / expected - 1.0)[seen] < bound[seen])
    assert np.std(record) == pytest.approx(std, rel=0.1)


def test_the_largest_deviation_of_a_gauss_markov_process() -> None:
    tau = np.linspace(1.0, 3.0, 2001)
    variance = gauss_markov_variance(tau, 1.0, 1.0)
    assert math.sqrt(variance.max()) == pytest.approx(GAUSS_MARKOV_PEAK, abs=1e-4)
    assert tau[variance.argmax()] == pytest.approx(1.89, abs=0.01)
    assert math.sqrt(gauss_markov_variance(1.89 * 100.0, drift_std(7.0), 100.0)) == pytest.approx(0.664 * 7.0, rel=1e-3)


def test_a_process_keeps_its_variance_with_correlation_times_that_float32_hardly_tells_from_infinity() -> None:
    """400 Hz and 1000 s: 1 - exp(-2 T) has three digits in float32, expm1 has seven."""
    value = gauss_markov(jnp.float32(0.0), jnp.float32(1.0), std=1.0, time_s=jnp.float32(1000.0), interval_s=0.0025)
    assert float(value) == pytest.approx(math.sqrt(-math.expm1(-2 * 0.0025 / 1000.0)), rel=1e-5)


@pytest.mark.parametrize(
    ("record", "told"), [([1.0], "too short"), ([1.0, math.nan] * 9, "finite"), (np.ones(()), "too short")]
)
def test_a_record_that_tells_nothing_is_refused(record: object, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        allan_deviation(record, 0.1)
    with pytest.raises(ValueError, match="positive"):
        allan_deviation(np.ones(20), 0.0)
    with pytest.raises(ValueError, match="clusters_min"):
        allan_deviation(np.ones(20), 1.0, clusters_min=1)


def at_rest(suites: object, count: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Gyroscope and accelerometer [samples, count, 3] of a batch of IMUs at rest."""
    keys = jax.random.split(jax.random.key(5), count)
    states = jax.vmap(begin)(suites, keys)
    still = truth()

    def tick(states: object, k: jax.Array) -> tuple[object, tuple[jax.Array, jax.Array]]:
        states, readings = jax.vmap(read, in_axes=(0, 0, None, 0, None))(suites, states, still, keys, k)
        return states, (readings.gyro_rad_s, readings.accel_m_s2)

    run = jax.jit(lambda states: jax.lax.scan(tick, states, jnp.arange(samples))[1])
    gyro, accel = run(states)
    return np.asarray(gyro, np.float64), np.asarray(accel, np.float64)


def test_densities_of_a_record_at_rest_are_those_of_the_file() -> None:
    """White noise and rate random walk of four random parts.

    The estimator on 300 records of numpy of this length: N comes out with a standard deviation of 0.3 % and 0.2 % too
    small, K with 5 to 8 % and 2 to 3 % too small (with both parts alike at 0.3 to 1 s). Bounds: 4 standard deviations
    of the mean of three axes, and that bias.
    """
    rng = np.random.default_rng(7)
    parts = []
    for _ in range(4):
        gyro_noise, accel_noise = 10.0 ** rng.uniform(-3.0, -1.0), 10.0 ** rng.uniform(1.5, 3.0)
        walk = rng.uniform(0.3, 1.0)  # where both parts are alike, s
        gyroscope = {"noise_deg_s_sqrt_hz": gyro_noise, "rate_random_walk_deg_s2_sqrt_hz": gyro_noise / walk}
        accelerometer = {"noise_ug_sqrt_hz": accel_noise, "rate_random_walk_ug_s_sqrt_hz": accel_noise / walk}
        parts.append(imu(gyroscope | {"turn_on_std_deg_s": 1.0}, accelerometer | {"turn_on_std_mg": 5.0}))
    suites = jax.tree.map(lambda *x: np.stack(x), *[suite_of([part], PERIOD_S) for part in parts])
    gyro, accel = at_rest(suites, len(parts), 60_000)
    for number, part in enumerate(parts):
        for record, unit, noise, walk in (
            (
                gyro,
                math.radians(1.0),
                part.gyroscope.noise_deg_s_sqrt_hz,
                part.gyroscope.rate_random_walk_deg_s2_sqrt_hz,
            ),
            (
                accel,
                9.80665e-6,
                part.accelerometer.noise_ug_sqrt_hz,
                part.accelerometer.rate_random_walk_ug_s_sqrt_hz,
            ),
        ):
            told = densities(allan_deviation(record[:, number], PERIOD_S))
            assert np.mean(told.random_walk) == pytest.approx(unit * noise, rel=0.01)
            assert np.mean(told.rate_random_walk) == pytest.approx(unit * walk, rel=0.21)


def test_the_bias_instability_of_a_record_is_that_of_its_closed_form() -> None:
    noise, instability, time_s = 0.002, 40.0, 5.0
    part = imu({"noise_deg_s_sqrt_hz": noise, "bias_instability_deg_h": instability, "bias_time_s": time_s})
    count = 6
    suites = jax.tree.map(lambda *x: np.stack(x), *[suite_of([part], PERIOD_S)] * count)
    gyro, _ = at_rest(suites, count, 60_000)
    record = np.degrees(gyro.reshape(len(gyro), -1))
    allan, variance, bound = mean_variance(record)
    expected = white_noise_variance(allan.tau_s, noise)
    expected = expected + gauss_markov_variance(allan.tau_s, drift_std(instability / 3600.0), time_s)
    assert np.all(np.abs(variance / expected - 1.0) < bound)
    own = AllanDeviation(allan.tau_s, np.sqrt(variance), allan.clusters)
    assert densities(own).random_walk == pytest.approx(noise, rel=0.05)  # the fit has no such process
    high = np.sqrt(variance[(allan.tau_s > 7.0) & (allan.tau_s < 13.0)]).mean()
    assert 3600.0 * high / 0.664 == pytest.approx(instability, rel=0.1)  # the peak is as high as the flat part


@pytest.mark.parametrize(
    ("name", "gyro_deg_s", "accel_ug"),
    [("icm_20948", 0.015, 230.0), ("bmi088", 0.014, math.sqrt((2 * 160.0**2 + 190.0**2) / 3))],
)
def test_the_noise_of_a_shipped_part_is_that_of_its_data_sheet(name: str, gyro_deg_s: float, accel_ug: float) -> None:
    """Densities as data sheets give them: the noise in a bandwidth B is that density times sqrt(B), one-sided."""
    spec = load_named("sensors", name)
    suites = jax.tree.map(lambda *x: np.stack(x), *[suite_of([spec], 1.0 / spec.rate_hz)] * 2)
    gyro, accel = at_rest(suites, 2, 40_000)
    for record, unit, density in ((gyro, math.radians(1.0), gyro_deg_s), (accel, 9.80665e-6, accel_ug)):
        spectrum = welch(record, spec.rate_hz, nperseg=1024, axis=0, return_onesided=True)[1][4:-1]
        assert math.sqrt(spectrum.mean()) / unit == pytest.approx(density, rel=0.03)
        noise = densities(allan_deviation(record.reshape(len(record), -1), 1.0 / spec.rate_hz)).random_walk
        assert noise.mean() / unit == pytest.approx(density / math.sqrt(2.0), rel=0.03)


def test_rounding_adds_its_variance() -> None:
    """Steps far below the noise add a twelfth of their square (B. Widrow, quantisation theory)."""
    model = error_model(
        interval_s=PERIOD_S, low=-10.0, high=10.0, resolution=0.02, noise=0.02, turn_on_std=0.0, drift_std=None,
        drift_time_s=None,
    )  # fmt: skip
    state = jax.tree.map(lambda _: jnp.zeros(100_000), {"turn_on": 0, "drift": 0, "walk": 0})
    _, reading = with_errors(model, ErrorState(**state), jnp.zeros(100_000), jax.random.key(0))
    assert np.var(np.asarray(reading)) == pytest.approx(0.02**2 * (1.0 + 1.0 / 12.0), rel=0.02)
