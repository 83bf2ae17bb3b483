"""A radiation counter on a vehicle: rates along its way, added up over its exposure, then drawn as counts."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim import randomness
from swarmsim.physics.rotations import rotate
from swarmsim.pytree import pytree, static
from swarmsim.radiation.background import BackgroundField, background_factor
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.rate import draw_counts, exposure_of, observed_rois, roi_rates
from swarmsim.site import Site, crossed
from swarmsim.site.rays import stretched
from swarmsim.vehicles.state import RigidState


@pytree
class Departures:
    """How far the truth may depart from what is presumed of it; each mission draws its own from its key."""

    thickness_share: jax.Array  # [M] walls of a material are up to so much thinner or thicker
    sensitivity_std: jax.Array  # [] of the logarithm of a detector model's sensitivity


def length_factors(departures: Departures, key: jax.Array) -> jax.Array:
    """True over presumed length [M] in each material, in the mission of ``key``."""
    share = jnp.asarray(departures.thickness_share)
    return 1.0 + share * jax.random.uniform(randomness.consumer(key, "thickness"), share.shape, minval=-1.0)


def sensitivity_factor(departures: Departures, key: jax.Array, index: int) -> jax.Array:
    """True over presumed sensitivity [] of detector model ``index`` in the mission of ``key``."""
    own = jax.random.fold_in(randomness.consumer(key, "sensitivity"), index)
    return jnp.exp(departures.sensitivity_std * jax.random.normal(own))


@pytree
class Counter:
    """The detectors of a group: one model, mounted on each vehicle in its own way."""

    detector: Detector  # without a vehicle axis: the group's vehicles carry the same model
    mount_position_m: jax.Array  # [U, 3] centre of the crystal, body
    mount_axis: jax.Array  # [U, 3] unit vector along the crystal, body
    ticks: int = static()  # control periods between two evaluations of the rate
    evaluations: int = static()  # evaluations in one exposure
    index: int = static()  # of the detector's model in the mission


@pytree
class Reading:
    """The latest completed exposure of each vehicle's counter."""

    time_s: jax.Array  # [U] end of the exposure
    position_m: jax.Array  # [U, 3] of the crystal, mean, world
    travel_m: jax.Array  # [U, 3] way of the crystal during the exposure, world
    axis: jax.Array  # [U, 3] unit vector along the crystal, mean, world
    counts: jax.Array  # [U]
    rois: jax.Array  # [U, R] the same counts by region of interest (`Spectrometer.rois_kev`)
    exposure_s: jax.Array  # [U] real time that the counts stand for, dead time included
    valid: jax.Array  # [U] bool: the vehicle had a part in the mission throughout
    fresh: jax.Array  # [U] bool: completed in this control period

    @property
    def rate_cps(self) -> jax.Array:
        """Counts over exposure [U]; zero before the first exposure."""
        return self.counts / jnp.maximum(self.exposure_s, 1e-9)


@pytree
class CounterState:
    """Sums of the exposure under way, and the last reading."""

    rate_cps: jax.Array  # [U, R] sum over evaluations of the observed rate in each region of interest
    position_m: jax.Array  # [U, 3] sum
    velocity_m_s: jax.Array  # [U, 3] sum
    axis: jax.Array  # [U, 3] sum
    used: jax.Array  # [U] int32: evaluations of this exposure at which the vehicle had a part in the mission
    expected_counts: jax.Array  # [U] mean of the last draw: differentiable, and unknown to the vehicle
    reading: Reading


def counter_start(vehicles: int, rois: int) -> CounterState:
    """State of counters with so many regions of interest that have measured nothing yet."""
    zero, vectors, no = jnp.zeros(vehicles), jnp.zeros((vehicles, 3)), jnp.zeros(vehicles, bool)
    reading = Reading(
        time_s=zero,
        position_m=vectors,
        travel_m=vectors,
        axis=vectors,
        counts=zero,
        rois=jnp.zeros((vehicles, rois)),
        exposure_s=zero,
        valid=no,
        fresh=no,
    )
    none = jnp.zeros(vehicles, jnp.int32)
    return CounterState(
        rate_cps=jnp.zeros((vehicles, rois)),
        position_m=vectors,
        velocity_m_s=vectors,
        axis=vectors,
        used=none,
        expected_counts=zero,
        reading=reading,
    )


def source_rate(
    site: Site,
    detector: Detector,
    sources: Source,
    position_m: jax.Array,
    axis: jax.Array,
    lengths: jax.Array | float = 1.0,
) -> jax.Array:
    """Net count rates [R] that all sources (leading axis S) cause in a crystal at a place [3] with an axis [3].

    ``lengths`` [M] are factors of the path length in each material.
    """

    def one(source: Source) -> jax.Array:
        way = stretched(crossed(site, source.position_m, position_m), jnp.asarray(lengths))
        return roi_rates(detector, source, way, position_m, axis)

    return jnp.sum(jax.vmap(one)(sources), axis=0)


def unread(state: CounterState) -> CounterState:
    """The counters with no reading that is fresh."""
    return replace(state, reading=replace(state.reading, fresh=jnp.zeros_like(state.reading.fresh)))


