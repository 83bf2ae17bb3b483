"""The error model that gyroscopes, accelerometers, magnetometers and pressure sensors share.

A reading is value + turn-on bias + drift + walk + white noise, rounded to the resolution and cut off at the range. The
parts are those of IEEE Std 952-1997, annexes B and C (and of O. J. Woodman, "An introduction to inertial navigation",
Cambridge UCAM-CL-TR-696, 2007, section 3.2, for MEMS parts): the drift is a first-order Gauss-Markov process, the
usual model of a bias instability that keeps to itself.
"""

import math
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.pytree import on_host, pytree

S = TypeVar("S")

FLICKER = float(np.sqrt(2.0 * np.log(2.0) / np.pi))
"""Allan deviation of the flat part of a bias instability B, over B (IEEE Std 952-1997, C.1.1.3): 0.664."""

GAUSS_MARKOV_PEAK = 0.6174
"""Largest Allan deviation of a Gauss-Markov process, over its standard deviation, at 1.89 correlation times."""


@pytree
class ErrorModel:
    """Parameters of one sensor's errors, in the unit U of the sensor. Scalars, or one value for each axis."""

    interval_s: jax.Array  # [] s between samples
    turn_on_std: jax.Array  # U: bias, constant after switching on
    noise: jax.Array  # U: standard deviation of the white noise of a sample
    drift_std: jax.Array  # U: of the Gauss-Markov process
    drift_time_s: jax.Array  # [] s: its correlation time
    walk: jax.Array  # U / sqrt(s): a random walk's standard deviation after 1 s (K of IEEE Std 952)
    resolution: jax.Array  # U: step of the digital output; 0: none
    low: jax.Array  # U: range
    high: jax.Array  # U


@pytree
class ErrorState:
    """What the errors of a sensor carry along; [3] or []."""

    turn_on: jax.Array  # U
    drift: jax.Array  # U
    walk: jax.Array  # U


def error_model(
    *,
    interval_s: float,
    low: float,
    high: float,
    resolution: float,
    noise: float,
    turn_on_std: float,
    drift_std: float | None,
    drift_time_s: float | None,
    walk: float | None = None,
) -> ErrorModel:
    """The model as a pytree (host); what is None is left out."""
    return ErrorModel(
        interval_s=on_host(interval_s),
        turn_on_std=on_host(turn_on_std),
        noise=on_host(noise),
        drift_std=on_host(drift_std or 0.0),
        drift_time_s=on_host(drift_time_s or 1.0),
        walk=on_host(walk or 0.0),
        resolution=on_host(resolution),
        low=on_host(low),
        high=on_host(high),
    )


def begin_errors(model: ErrorModel, shape: tuple[int, ...], key: jax.Array) -> ErrorState:
    """Errors when a sensor is switched on: its bias is drawn, and the drift from its stationary distribution."""
    draws = jax.random.normal(key, (2, *shape))
    return ErrorState(
        turn_on=model.turn_on_std * draws[0], drift=model.drift_std * draws[1], walk=jnp.zeros(shape, jnp.float32)
    )


def gauss_markov(
    value: jax.Array, draw: jax.Array, *, std: jax.Array, time_s: jax.Array, interval_s: jax.Array
) -> jax.Array:
    """A first-order Gauss-Markov process ``interval_s`` later, exactly: variance std^2, correlation exp(-t / time_s).

    ``draw`` is of unit normal distribution. By expm1, because 1 - exp(-t / T) of a small t / T has no digits left in
    float32.
    """
    share = interval_s / time_s
    return value + jnp.expm1(-share) * value + std * jnp.sqrt(-jnp.expm1(-2.0 * share)) * draw


def with_errors(model: ErrorModel, state: ErrorState, value: jax.Array, key: jax.Array) -> tuple[ErrorState, jax.Array]:
    """The errors after one sample, and what the sensor reads where ``value`` [3] or [] is true."""
    draws = jax.random.normal(key, (3, *jnp.shape(value)))
    drift = gauss_markov(
        state.drift, draws[0], std=model.drift_std, time_s=model.drift_time_s, interval_s=model.interval_s
    )
    walk = state.walk + model.walk * jnp.sqrt(model.interval_s) * draws[1]
    read = value + state.turn_on + drift + walk + model.noise * draws[2]
    moved = ErrorState(turn_on=state.turn_on, drift=drift, walk=walk)
    return moved, digital(read, resolution=model.resolution, low=model.low, high=model.high)


def digital(value: jax.Array, *, resolution: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """``value`` in whole steps of the resolution, cut off at the range."""
    stepped = resolution > 0.0
    step = jnp.where(stepped, resolution, 1.0)
    return jnp.clip(jnp.where(stepped, step * jnp.round(value / step), value), low, high)


def gain_matrix(scale_std: jax.Array, cross_std: jax.Array, key: jax.Array) -> jax.Array:
    """Matrix [3, 3] of a triad that was drawn: scale factors on the diagonal, sensitivity across the axes beside it."""
    draws = jax.random.normal(key, (3, 3))
    level = jnp.eye(3)
    return level + draws * (level * scale_std + (1.0 - level) * cross_std)


def apply(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """``matrix`` [3, 3] times ``vector`` [3] in full precision on every device."""
    return jnp.sum(matrix * vector, axis=-1)


def sample_ticks(rate_hz: float, period_s: float) -> int:
    """Base periods between two samples: those whose rate is nearest to ``rate_hz``, at least one.

    Rounding the number of periods would let a part of 100 Hz sample at 125 Hz in periods of 4 ms: 83 Hz is nearer.
    """
    wanted = 1.0 / (rate_hz * period_s)
    fewer = max(1, math.floor(wanted))
    too_fast, too_slow = wanted / fewer - 1.0, 1.0 - wanted / (fewer + 1)
    return fewer if too_fast <= too_slow + 1e-9 else fewer + 1


def sampled(
    ticks: int, tick: jax.Array, key: jax.Array, sample: Callable[[jax.Array], S], held: S
) -> tuple[S, jax.Array]:
    """``sample(key)`` where a sensor is due at ``tick``, otherwise ``held``; and whether [] it was due.

    Where all of a batch share their tick, samples are computed only when they are due.
    """
    own = jax.random.fold_in(key, tick)
    if ticks == 1:
        return sample(own), jnp.array(True)
    due = tick % ticks == 0
    # Across the branches go the key's bits: JAX (0.10.1) cannot take the gradient of a scan whose `cond` keeps a key.
    bits, impl = jax.random.key_data(own), jax.random.key_impl(own)

    def go(bits: jax.Array) -> S:
        return sample(jax.random.wrap_key_data(bits, impl=impl))

    return jax.lax.cond(due, go, lambda _: held, bits), due
