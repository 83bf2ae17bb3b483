"""A satellite receiver: position and velocity with correlated errors, some time late.

Errors of the position are a Gauss-Markov process (orbits, clocks, the ionosphere and slow multipath, which receivers
filter: J. Rankin, "An error model for sensor simulation: GPS and differential GPS", IEEE PLANS 1994) and a part of each
fix by itself; velocity comes from Doppler shifts, whose errors are nearly white.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.config.sensors import Gnss as GnssSpec
from swarmsim.config.sensors import GnssErrors, Place
from swarmsim.pytree import on_host, pytree, static
from swarmsim.sensors.errors import gauss_markov, sample_ticks, sampled
from swarmsim.sensors.truth import Truth

NO_FIX = 0
FIXES = {"3d": 3, "rtk_float": 5, "rtk_fixed": 6}
"""Numbers of fixes, those of MAVLink's GPS_FIX_TYPE; `NO_FIX` before the first message."""


@pytree
class Gnss:
    """Parameters; errors of the usual fix and of the poorer one [2]."""

    interval_s: jax.Array  # [] between fixes
    fix: jax.Array  # [2] int32, as in `FIXES`
    std_m: jax.Array  # [2, 3] of the correlated error, world
    correlation_s: jax.Array  # [2]
    noise_m: jax.Array  # [2, 3] of each fix by itself
    velocity_noise_m_s: jax.Array  # [2]
    baseline: jax.Array  # [2] standard deviation per distance to the mission's origin
    between_s: jax.Array  # [] mean time until the usual fix is lost; inf: never
    duration_s: jax.Array  # [] mean time until it is back
    ticks: int = static()  # base periods between fixes
    late: int = static()  # base periods from a fix to its message


@pytree
class Fix:
    """One fix, or several on a leading axis."""

    position_m: jax.Array  # [3] world, from the mission's origin
    velocity_m_s: jax.Array  # [3] world
    eph_m: jax.Array  # [] standard deviation of the horizontal error, both axes together
    epv_m: jax.Array  # [] of the vertical one
    fix: jax.Array  # [] int32


@pytree
class GnssState:
    """Errors, fixes on their way (Q, the newest first), and the last message."""

    error: jax.Array  # [3] unit variance
    poor: jax.Array  # [] bool: the poorer fix
    queue: Fix  # [Q]
    message: Fix


def params_of(spec: GnssSpec, place: Place, period_s: float) -> Gnss:
    """Parameters of a data sheet (host), sampled at whole base periods of ``period_s``."""
    ticks = sample_ticks(spec.rate_hz, period_s)
    outages = spec.outages
    both: list[GnssErrors] = [spec.errors, spec.errors if outages is None else outages.errors]
    return Gnss(
        interval_s=on_host(ticks * period_s),
        fix=on_host([FIXES[e.fix] for e in both], "int32"),
        std_m=on_host([[e.horizontal_std_m, e.horizontal_std_m, e.vertical_std_m] for e in both]),
        correlation_s=on_host([e.correlation_s for e in both]),
        noise_m=on_host([[e.horizontal_noise_m, e.horizontal_noise_m, e.vertical_noise_m] for e in both]),
        velocity_noise_m_s=on_host([e.velocity_noise_m_s for e in both]),
        baseline=on_host([1e-6 * (e.baseline_ppm or 0.0) for e in both]),
        between_s=on_host(float("inf") if outages is None else outages.mean_time_between_s),
        duration_s=on_host(1.0 if outages is None else outages.mean_duration_s),
        ticks=ticks,
        late=round(spec.latency_s / period_s),
    )


def begin(gnss: Gnss, key: jax.Array) -> GnssState:
    """Switched on, with satellites found: the first fix is made at once, its message comes after the latency.

    Until then there is `NO_FIX`, at zero with infinite standard deviations.
    """
    nothing = Fix(
        position_m=jnp.zeros(3),
        velocity_m_s=jnp.zeros(3),
        eph_m=jnp.float32(jnp.inf),
        epv_m=jnp.float32(jnp.inf),
        fix=jnp.int32(NO_FIX),
    )
    depth = gnss.late // gnss.ticks + 1
    return GnssState(
        error=jax.random.normal(key, (3,)),
        poor=jnp.array(False),
        queue=jax.tree.map(lambda x: jnp.broadcast_to(x, (depth, *x.shape)), nothing),
        message=nothing,
    )


def read(gnss: Gnss, state: GnssState, truth: Truth, key: jax.Array, tick: jax.Array) -> tuple[GnssState, jax.Array]:
    """The receiver at ``tick``, and whether [] a message came."""

    def sample(key: jax.Array) -> GnssState:
        return _measured(gnss, state, truth, key)

    state, _ = sampled(gnss.ticks, tick, key, sample, state)
    due = (tick >= gnss.late) & ((tick - gnss.late) % gnss.ticks == 0)
    message = jax.tree.map(lambda queue, old: jnp.where(due, queue[-1], old), state.queue, state.message)
    return replace(state, message=message), due


def _measured(gnss: Gnss, state: GnssState, truth: Truth, key: jax.Array) -> GnssState:
    """The receiver after a fix, which enters the queue."""
    lost, drift, noise, doppler = jax.random.split(key, 4)
    mean_s = jnp.where(state.poor, gnss.duration_s, gnss.between_s)
    changed = jax.random.uniform(lost) < -jnp.expm1(-gnss.interval_s / mean_s)
    poor = state.poor ^ changed

    def own(pair: jax.Array) -> jax.Array:
        return jnp.where(poor, pair[1], pair[0])

    error = gauss_markov(
        state.error,
        jax.random.normal(drift, (3,)),
        std=jnp.float32(1.0),
        time_s=own(gnss.correlation_s),
        interval_s=gnss.interval_s,
    )
    away = own(gnss.baseline) * jnp.sqrt(jnp.sum(truth.position_m**2))
    slow = jnp.sqrt(own(gnss.std_m) ** 2 + away**2)
    white = own(gnss.noise_m)
    total = jnp.sqrt(slow**2 + white**2)
    fix = Fix(
        position_m=truth.position_m + slow * error + white * jax.random.normal(noise, (3,)),
        velocity_m_s=truth.velocity_m_s + own(gnss.velocity_noise_m_s) * jax.random.normal(doppler, (3,)),
        eph_m=jnp.hypot(total[0], total[1]),
        epv_m=total[2],
        fix=own(gnss.fix),
    )
    queue = jax.tree.map(lambda new, old: jnp.concatenate([new[None], old[:-1]]), fix, state.queue)
    return GnssState(error=error, poor=poor, queue=queue, message=state.message)
