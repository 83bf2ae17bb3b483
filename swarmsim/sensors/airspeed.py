"""A pitot tube along x of the body: the dynamic pressure of the air that meets it."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.config.sensors import Airspeed as AirspeedSpec
from swarmsim.config.sensors import Place
from swarmsim.pytree import on_host, pytree, static
from swarmsim.sensors.barometer import Weather, air_above, weather_of
from swarmsim.sensors.errors import (
    ErrorModel,
    ErrorState,
    begin_errors,
    error_model,
    sample_ticks,
    sampled,
    with_errors,
)
from swarmsim.sensors.truth import Truth


@pytree
class Airspeed:
    """Parameters."""

    errors: ErrorModel  # Pa
    scale_std: jax.Array  # [] of the tube's factor, relative
    weather: Weather
    ticks: int = static()  # base periods between samples


@pytree
class AirspeedState:
    """Errors, and the last reading."""

    errors: ErrorState
    gain: jax.Array  # []
    differential_pressure_pa: jax.Array  # []


def params_of(spec: AirspeedSpec, place: Place, period_s: float) -> Airspeed:
    """Parameters of a data sheet (host), sampled at whole base periods of ``period_s``."""
    ticks = sample_ticks(spec.rate_hz, period_s)
    return Airspeed(
        errors=error_model(
            interval_s=ticks * period_s,
            low=-spec.range_pa,
            high=spec.range_pa,
            resolution=spec.resolution_pa,
            noise=spec.noise_pa,
            turn_on_std=spec.turn_on_std_pa,
            drift_std=spec.drift_std_pa,
            drift_time_s=spec.drift_time_s,
        ),
        scale_std=on_host(spec.scale_std or 0.0),
        weather=weather_of(place),
        ticks=ticks,
    )


def begin(airspeed: Airspeed, key: jax.Array) -> AirspeedState:
    """Switched on: offset and factor are drawn."""
    one, other = jax.random.split(key)
    return AirspeedState(
        errors=begin_errors(airspeed.errors, (), one),
        gain=1.0 + airspeed.scale_std * jax.random.normal(other),
        differential_pressure_pa=jnp.zeros(()),
    )


def read(
    airspeed: Airspeed, state: AirspeedState, truth: Truth, key: jax.Array, tick: jax.Array
) -> tuple[AirspeedState, jax.Array]:
    """The sensor at ``tick``, and whether [] its reading is new.

    The pressure is rho v |v| / 2 of the air speed v along x; a tube that is blown on from behind reads less than zero.
    The air is incompressible: the share M^2 / 4 of the Mach number M is missing, 0.1 % at 20 m/s and 2 % at 100 m/s.
    """

    def sample(key: jax.Array) -> AirspeedState:
        density = air_above(airspeed.weather, truth.position_m[2]).density_kg_m3
        speed = truth.air_velocity_m_s[0]
        pressure = state.gain * 0.5 * density * speed * jnp.abs(speed)
        errors, reading = with_errors(airspeed.errors, state.errors, pressure, key)
        return replace(state, errors=errors, differential_pressure_pa=reading)

    return sampled(airspeed.ticks, tick, key, sample, state)
