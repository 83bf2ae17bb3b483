"""Detectors and sources as arrays, and construction of a detector from its configuration (host side)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.errors import InputError
from swarmsim.config.radiation import Detector as DetectorSpec
from swarmsim.config.radiation import DetectorMount, Nuclide
from swarmsim.pytree import on_device, pytree, static
from swarmsim.radiation import scattering
from swarmsim.radiation.attenuation import linear_attenuation
from swarmsim.radiation.cylinder import fit_effective_area, near_parts
from swarmsim.radiation.ground import from_ground
from swarmsim.radiation.library import Library
from swarmsim.radiation.lines import (
    GAINS,
    ORDERS,
    SPECTRUM_BINS,
    SPECTRUM_DEPTHS,
    energy_shares,
    identification_bins,
    in_spectrum_bins,
    orders,
    shielded_lines,
    spectrum_edges,
    tilt,
)
from swarmsim.radiation.response import (
    Response,
    background_spectrum,
    build_response,
    line_spectra,
    normalised,
)
from swarmsim.radiation.strangers import others_than, spectra_of
from swarmsim.site.model import SURROUNDING_KG_M3

Floats = NDArray[np.float64]

KINDS = ("physical", "paper_ideal")
AIR = "air"  # material of the part of a ray that lies in no obstacle
OPAQUE_1_M = 1e6  # attenuation of a detector that counts every photon that meets it


@pytree
class Source:
    """A point source."""

    position_m: jax.Array  # [3] world ENU
    activity_bq: jax.Array  # []
    nuclide: jax.Array  # [] int32, index into the detector's nuclide_names


@pytree
class Detector:
    """A cylindrical counter on a vehicle; tables for every nuclide (N), line (L, padded with yield 0), material (M)."""

    radius_m: jax.Array  # [] of the crystal
    length_m: jax.Array  # []
    mount_position_m: jax.Array  # [3] crystal centre, body FLU
    mount_axis: jax.Array  # [3] unit, crystal axis, body FLU
    background_cps: jax.Array  # [] nominal
    background_height_m: jax.Array  # [] above ground, where it is that
    paralyzable_s: jax.Array  # []
    non_paralyzable_s: jax.Array  # []
    sample_period_s: jax.Array  # [] real time of one measurement, dead time included
    decay_1_s: jax.Array  # [N] decay constant
    yields: jax.Array  # [N, L] photons per decay
    effective_area_m2: jax.Array  # [N, L, 5] coefficients of cylinder.direction_basis, housing and threshold included
    near: jax.Array  # [NEAR_TABLES, NEAR_ROWS, NEAR_COLUMNS] of cylinder.near_parts
    near_share: jax.Array  # [N, L, NEAR_TABLES] weights of the tables for each line
    attenuation_1_m: jax.Array  # [N, L, M]
    surrounds: jax.Array  # [M] 1 for materials that are no walls (air, leaves), else 0
    scatter_1_m: jax.Array  # [N, positions, COEFFICIENTS, L, M] attenuation times coefficients of scattered counts
    ground: jax.Array  # [N, L, 2] coefficients of the counts from the ground (`swarmsim.radiation.ground`)
    peak_spectrum: jax.Array  # [N, L, channels] share of the counts of unscattered photons in each channel, sums to 1
    scattered_bins: jax.Array  # [N, depths, M, L, SPECTRUM_BINS] share of the scattered counts in each bin, sums to 1
    ground_bins: jax.Array  # [N, L, SPECTRUM_BINS] share of the counts from the ground in each bin, sums to 1
    bin_spectrum: jax.Array  # [SPECTRUM_BINS, channels] spectra of photons of those bins, each sums to 1
    peak_rois: jax.Array  # [N, L, R] the spectra above added up in the regions of interest
    scattered_rois: jax.Array  # [N, depths, M, L, R] share of the scattered counts in each
    ground_rois: jax.Array  # [N, L, R] share of the counts from the ground in each
    background_rois: jax.Array  # [R] cps, sums to background_cps
    peak_orders: jax.Array  # [N, L, GAINS, ORDERS, bins] peak_spectrum by bin at any gain and width (lines.orders)
    bin_orders: jax.Array  # [SPECTRUM_BINS, GAINS, ORDERS, bins] bin_spectrum likewise
    natural_orders: jax.Array  # [GAINS, 2, ORDERS, bins] the background's shape, and that times lines.tilt
    grid_spectrum: jax.Array  # [shields, grid, bins] of lines half a FWHM apart behind walls; sum to 1
    known_spectrum: jax.Array  # [K shields, GAINS, bins] of all nuclides that are known of (radiation.strangers)
    known_scattered: jax.Array  # [K shields, bins] the part of scattered photons in them
    stranger: jax.Array  # [K] 1 for those that are none of the nuclides above, else 0
    background_spectrum: jax.Array  # [channels] cps, sums to background_cps
    energy_kev: jax.Array  # [channels] centre of each channel
    sigma_kev: jax.Array  # [channels] standard deviation of a peak there
    line_energy_kev: jax.Array  # [N, L]
    nuclide_names: tuple[str, ...] = static()
    known_names: tuple[str, ...] = static()
    material_names: tuple[str, ...] = static()
    kind: str = static()  # physical | paper_ideal
    identification_bins: tuple[int, ...] = static()  # first channel of each bin of identification; () without


@dataclass(frozen=True)
class Counting:
    """How a detector counts photons, whatever its kind."""

    attenuation_1_m: Callable[[Floats], Floats]  # in the crystal
    counts: Callable[[Floats], Floats]  # per photon that interacts there
    through_housing: Callable[[Floats], Floats]


def build_detector(spec: DetectorSpec, mount: DetectorMount, library: Library, kind: str) -> Detector:
    """Detector ``spec`` mounted as ``mount`` with the tables of every nuclide and material of ``library``.

    ``kind`` is ``physical`` or ``paper_ideal``: the latter counts every photon that meets the crystal (no housing, no
    efficiency), neglects attenuation in air and scattered photons, and draws counts as the Gazebo plugin of the paper
    does. Raises `InputError` when the material of the crystal or the housing is unknown, or when a table does not reach
    the energy of a line.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {KINDS}, not {kind!r}")
    energy, yields = lines_of(library)
    radius, length = spec.diameter_mm / 2000, spec.length_mm / 1000
    response = None
    if spec.crystal is not None:
        response = build_response(spec, library.material(spec.crystal), library.material(spec.housing.material))
    counting = counting_of(spec, library, response, kind)
    mu = np.broadcast_to(counting.attenuation_1_m(energy), energy.shape)
    area = fit_effective_area(radius, length, mu.ravel()).reshape(*energy.shape, 5)
    area = area * (counting.counts(energy) * counting.through_housing(energy))[..., None]
    near, near_share = near_parts(radius, length, mu)
    axis = np.asarray(mount.axis) / np.linalg.norm(mount.axis)
    counted = (lambda e: _mean_area(counting, e, (radius, length))) if kind == "physical" else None
    attenuation, coefficients, bins = _transport(library, energy, counted)
    ground, ground_bins = _ground(energy, counted)
    f32 = on_device
    known = library.nuclides + others_than(library.nuclide_names)
    return Detector(
        radius_m=f32(radius),
        length_m=f32(length),
        mount_position_m=f32(mount.position_m),
        mount_axis=f32(axis),
        background_cps=f32(spec.background.rate_cps),
        background_height_m=f32(spec.background.height_m),
        paralyzable_s=f32(spec.dead_time.paralyzable_us * 1e-6),
        non_paralyzable_s=f32(spec.dead_time.non_paralyzable_us * 1e-6),
        sample_period_s=f32(spec.sample_period_s),
        decay_1_s=f32(library.decay_1_s),
        yields=f32(yields),
        effective_area_m2=f32(area),
        near=f32(near),
        near_share=f32(near_share),
        attenuation_1_m=f32(attenuation),
        surrounds=f32(surrounding(library)),
        scatter_1_m=f32(coefficients),
        scattered_bins=f32(bins),
        ground=f32(ground),
        ground_bins=f32(ground_bins),
        line_energy_kev=f32(energy),
        nuclide_names=library.nuclide_names,
        known_names=tuple(nuclide.name for nuclide in known),
        stranger=f32(np.arange(len(known)) >= len(library.nuclides)),
        material_names=library.material_names,
        kind=kind,
        **_spectra(spec, library, known, response, energy, bins, ground_bins, counted),
    )


