"""From one mission's counts to what it knows: map, hotspots, estimate, the nuclide."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim import randomness
from swarmsim.estimation import (
    Measurements,
    SourceFit,
    concatenate,
    extract_hotspots,
    initial_points,
    interpolate,
    localise,
)
from swarmsim.estimation.windows import Windows, measured
from swarmsim.missions.plan import Plan
from swarmsim.missions.state import Survey
from swarmsim.pytree import pytree
from swarmsim.radiation.background import BackgroundField, background_factor
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.identify import Identification, identify
from swarmsim.radiation.poisson import poisson
from swarmsim.radiation.rate import spectrum_rate
from swarmsim.site import Site, crossed
from swarmsim.world.model import World


@pytree
class Accumulated:
    """A spectrum summed over samples."""

    counts: jax.Array  # [channels]
    live_s: jax.Array  # []


@pytree
class Conclusion:
    """What the mission found in the end."""

    survey: Survey  # what sent the searchers out, or the map and estimate of all counts
    spectrum: Accumulated | None  # None without an identification
    identification: Identification | None
    nuclide: jax.Array  # [] int32: the identified one, or the presumed one where the confidence is too small
    fit: SourceFit  # from all counts


def gathered(world: World, windows: tuple[Windows | None, ...]) -> Measurements:
    """Counts of all groups after one another."""
    return concatenate(
        *(
            measured(held, group.counter.index)
            for group, held in zip(world.groups, windows, strict=True)
            if held is not None and group.counter is not None
        )
    )


def survey(plan: Plan, measurements: Measurements) -> Survey:
    """Interpolate the map, find hotspots, and fit a source to the counts.

    The map joins detectors of several models by their nominal backgrounds: the exposure of each is multiplied by its
    background over that of the first model, as if all its counts grew with its size alike.
    """
    assert plan.mapping is not None
    assert plan.localisation is not None
    background = jnp.stack([d.background_cps for d in plan.detectors])
    size = jnp.where(background[0] > 0.0, background / jnp.maximum(background[0], 1e-9), 1.0)
    scaled = replace(measurements, exposure_s=measurements.exposure_s * size[measurements.detector])
    chart = interpolate(plan.mapping, scaled)
    hotspots = extract_hotspots(plan.mapping, chart)
    places = initial_points(plan.mapping, hotspots, plan.starts)
    fit = localise(plan.site, plan.detectors, measurements, places, plan.presumed_nuclide, plan.localisation)
    return Survey(map=chart, hotspots=hotspots, fit=fit, found=hotspots.valid[0])


def conclude(key: jax.Array, world: World, plan: Plan, known: Survey, measurements: Measurements) -> Conclusion:
    """Identify the nuclide from the spectra near the source, and estimate the source from all counts.

    ``world`` is asked for the spectra alone: they are drawn here, at the places of the measurements.
    """
    assert plan.localisation is not None
    nuclide, spectrum, identification = plan.presumed_nuclide, None, None
    if plan.spectrometer >= 0:
        spectrum = _spectrum(key, world, plan, known, measurements)
        identification = identify(plan.detectors[plan.spectrometer], spectrum.counts, spectrum.live_s)
        sure = (identification.confidence >= plan.confidence_min) & (identification.nuclide >= 0)
        nuclide = jnp.where(sure, identification.nuclide, plan.presumed_nuclide)
    start = known.fit.position_m[None, :2]
    fit = localise(plan.site, plan.detectors, measurements, start, nuclide, plan.localisation)
    return Conclusion(survey=known, spectrum=spectrum, identification=identification, nuclide=nuclide, fit=fit)


def _spectrum(key: jax.Array, world: World, plan: Plan, known: Survey, measurements: Measurements) -> Accumulated:
    """The spectrum taken by the spectrometer within its radius of the estimate."""
    apart = measurements.position_m[:, :2] - known.fit.position_m[:2]
    near = jnp.sqrt(jnp.sum(apart * apart, axis=-1)) < plan.spectrum_radius_m
    used = near & measurements.valid & (measurements.detector == plan.spectrometer)
    counter = next(g.counter for g in world.groups if g.counter is not None and g.counter.index == plan.spectrometer)
    return accumulate_spectrum(key, world.site, counter.detector, world.sources, world.background, measurements, used)


def accumulate_spectrum(
    key: jax.Array,
    site: Site,
    detector: Detector,
    sources: Source,
    background: BackgroundField,
    samples: Measurements,
    used: jax.Array,
) -> Accumulated:
    """The spectrum taken during the samples that are ``used`` [n].

    The sum of the samples' Poisson spectra is drawn at once, as a Poisson spectrum of the summed mean. The analyser has
    its own draw: its total differs from the counter's by statistics, as it would with a dead time of its own.
    """
    # an idealised counter draws counts that stand for one second, whatever its period is
    per_exposure = detector.sample_period_s if detector.kind == "paper_ideal" else jnp.ones(())
    live = jnp.where(used, samples.exposure_s * per_exposure, 0.0)

    def one(position: jax.Array, axis: jax.Array) -> jax.Array:
        def of_source(source: Source) -> jax.Array:
            return spectrum_rate(detector, source, crossed(site, source.position_m, position), position, axis)

        natural = background_factor(background, site, key, position, detector.background_height_m)
        return jnp.sum(jax.vmap(of_source)(sources), axis=0) + natural * detector.background_spectrum

    def add(total: jax.Array, sample: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        position, axis, live = sample
        counted = jax.lax.cond(live > 0.0, lambda: live * one(position, axis), lambda: jnp.zeros_like(total))
        return total + counted, None

    start = jnp.zeros_like(detector.background_spectrum)
    mean = jax.lax.scan(add, start, (samples.position_m, samples.axis, live))[0]
    keys = jax.random.split(randomness.consumer(key, "spectrum"), mean.shape[0])
    return Accumulated(counts=jax.vmap(poisson)(keys, mean), live_s=jnp.sum(live))