def count(
    counter: Counter,
    state: CounterState,
    body: RigidState,
    active: jax.Array,
    member: jax.Array,
    site: Site,
    sources: Source,
    background: BackgroundField,
    departures: Departures,
    key: jax.Array,
    tick: jax.Array,
    control_period_s: float,
    due: jax.Array,
    branch: Callable[..., Any] = jax.lax.cond,
) -> CounterState:
    """The counters (axis U) after the rate was evaluated at the end of control period ``tick``, if that is ``due``.

    The rate is due every ``counter.ticks`` control periods, where the vehicle then is; its mean over the
    ``counter.evaluations`` of an exposure is the mean of the Poisson counts.

    Args:
        counter, state: of the group.
        body: poses and velocities [U] then.
        active: [U] bool, vehicles that have a part in the mission.
        member: [U] int32, number of each vehicle in the mission.
        site, sources, background, departures: the true world.
        key: of the mission; a draw depends on it, the time and the vehicle's number only.
        tick, control_period_s: the time; the first control period has the number 1.
        due: [] bool; without it the state is returned as it is.
        branch: computes the rate if it is due: `jax.lax.cond` or the like.
    """
    # Across the branches go the key's bits: JAX (0.10.1) cannot take the gradient of a scan whose `cond` keeps a key.
    bits, impl = jax.random.key_data(key), jax.random.key_impl(key)
    ends = tick % (counter.ticks * counter.evaluations) == 0
    centre = body.position_m + rotate(body.quaternion, counter.mount_position_m)
    axis = rotate(body.quaternion, counter.mount_axis)
    none = jnp.zeros_like(state.rate_cps)

    def draw(rate_cps: jax.Array) -> jax.Array:
        key = jax.random.wrap_key_data(bits, impl=impl)
        return _drawn(counter, rate_cps, member, key, tick, control_period_s)

    def evaluate() -> tuple[jax.Array, jax.Array]:
        """Observed rates [U, R], and counts [U, R] if the exposure ends now."""
        own = jax.random.wrap_key_data(bits, impl=impl)
        lengths, detector = length_factors(departures, own), counter.detector
        rate = jax.vmap(lambda place, along: source_rate(site, detector, sources, place, along, lengths))(centre, axis)
        rate = rate * sensitivity_factor(departures, own, counter.index)
        reference = counter.detector.background_height_m
        natural = jax.vmap(lambda place: background_factor(background, site, own, place, reference))(centre)
        rate = observed_rois(counter.detector, rate, natural)
        total = state.rate_cps + rate
        counts = draw(total) if counter.evaluations == 1 else jax.lax.cond(ends, draw, lambda _: none, total)
        return rate, counts

    # Little goes across the branches: an accelerator copies each array.
    rate, counts = branch(due, evaluate, lambda: (none, none))
    summed = replace(
        state,
        rate_cps=state.rate_cps + rate,
        position_m=state.position_m + centre,
        velocity_m_s=state.velocity_m_s + body.velocity_m_s,
        axis=state.axis + axis,
        used=state.used + active,
    )
    read = _read_out(counter, summed, counts, tick, control_period_s)
    return jax.tree.map(
        lambda ended, more, before: jnp.where(due, jnp.where(ends, ended, more), before), read, summed, state
    )


def _drawn(
    counter: Counter, rate_cps: jax.Array, member: jax.Array, key: jax.Array, tick: jax.Array, control_period_s: float
) -> jax.Array:
    """Counts [U, R] of an exposure with the sum ``rate_cps`` [U, R] over its evaluations."""
    period_s = jnp.float32(counter.ticks * counter.evaluations * control_period_s)
    keys = randomness.per_vehicle(randomness.consumer(key, "counts"), tick, member)
    mean = jax.lax.stop_gradient(rate_cps / counter.evaluations)
    return jax.vmap(lambda key, mean: draw_counts(counter.detector, key, mean, period_s)[0])(keys, mean)


def _read_out(
    counter: Counter, state: CounterState, counts: jax.Array, tick: jax.Array, control_period_s: float
) -> CounterState:
    """The reading of a completed exposure, and the beginning of the next one."""
    n, vehicles = counter.evaluations, state.used.shape[0]
    period_s = jnp.float32(counter.ticks * n * control_period_s)
    mean = state.rate_cps / n
    exposure = jnp.broadcast_to(exposure_of(counter.detector, period_s), (vehicles,))
    norm = jnp.sqrt(jnp.sum(state.axis**2, axis=-1, keepdims=True) + 1e-12)
    reading = Reading(
        time_s=jnp.broadcast_to(tick * jnp.float32(control_period_s), (vehicles,)),
        position_m=state.position_m / n,
        travel_m=state.velocity_m_s / n * period_s,
        axis=state.axis / norm,
        counts=jnp.sum(counts, axis=-1),
        rois=counts,
        exposure_s=exposure,
        valid=state.used == n,
        fresh=jnp.ones(vehicles, bool),
    )
    expected = jnp.sum(mean, axis=-1) * exposure
    return replace(counter_start(vehicles, counts.shape[-1]), expected_counts=expected, reading=reading)