def restrict(detector: Detector, nuclides: tuple[str, ...]) -> Detector:
    """The same detector with only the tables of ``nuclides``, in that order, and as many lines as they have (host).

    An estimator for one known nuclide runs several times faster with it. Raises `InputError` for an unknown name.
    """
    missing = [name for name in nuclides if name not in detector.nuclide_names]
    if missing or not nuclides:
        raise InputError.of(f"unknown nuclides {missing}", allowed="one of " + ", ".join(detector.nuclide_names))
    rows = np.array([detector.nuclide_names.index(name) for name in nuclides])
    lines = int(np.max(np.sum(np.asarray(detector.yields)[rows] > 0, axis=1)))
    second = (
        "yields", "effective_area_m2", "near_share", "attenuation_1_m", "peak_spectrum", "peak_rois", "line_energy_kev",
        "ground", "ground_bins", "ground_rois", "peak_orders",
    )  # fmt: skip
    last_but_one = ("scatter_1_m", "scattered_bins", "scattered_rois")
    tables = {name: getattr(detector, name)[rows, :lines] for name in second}
    tables |= {name: getattr(detector, name)[rows][..., :lines, :] for name in last_but_one}
    stranger = np.array([name not in nuclides for name in detector.known_names], np.float32)
    tables |= {"decay_1_s": detector.decay_1_s[rows], "stranger": on_device(stranger)}
    return replace(detector, nuclide_names=nuclides, **tables)


