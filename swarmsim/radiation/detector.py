"""Detectors and sources as arrays, and construction of a detector from its configuration (host side)."""

from dataclasses import replace

import jax
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.errors import InputError
from swarmsim.config.radiation import Detector as DetectorSpec
from swarmsim.config.radiation import DetectorMount, Material
from swarmsim.pytree import on_device, pytree, static
from swarmsim.radiation.cylinder import fit_effective_area
from swarmsim.radiation.library import Library, build_up_coefficients, linear_attenuation, mass_attenuation
from swarmsim.radiation.response import (
    Response,
    background_spectrum,
    build_response,
    peak_spectrum,
    scattered_spectrum,
)

Floats = NDArray[np.float64]

KINDS = ("physical", "paper_ideal")
AIR = "air"  # material of the part of a ray that lies in no obstacle


@pytree
class Source:
    """A point source."""

    position_m: jax.Array  # [3] world ENU
    activity_bq: jax.Array  # []
    nuclide: jax.Array  # [] int32, index into the detector's nuclide_names


@pytree
class Detector:
    """A cylindrical counter on a vehicle; tables for every nuclide (N) and line (L, padded with yield 0)."""

    radius_m: jax.Array  # [] of the crystal
    length_m: jax.Array  # []
    mount_position_m: jax.Array  # [3] crystal centre, body FLU
    mount_axis: jax.Array  # [3] unit, crystal axis, body FLU
    background_cps: jax.Array  # []
    paralyzable_s: jax.Array  # []
    non_paralyzable_s: jax.Array  # []
    sample_period_s: jax.Array  # [] live time of one measurement
    yields: jax.Array  # [N, L] photons per decay
    effective_area_m2: jax.Array  # [N, L, 5] coefficients of cylinder.direction_basis, housing and efficiency included
    transport_1_m: jax.Array  # [N, 4, L, M] linear attenuation mu, and mu times build-up C, D, P of each material
    shielding: jax.Array  # [N, 4, L] optical depth, and depth times C, D, P, of the shielded template of `identify`
    peak_spectrum: jax.Array  # [N, L, channels] share of the counts of unscattered photons in each channel, sums to 1
    scattered_spectrum: jax.Array  # [N, L, channels] same for photons that scattered before the crystal
    background_spectrum: jax.Array  # [channels] cps, sums to background_cps
    energy_kev: jax.Array  # [channels] centre of each channel
    line_energy_kev: jax.Array  # [N, L]
    nuclide_names: tuple[str, ...] = static()
    material_names: tuple[str, ...] = static()
    kind: str = static()  # physical | paper_ideal
    identification_bins: tuple[int, ...] = static()  # first channel of each bin that identification works in


def build_detector(spec: DetectorSpec, mount: DetectorMount, library: Library, kind: str) -> Detector:
    """Detector ``spec`` mounted as ``mount`` with the tables of every nuclide and material of ``library``.

    ``kind`` is ``physical`` or ``paper_ideal``: the latter counts every photon that meets the crystal (no housing, no
    efficiency), neglects attenuation in air and scattered photons, and draws counts as the Gazebo plugin of the paper
    does. Raises `InputError` when the material of the crystal or the housing is unknown, or when a table does not reach
    the energy of a line.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {KINDS}, not {kind!r}")
    crystal, housing = library.material(spec.crystal), library.material(spec.housing.material)
    air = library.material_index(AIR)
    lines_max = max(len(n.lines) for n in library.nuclides)
    energy, yields = np.full((len(library.nuclides), lines_max), 662.0), np.zeros((len(library.nuclides), lines_max))
    for i, nuclide in enumerate(library.nuclides):
        energy[i, : len(nuclide.lines)] = [line.energy_kev for line in nuclide.lines]
        yields[i, : len(nuclide.lines)] = [line.yield_percent / 100 for line in nuclide.lines]
    radius, length = spec.diameter_mm / 2000, spec.length_mm / 1000
    response = build_response(spec, crystal, housing)
    if kind == "physical":
        mu = linear_attenuation(crystal, energy)
        area = fit_effective_area(radius, length, mu.ravel()).reshape(*mu.shape, 5)
        area = area * (response.bare_factor(energy) * response.housing_transmission(energy))[..., None]
    else:
        silhouette = np.array([0.0, np.pi * radius**2, 2 * radius * length, 0.0, 0.0])
        area = np.broadcast_to(silhouette, (*energy.shape, 5))
    axis = np.asarray(mount.axis) / np.linalg.norm(mount.axis)
    f32 = on_device
    return Detector(
        radius_m=f32(radius),
        length_m=f32(length),
        mount_position_m=f32(mount.position_m),
        mount_axis=f32(axis),
        background_cps=f32(spec.background.rate_cps),
        paralyzable_s=f32(spec.dead_time.paralyzable_us * 1e-6),
        non_paralyzable_s=f32(spec.dead_time.non_paralyzable_us * 1e-6),
        sample_period_s=f32(spec.sample_period_s),
        yields=f32(yields),
        effective_area_m2=f32(area),
        transport_1_m=f32(_transport(library, energy, kind, air)),
        shielding=f32(_shielding(housing, energy, kind)),
        peak_spectrum=f32(peak_spectrum(response, energy)),
        scattered_spectrum=f32(scattered_spectrum(response, energy)),
        background_spectrum=f32(background_spectrum(response, spec.background)),
        energy_kev=f32(response.channel_centre_kev),
        line_energy_kev=f32(energy),
        nuclide_names=library.nuclide_names,
        material_names=library.material_names,
        kind=kind,
        identification_bins=_identification_bins(response),
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
    per_line = ("yields", "effective_area_m2", "peak_spectrum", "scattered_spectrum", "line_energy_kev")
    tables = {name: getattr(detector, name)[rows, :lines] for name in per_line}
    transport = detector.transport_1_m[rows, :, :lines]
    shielding = detector.shielding[rows, :, :lines]
    return replace(detector, transport_1_m=transport, shielding=shielding, nuclide_names=nuclides, **tables)


def _transport(library: Library, energy: Floats, kind: str, air: int) -> Floats:
    """Linear attenuation and build-up products [N, 4, L, M] in 1/m."""
    table = np.zeros((energy.shape[0], 4, energy.shape[1], len(library.materials)))
    for m, material in enumerate(library.materials):
        mu = linear_attenuation(material, energy)
        if kind == "physical":
            table[..., m] = np.stack([mu, *(mu * k for k in build_up_coefficients(material, energy))], axis=1)
        elif m != air:
            table[:, 0, :, m] = mu
    return table


def _shielding(material: Material, energy: Floats, kind: str) -> Floats:
    """Optical depth, and depth times C, D, P [N, 4, L], of two mean free paths (at 662 keV) of ``material``."""
    depth = 2.0 * mass_attenuation(material, energy) / mass_attenuation(material, 662.0)
    build_up = [depth * k for k in build_up_coefficients(material, energy)]
    return np.stack([depth, *build_up] if kind == "physical" else [depth, *np.zeros((3, *depth.shape))], axis=1)


def _identification_bins(response: Response) -> tuple[int, ...]:
    """First channels of bins a third of the resolution (FWHM) wide, from the threshold, and the end of the last bin."""
    starts = [int(np.searchsorted(response.channel_edge_kev, response.threshold_kev))]
    end = len(response.channel_centre_kev)
    while starts[-1] < end:
        energy = response.channel_edge_kev[starts[-1]]
        width = response.sigma_kev(np.array([energy]))[0] * 2.355 / 3 / response.channel_width_kev
        starts.append(min(starts[-1] + max(round(float(width)), 1), end))
    return tuple(starts)
