"""Counts from a source in a house or a container: the model that missions use against the Monte Carlo.

    python -m experiments.transport.enclosures [--photons N] [--out FOLDER]

writes ``enclosures.csv`` and prints the table of the README.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from cyclopts import App, Parameter
from numpy.typing import NDArray

from experiments.transport.bodies import Boxes, seen
from experiments.transport.compare import ENERGIES_KEV, FAINT, detector_of, efficiency
from experiments.transport.sites import Block, modelled, site_of, ways
from experiments.transport.tables import write_table
from experiments.transport.walk import Floats, Medium, medium
from swarmsim.radiation import load_library

BOXED_KEV = (60.0, 122.0, 356.0, 662.0, 1332.0)
GROUND_M = (60.0, 0.6)  # half width and depth
SOURCE_HEIGHT_M = 0.5
FROM_WALL_M = 0.7  # of a source by the wall, to its outside
VIEWS_M = {  # detectors, from the middle of the building on the ground
    "rover 10 m": (10.0, 0.0, 0.5),
    "rover 30 m": (30.0, 0.0, 0.5),
    "rover 30 m, oblique": (21.2, 21.2, 0.5),
    "UAV above": (0.0, 0.0, 20.0),
    "UAV 10 m": (10.0, 0.0, 20.0),
    "UAV 30 m": (30.0, 0.0, 20.0),
}

CROSSED = {  # by the metres on the line over the thickness of the wall
    "nowhere": (0.0, 0.5),
    "within 20 degrees of square on": (0.5, 1.06),
    "at 27 to 51 degrees": (1.06, 1.7),
    "at 68 to 74 degrees": (1.7, 9.0),
}
KNOWN = 0.15  # relative error above which a case is left out of the table

app = App(name="enclosures", help=__doc__, help_format="plaintext")


@dataclass(frozen=True)
class Building:
    """A hollow box on the ground, open below (on the ground) unless it has a floor."""

    name: str
    size_m: tuple[float, float, float]  # outside
    wall_m: float
    material: str
    roof: bool
    floor: bool = False


HOUSE_M = (10.0, 8.0, 4.0)
BUILDINGS = (
    Building("container, 2 mm steel", (6.0, 2.5, 2.6), 0.002, "steel", True, True),
    *(
        Building(f"house, {told}{'' if roof else ', no roof'}", HOUSE_M, wall, material, roof)
        for told, wall, material in (
            ("24 cm brick", 0.24, "brick"), ("10 cm concrete", 0.10, "concrete"), ("20 cm concrete", 0.20, "concrete"),
        )
        for roof in (True, False)
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One building, energy, place of the source and view: counts over those of the source alone, without ground."""

    building: str
    energy_kev: float
    source: str
    view: str
    ground: bool
    slant: float  # metres of the line in the building over the thickness of a wall
    bare: float  # counts of the source without the building
    bare_model: float
    uncollided: float
    monte_carlo: float
    error: float
    model: float


def boxes(building: Building) -> Floats:
    """Lower and upper corners [i, 2, 3] of the walls, the roof and the floor; they do not overlap."""
    (x, y), z, t = (0.5 * s for s in building.size_m[:2]), building.size_m[2], building.wall_m
    low, high = (t if building.floor else 0.0), (z - t if building.roof else z)
    found = [
        ((-x, -y, low), (-x + t, y, high)),
        ((x - t, -y, low), (x, y, high)),
        ((-x + t, -y, low), (x - t, -y + t, high)),
        ((-x + t, y - t, low), (x - t, y, high)),
    ]
    if building.roof:
        found.append(((-x, -y, z - t), (x, y, z)))
    if building.floor:
        found.append(((-x, -y, 0.0), (x, y, t)))
    return np.array(found)


def blocks_of(building: Building) -> list[Block]:
    """What the importer of sites makes of the building: a hollow box, or walls that are solid if it is open above."""
    if building.roof:
        (x, y), z = (0.5 * s for s in building.size_m[:2]), building.size_m[2]
        return [Block((-x, -y, 0.0), (x, y, z), building.wall_m, building.material)]
    return [Block(tuple(low), tuple(high), 0.0, building.material) for low, high in boxes(building)]


def bodies_of(corners: Floats, ground: bool) -> Boxes:
    """The boxes of the first medium and, with ``ground``, the ground of the last one."""
    half, depth = GROUND_M
    material = np.zeros(len(corners), np.int32)
    if ground:
        corners = np.concatenate([corners, [[(-half, -half, -depth), (half, half, 0.0)]]])
        material = np.append(material, np.int32(1))
    return Boxes(
        jnp.asarray(corners[:, 0], jnp.float32), jnp.asarray(corners[:, 1], jnp.float32), jnp.asarray(material)
    )


