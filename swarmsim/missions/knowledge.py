"""From one mission's counts to what it knows: map, hotspots, estimate, the nuclide."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim import randomness
from swarmsim.estimation import (
    Estimated,
    Hotspots,
    LocalisationParams,
    MappingParams,
    Measurements,
    Presumed,
    RadiationMap,
    concatenate,
    extract_hotspots,
    interpolate,
    localise,
)
from swarmsim.estimation.localise import nothing_found
from swarmsim.estimation.nodes import Span
from swarmsim.estimation.state import State
from swarmsim.estimation.windows import Windows, measured, merged
from swarmsim.missions.plan import Plan
from swarmsim.missions.state import Survey
from swarmsim.missions.trail import Trail, poses_at
from swarmsim.pytree import pytree, static
from swarmsim.radiation.background import background_factor
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.identify import Identification, identify
from swarmsim.radiation.poisson import poisson
from swarmsim.radiation.rate import mean_view, spectrum_rate
from swarmsim.sensors.radiation import length_factors, sensitivity_factor
from swarmsim.site import crossed
from swarmsim.site.rays import stretched
from swarmsim.world.emission import sources_at
from swarmsim.world.model import World


@pytree
class Accumulated:
    """A spectrum summed over samples."""

    counts: jax.Array  # [channels]
    live_s: jax.Array  # [] real time of them, all of which is live: there is no dead time
    begin_s: jax.Array  # [] when the first of them began; inf without one


@pytree
class Conclusion:
    """What the mission found in the end."""

    survey: Survey  # what sent the searchers out, or the map and estimate of all counts
    spectrum: Accumulated | None  # None without an identification
    identification: Identification | None
    estimated: Estimated  # from all counts


@pytree
class Premises:
    """What an estimate takes from the plan, and nothing else: missions that agree in its kind share the program."""

    presumed: Presumed
    localisation: LocalisationParams
    mapping: MappingParams
    background_cps: tuple[jax.Array, ...]  # [] nominal one of each detector model
    spans: tuple[Span, ...] = static()


def premises_of(plan: Plan) -> Premises:
    """The premises of a plan that `estimates`; they are taken from it as they are."""
    assert plan.presumed is not None
    assert plan.localisation is not None
    assert plan.mapping is not None
    return Premises(
        presumed=plan.presumed,
        localisation=plan.localisation,
        mapping=plan.mapping,
        background_cps=tuple(d.background_cps for d in plan.detectors),
        spans=plan.spans,
    )


def gathered(world: World, plan: Plan, windows: tuple[Windows | None, ...], key: jax.Array) -> Measurements:
    """Counts of all groups after one another, at the measured places; `Plan.spans` says of which detector models.

    The places of each vehicle are off by the same error throughout (`pose_errors`), as those of a GNSS receiver with
    RTK are for minutes; ``key`` is the mission's.
    """
    assert plan.presumed is not None
    parts = []
    for group, held, kept in zip(world.groups, windows, plan.kept, strict=True):
        if held is None or group.counter is None:
            continue
        few = merged(held, kept)
        off = pose_errors(errors_of_places(plan.presumed), key, jnp.asarray(group.member))
        shifted = few.position_m + few.exposure_s[..., None] * off[:, None]
        few = replace(few, position_m=shifted, begin_m=few.begin_m + off[:, None])
        parts.append(measured(few, group.counter.index))
    return concatenate(*parts)


def errors_of_places(presumed: Presumed) -> tuple[jax.Array, jax.Array]:
    """Standard deviations [] (m) of measured places: of each vehicle's own error, and of that which all have alike."""
    return presumed.pose_std_m, presumed.geometry_std_m


