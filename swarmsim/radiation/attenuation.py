"""Attenuation coefficients of materials from their composition (host side)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarmsim.config.errors import InputError
from swarmsim.config.radiation import Material
from swarmsim.radiation.elements import AVOGADRO_PER_BARN, ENERGY_RANGE_KEV, elements

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Coefficients:
    """Mass attenuation coefficients [...] in cm2/g by process."""

    coherent: Floats
    incoherent: Floats
    photoelectric: Floats
    pair: Floats

    @property
    def total(self) -> Floats:
        """Their sum, coherent scattering included."""
        return self.coherent + self.incoherent + self.photoelectric + self.pair


def coefficients(material: Material, energy_kev: ArrayLike) -> Coefficients:
    """Mass attenuation coefficients of ``material`` at ``energy_kev`` [...], by the mixture rule from its elements.

    Raises `InputError` for an energy outside the table of cross sections.
    """
    energy = np.asarray(energy_kev, np.float64)
    low, high = ENERGY_RANGE_KEV
    if np.any(energy < low) or np.any(energy > high):
        raise InputError.of(
            f"the cross sections reach from {low:g} to {high:g} keV, and those of '{material.name}' are needed at "
            f"{np.min(energy):g} to {np.max(energy):g} keV: leave out lines beyond the table"
        )
    flat, table = energy.ravel(), elements()
    parts = np.zeros((4, flat.size))
    for symbol, share in material.mass_fractions.items():
        element = table[symbol]
        parts += share * AVOGADRO_PER_BARN / element.atomic_weight * np.stack(element.at(flat))
    return Coefficients(*(part.reshape(energy.shape) for part in parts))


def mass_attenuation(material: Material, energy_kev: ArrayLike) -> Floats:
    """Mass attenuation coefficient [cm2/g] at ``energy_kev`` [...], coherent scattering included."""
    return coefficients(material, energy_kev).total


def linear_attenuation(material: Material, energy_kev: ArrayLike) -> Floats:
    """Linear attenuation coefficient [1/m] at ``energy_kev`` [...] and the material's bulk density."""
    return mass_attenuation(material, energy_kev) * 0.1 * material.density_kg_m3
