"""The navigation sensors of one vehicle: what an autopilot, a policy or a belief reads.

    suite = suite_of(vehicle, period_s=0.0025)
    state = begin(suite, key)
    state, readings = jax.jit(read)(suite, state, truth, key, tick)

`begin` and `read` are pure: `jax.jit`, `jax.vmap` and `jax.lax.scan` work on them. The parameters are leaves, so that
other values, of a sweep or of another part of the same kinds and rates, compile nothing anew. Call `read` inside of the
program that steps the physics: a call by itself costs Python 0.4 ms for its hundred arrays, the sensors cost 3 us.

Everything is float32: at 10 km from the mission's origin a position is known to 1 mm, at 100 km to 8 mm, which is what
an RTK fix is good for.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from types import ModuleType
from typing import Any

import jax

from swarmsim import randomness
from swarmsim.config.errors import InputError, Problem
from swarmsim.config.load import load_named
from swarmsim.config.sensors import AnySensor, Place
from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.pytree import pytree
from swarmsim.sensors import airspeed, barometer, gnss, imu, magnetometer, rangefinder
from swarmsim.sensors.airspeed import Airspeed, AirspeedState
from swarmsim.sensors.barometer import Barometer, BarometerState
from swarmsim.sensors.gnss import Gnss, GnssState
from swarmsim.sensors.imu import Imu, ImuState
from swarmsim.sensors.magnetometer import Magnetometer, MagnetometerState
from swarmsim.sensors.rangefinder import Rangefinder, RangefinderState
from swarmsim.sensors.truth import Truth

__all__ = ["Place", "Readings", "Suite", "SuiteState", "Truth", "begin", "read", "suite_of"]

_MODULES: dict[str, ModuleType] = {
    "imu": imu,
    "gnss": gnss,
    "barometer": barometer,
    "magnetometer": magnetometer,
    "rangefinder": rangefinder,
    "airspeed": airspeed,
}
"""The kinds of sensor. Each is a module with ``params_of``, ``begin`` and ``read``."""


@pytree
class Suite:
    """Parameters of the sensors of one vehicle; None for what it lacks."""

    imu: Imu | None = None
    gnss: Gnss | None = None
    barometer: Barometer | None = None
    magnetometer: Magnetometer | None = None
    rangefinder: Rangefinder | None = None
    airspeed: Airspeed | None = None


@pytree
class SuiteState:
    """Errors and last readings of the sensors; None for what the vehicle lacks."""

    imu: ImuState | None = None
    gnss: GnssState | None = None
    barometer: BarometerState | None = None
    magnetometer: MagnetometerState | None = None
    rangefinder: RangefinderState | None = None
    airspeed: AirspeedState | None = None


@pytree
class Readings:
    """Latest readings of one vehicle's sensors, body FLU and world ENU; None for what it lacks.

    ``*_fresh`` [] bool: the reading is new at this tick; otherwise it is the last one.
    """

    imu_fresh: jax.Array | None = None
    gyro_rad_s: jax.Array | None = None  # [3] body
    accel_m_s2: jax.Array | None = None  # [3] body, +9.81 along z at rest
    gnss_fresh: jax.Array | None = None
    gnss_position_m: jax.Array | None = None  # [3] world, from the mission's origin
    gnss_velocity_m_s: jax.Array | None = None  # [3] world
    gnss_eph_m: jax.Array | None = None  # [] standard deviation of the horizontal error; inf before the first message
    gnss_epv_m: jax.Array | None = None  # [] of the vertical one
    gnss_fix: jax.Array | None = None  # [] int32: 0 none, 3 3D, 5 RTK float, 6 RTK fixed
    barometer_fresh: jax.Array | None = None
    pressure_pa: jax.Array | None = None  # []
    temperature_k: jax.Array | None = None  # [] of the barometer
    magnetometer_fresh: jax.Array | None = None
    magnetic_field_t: jax.Array | None = None  # [3] body
    rangefinder_fresh: jax.Array | None = None
    range_m: jax.Array | None = None  # [] along -z of the body; the nearest or farthest range where it is not valid
    range_valid: jax.Array | None = None  # [] bool: the ground was within reach
    airspeed_fresh: jax.Array | None = None
    differential_pressure_pa: jax.Array | None = None  # []


def suite_of(
    carrier: Multirotor | SkidSteer | Sequence[AnySensor],
    period_s: float,
    *,
    place: Place | None = None,
    known: Mapping[str, AnySensor] | None = None,
) -> Suite:
    """The suite of a vehicle's configuration, or of a list of sensors' (host).

    Args:
        carrier: whose ``sensors`` are looked up by name, or the sensors themselves, at most one of each kind.
        period_s: base period, one call of `read` each. A sensor samples every whole number of base periods, the
            one whose rate is nearest to its own.
        place: where the mission's origin lies; the defaults of `Place` without it.
        known: sensors by name that come before those of the catalogue, such as ``scenario.sensors``.

    Raises:
        InputError: a name that no sensor has, two sensors of one kind, or a period that is not positive.
    """
    if not 0.0 < period_s < 1e6:
        raise InputError.of("the period of sensors must be a positive number of seconds", given=f"{period_s:g}")
    specs = sensors_of(carrier, known or {}) if isinstance(carrier, Multirotor | SkidSteer) else tuple(carrier)
    problems: list[Problem] = []
    own: dict[str, AnySensor] = {}
    for spec in specs:
        if spec.kind in own:
            message = f"a vehicle carries at most one {spec.kind}: '{own[spec.kind].name}' and '{spec.name}' are two"
            problems.append(Problem(message, given=spec.name, suggestion="leave one of them out"))
        own.setdefault(spec.kind, spec)
    if problems:
        raise InputError(problems)
    where = Place() if place is None else place
    return Suite(**{kind: _MODULES[kind].params_of(spec, where, period_s) for kind, spec in own.items()})


def sensors_of(vehicle: Multirotor | SkidSteer, known: Mapping[str, AnySensor]) -> tuple[AnySensor, ...]:
    """The sensors that a vehicle names, from ``known`` or else from the catalogue. Raises `InputError`."""
    return tuple(known[name] if name in known else load_named("sensors", name) for name in vehicle.sensors)


def begin(suite: Suite, key: jax.Array) -> SuiteState:
    """All sensors switched on: constant errors are drawn. ``key`` [] may be the one that `read` gets."""
    own = randomness.consumer(key, "sensors begin")
    return SuiteState(
        **{kind: _MODULES[kind].begin(params, randomness.consumer(own, kind)) for kind, params in _present(suite)}
    )


def read(suite: Suite, state: SuiteState, truth: Truth, key: jax.Array, tick: jax.Array) -> tuple[SuiteState, Readings]:
    """One base period: sensors that are due sample ``truth``, the others keep their reading.

    Args:
        suite: parameters.
        state: from `begin` or the last call.
        truth: of the vehicle now.
        key: [] randomness of the vehicle, the same at each call.
        tick: [] int32, number of this call from 0; a sensor of every n-th period samples at multiples of n.
    """
    own = randomness.consumer(key, "sensors")
    states, fresh = {}, {}
    for kind, params in _present(suite):
        module, before = _MODULES[kind], getattr(state, kind)
        states[kind], fresh[kind] = module.read(params, before, truth, randomness.consumer(own, kind), tick)
    after = replace(state, **states)
    return after, _readings(after, fresh)


def stale(readings: Readings | None, old: jax.Array) -> Readings | None:
    """The readings with nothing fresh where they are ``old`` [] bool: they were seen before."""
    if readings is None:
        return None
    flags = {f"{kind}_fresh": getattr(readings, f"{kind}_fresh") for kind in _MODULES}
    return replace(readings, **{name: flag & ~old for name, flag in flags.items() if flag is not None})


def _present(suite: Suite) -> list[tuple[str, Any]]:
    """Kinds and parameters of the sensors that there are."""
    pairs = [(field.name, getattr(suite, field.name)) for field in fields(suite)]
    return [(kind, params) for kind, params in pairs if params is not None]


def _readings(state: SuiteState, fresh: Mapping[str, jax.Array]) -> Readings:
    found: dict[str, Any] = {f"{kind}_fresh": new for kind, new in fresh.items()}
    if state.imu is not None:
        found |= {"gyro_rad_s": state.imu.gyro_rad_s, "accel_m_s2": state.imu.accel_m_s2}
    if state.gnss is not None:
        message = state.gnss.message
        found |= {
            "gnss_position_m": message.position_m,
            "gnss_velocity_m_s": message.velocity_m_s,
            "gnss_eph_m": message.eph_m,
            "gnss_epv_m": message.epv_m,
            "gnss_fix": message.fix,
        }
    if state.barometer is not None:
        found |= {"pressure_pa": state.barometer.pressure_pa, "temperature_k": state.barometer.temperature_k}
    if state.magnetometer is not None:
        found["magnetic_field_t"] = state.magnetometer.magnetic_field_t
    if state.rangefinder is not None:
        found |= {"range_m": state.rangefinder.range_m, "range_valid": state.rangefinder.valid}
    if state.airspeed is not None:
        found["differential_pressure_pa"] = state.airspeed.differential_pressure_pa
    return Readings(**found)
