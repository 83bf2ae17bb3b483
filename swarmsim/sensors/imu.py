"""Gyroscopes and accelerometers."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.config.sensors import Accelerometer, Gyroscope, Place
from swarmsim.config.sensors import Imu as ImuSpec
from swarmsim.pytree import on_host, pytree, static
from swarmsim.sensors.errors import (
    FLICKER,
    GAUSS_MARKOV_PEAK,
    ErrorModel,
    ErrorState,
    apply,
    begin_errors,
    error_model,
    gain_matrix,
    sample_ticks,
    sampled,
    with_errors,
)
from swarmsim.sensors.truth import Truth

STANDARD_GRAVITY_M_S2 = 9.80665
"""The g of data sheets."""


@pytree
class Triad:
    """Three sensors at right angles, nearly."""

    errors: ErrorModel
    scale_std: jax.Array  # [] of the scale factors, relative
    cross_std: jax.Array  # [] share of one axis that another one feels


@pytree
class Imu:
    """Parameters."""

    gyroscope: Triad  # rad/s
    accelerometer: Triad  # m/s2
    acceleration_std_s_m: jax.Array  # [] rad/s of a gyroscope per m/s2 along its axis
    ticks: int = static()  # base periods between samples


@pytree
class ImuState:
    """Errors, and the last reading."""

    gyroscope: ErrorState
    accelerometer: ErrorState
    gyroscope_gain: jax.Array  # [3, 3]
    accelerometer_gain: jax.Array  # [3, 3]
    acceleration_s_m: jax.Array  # [3] rad/s per m/s2
    gyro_rad_s: jax.Array  # [3] body
    accel_m_s2: jax.Array  # [3] body


def params_of(spec: ImuSpec, place: Place, period_s: float) -> Imu:
    """Parameters of a data sheet (host), sampled at whole base periods of ``period_s``."""
    ticks = sample_ticks(spec.rate_hz, period_s)
    interval = ticks * period_s
    return Imu(
        gyroscope=_gyroscope(spec.gyroscope, interval),
        accelerometer=_accelerometer(spec.accelerometer, interval),
        acceleration_std_s_m=on_host(
            math.radians(spec.gyroscope.acceleration_std_deg_s_g or 0.0) / STANDARD_GRAVITY_M_S2
        ),
        ticks=ticks,
    )


def _gyroscope(spec: Gyroscope, interval_s: float) -> Triad:
    unit = math.pi / 180.0
    return Triad(
        errors=error_model(
            interval_s=interval_s,
            low=-unit * spec.range_deg_s,
            high=unit * spec.range_deg_s,
            resolution=unit * spec.resolution_deg_s,
            noise=unit * spec.noise_deg_s_sqrt_hz / math.sqrt(interval_s),
            turn_on_std=unit * spec.turn_on_std_deg_s,
            drift_std=drift_std(unit * spec.bias_instability_deg_h / 3600.0),
            drift_time_s=spec.bias_time_s,
            walk=unit * (spec.rate_random_walk_deg_s2_sqrt_hz or 0.0),
        ),
        scale_std=on_host(spec.scale_std or 0.0),
        cross_std=on_host(spec.cross_axis_std or 0.0),
    )


def _accelerometer(spec: Accelerometer, interval_s: float) -> Triad:
    unit = STANDARD_GRAVITY_M_S2
    return Triad(
        errors=error_model(
            interval_s=interval_s,
            low=-unit * spec.range_g,
            high=unit * spec.range_g,
            resolution=1e-3 * unit * spec.resolution_mg,
            noise=1e-6 * unit * spec.noise_ug_sqrt_hz / math.sqrt(interval_s),
            turn_on_std=1e-3 * unit * spec.turn_on_std_mg,
            drift_std=drift_std(1e-6 * unit * spec.bias_instability_ug),
            drift_time_s=spec.bias_time_s,
            walk=1e-6 * unit * (spec.rate_random_walk_ug_s_sqrt_hz or 0.0),
        ),
        scale_std=on_host(spec.scale_std or 0.0),
        cross_std=on_host(spec.cross_axis_std or 0.0),
    )


def drift_std(bias_instability: float) -> float:
    """Standard deviation of the Gauss-Markov process whose largest Allan deviation is that of a bias instability."""
    return bias_instability * FLICKER / GAUSS_MARKOV_PEAK


def begin(imu: Imu, key: jax.Array) -> ImuState:
    """Switched on: biases, scale factors and misalignments are drawn."""
    keys = jax.random.split(key, 5)
    return ImuState(
        gyroscope=begin_errors(imu.gyroscope.errors, (3,), keys[0]),
        accelerometer=begin_errors(imu.accelerometer.errors, (3,), keys[1]),
        gyroscope_gain=gain_matrix(imu.gyroscope.scale_std, imu.gyroscope.cross_std, keys[2]),
        accelerometer_gain=gain_matrix(imu.accelerometer.scale_std, imu.accelerometer.cross_std, keys[3]),
        acceleration_s_m=imu.acceleration_std_s_m * jax.random.normal(keys[4], (3,)),
        gyro_rad_s=jnp.zeros(3),
        accel_m_s2=jnp.zeros(3),
    )


def read(imu: Imu, state: ImuState, truth: Truth, key: jax.Array, tick: jax.Array) -> tuple[ImuState, jax.Array]:
    """The IMU at ``tick``, and whether [] its reading is new."""

    def sample(key: jax.Array) -> ImuState:
        one, other = jax.random.split(key)
        turning = apply(state.gyroscope_gain, truth.angular_velocity_rad_s)
        turning = turning + state.acceleration_s_m * truth.specific_force_m_s2
        gyroscope, gyro = with_errors(imu.gyroscope.errors, state.gyroscope, turning, one)
        force = apply(state.accelerometer_gain, truth.specific_force_m_s2)
        accelerometer, accel = with_errors(imu.accelerometer.errors, state.accelerometer, force, other)
        return replace(state, gyroscope=gyroscope, accelerometer=accelerometer, gyro_rad_s=gyro, accel_m_s2=accel)

    return sampled(imu.ticks, tick, key, sample, state)
