"""A made-up place, its detectors and a survey over it, for tests of the estimation."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.load import load_named
from swarmsim.config.mission import Knowledge, Localisation, Mapping
from swarmsim.config.radiation import DetectorMount
from swarmsim.estimation import Measurements, mapping_params, net_rates, presume
from swarmsim.radiation import Source, build_detector, load_library, observed_rate, restrict
from swarmsim.radiation.rate import observed_rois, roi_rates
from swarmsim.site import Obstacles, Site, crossed

_net_rates = jax.jit(net_rates)
NUCLIDE = jnp.int32(0)  # the only one that the restricted detectors know: Co-60
NUCLIDES = ("Co-60", "Cs-137", "I-131", "Ir-192", "Ba-133", "Se-75")  # of `spectrometer`
HALF = 70.0  # m, half the side of the surveyed square


@cache
def library():
    return load_library()


@cache
def detector(kind="physical", model="nai_1p5x1p5"):
    mount = DetectorMount(model=model, position_m=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    return restrict(build_detector(load_named("detectors", model), mount, library(), kind), ("Co-60",))


def place(boxes=(), slope=(0.0, 0.0), half=HALF, margin=20.0):
    """A plane of the given slope with solid boxes (centre, half extent, material); cells of 2 m."""
    side = np.arange(-half - margin, half + margin + 1e-9, 2.0)
    ground = slope[0] * side[None, :] + slope[1] * side[:, None]
    # a grain in a corner for each wall that it lacks of two: it is computed by the program of a place with these
    grain = ((-half - 15.0, -half - 15.0, 0.0), (0.01, 0.01, 0.01), "concrete")
    boxes = [*boxes, *[grain] * (2 - len(boxes))]
    centre, extent, material = zip(*boxes, strict=True)
    names = library().material_names
    raster = jnp.asarray(ground, jnp.float32)
    return Site(
        origin_m=jnp.full(2, -half - margin),
        cell_m=jnp.float32(2.0),
        terrain_m=raster,
        surface_m=raster,
        clearance_m=jnp.full_like(raster, 10.0),
        cost=jnp.ones_like(raster),
        obstacles=Obstacles(
            centre_m=jnp.asarray(centre, jnp.float32),
            half_extent_m=jnp.asarray(extent, jnp.float32),
            axis=jnp.tile(jnp.array([1.0, 0.0]), (len(boxes), 1)),
            wall_m=jnp.zeros(len(boxes)),
            material=jnp.asarray([names.index(m) for m in material], jnp.int32),
        ),
        survey_area_m=half * jnp.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
        ground_material=jnp.int32(names.index("soil")),
        material_names=names,
    )


def windows(position, exposure=1.0, which=0):
    """Measurements without counts at ``position`` [n, 3], crystal upright."""
    n = len(position)
    return Measurements(
        time_s=jnp.arange(1.0, n + 1),
        position_m=jnp.asarray(position, jnp.float32),
        travel_m=jnp.zeros((n, 3)),
        axis=jnp.tile(jnp.array([0.0, 0.0, 1.0]), (n, 1)),
        counts=jnp.zeros(n),
        exposure_s=jnp.full(n, exposure),
        valid=jnp.ones(n, bool),
        detector=jnp.full(n, which, jnp.int32),
    )


def survey(altitude=20.0, half=HALF, lines=15, count=924, slope=(0.0, 0.0)):
    """``count`` one-second windows on parallel lines, flown at one speed."""
    along = np.linspace(0.0, lines, count, endpoint=False) + 0.5 * lines / count
    y = np.linspace(-half, half, lines)[along.astype(int)]
    x = half * (2.0 * (along % 1.0) - 1.0) * np.where(along.astype(int) % 2, -1.0, 1.0)
    return windows(np.stack([x, y, altitude + slope[0] * x + slope[1] * y], axis=-1))


def orbit(centre, radius, count, height=0.6, which=1):
    """Windows on a circle around a place, as the rover drives it."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    ring = np.stack([centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)], axis=-1)
    return windows(np.concatenate([ring, np.full((count, 1), height)], axis=-1), which=which)