def lines_of(library: Library) -> tuple[Floats, Floats]:
    """Energies [N, L] and photons per decay [N, L] of every nuclide's lines, padded with yield 0."""
    lines_max = max(len(n.lines) for n in library.nuclides)
    energy, yields = np.full((len(library.nuclides), lines_max), 662.0), np.zeros((len(library.nuclides), lines_max))
    for i, nuclide in enumerate(library.nuclides):
        energy[i, : len(nuclide.lines)] = [line.energy_kev for line in nuclide.lines]
        yields[i, : len(nuclide.lines)] = [line.yield_percent / 100 for line in nuclide.lines]
    return energy, yields


def counting_of(spec: DetectorSpec, library: Library, response: Response | None, kind: str) -> Counting:
    """How the detector ``spec`` counts: by its crystal's ``response``, or by its table of efficiencies without one."""
    if kind == "paper_ideal":
        return Counting(lambda e: np.full_like(e, OPAQUE_1_M), np.ones_like, np.ones_like)
    if response is not None:
        return Counting(response.attenuation_1_m, response.counts, response.housing_transmission)
    assert spec.efficiency is not None
    points = np.log([p.energy_kev for p in spec.efficiency])
    values = np.log([p.efficiency for p in spec.efficiency])
    housing, thickness = library.material(spec.housing.material), spec.housing.thickness_mm / 1000
    return Counting(
        lambda e: np.full_like(e, OPAQUE_1_M),
        lambda e: np.exp(np.interp(np.log(e), points, values)),
        lambda e: np.exp(-linear_attenuation(housing, e) * thickness),
    )


def surrounding(library: Library) -> Floats:
    """1 for the materials [M] that are no walls, else 0."""
    return np.array([float(material.density_kg_m3 < SURROUNDING_KG_M3) for material in library.materials])


def _transport(
    library: Library, energy: Floats, counted: Callable[[Floats], Floats] | None
) -> tuple[Floats, Floats, Floats]:
    """The fields attenuation_1_m, scatter_1_m and scattered_bins of a detector."""
    tables = scattering.transport(library.materials, energy, counted)
    attenuation, row = tables.attenuation_1_m, tables.row
    bins = np.zeros((len(tables.energy_kev), len(SPECTRUM_DEPTHS), len(library.materials), SPECTRUM_BINS))
    if counted is not None:
        energies = scattering.bin_energies(tables.energy_kev)
        for m in range(len(library.materials)):
            bins[:, :, m] = np.moveaxis(energy_shares(tables.counts[:, m, :, 0], energies), 1, 0)
    else:
        attenuation = attenuation * [material.name != AIR for material in library.materials]
    # from [N, L, ...] to the places of the lines in the fields
    return attenuation[row], np.moveaxis(tables.scatter_1_m[row], 1, 3), np.moveaxis(bins[row], 1, 3)


def _ground(energy: Floats, counted: Callable[[Floats], Floats] | None) -> tuple[Floats, Floats]:
    """The fields ground and ground_bins of a detector."""
    flat, row = np.unique(energy, return_inverse=True)
    if counted is None:
        return np.zeros((*energy.shape, 2)), np.full((*energy.shape, SPECTRUM_BINS), 1.0 / SPECTRUM_BINS)
    found, counts = from_ground(flat, counted)
    shares = normalised(in_spectrum_bins(counts, scattering.bin_energies(flat)))
    return found[row].reshape(*energy.shape, -1), shares[row].reshape(*energy.shape, -1)


