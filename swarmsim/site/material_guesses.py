"""Guesses of what a mesh is made of, from the names of its materials, geometries, nodes and textures."""

import glob
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from swarmsim.config.radiation import Material

BUILDINGS = frozenset(
    {"house", "barn", "building", "shed", "hut", "cabin", "hangar", "warehouse", "garage", "container"}
)
"""Words of things that are hollow, as a rule."""
PREFIX_MIN = 4  # letters of a word from which on it is compared with the beginning of a word of a name


@dataclass(frozen=True)
class Guess:
    """One rule for the specification, and the name that it was guessed from."""

    name: str
    material: str
    wall_m: float | None

    def rule(self) -> dict[str, Any]:
        """As it stands under ``obstacles:`` in a site's specification."""
        thick = {} if self.wall_m is None else {"wall_m": self.wall_m}
        return {"match": glob.escape(self.name), "material": self.material, **thick}

    def __str__(self) -> str:
        """For a message."""
        built = {word for word in words(self.name) if word in BUILDINGS}
        hint = ": say wall_m if it is hollow" if built else ""
        return f"{self.name}: {self.material}, " + (f"solid{hint}" if self.wall_m is None else f"{self.wall_m:g} m")


def guess(name: str, materials: Mapping[str, Material]) -> Guess | None:
    """What a name says, by the words that the ``materials`` are known by; None where it says nothing.

    The last word that says something decides, as the head of a compound does (tree trunk, brick house); if another word
    of the name says the same material with a thickness (corrugated steel), that thickness counts.
    """
    found = [hit for word in words(name) for hit in _said(word, materials)]
    if not found:
        return None
    material = found[-1][0]
    walls = [wall for other, wall in found if other == material and wall is not None]
    return Guess(name, material, walls[-1] if walls else None)


def words(name: str) -> list[str]:
    """The words of a name in small letters: parted by signs, digits and capitals (WoodPlanks_02: wood, planks)."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def _said(word: str, materials: Mapping[str, Material]) -> list[tuple[str, float | None]]:
    """Material and thickness by the longest of the materials' words that fits."""
    fitting = [
        (len(known), material, entry.wall_m)
        for material, content in materials.items()
        for entry in content.named_as
        for known in entry.words
        if word == known or (len(known) >= PREFIX_MIN and word.startswith(known))
    ]
    return [max(fitting, key=lambda hit: hit[0])[1:]] if fitting else []


def guesses(parts: Sequence[Mapping[str, Any]], materials: Mapping[str, Material]) -> list[Guess]:
    """One guess for each name that says what the parts are that no rule names, those of mesh materials first.

    ``parts`` are those of an import's report. A part's first name that says something counts.
    """
    found: dict[str, tuple[int, Guess]] = {}
    for part in parts:
        if part["rule"]:
            continue
        said = ((order, guess(name, materials)) for order, name in enumerate(part["names"]))
        order, first = next(((order, g) for order, g in said if g is not None), (0, None))
        if first is not None:
            found.setdefault(first.name, (order, first))
    return [each for _, each in sorted(found.values(), key=lambda item: item[0])]
