"""Detectors for estimates: few lines for each nuclide, and the materials of one site only (host side).

An estimate asks for the rates of thousands of places, where the truth asks for one. Lines that lie close to one another
are attenuated alike and fall into the same region of interest, so that their yields can be added up.
"""

import itertools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.pytree import on_device
from swarmsim.radiation.cylinder import direction_basis
from swarmsim.radiation.detector import Detector

Floats = NDArray[np.float64]

WIDTH = 0.12
"""Lines within this of each other in ln(energy) are alike: the width of a NaI(Tl) peak at 300 keV."""


def coarse(detector: Detector, lines: int, materials: tuple[str, ...]) -> Detector:
    """``detector`` with at most ``lines`` lines for each nuclide, and the tables of ``materials`` in that order.

    Neighbours in energy are put together, those first whose union changes the counts least: the energy of a group, and
    every table, is the mean over its lines, weighted with the counts that each adds in the open. Raises `ValueError`
    for a material that the detector has no table of.
    """
    columns = [detector.material_names.index(name) for name in materials]
    energy, yields = np.asarray(detector.line_energy_kev, float), np.asarray(detector.yields, float)
    area = np.asarray(detector.effective_area_m2, float)
    counts = yields * (area @ np.asarray(direction_basis(jnp.float32(0.5**0.5), jnp.float32(0.5**0.5)), float))
    most = min(lines, energy.shape[1])
    shares = np.stack([_groups(e, c, most) for e, c in zip(energy, counts, strict=True)])  # [N, most, L]
    mean = shares / np.maximum(shares.sum(axis=-1, keepdims=True), 1e-300)
    total = (shares > 0) @ np.where(yields > 0, yields, 0.0)[..., None]

    def averaged(name: str, axis: int) -> Floats:
        """Table ``name`` with its axis of lines (counted without that of the nuclides) averaged."""
        table = np.moveaxis(np.asarray(getattr(detector, name), float), 1 + axis, 1)
        flat = table.reshape(*table.shape[:2], -1)
        return np.moveaxis((mean @ flat).reshape(table.shape[0], most, *table.shape[2:]), 1, 1 + axis)

    by_yield = np.where(yields > 0, yields, 0.0)[:, None, :] * (shares > 0)
    by_yield = by_yield / np.maximum(by_yield.sum(axis=-1, keepdims=True), 1e-300)
    f32 = on_device
    return replace(
        detector,
        material_names=materials,
        yields=f32(total[..., 0]),
        effective_area_m2=f32(by_yield @ area),
        near_share=f32(averaged("near_share", 0)),
        attenuation_1_m=f32(averaged("attenuation_1_m", 0)[..., columns]),
        surrounds=f32(np.asarray(detector.surrounds)[columns]),
        scatter_1_m=f32(averaged("scatter_1_m", 2)[..., columns]),
        peak_spectrum=f32(np.ones((len(energy), most, 1))),
        peak_orders=f32(np.zeros((len(energy), most, 1, 1, 1))),
        peak_rois=f32(averaged("peak_rois", 0)),
        scattered_bins=f32(np.ones((len(energy), 1, 1, most, 1))),
        scattered_rois=f32(averaged("scattered_rois", 2)[:, :, columns]),
        ground=f32(averaged("ground", 0)),
        ground_bins=f32(np.ones((len(energy), most, 1))),
        ground_rois=f32(averaged("ground_rois", 0)),
        line_energy_kev=f32(averaged("line_energy_kev", 0)),
    )


def _groups(energy: Floats, counts: Floats, most: int) -> Floats:
    """Counts [most, L] of each group's lines: neighbours joined until so many are left, and while they are alike."""
    order = np.argsort(energy)
    groups = [[i] for i in order if counts[i] > 0.0]

    def cost(a: list[int], b: list[int]) -> float:
        ca, cb = counts[a].sum(), counts[b].sum()
        apart = np.log((energy[b] @ counts[b] / cb) / (energy[a] @ counts[a] / ca))
        return float(ca * cb / (ca + cb) * apart**2 / counts.sum())

    while len(groups) > 1:
        costs = [cost(a, b) for a, b in itertools.pairwise(groups)]
        k = int(np.argmin(costs))
        if len(groups) <= most and costs[k] > 0.02 * WIDTH**2:
            break
        groups[k : k + 2] = [groups[k] + groups[k + 1]]
    found = np.zeros((most, len(energy)))
    for row, members in enumerate(groups):
        found[row, members] = counts[members]
    return found
