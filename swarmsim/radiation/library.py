"""The nuclides and materials of the configuration folders, and interpolation of their tables (host side)."""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarmsim.config.errors import InputError
from swarmsim.config.files import config_dirs
from swarmsim.config.load import load_all
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.radiation import Material, Nuclide

Floats = NDArray[np.float64]
ELECTRON_KEV = 510.99895  # rest energy, CODATA 2018
BUILD_UP_SCALE = 0.2  # mean free paths, in B = 1 + C t (1 + t / 0.2)^P exp(D t)
T = TypeVar("T", Nuclide, Material)


@dataclass(frozen=True)
class Library:
    """Nuclides and materials sorted by name, which is the order of every table and index."""

    nuclides: tuple[Nuclide, ...]
    materials: tuple[Material, ...]

    @property
    def nuclide_names(self) -> tuple[str, ...]:
        """Sorted names of the nuclides."""
        return tuple(n.name for n in self.nuclides)

    @property
    def material_names(self) -> tuple[str, ...]:
        """Sorted names of the materials."""
        return tuple(m.name for m in self.materials)

    def nuclide(self, name: str) -> Nuclide:
        """The nuclide of that name; raises `InputError` with the nearest one."""
        return _named(name, self.nuclides, self.nuclide_names, "nuclide")

    def material(self, name: str) -> Material:
        """The material of that name; raises `InputError` with the nearest one."""
        return _named(name, self.materials, self.material_names, "material")

    def nuclide_index(self, name: str) -> int:
        """Index of a nuclide in the tables; raises `InputError` when unknown."""
        return self.nuclides.index(self.nuclide(name))

    def material_index(self, name: str) -> int:
        """Index of a material in the tables; raises `InputError` when unknown."""
        return self.materials.index(self.material(name))


def _named(name: str, items: tuple[T, ...], names: tuple[str, ...], kind: str) -> T:
    if name not in names:
        raise InputError.of(
            f"there is no {kind} '{name}'", given=name, allowed=one_of(names), suggestion=did_you_mean(name, names)
        )
    return items[names.index(name)]


def load_library(near: Path | None = None) -> Library:
    """Read every nuclide and material of the configuration folders (`swarmsim.config.files.config_dirs`).

    ``near`` is a file whose own ``configs`` folder is searched too. Raises `InputError` with the problems of all files.
    """
    nuclides = tuple(load_all("nuclides", near).values())
    materials = tuple(load_all("materials", near).values())
    for kind, found in (("nuclides", nuclides), ("materials", materials)):
        if not found:
            places = ", ".join(map(str, config_dirs(near))) or "configs"
            raise InputError.of(f"no {kind} found: put {kind}/<name>.yaml into {places}")
    return Library(nuclides, materials)


def mass_attenuation(material: Material, energy_kev: ArrayLike) -> Floats:
    """Mass attenuation coefficient [cm2/g] at ``energy_kev`` [...], log-log between the table's points.

    An energy that is listed twice is an absorption edge, and the step is kept. Raises `InputError` outside the table.
    """
    energy, table = np.asarray(energy_kev, np.float64), np.asarray(material.energy_kev)
    if np.any(energy < table[0]) or np.any(energy > table[-1]):
        raise InputError.of(
            f"material '{material.name}' is tabulated from {table[0]:g} to {table[-1]:g} keV and is needed at "
            f"{np.min(energy):g} to {np.max(energy):g} keV: extend energy_kev and mass_attenuation_cm2_g in its file"
        )
    return np.exp(np.interp(np.log(energy), np.log(table), np.log(material.mass_attenuation_cm2_g)))


def linear_attenuation(material: Material, energy_kev: ArrayLike) -> Floats:
    """Linear attenuation coefficient [1/m] at ``energy_kev`` [...] and the material's bulk density."""
    return mass_attenuation(material, energy_kev) * 0.1 * material.density_kg_m3


def build_up_coefficients(material: Material, energy_kev: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """C, D and P of the number build-up at ``energy_kev`` [...], linear in ln(energy), constant outside the table."""
    log_energy = np.log(np.asarray(energy_kev, np.float64))
    table = np.log([row.energy_kev for row in material.build_up])
    c, d, p = (np.interp(log_energy, table, [getattr(row, k) for row in material.build_up]) for k in ("c", "d", "p"))
    return c, d, p