def _mean_area(counting: Counting, energy: Floats, size: tuple[float, float]) -> Floats:
    """Counts per photon and area [...] of photons that come from around, up to a factor.

    End on, with the mean chord of the crystal (4 V / S, Cauchy) in place of its length.
    """
    radius, length = size
    chord = 2.0 * radius * length / (radius + length)
    seen = -np.expm1(-counting.attenuation_1_m(energy) * chord)
    return np.asarray(seen * counting.counts(energy) * counting.through_housing(energy))


def _spectra(
    spec: DetectorSpec,
    library: Library,
    known: tuple[Nuclide, ...],
    response: Response | None,
    energy: Floats,
    bins: Floats,
    ground_bins: Floats,
    counted: Callable[[Floats], Floats] | None,
) -> dict[str, Any]:
    """The fields of a detector that have channels; a counter without energy resolution has one channel."""
    f32 = on_device
    if response is None:
        return {
            "peak_spectrum": f32(np.ones((*energy.shape, 1))),
            "bin_spectrum": f32(np.ones((SPECTRUM_BINS, 1))),
            "peak_rois": f32(np.ones((*energy.shape, 1))),
            "scattered_rois": f32(np.ones((*bins.shape[:-1], 1))),
            "ground_rois": f32(np.ones((*energy.shape, 1))),
            "background_rois": f32(np.array([spec.background.rate_cps])),
            "peak_orders": f32(np.zeros((*energy.shape, 1, 1, 1))),
            "bin_orders": f32(np.zeros((SPECTRUM_BINS, 1, 1, 1))),
            "natural_orders": f32(np.zeros((1, 2, 1, 1))),
            "grid_spectrum": f32(np.ones((1, 1, 1))),
            "known_spectrum": f32(np.ones((1, 1, 1))),
            "known_scattered": f32(np.ones((1, 1))),
            "background_spectrum": f32(np.array([spec.background.rate_cps])),
            "energy_kev": f32(np.array([662.0])),
            "sigma_kev": f32(np.array([662.0])),
            "identification_bins": (),
        }
    assert spec.spectrometer is not None
    flat, back = np.unique(energy, return_inverse=True)
    edges = spectrum_edges()
    peaks = normalised(line_spectra(response, flat))
    of_bins = normalised(line_spectra(response, np.sqrt(edges[1:] * edges[:-1])))
    background = background_spectrum(response, spec.background)
    shape = normalised(background[None])[0]
    natural = orders(response, shape * np.stack([np.ones_like(shape), tilt(response.channel_centre_kev)]))
    peak_orders = orders(response, peaks)[back].reshape(*energy.shape, len(GAINS), ORDERS, -1)
    rois = rois_of(response, spec.spectrometer.rois_kev)
    spectra = spectra_of(response, known, library.materials, counted)
    return {
        "peak_spectrum": f32(peaks[back].reshape(*energy.shape, -1)),
        "bin_spectrum": f32(of_bins),
        "peak_orders": f32(peak_orders),
        "bin_orders": f32(orders(response, of_bins)),
        "natural_orders": f32(np.swapaxes(natural, 0, 1)),
        "grid_spectrum": f32(shielded_lines(response, library.materials, counted)),
        "known_spectrum": f32(spectra.total),
        "known_scattered": f32(spectra.scattered),
        "peak_rois": f32((peaks @ rois)[back].reshape(*energy.shape, -1)),
        "scattered_rois": f32(bins @ of_bins @ rois),
        "ground_rois": f32(ground_bins @ of_bins @ rois),
        "background_rois": f32(background @ rois),
        "background_spectrum": f32(background),
        "energy_kev": f32(response.channel_centre_kev),
        "sigma_kev": f32(response.sigma_kev(response.channel_centre_kev)),
        "identification_bins": identification_bins(response),
    }


def rois_of(response: Response, edges_kev: tuple[float, ...]) -> Floats:
    """Which channel belongs to which region [channels, R] (`region_of`)."""
    return np.eye(len(edges_kev) - 1)[region_of(response.channel_centre_kev, edges_kev)]


def region_of(energy_kev: Floats, edges_kev: tuple[float, ...]) -> NDArray[np.int64]:
    """Number of the region of each energy [...]; those below the first and above the last go to these."""
    return np.clip(np.searchsorted(edges_kev, energy_kev) - 1, 0, len(edges_kev) - 2)
