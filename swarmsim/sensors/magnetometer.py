"""A magnetometer in the Earth's field of the place."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.sensors import Magnetometer as MagnetometerSpec
from swarmsim.config.sensors import Place
from swarmsim.physics.rotations import rotate_inverse
from swarmsim.pytree import on_host, pytree, static
from swarmsim.sensors.errors import (
    ErrorModel,
    ErrorState,
    apply,
    begin_errors,
    error_model,
    sample_ticks,
    sampled,
    with_errors,
)
from swarmsim.sensors.truth import Truth


@pytree
class Magnetometer:
    """Parameters; the model computes in microtesla, in which float32 and its users have handy numbers."""

    errors: ErrorModel  # uT; its turn-on bias is the hard iron that is left
    soft_iron_std: jax.Array  # []
    field_ut: jax.Array  # [3] of the Earth, world
    ticks: int = static()  # base periods between samples


@pytree
class MagnetometerState:
    """Errors, and the last reading."""

    errors: ErrorState
    soft_iron: jax.Array  # [3, 3]
    magnetic_field_t: jax.Array  # [3] body


def earth_field_ut(place: Place) -> np.ndarray:
    """The Earth's field [3] in uT, world ENU, from its declination, inclination and strength (host)."""
    declination, inclination = math.radians(place.declination_deg), math.radians(place.inclination_deg)
    level = math.cos(inclination)
    return place.field_ut * np.array(
        [level * math.sin(declination), level * math.cos(declination), -math.sin(inclination)]
    )


def params_of(spec: MagnetometerSpec, place: Place, period_s: float) -> Magnetometer:
    """Parameters of a data sheet (host), sampled at whole base periods of ``period_s``."""
    ticks = sample_ticks(spec.rate_hz, period_s)
    return Magnetometer(
        errors=error_model(
            interval_s=ticks * period_s,
            low=-spec.range_ut,
            high=spec.range_ut,
            resolution=spec.resolution_ut,
            noise=spec.noise_ut,
            turn_on_std=spec.hard_iron_std_ut,
            drift_std=spec.drift_std_ut,
            drift_time_s=spec.drift_time_s,
        ),
        soft_iron_std=on_host(spec.soft_iron_std),
        field_ut=on_host(earth_field_ut(place)),
        ticks=ticks,
    )


def begin(magnetometer: Magnetometer, key: jax.Array) -> MagnetometerState:
    """Switched on: hard and soft iron are drawn."""
    one, other = jax.random.split(key)
    draws = jnp.triu(jax.random.normal(other, (3, 3)))
    symmetric = draws + jnp.triu(draws, 1).T
    return MagnetometerState(
        errors=begin_errors(magnetometer.errors, (3,), one),
        soft_iron=jnp.eye(3) + magnetometer.soft_iron_std * symmetric,
        magnetic_field_t=jnp.zeros(3),
    )


def read(
    magnetometer: Magnetometer, state: MagnetometerState, truth: Truth, key: jax.Array, tick: jax.Array
) -> tuple[MagnetometerState, jax.Array]:
    """The magnetometer at ``tick``, and whether [] its reading is new."""

    def sample(key: jax.Array) -> MagnetometerState:
        field = apply(state.soft_iron, rotate_inverse(truth.quaternion, magnetometer.field_ut))
        errors, reading = with_errors(magnetometer.errors, state.errors, field, key)
        return replace(state, errors=errors, magnetic_field_t=1e-6 * reading)

    return sampled(magnetometer.ticks, tick, key, sample, state)