def mean_rates(site, detectors, measurements, sources=()):
    """Expected observed rate [n] of (position, activity) sources over the background."""
    net = sum((a * _net_rates(site, detectors, measurements, jnp.asarray(p), NUCLIDE) for p, a in sources), 0.0)
    net = jnp.broadcast_to(net, measurements.counts.shape)
    rates = jnp.stack([jax.vmap(observed_rate, (None, 0))(d, net) for d in detectors])
    return jnp.take_along_axis(rates, measurements.detector[None], axis=0)[0]


def draw(measurements, rates, seed):
    """The same measurements with counts drawn for the given rates [n]; ``seed`` may be a key."""
    key = jax.random.key(seed) if isinstance(seed, int) else seed
    return replace(measurements, counts=jax.random.poisson(key, rates * measurements.exposure_s).astype(jnp.float32))


def mapping(half=HALF, variance_kept=0.95, **changes):
    spec = {
        "cell_m": 2.0,
        "length_scale_m": 6.0,
        "hotspots_max": 4,
        "hotspot_separation_m": 15.0,
        "significance_sigma": 5.0,
    }
    area = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return mapping_params(Mapping(**(spec | changes)), area, variance_kept)


@cache
def spectrometer(model="nai_1p5x1p5"):
    """A detector that knows `NUCLIDES`, with its regions of interest."""
    mount = DetectorMount(model=model, position_m=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    return restrict(build_detector(load_named("detectors", model), mount, library(), "physical"), NUCLIDES)


def mean_rois(site, detectors, m, sources=(), background=1.0):
    """Expected counts [n, R] by region of interest of (position, activity, nuclide's name), as a counter has them.

    ``background`` [] or [n] is that over the nominal one.
    """
    background = jnp.broadcast_to(jnp.asarray(background, jnp.float32), m.counts.shape)
    net = [jnp.zeros((m.counts.shape[0], d.background_rois.shape[0])) for d in detectors]
    for position, activity, name in sources:
        source = Source(
            position_m=jnp.asarray(position, jnp.float32),
            activity_bq=jnp.float32(activity),
            nuclide=jnp.int32(NUCLIDES.index(name)),
        )
        net = [
            before + _source_rois(site, d, source, m.position_m, m.axis)
            for before, d in zip(net, detectors, strict=True)
        ]
    rates = jnp.stack([observed_rois(d, x, background) for d, x in zip(detectors, net, strict=True)])
    which = jnp.arange(m.counts.shape[0])
    return rates[m.detector, which] * m.exposure_s[:, None]


@jax.jit
def _source_rois(site, detector, source, position, axis):
    def one(place, along):
        return roi_rates(detector, source, crossed(site, source.position_m, place), place, along)

    return jax.vmap(one)(position, axis)


def counted(m, rois):
    """The same measurements with these counts [n, R]."""
    return replace(m, rois=jnp.asarray(rois, jnp.float32), counts=jnp.sum(jnp.asarray(rois, jnp.float32), axis=1))


def drawn(m, mean, seed):
    """The same measurements with counts by region drawn about their means [n, R]."""
    return counted(m, np.random.default_rng(seed).poisson(np.asarray(mean)))


def drawn_of_one(site, detector, m, position, activity, seed):
    """Counts by region drawn for one source of the first nuclide that ``detector`` knows."""
    source = Source(position_m=jnp.asarray(position), activity_bq=jnp.float32(activity), nuclide=NUCLIDE)
    net = _source_rois(site, detector, source, m.position_m, m.axis)
    return drawn(m, observed_rois(detector, net, jnp.ones(len(net))) * m.exposure_s[:, None], seed)


def spec(**changes):
    """Few places are tried: enough in the open, and fast."""
    few = {"search_rounds": 5, "sample_rounds": 20, "samples": 32, "sources_max": 2}
    given = {"presumed_height_m": 1.0, "height_std_m": 0.5, "window_s": 1.0}
    return Localisation(**(given | few | changes))


def presumed(site, detectors, half=HALF, knowledge=None, **changes):
    """What a mission presumes that knows the site and may meet a background that varies."""
    corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return presume(
        site, detectors, spec(**changes), knowledge or Knowledge(site="exact", learning_rate=1.0), 0.0, [corners]
    )


SOURCE, ACTIVITY = jnp.array([12.0, 4.0, 1.0]), 170e6