def crossed(corners: Floats, source: Floats, target: Floats) -> tuple[float, float]:
    """Metres of the way from ``source`` to ``target`` [3] in the boxes, and their mean place on it, from 0 to 1."""
    along = target - source
    along = np.where(np.abs(along) < 1e-9, 1e-9, along)
    ends = np.sort((corners - source) / along, axis=1)  # [i, 2, 3]
    enter, leave = np.clip(ends[:, 0].max(axis=1), 0.0, 1.0), np.clip(ends[:, 1].min(axis=1), 0.0, 1.0)
    share = np.maximum(leave - enter, 0.0)
    place = 0.5 if share.sum() == 0.0 else float(np.sum(share * 0.5 * (enter + leave)) / share.sum())
    return float(share.sum() * np.linalg.norm(target - source)), place


class Runs:
    """Monte Carlo and model of one detector at one energy after the other."""

    def __init__(self, name: str, photons: int):
        self.library, self.photons = load_library(), photons
        self.detector = detector_of(self.library, name)
        self.grid, self.counted = efficiency(self.library, name)

    def of_energy(self, energy: float) -> Iterator[Case]:
        """Every building, source and view, without ground and with it."""
        names = ("soil", *dict.fromkeys(building.material for building in BUILDINGS))
        tables = {
            name: medium(self.library.material(name), energy, lambda e: np.interp(e, self.grid, self.counted))
            for name in names
        }
        views = np.array(list(VIEWS_M.values()))
        number = ENERGIES_KEV.index(energy)
        for building in BUILDINGS:
            corners, walls = boxes(building), tables[building.material]
            for place, from_middle in (("middle", 0.0), ("by the wall", 0.5 * building.size_m[0] - FROM_WALL_M)):
                source = np.array([from_middle, 0.0, SOURCE_HEIGHT_M])
                for ground in (False, True):
                    tally = self._seen((walls, tables["soil"]), bodies_of(corners, ground), energy, source, views)
                    bare = np.ones(len(views))
                    if ground:
                        alone = bodies_of(corners[:0], True)
                        bare = np.sum(self._seen((walls, tables["soil"]), alone, energy, source, views)[:2], axis=0)
                    model, bare_model = (
                        self._modelled(number, blocks, ground, source, views) for blocks in (blocks_of(building), [])
                    )
                    for v, view in enumerate(VIEWS_M):
                        slant = crossed(corners, source, views[v])[0] / building.wall_m
                        direct, scattered, error = tally[:, v]
                        yield Case(building.name, energy, place, view, ground, slant, float(bare[v]), bare_model[v],
                                   direct, direct + scattered, error, model[v])  # fmt: skip

    def _modelled(
        self, number: int, blocks: list[Block], ground: bool, source: Floats, views: Floats
    ) -> NDArray[np.float64]:
        site = site_of(blocks, self.detector.material_names, ground)
        way = ways(site, jnp.asarray(source, jnp.float32), jnp.asarray(views, jnp.float32))
        return np.sum(np.asarray(modelled(self.detector, number, way), np.float64), axis=0)

    def _seen(
        self, media: tuple[Medium, ...], bodies: Boxes, energy: float, source: Floats, views: Floats
    ) -> NDArray[np.float64]:
        """Unscattered and scattered photons and the latter's error [3, views]."""
        f32 = partial(jnp.asarray, dtype=jnp.float32)
        found = seen(jax.random.key(7), media, bodies, f32(energy), f32(source), f32(views), self.photons)
        return np.asarray(found, np.float64)


def told(found: list[Case]) -> str:
    """The table of the README: model over Monte Carlo on the ground, median and range over sources and views."""
    rows = [
        "| building | the line crosses it | " + " | ".join(f"{e:g} keV" for e in BOXED_KEV) + " |",
        "|---|---|" + "---|" * len(BOXED_KEV),
    ]
    for building in BUILDINGS:
        own = [c for c in found if c.ground and c.building == building.name]
        for how, (low, high) in CROSSED.items():
            of_kind = [c for c in own if low <= c.slant < high]
            if of_kind:
                cells = [_cell([c for c in of_kind if c.energy_kev == energy]) for energy in BOXED_KEV]
                rows.append(f"| {building.name} | {how} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _cell(own: list[Case]) -> str:
    known = [c for c in own if c.monte_carlo > FAINT and c.error < KNOWN * c.monte_carlo]
    if not known:
        return "faint"
    ratio = [c.model / c.monte_carlo for c in known]
    median = f"{np.median([c.monte_carlo for c in known]):.2g}: {np.median(ratio):.2g}"
    return median if len(known) == 1 else f"{median} ({min(ratio):.2g} to {max(ratio):.2g})"


@app.default
def main(
    *, photons: Annotated[int, Parameter(help="Photons of each run.")] = 100_000,
    detector: Annotated[str, Parameter(help="Detector, by its name.")] = "nai_2x2",
    out: Annotated[Path, Parameter(help="Folder of the results.")] = Path("runs/transport"),
) -> None:  # fmt: skip
    """Compare, and write the table."""
    runs, found = Runs(detector, photons), []
    for energy in BOXED_KEV:
        found += list(runs.of_energy(energy))
        print(f"{energy:g} keV", flush=True)
    write_table(out / "enclosures.csv", found)
    print(told(found))


if __name__ == "__main__":
    app()
