"""Spectra of single samples, drawn after the flight from what was counted in each energy window."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.errors import InputError
from swarmsim.config.names import one_of
from swarmsim.missions.knowledge import expected_spectrum
from swarmsim.radiation.detector import region_of
from swarmsim.results.counted import Counted
from swarmsim.results.record import Floats, Samples
from swarmsim.results.tracks import place_of
from swarmsim.runtime.simulation import Simulation
from swarmsim.world.model import World

_BLOCK = 256  # samples whose expected spectra are computed at once


@dataclass(frozen=True)
class SampleSpectra:
    """The samples of one vehicle with a spectrum each."""

    samples: Samples  # [n] of the vehicle, in the order of time
    edge_kev: Floats  # [channels + 1] of the channels
    counts: NDArray[np.int32]  # [n, channels]


def sample_spectra(simulation: Simulation, counted: Counted, vehicle: str, world: World | None = None) -> SampleSpectra:
    """A spectrum for each sample of ``vehicle``: the counts of each energy window, distributed over its channels.

    The counts of a window fall on its channels by a multinomial distribution in proportion to the expected spectrum at
    the sample's mean place. Poisson counts with a given sum are distributed so; the sums over each window are those
    recorded. The draw depends on the mission's seed and the vehicle only. A source that a vehicle carries is taken to
    be where it began: only the shape of the spectrum within a window depends on it.

    Args:
        simulation: that flew the mission.
        counted: its `MissionRecord`, or what `read_counts` found in a run directory.
        vehicle: name of a vehicle with a spectrometer.
        world: the mission's, if it was flown with other values than its seed's own.

    Raises:
        InputError: no such vehicle, or its detector resolves no energies.
    """
    samples, seed = counted.samples, counted.seed
    number = _number(simulation, vehicle)
    spec = simulation.scenario.vehicles[number].detector
    analyser = None if spec is None else simulation.scenario.detectors[spec.model].spectrometer
    own = samples.rows(samples.vehicle == number)
    if analyser is None or own.windows is None or own.axis is None:
        raise InputError.of("has no spectrometer, so that there are no spectra of its samples", given=vehicle)
    edges = np.linspace(0.0, analyser.energy_max_kev, analyser.channels + 1)
    region = region_of(0.5 * (edges[1:] + edges[:-1]), analyser.rois_kev)
    columns = [counted.windows_kev.index(w) for w in zip(analyser.rois_kev, analyser.rois_kev[1:], strict=False)]
    recorded = np.asarray(own.windows[:, columns], np.int64)
    expected = _expected(simulation.world_of(seed) if world is None else world, simulation, seed, number)
    rng = np.random.default_rng([seed, number])
    counts = np.zeros((len(recorded), analyser.channels), np.int32)
    for first in range(0, len(recorded), _BLOCK):
        rows = slice(first, first + _BLOCK)
        mean = expected(own.position_m[rows], own.axis[rows], own.time_s[rows])
        counts[rows] = _distributed(rng, mean, recorded[rows], region)
    return SampleSpectra(samples=own, edge_kev=edges, counts=counts)


def _number(simulation: Simulation, vehicle: str) -> int:
    names = [member.name for member in simulation.scenario.members]
    if vehicle not in names:
        raise InputError.of("there is no such vehicle", given=vehicle, allowed=one_of(names))
    return names.index(vehicle)


def _expected(
    world: World, simulation: Simulation, seed: int, number: int
) -> Callable[[Floats, Floats, Floats], Floats]:
    """Expected spectra [n, channels], up to a factor, at n places, axes and times of vehicle ``number``."""
    counter = world.groups[place_of(simulation, number)[0]].counter
    assert counter is not None
    compute = jax.jit(partial(_spectra, counter.index))

    def expected(position_m: Floats, axis: Floats, time_s: Floats) -> Floats:
        given = (np.asarray(each, np.float32) for each in (position_m, axis, time_s))
        padded = [np.resize(each, (_BLOCK, *each.shape[1:])) for each in given]
        return np.asarray(compute(world, jax.random.key(seed), *padded), float)[: len(position_m)]

    return expected


def _spectra(
    model: int, world: World, key: jax.Array, position_m: jax.Array, axis: jax.Array, time_s: jax.Array
) -> jax.Array:
    return jax.vmap(expected_spectrum(key, world, model))(position_m, axis, time_s)


def _distributed(
    rng: np.random.Generator, mean: Floats, counted: NDArray[np.int64], region: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Counts [n, channels] with the sums ``counted`` [n, R] over the regions, in proportion to ``mean`` within them."""
    counts = np.zeros(mean.shape, np.int64)
    for number in range(counted.shape[1]):
        inside = np.flatnonzero(region == number)
        if not len(inside):
            continue
        # counts that nothing is expected of, which rounding may leave, fall anywhere in their window
        weight = np.maximum(mean[:, inside], 1e-30)
        counts[:, inside] = rng.multinomial(counted[:, number], weight / weight.sum(axis=1, keepdims=True))
    return counts
