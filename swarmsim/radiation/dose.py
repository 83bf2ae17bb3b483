"""Dose rates of point sources: ambient dose equivalent H*(10) and air kerma, scattered photons included."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.radiation import Nuclide
from swarmsim.pytree import on_device
from swarmsim.radiation import scattering
from swarmsim.radiation.cylinder import NEAR_COLUMNS, NEAR_ROWS, NEAR_TABLES
from swarmsim.radiation.detector import Detector, lines_of, surrounding
from swarmsim.radiation.ground import from_ground
from swarmsim.radiation.library import Library
from swarmsim.radiation.lines import SPECTRUM_BINS

Floats = NDArray[np.float64]
Quantity = Literal["ambient_dose_equivalent", "air_kerma"]

# keV; ambient dose equivalent in pSv cm2 and air kerma in pGy cm2 per photon: ICRP 74 (1996), tables A.21 and A.1
_CONVERSION = np.array([
    (20.0, 1.05, 1.68), (30.0, 0.81, 0.721), (40.0, 0.64, 0.429), (50.0, 0.55, 0.323), (60.0, 0.51, 0.289),
    (80.0, 0.53, 0.307), (100.0, 0.61, 0.371), (150.0, 0.89, 0.599), (200.0, 1.20, 0.856), (300.0, 1.80, 1.38),
    (400.0, 2.38, 1.89), (500.0, 2.93, 2.38), (600.0, 3.44, 2.84), (800.0, 4.38, 3.69), (1000.0, 5.20, 4.47),
    (1500.0, 6.90, 6.14), (2000.0, 8.60, 7.55), (3000.0, 11.1, 9.96), (4000.0, 13.4, 12.1), (5000.0, 15.5, 14.1),
    (6000.0, 17.6, 16.1), (8000.0, 21.6, 20.1), (10000.0, 25.6, 24.0),
])  # fmt: skip
MICRO_PER_HOUR = 3600.0 * 1e-6  # of pSv/s


def per_fluence(quantity: Quantity, energy_kev: Floats) -> Floats:
    """Ambient dose equivalent [pSv cm2] or air kerma [pGy cm2] per photon of ``energy_kev`` [...], log-log."""
    column = 1 if quantity == "ambient_dose_equivalent" else 2
    return np.exp(np.interp(np.log(energy_kev), np.log(_CONVERSION[:, 0]), np.log(_CONVERSION[:, column])))


def gamma_constant(nuclide: Nuclide, quantity: Quantity = "ambient_dose_equivalent") -> float:
    """Dose rate 1 m from a point source of 1 MBq without anything around it, in uSv/h (or uGy/h).

    That of the nuclide's lines as its file has them: rays of less energy, such as X-rays under 30 keV, are left out.
    """
    energy = np.array([line.energy_kev for line in nuclide.lines])
    yields = np.array([line.yield_percent / 100 for line in nuclide.lines])
    fluence_rate = 1e6 / (4.0 * np.pi * 100.0**2)  # 1/(cm2 s) of 1 MBq with one photon to a decay
    return float(MICRO_PER_HOUR * fluence_rate * (yields @ per_fluence(quantity, energy)))


def build_dosimeter(library: Library, quantity: Quantity = "ambient_dose_equivalent") -> Detector:
    """An ideal dosimeter without extent: `net_rate` of it is the dose rate in uSv/h (or uGy/h) of a source.

    It has no background, no dead time and no spectrum.
    """
    energy, yields = lines_of(library)
    tables = scattering.transport(library.materials, energy, lambda e: per_fluence(quantity, e))
    ground, _ = from_ground(tables.energy_kev, lambda e: per_fluence(quantity, e))
    area = np.zeros((*energy.shape, 5))
    area[..., 0] = per_fluence(quantity, energy) * 1e-4 * MICRO_PER_HOUR
    f32, zero = on_device, on_device(0.0)
    bins = np.full(
        (len(library.nuclides), 2, len(library.materials), energy.shape[1], SPECTRUM_BINS), 1 / SPECTRUM_BINS
    )
    return Detector(
        radius_m=f32(1e-3),
        length_m=f32(2e-3),
        mount_position_m=f32(np.zeros(3)),
        mount_axis=f32([0.0, 0.0, 1.0]),
        background_cps=zero,
        background_height_m=zero,
        paralyzable_s=zero,
        non_paralyzable_s=zero,
        sample_period_s=f32(1.0),
        decay_1_s=f32(library.decay_1_s),
        yields=f32(yields),
        effective_area_m2=f32(area),
        near=f32(np.zeros((NEAR_TABLES, NEAR_ROWS, NEAR_COLUMNS))),
        near_share=f32(np.full((*energy.shape, NEAR_TABLES), 1 / NEAR_TABLES)),
        attenuation_1_m=f32(tables.attenuation_1_m[tables.row]),
        surrounds=f32(surrounding(library)),
        scatter_1_m=f32(np.moveaxis(tables.scatter_1_m[tables.row], 1, 3)),
        ground=f32(ground[tables.row]),
        ground_bins=f32(np.full((*energy.shape, SPECTRUM_BINS), 1 / SPECTRUM_BINS)),
        ground_rois=f32(np.ones((*energy.shape, 1))),
        peak_spectrum=f32(np.ones((*energy.shape, 1))),
        scattered_bins=f32(bins),
        peak_rois=f32(np.ones((*energy.shape, 1))),
        scattered_rois=f32(np.ones((*bins.shape[:-1], 1))),
        background_rois=f32(np.zeros(1)),
        bin_spectrum=f32(np.ones((SPECTRUM_BINS, 1))),
        peak_orders=f32(np.zeros((*energy.shape, 1, 1, 1))),
        bin_orders=f32(np.zeros((SPECTRUM_BINS, 1, 1, 1))),
        natural_orders=f32(np.zeros((1, 2, 1, 1))),
        grid_spectrum=f32(np.ones((1, 1, 1))),
        known_spectrum=f32(np.ones((1, 1, 1))),
        known_scattered=f32(np.ones((1, 1))),
        stranger=f32(np.zeros(1)),
        background_spectrum=f32(np.zeros(1)),
        energy_kev=f32([662.0]),
        sigma_kev=f32([662.0]),
        line_energy_kev=f32(energy),
        nuclide_names=library.nuclide_names,
        known_names=library.nuclide_names,
        material_names=library.material_names,
        kind="physical",
        identification_bins=(),
    )
