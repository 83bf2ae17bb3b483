"""What the detectors count: rates along logged poses, and the draws."""

from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.estimation import Measurements
from swarmsim.missions.keys import consumer
from swarmsim.physics.rotations import rotate
from swarmsim.pytree import pytree
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.rate import draw_counts, net_rate, observed_rate, spectrum_rate
from swarmsim.site import Site, path_lengths


@pytree
class Log:
    """Poses of one vehicle at the end of each tick."""

    time_s: jax.Array  # [T] mission clock
    position_m: jax.Array  # [T, 3] ENU
    quaternion: jax.Array  # [T, 4] w x y z, body to world
    velocity_m_s: jax.Array  # [T, 3] ENU
    energy_j: jax.Array  # [T] used since the start
    active: jax.Array  # [T] bool: under way at the end of the tick


def crystal_pose(detector: Detector, position_m: jax.Array, quaternion: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Centre [..., 3] and axis [..., 3] of the crystal in the world, of vehicles at the poses."""
    centre = position_m + rotate(quaternion, jnp.broadcast_to(detector.mount_position_m, position_m.shape))
    return centre, rotate(quaternion, jnp.broadcast_to(detector.mount_axis, position_m.shape))


def source_rate(site: Site, detector: Detector, sources: Source, position_m: jax.Array, axis: jax.Array) -> jax.Array:
    """Net count rate [] that all sources (leading axis S) cause in a crystal at a place [3] with an axis [3]."""

    def one(source: Source) -> jax.Array:
        lengths = path_lengths(site, source.position_m, position_m)
        return net_rate(detector, source, lengths, position_m, axis)

    return jnp.sum(jax.vmap(one)(sources))


def count(
    key: jax.Array,
    site: Site,
    detector: Detector,
    sources: Source,
    log: Log,
    per_sample: int,
    index: int,
    first: jax.Array | int = 0,
) -> Measurements:
    """Measurements of one vehicle along its log: one for every ``per_sample`` ticks.

    The mean of a sample is the mean of the observed rates at its ticks' ends (the rate changes little within a tick).
    A sample is valid if the vehicle was under way in all of its ticks.

    Args:
        key: of this vehicle's counts.
        site, detector, sources: the world.
        log: [T] ticks; T is a whole number of samples.
        per_sample: ticks in a sample.
        index: of the detector in the mission's pair (UAV, rover).
        first: number of the log's first sample since the mission began.
    """
    centre, axis = crystal_pose(detector, log.position_m, log.quaternion)

    def rate(centre: jax.Array, axis: jax.Array) -> jax.Array:
        return observed_rate(detector, source_rate(site, detector, sources, centre, axis))

    rates = jax.lax.map(lambda pose: rate(*pose), (centre, axis), batch_size=256)
    samples = rates.shape[0] // per_sample
    numbers = first + jnp.arange(samples)

    def draw(number: jax.Array, mean: jax.Array) -> Any:
        return draw_counts(detector, jax.random.fold_in(key, number), mean, detector.sample_period_s)

    counts, exposure = jax.vmap(draw)(numbers, rates.reshape(samples, per_sample).mean(axis=1))

    def mean(x: jax.Array) -> jax.Array:
        return x.reshape(samples, per_sample, *x.shape[1:]).mean(axis=1)

    mean_axis = mean(axis)
    return Measurements(
        time_s=log.time_s.reshape(samples, per_sample)[:, -1],
        position_m=mean(centre),
        travel_m=mean(log.velocity_m_s) * detector.sample_period_s,
        axis=mean_axis / jnp.linalg.norm(mean_axis, axis=-1, keepdims=True),
        counts=counts.astype(jnp.float32),
        exposure_s=exposure,
        valid=jnp.all(log.active.reshape(samples, per_sample), axis=1),
        detector=jnp.full(samples, index, jnp.int32),
    )


@pytree
class Accumulated:
    """A spectrum summed over samples."""

    counts: jax.Array  # [channels]
    live_s: jax.Array  # []


def accumulate_spectrum(
    key: jax.Array, site: Site, detector: Detector, sources: Source, samples: Measurements, near: jax.Array
) -> Accumulated:
    """The spectrum taken during the samples that are ``near`` [n] and valid.

    The sum of the samples' Poisson spectra is drawn at once, as a Poisson spectrum of the summed mean. The analyser has
    its own draw: its total differs from the counter's by statistics, as it would with a dead time of its own.
    """
    used = near & samples.valid

    def one(sample: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        position, axis, use = sample

        def of_source(source: Source) -> jax.Array:
            return spectrum_rate(detector, source, path_lengths(site, source.position_m, position), position, axis)

        return jnp.where(use, jnp.sum(jax.vmap(of_source)(sources), axis=0) + detector.background_spectrum, 0.0)

    def add(total: jax.Array, sample: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return total + one(sample), None

    start = jnp.zeros_like(detector.background_spectrum)
    rate = jax.lax.scan(add, start, (samples.position_m, samples.axis, used))[0]
    live = jnp.sum(jnp.where(used, detector.sample_period_s, 0.0))
    mean = rate * detector.sample_period_s
    return Accumulated(counts=jax.random.poisson(consumer(key, "spectrum"), mean).astype(jnp.float32), live_s=live)
