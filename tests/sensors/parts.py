"""Sensors of tests: perfect ones with single errors, and the truth of a vehicle that rests."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.sensors import Airspeed, Barometer, Gnss, Imu, Magnetometer, Rangefinder
from swarmsim.sensors.suite import Readings, Suite, SuiteState, Truth, begin, read

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


def gnss(latency_s: float = 0.0, rate_hz: float = 5.0, outages: Any = None, **errors: Any) -> Gnss:
    """A receiver without errors but these."""
    own = {
        "fix": "3d",
        "horizontal_std_m": 0.0,
        "vertical_std_m": 0.0,
        "correlation_s": 10.0,
        "horizontal_noise_m": 0.0,
        "vertical_noise_m": 0.0,
        "velocity_noise_m_s": 0.0,
    } | errors
    fields = {"kind": "gnss", "name": "test", "description": "of a test", "rate_hz": rate_hz, "latency_s": latency_s}
    sources = {"rate_hz": "test", "latency_s": "test", "errors": "test"}
    if outages is not None:
        fields["outages"] = outages | {"errors": own | outages["errors"]}
        sources["outages"] = "test"
    return Gnss.model_validate(fields | {"errors": own, "sources": sources})


def barometer(**changes: Any) -> Barometer:
    """A barometer without errors but these, at 50 Hz."""
    fields = {
        "rate_hz": 50.0,
        "range_pa": (1000.0, 120_000.0),
        "resolution_pa": 0.0,
        "noise_pa": 0.0,
        "turn_on_std_pa": 0.0,
        "drift_std_pa": 0.0,
        "drift_time_s": 100.0,
    }
    return Barometer.model_validate(_sourced("barometer", fields | changes))


def magnetometer(**changes: Any) -> Magnetometer:
    """A magnetometer without errors but these, at 50 Hz."""
    fields = {
        "rate_hz": 50.0,
        "range_ut": 1000.0,
        "resolution_ut": 0.0,
        "noise_ut": 0.0,
        "hard_iron_std_ut": 0.0,
        "soft_iron_std": 0.0,
    }
    return Magnetometer.model_validate(_sourced("magnetometer", fields | changes))


def rangefinder(**changes: Any) -> Rangefinder:
    """A rangefinder without errors but these, at 50 Hz."""
    fields = {"rate_hz": 50.0, "range_m": (0.3, 12.0), "resolution_m": 0.0, "noise_m": 0.0, "tilt_max_deg": 60.0}
    return Rangefinder.model_validate(_sourced("rangefinder", fields | changes))


def airspeed(**changes: Any) -> Airspeed:
    """A pitot tube without errors but these, at 50 Hz."""
    fields = {"rate_hz": 50.0, "range_pa": 5000.0, "resolution_pa": 0.0, "noise_pa": 0.0, "turn_on_std_pa": 0.0}
    return Airspeed.model_validate(_sourced("airspeed", fields | changes))


def _sourced(kind: str, fields: dict[str, Any]) -> dict[str, Any]:
    about = {"kind": kind, "name": "test", "description": "of a test", "sources": dict.fromkeys(fields, "test")}
    return fields | about


Tick = Callable[[Suite, SuiteState, Truth, jax.Array, jax.Array], tuple[SuiteState, Readings]]
TICK: Tick = jax.jit(read)


def record(suite: Suite, truths: list[Truth], seed: int = 0) -> list[Readings]:
    """What the suite reads of one truth after the other."""
    key = jax.random.key(seed)
    state, found = begin(suite, key), []
    for number, now in enumerate(truths):
        state, readings = TICK(suite, state, now, key, jnp.int32(number))
        found.append(readings)
    return found


def scanned(suite: Suite, one: Truth, count: int, seed: int = 0) -> Readings:
    """What the suite reads ``count`` times of a truth that does not change, stacked on the leading axis."""
    key = jax.random.key(seed)

    @jax.jit
    def run(suite: Suite, state: SuiteState, one: Truth) -> Readings:
        return jax.lax.scan(lambda s, k: read(suite, s, one, key, k), state, jnp.arange(count))[1]

    return jax.tree.map(np.asarray, run(suite, begin(suite, key), one))
