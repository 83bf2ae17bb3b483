"""From one mission's measurements to what it knows: map, hotspots, estimates, the nuclide."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.estimation import (
    Hotspots,
    Measurements,
    RadiationMap,
    SourceFit,
    aggregate,
    concatenate,
    extract_hotspots,
    initial_points,
    interpolate,
    localise,
)
from swarmsim.missions import keys
from swarmsim.missions.measure import Accumulated, Log, accumulate_spectrum, count
from swarmsim.missions.world import World
from swarmsim.pytree import pytree
from swarmsim.radiation.detector import Detector
from swarmsim.radiation.identify import Identification, identify

AERIAL, GROUND = 0, 1  # index of the detector in the pair (UAV, rover)


@pytree
class AerialKnowledge:
    """What the survey flight found."""

    map: RadiationMap
    hotspots: Hotspots
    fit: SourceFit
    found: jax.Array  # [] bool: there is a hotspot above the background


@pytree
class GroundKnowledge:
    """What the rover's drive added."""

    spectrum: Accumulated
    identification: Identification
    nuclide: jax.Array  # [] int32: the identified one, or the presumed one where the confidence is too small
    fit: SourceFit


def count_from_air(key: jax.Array, world: World, log: Log, first: jax.Array | int = 0) -> Measurements:
    """The UAVs' measurements (axes [U, n]) along their logs [T, U], which begin with sample number ``first``."""
    counts = keys.consumer(key, "aerial counts")
    each = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), log)

    def one(index: jax.Array, detector: Detector, log: Log) -> Measurements:
        return count(jax.random.fold_in(counts, index), world.site, detector, world.sources, log, 1, AERIAL, first)

    return jax.vmap(one)(jnp.arange(world.team.home_m.shape[0]), world.team.detector, each)


def count_on_ground(
    key: jax.Array,
    world: World,
    log: Log,
    ticks_per_sample: int,
    first: jax.Array | int = 0,
    live_s: float | None = None,
) -> Measurements:
    """The rover's measurements [n] along its log [T], which begins with sample number ``first``.

    ``live_s`` replaces the detector's own sample period.
    """
    assert world.rover is not None
    counts = keys.consumer(key, "ground counts")
    detector = world.rover.detector
    if live_s is not None:
        detector = replace(detector, sample_period_s=jnp.float32(live_s))
    return count(counts, world.site, detector, world.sources, log, ticks_per_sample, GROUND, first)


def detectors(world: World) -> tuple[Detector, ...]:
    """The pair (UAV, rover) that `Measurements.detector` indexes; the rover's is left out where there is none."""
    aerial = jax.tree.map(lambda leaf: leaf[0], world.team.detector)
    return (aerial,) if world.rover is None else (aerial, world.rover.detector)


def windows(measurements: Measurements, per_window: int) -> Measurements:
    """Measurements [U, n] summed over windows and put after one another."""
    return concatenate(jax.vmap(lambda m: aggregate(m, per_window))(measurements))


def learn_from_air(world: World, measurements: Measurements, per_window: int, starts: int) -> AerialKnowledge:
    """Interpolate the map, find hotspots, and fit a source to the counts."""
    summed = windows(measurements, per_window)
    chart = interpolate(world.mapping, summed)
    hotspots = extract_hotspots(world.mapping, chart)
    places = initial_points(world.mapping, hotspots, starts)
    fit = localise(world.site, detectors(world)[:1], summed, places, world.presumed_nuclide, world.localisation)
    return AerialKnowledge(map=chart, hotspots=hotspots, fit=fit, found=hotspots.valid[0])


def learn_from_ground(
    key: jax.Array, world: World, aerial: AerialKnowledge, air: Measurements, ground: Measurements, per_window: int
) -> GroundKnowledge:
    """Identify the nuclide from the spectrum near the source, and refine the estimate with all data."""
    assert world.rover is not None
    distance = jnp.linalg.norm(ground.position_m[:, :2] - aerial.fit.position_m[:2], axis=-1)
    near = distance < world.rover.spectrum_radius_m
    detector = world.rover.detector
    spectrum = accumulate_spectrum(key, world.site, detector, world.sources, ground, near)
    identification = identify(detector, spectrum.counts, spectrum.live_s)
    sure = identification.confidence >= world.confidence_min
    nuclide = jnp.where(sure & (identification.nuclide >= 0), identification.nuclide, world.presumed_nuclide)
    everything = concatenate(windows(air, per_window), ground)
    start = aerial.fit.position_m[None, :2]
    fit = localise(world.site, detectors(world), everything, start, nuclide, world.localisation)
    return GroundKnowledge(spectrum=spectrum, identification=identification, nuclide=nuclide, fit=fit)
