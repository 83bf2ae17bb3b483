"""A rangefinder that looks along -z of the body at the ground."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.config.sensors import Place
from swarmsim.config.sensors import Rangefinder as RangefinderSpec
from swarmsim.pytree import on_host, pytree, static
from swarmsim.sensors.errors import digital, sample_ticks, sampled
from swarmsim.sensors.truth import Truth


@pytree
class Rangefinder:
    """Parameters."""

    nearest_m: jax.Array  # []
    farthest_m: jax.Array  # []
    resolution_m: jax.Array  # []
    noise_m: jax.Array  # [] standard deviation
    noise_share: jax.Array  # [] of the range
    bias_std_m: jax.Array  # []
    scale_std: jax.Array  # [] relative
    dropout: jax.Array  # [] share of ranges that are lost
    upright_min: jax.Array  # [] cosine of the largest angle between beam and vertical
    ticks: int = static()  # base periods between samples


@pytree
class RangefinderState:
    """Constant errors, and the last reading."""

    bias_m: jax.Array  # []
    gain: jax.Array  # []
    range_m: jax.Array  # []
    valid: jax.Array  # [] bool


def params_of(spec: RangefinderSpec, place: Place, period_s: float) -> Rangefinder:
    """Parameters of a data sheet (host), sampled at whole base periods of ``period_s``."""
    return Rangefinder(
        nearest_m=on_host(spec.range_m[0]),
        farthest_m=on_host(spec.range_m[1]),
        resolution_m=on_host(spec.resolution_m),
        noise_m=on_host(spec.noise_m),
        noise_share=on_host(spec.noise_share or 0.0),
        bias_std_m=on_host(spec.bias_std_m or 0.0),
        scale_std=on_host(spec.scale_std or 0.0),
        dropout=on_host(spec.dropout or 0.0),
        upright_min=on_host(math.cos(math.radians(spec.tilt_max_deg))),
        ticks=sample_ticks(spec.rate_hz, period_s),
    )


def begin(rangefinder: Rangefinder, key: jax.Array) -> RangefinderState:
    """Switched on: bias and factor are drawn."""
    draws = jax.random.normal(key, (2,))
    return RangefinderState(
        bias_m=rangefinder.bias_std_m * draws[0],
        gain=1.0 + rangefinder.scale_std * draws[1],
        range_m=rangefinder.farthest_m + jnp.zeros(()),
        valid=jnp.array(False),
    )


def read(
    rangefinder: Rangefinder, state: RangefinderState, truth: Truth, key: jax.Array, tick: jax.Array
) -> tuple[RangefinderState, jax.Array]:
    """The rangefinder at ``tick``, and whether [] its reading is new.

    The ground is level, ``truth.height_m`` below the vehicle: the beam is longer by the cosine of its tilt. What is not
    measured reads as the farthest range (the nearest one where the ground is nearer than that), and is not valid.
    """

    def sample(key: jax.Array) -> RangefinderState:
        one, other = jax.random.split(key)
        x, y = truth.quaternion[1], truth.quaternion[2]
        upright = 1.0 - 2.0 * (x * x + y * y)
        seen = upright >= rangefinder.upright_min
        range_m = truth.height_m / jnp.where(seen, upright, 1.0)
        std = jnp.hypot(rangefinder.noise_m, rangefinder.noise_share * range_m)
        noisy = state.gain * range_m + state.bias_m + std * jax.random.normal(one)
        seen &= (range_m <= rangefinder.farthest_m) & (jax.random.uniform(other) >= rangefinder.dropout)
        reading = digital(
            noisy, resolution=rangefinder.resolution_m, low=rangefinder.nearest_m, high=rangefinder.farthest_m
        )
        return replace(
            state,
            range_m=jnp.where(seen, reading, rangefinder.farthest_m),
            valid=seen & (range_m >= rangefinder.nearest_m),
        )

    return sampled(rangefinder.ticks, tick, key, sample, state)
