"""Sensors of tests: perfect ones with single errors, and the truth of a vehicle that rests."""

from typing import Any

import jax.numpy as jnp

from swarmsim.config.sensors import Imu
from swarmsim.sensors.suite import Truth

GYROSCOPE = {
    "range_deg_s": 1e5,
    "resolution_deg_s": 0.0,
    "noise_deg_s_sqrt_hz": 0.0,
    "bias_instability_deg_h": 0.0,
    "bias_time_s": 100.0,
    "turn_on_std_deg_s": 0.0,
}
ACCELEROMETER = {
    "range_g": 1000.0,
    "resolution_mg": 0.0,
    "noise_ug_sqrt_hz": 0.0,
    "bias_instability_ug": 0.0,
    "bias_time_s": 100.0,
    "turn_on_std_mg": 0.0,
}


def imu(gyroscope: dict[str, float] | None = None, accelerometer: dict[str, float] | None = None, **other: Any) -> Imu:
    """An IMU without errors but these."""
    fields = {"kind": "imu", "name": "test", "description": "of a test", "rate_hz": 100.0}
    fields |= {"gyroscope": GYROSCOPE | (gyroscope or {}), "accelerometer": ACCELEROMETER | (accelerometer or {})}
    fields |= {"sources": {"gyroscope": "test", "accelerometer": "test", "rate_hz": "test"}} | other
    return Imu.model_validate(fields)


def truth(**changes: Any) -> Truth:
    """A vehicle that rests 5 m above level ground, looking east."""
    own: dict[str, Any] = {
        "position_m": (10.0, 20.0, 5.0),
        "velocity_m_s": (0.0, 0.0, 0.0),
        "quaternion": (1.0, 0.0, 0.0, 0.0),
        "angular_velocity_rad_s": (0.0, 0.0, 0.0),
        "specific_force_m_s2": (0.0, 0.0, 9.81),
        "air_velocity_m_s": (0.0, 0.0, 0.0),
        "height_m": 5.0,
    } | changes
    return Truth(**{name: jnp.asarray(value, jnp.float32) for name, value in own.items()})