def pose_errors(std_m: tuple[jax.Array, jax.Array], key: jax.Array, member: jax.Array) -> jax.Array:
    """Measured less true place [U, 3] (ENU, m) of the vehicles numbered ``member`` [U], in the mission of ``key``.

    Each vehicle has an error of its own, and all have that in common by which the geometry of the site, which places
    are told in, was registered wrongly (``std_m``: `errors_of_places`).
    """
    of_each, of_all = std_m
    keys = randomness.per_vehicle(randomness.consumer(key, "pose"), jnp.int32(0), member)
    own: jax.Array = of_each * jax.vmap(lambda k: jax.random.normal(k, (3,)))(keys)
    return own + of_all * jax.random.normal(randomness.consumer(key, "registration"), (3,))


@pytree
class Inquiry:
    """What an estimate works on, and what it found."""

    measurements: Measurements  # all counts so far (`gathered`)
    survey: Survey  # what was known before, then what is known
    afresh: jax.Array  # [] bool: forget what was known before


def learn(premises: Premises, inquiry: Inquiry) -> Inquiry:
    """The inquiry with the survey of all its counts, whose estimate goes on from the one before."""
    known = jax.tree.map(lambda x: jnp.where(inquiry.afresh, jnp.zeros_like(x), x), inquiry.survey.estimated.state)
    # what begins afresh is gone on from: the detection limits are those of the last estimate
    return replace(inquiry, survey=survey(premises, inquiry.measurements, known, ~inquiry.afresh))


def nothing_learned(world: World, plan: Plan, windows: tuple[Windows | None, ...], key: jax.Array) -> Survey | None:
    """A survey of no counts; None for a mission that does not estimate sources."""
    if not plan.estimates:
        return None
    premises = premises_of(plan)

    def nothing() -> Survey:
        measurements = gathered(world, plan, windows, key)
        estimated = nothing_found(premises.presumed, measurements, premises.spans, premises.localisation)
        chart, hotspots = _mapped(premises, measurements)
        return Survey(map=chart, hotspots=hotspots, estimated=estimated, found=estimated.fits.present[0])

    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(nothing))


def survey(premises: Premises, measurements: Measurements, known: State | None, last: jax.Array) -> Survey:
    """Interpolate the map, find hotspots, and estimate the sources, from where an earlier estimate came to.

    What would have been noticed is told by the ``last`` [] estimate alone.
    """
    chart, hotspots = _mapped(premises, measurements)
    estimated = localise(premises.presumed, measurements, premises.spans, premises.localisation, known, last)
    return Survey(map=chart, hotspots=hotspots, estimated=estimated, found=estimated.fits.present[0])


def _mapped(premises: Premises, measurements: Measurements) -> tuple[RadiationMap, Hotspots]:
    """Map and hotspots.

    The map joins detectors of several models by their nominal backgrounds: the exposure of each is multiplied by its
    background over that of the first model, as if all its counts grew with its size alike.
    """
    background = jnp.stack(premises.background_cps)
    size = jnp.where(background[0] > 0.0, background / jnp.maximum(background[0], 1e-9), 1.0)
    scaled = replace(measurements, exposure_s=measurements.exposure_s * size[measurements.detector])
    chart = interpolate(premises.mapping, scaled)
    return chart, extract_hotspots(premises.mapping, chart)


def named(
    key: jax.Array,
    world: World,
    plan: Plan,
    known: Survey,
    measurements: Measurements,
    trail: Trail | None = None,
) -> tuple[Survey, Accumulated, Identification]:
    """Identify the nuclide from the spectra near the first source, and let the estimate go on with it.

    ``world`` is asked for the spectra alone, and the ``trail`` of its carried sources: they are drawn here, at the
    places and times of the measurements.
    """
    assert plan.presumed is not None
    used, detector = _near_source(plan, known, measurements), plan.detectors[plan.spectrometer]
    spectrum = accumulate_spectrum(key, world, plan.spectrometer, measurements, used, trail)
    offset = known.estimated.fits.position_m[0] - measurements.position_m
    view = mean_view(detector, offset, measurements.axis, jnp.where(used, measurements.exposure_s, 0.0))
    identification = identify(detector, spectrum.counts, spectrum.live_s, view)
    state = known.estimated.state
    inside = jnp.asarray(plan.presumed.nuclides)[jnp.maximum(identification.nuclide, 0)]
    sure = (identification.confidence >= plan.confidence_min) & (identification.nuclide >= 0) & inside
    nuclides = state.sources.nuclide
    first = jnp.where(sure & state.sources.present[0], identification.nuclide, nuclides[0])
    state = replace(state, sources=replace(state.sources, nuclide=nuclides.at[0].set(first)))
    return replace(known, estimated=replace(known.estimated, state=state)), spectrum, identification


