"""The nuclides and materials of the configuration folders (host side)."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from swarmsim.config.errors import InputError
from swarmsim.config.files import config_dirs
from swarmsim.config.load import load_all
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.radiation import Material, Nuclide

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

    @property
    def decay_1_s(self) -> tuple[float, ...]:
        """Decay constant of each nuclide."""
        return tuple(math.log(2.0) / n.half_life_s for n in self.nuclides)

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
