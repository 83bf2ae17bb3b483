"""A barometer in the standard atmosphere of the place."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.config.sensors import Barometer as BarometerSpec
from swarmsim.config.sensors import Place
from swarmsim.pytree import on_host, pytree, static
from swarmsim.sensors.atmosphere import Air, air_at
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
class Weather:
    """Air of the place, by its values at mean sea level."""

    altitude_m: jax.Array  # [] of the mission's origin above mean sea level
    sea_level_pressure_pa: jax.Array  # []
    sea_level_temperature_k: jax.Array  # []


def weather_of(place: Place) -> Weather:
    """The weather of a place (host)."""
    return Weather(
        altitude_m=on_host(place.altitude_m),
        sea_level_pressure_pa=on_host(place.sea_level_pressure_pa),
        sea_level_temperature_k=on_host(place.sea_level_temperature_k),
    )


def air_above(weather: Weather, height_m: jax.Array) -> Air:
    """Air at ``height_m`` [] above the mission's origin."""
    return air_at(
        weather.altitude_m + height_m,
        sea_level_pressure_pa=weather.sea_level_pressure_pa,
        sea_level_temperature_k=weather.sea_level_temperature_k,
    )


@pytree
class Barometer:
    """Parameters."""

    errors: ErrorModel  # Pa
    temperature_offset_k: jax.Array  # [] of the part over the air
    weather: Weather
    ticks: int = static()  # base periods between samples


@pytree
class BarometerState:
    """Errors, and the last reading."""

    errors: ErrorState
    pressure_pa: jax.Array  # []
    temperature_k: jax.Array  # []


def params_of(spec: BarometerSpec, place: Place, period_s: float) -> Barometer:
    """Parameters of a data sheet (host), sampled at whole base periods of ``period_s``."""
    ticks = sample_ticks(spec.rate_hz, period_s)
    return Barometer(
        errors=error_model(
            interval_s=ticks * period_s,
            low=spec.range_pa[0],
            high=spec.range_pa[1],
            resolution=spec.resolution_pa,
            noise=spec.noise_pa,
            turn_on_std=spec.turn_on_std_pa,
            drift_std=spec.drift_std_pa,
            drift_time_s=spec.drift_time_s,
        ),
        temperature_offset_k=on_host(spec.temperature_offset_k or 0.0),
        weather=weather_of(place),
        ticks=ticks,
    )


def begin(barometer: Barometer, key: jax.Array) -> BarometerState:
    """Switched on: the offset is drawn."""
    zero = jnp.zeros(())
    return BarometerState(errors=begin_errors(barometer.errors, (), key), pressure_pa=zero, temperature_k=zero)


def read(
    barometer: Barometer, state: BarometerState, truth: Truth, key: jax.Array, tick: jax.Array
) -> tuple[BarometerState, jax.Array]:
    """The barometer at ``tick``, and whether [] its reading is new."""

    def sample(key: jax.Array) -> BarometerState:
        air = air_above(barometer.weather, truth.position_m[2])
        errors, pressure = with_errors(barometer.errors, state.errors, air.pressure_pa, key)
        temperature = air.temperature_k + barometer.temperature_offset_k
        return replace(state, errors=errors, pressure_pa=pressure, temperature_k=temperature)

    return sampled(barometer.ticks, tick, key, sample, state)