def _near_source(plan: Plan, known: Survey, measurements: Measurements) -> jax.Array:
    """Whether each measurement [n] is the spectrometer's, within its radius of the first source."""
    apart = measurements.position_m[:, :2] - known.estimated.fits.position_m[0, :2]
    near = jnp.sqrt(jnp.sum(apart * apart, axis=-1)) < plan.spectrum_radius_m
    return near & measurements.valid & (measurements.detector == plan.spectrometer) & known.found


def accumulate_spectrum(
    key: jax.Array, world: World, model: int, samples: Measurements, used: jax.Array, trail: Trail | None = None
) -> Accumulated:
    """The spectrum taken during the samples that are ``used`` [n], by detector model ``model``.

    The sum of the samples' Poisson spectra is drawn at once, as a Poisson spectrum of the summed mean. The analyser has
    its own draw, without dead time: its total differs from the counter's by statistics and by what that one missed.
    """
    detector = detector_of(world, model)
    # an idealised counter draws counts that stand for one second, whatever its period is
    per_exposure = detector.sample_period_s if detector.kind == "paper_ideal" else jnp.ones(())
    live = jnp.where(used, samples.exposure_s * per_exposure, 0.0)
    begin_s = jnp.min(jnp.where(used, samples.time_s - live, jnp.inf))
    expected = expected_spectrum(key, world, model, trail)

    def add(total: jax.Array, sample: tuple[jax.Array, ...]) -> tuple[jax.Array, None]:
        position, axis, middle_s, live = sample
        rate = jax.lax.cond(live > 0.0, expected, lambda *_: jnp.zeros_like(total), position, axis, middle_s)
        return total + live * rate, None

    start = jnp.zeros_like(detector.background_spectrum)
    mean = jax.lax.scan(add, start, (samples.position_m, samples.axis, samples.time_s - 0.5 * live, live))[0]
    keys = jax.random.split(randomness.consumer(key, "spectrum"), mean.shape[0])
    return Accumulated(counts=jax.vmap(poisson)(keys, mean), live_s=jnp.sum(live), begin_s=begin_s)


def detector_of(world: World, model: int) -> Detector:
    """Detector model number ``model`` of the mission."""
    return next(g.counter for g in world.groups if g.counter is not None and g.counter.index == model).detector


def expected_spectrum(
    key: jax.Array, world: World, model: int, trail: Trail | None = None
) -> Callable[[jax.Array, jax.Array, jax.Array], jax.Array]:
    """What detector ``model`` is to count per second in each channel [channels], by place [3], axis [3] and time [].

    In the mission of ``key``; without dead time, background included. Without a ``trail`` carried sources are where
    they began.
    """
    site, background, departures = world.site, world.background, world.departures
    detector = detector_of(world, model)
    lengths, sensitivity = length_factors(departures, key), sensitivity_factor(departures, key, model)

    def expected(position: jax.Array, axis: jax.Array, time_s: jax.Array) -> jax.Array:
        sources = sources_at(world.sources, world.emission, time_s, poses_at(trail, time_s))

        def of_source(source: Source) -> jax.Array:
            way = stretched(crossed(site, source.position_m, position), lengths)
            return sensitivity * spectrum_rate(detector, source, way, position, axis)

        natural = background_factor(background, site, key, position, detector.background_height_m)
        return jnp.sum(jax.vmap(of_source)(sources), axis=0) + natural * detector.background_spectrum

    return expected
