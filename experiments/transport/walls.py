"""Counts from sources in and behind walls that are drawn at random: the model against the Monte Carlo.

    python -m experiments.transport.walls [--seeds 3] [--photons N] [--out FOLDER]

writes ``walls.csv``, prints how far the model is from the Monte Carlo, fits the network to all but the last set of
cases, and writes it as ``network.csv``: the rows of ``configs/elements/walls.csv``, which are of 250 sets and take ten
minutes on one H100. Thirty minutes on one core for three.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from cyclopts import App, Parameter

from experiments.transport.bodies import Boxes, seen
from experiments.transport.compare import ENERGIES_KEV, FAINT, detector_of, efficiency
from experiments.transport.sites import Block, modelled, site_of, ways
from experiments.transport.tables import write_table
from experiments.transport.walk import Floats, Medium, medium
from experiments.transport.walls_fit import Rows, features_of, fitted
from swarmsim.radiation import Detector, load_library
from swarmsim.radiation.attenuation import linear_attenuation
from swarmsim.radiation.walls import scattered_counts
from swarmsim.site import Crossed
from swarmsim.site.wall_network import table_of

ENERGIES = (60.0, 122.0, 356.0, 662.0, 1332.0), (0.12, 0.2, 0.2, 0.24, 0.24)  # and how often they are drawn
THICKNESS_M = {
    "concrete": (0.04, 0.4),
    "brick": (0.08, 0.4),
    "steel": (0.0007, 0.025),
    "lead": (0.001, 0.025),
    "wood": (0.015, 0.3),
    "glass": (0.004, 0.03),
    "soil": (0.1, 0.6),
}
OFTEN = (0.32, 0.2, 0.22, 0.08, 0.08, 0.05, 0.05)  # these are drawn
DEEPEST = 8.0  # mean free paths of a wall
RUNS = {"inside": 60, "container": 9, "cube": 5, "wall": 34, "square": 4, "behind": 30, "block": 14}  # of each seed
TOLD = {
    "inside": "in a closed building",
    "container": "in a container of steel",
    "cube": "in the middle of a cube",
    "wall": "a free-standing wall between",
    "square": "a wide wall between, crossed squarely",
    "behind": "a closed building between",
    "block": "a solid block between",
}
ENCLOSED = ("inside", "container", "cube")  # the source
SOLID = ("wall", "square", "block")
VIEWS = 8
COLLISIONS = 30
ALIKE = 0.1  # relative error of taking photons into a building for those out of it
KNOWN = 0.06  # relative error of the Monte Carlo above which a case is left out

app = App(name="walls", help=__doc__, help_format="plaintext")


class Drawn(NamedTuple):
    """A building or a wall, a source, and detectors behind."""

    kind: str
    material: str
    energy_kev: float
    block: Block
    pieces: Floats  # [i, 2, 3] corners of the boxes that it is made of
    source_m: Floats  # [3]
    detectors_m: Floats  # [VIEWS, 3]


@dataclass(frozen=True)
class Case:
    """One view: counts over those of the bare source."""

    kind: str
    material: str
    energy_kev: float
    thickness_m: float
    seed: int
    run: int
    uncollided: float
    scattered: float
    error: float
    model: float


def drawn(rng: np.random.Generator, kind: str) -> Drawn:
    """A case of one of the kinds of `RUNS`."""

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    material = str(rng.choice(list(THICKNESS_M), p=OFTEN))
    energy = float(rng.choice(ENERGIES[0], p=ENERGIES[1]))
    thickness, (x, y, z) = between(*THICKNESS_M[material]), _half_extents(rng, between)
    if kind == "container":
        material, thickness = "steel", between(0.001, 0.006)
        x, y, z = 0.5 * between(2.0, 12.2), 0.5 * between(2.0, 2.6), between(2.0, 3.0)
    elif kind in ("wall", "square") and rng.random() < 0.5:
        thickness = between(0.5, 1.5) * THICKNESS_M[material][1] / 2
    deep = attenuation_1_m(material, energy) * thickness
    thickness *= min(1.0, between(0.1 * DEEPEST, DEEPEST) / deep) if deep > DEEPEST else 1.0
    x, y, z = max(x, 2.0 * thickness), max(y, 2.0 * thickness), max(z, 4.0 * thickness)
    if kind == "cube":
        x = y = z = 1.0 + thickness
    elif kind == "square":
        y, z = between(8.0, 15.0), between(8.0, 15.0)
    elif kind == "block":
        x, y, z = (between(0.3, 5.0) * THICKNESS_M[material][1] for _ in range(3))
        if rng.random() < 0.4:  # a post, or a trunk
            x, y, z = between(0.05, 0.6), between(0.05, 0.6), between(1.0, 8.0)
            material = str(rng.choice(["wood", "concrete", "brick", "steel"], p=[0.6, 0.15, 0.15, 0.1]))
    low, high = np.array([-x, -y, -z if kind in ("cube", "square") else 0.0]), np.array([x, y, z])
    if kind == "cube":
        source = np.zeros(3)
    elif kind in ENCLOSED:
        least, most = low + thickness, high - thickness
        margin = np.minimum(between(0.02, 0.25), 0.3 * (most - least))
        source = rng.uniform(least + margin, most - margin)
        if rng.random() < 0.5:
            source[2] = least[2] + min(0.5, 0.4 * (most[2] - least[2]))
    elif kind in ("behind", "block"):
        source = np.array([-x - between(0.01, 40.0), rng.uniform(-y, y), rng.uniform(min(0.3, 0.5 * z), min(2.0, z))])
    else:
        low[0], high[0] = -0.5 * thickness, 0.5 * thickness
        near, far, aside = (0.01, 40.0, y) if kind == "wall" else (0.3, 8.0, 1.0)
        source = np.array([low[0] - between(near, far), rng.uniform(-aside, aside), rng.uniform(0.3, min(2.0, z))])
    block = Block(tuple(low), tuple(high), 0.0 if kind in SOLID else thickness, material)
    pieces = np.array([[low, high]]) if kind in SOLID else shell_of(low, high, thickness)
    return Drawn(kind, material, energy, block, pieces, source, _beyond(rng, kind, source, np.array([low, high])))


def _half_extents(rng: np.random.Generator, between: Callable[[float, float], float]) -> tuple[float, float, float]:
    """Half the length and the width, and the height, of a building or, of one in five, of a crate."""
    if rng.random() < 0.2:
        return between(0.25, 1.0), between(0.25, 1.0), between(0.5, 2.0)
    return between(0.8, 15.0), between(0.8, 15.0), between(2.0, 9.0)


@cache
def attenuation_1_m(material: str, energy_kev: float) -> float:
    """Of the photons that are drawn."""
    return float(linear_attenuation(load_library().material(material), np.array([energy_kev]))[0])


def _beyond(rng: np.random.Generator, kind: str, source: Floats, box: Floats) -> Floats:
    """Detectors [VIEWS, 3] beyond a box [2, 3] that the lines from the source cross."""
    detectors: list[Floats] = []
    while len(detectors) < VIEWS:
        level = rng.random() >= 0.5
        elevation = rng.normal(0.0, 0.15) if level else np.arcsin(rng.uniform(-0.1, 1.0))
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        if kind not in ENCLOSED:
            azimuth, elevation = rng.normal(0.0, 0.8), abs(elevation)
        if kind == "square":
            azimuth, elevation = rng.uniform(-0.2, 0.2, 2)
        way = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        if kind == "block" or (kind not in ENCLOSED and rng.random() < 0.5):  # small ones are not met by chance
            way = rng.uniform(*box) - source
            way /= np.linalg.norm(way)
        ends = np.sort((box - source) / np.where(np.abs(way) < 1e-9, 1e-9, way), axis=0)
        if ends[1].min() > max(ends[0].max(), 0.0):
            distance = float(np.exp(rng.uniform(np.log(0.3), np.log(100.0))))
            detectors.append(source + way * (ends[1].min() + distance))
    return np.array(detectors)


def shell_of(low: Floats, high: Floats, wall_m: float) -> Floats:
    """Corners [6, 2, 3] of the walls, the roof and the floor of a hollow box; they do not overlap."""
    (x0, y0, z0), (x1, y1, z1), t = low, high, wall_m
    return np.array([
        ((x0, y0, z0 + t), (x0 + t, y1, z1 - t)), ((x1 - t, y0, z0 + t), (x1, y1, z1 - t)),
        ((x0 + t, y0, z0 + t), (x1 - t, y0 + t, z1 - t)), ((x0 + t, y1 - t, z0 + t), (x1 - t, y1, z1 - t)),
        ((x0, y0, z1 - t), (x1, y1, z1)), ((x0, y0, z0), (x1, y1, z0 + t)),
    ])  # fmt: skip


def lines_of(case: Drawn) -> Floats:
    """Source, detectors, half extents and the thickness of the wall [VIEWS, 10] in the axes of the box."""
    low, high = (np.array(x) for x in (case.block.low_m, case.block.high_m))
    middle, one = 0.5 * (low + high), np.ones((len(case.detectors_m), 1))
    wall = one * case.block.wall_m
    return np.hstack([one * (case.source_m - middle), case.detectors_m - middle, one * 0.5 * (high - low), wall])


def cases(name: str, seeds: int, photons: int) -> Iterator[tuple[list[Case], Floats, Crossed]]:
    """The views of every kind and run, their `lines_of`, and what lies between; the last seed is not fitted to."""
    library = load_library()
    detector, (grid, counted) = detector_of(library, name), efficiency(library, name)

    @cache
    def tables(material: str, energy: float) -> Medium:
        return medium(library.material(material), energy, lambda e: np.interp(e, grid, counted))

    for seed, (kind, runs) in product(range(1, seeds + 1), RUNS.items()):
        rng = np.random.default_rng(seed)
        for run in range(runs):
            case = drawn(rng, kind)
            number, pieces = ENERGIES_KEV.index(case.energy_kev), np.full((6, 2, 3), 1e3)
            pieces[: len(case.pieces)] = case.pieces
            low, high = (jnp.asarray(pieces[:, k], jnp.float32) for k in (0, 1))
            bodies = Boxes(low, high, jnp.zeros(6, jnp.int32))
            places = [jnp.asarray(x, jnp.float32) for x in (case.energy_kev, case.source_m, case.detectors_m)]
            found = seen(
                jax.random.key(run), (tables(case.material, case.energy_kev),), bodies, *places, photons, COLLISIONS
            )
            way = ways(site_of([case.block], detector.material_names, ground=False), *places[1:])
            direct, scattered, _ = modelled(detector, number, way)
            mc = (np.asarray(x, float) for x in (found.uncollided, found.scattered, found.error))
            yield (
                [
                    Case(kind, case.material, case.energy_kev, case.block.wall_m, seed, run, *row)
                    for row in zip(*mc, np.asarray(direct + scattered, float), strict=True)
                ],
                lines_of(case),
                way,
            )


def told(found: list[Case]) -> str:
    """A table: model over Monte Carlo by kind."""
    rows = ["| | cases | median | 5 to 95 % | within 10 % | within 25 % |", "|---|---|---|---|---|---|"]
    for kind, words in TOLD.items():
        ratio = np.array([c.model / (c.uncollided + c.scattered) for c in known(found) if c.kind == kind])
        if len(ratio):
            low, middle, high = np.quantile(ratio, (0.05, 0.5, 0.95))
            within = [np.mean(np.abs(ratio - 1.0) < part) for part in (0.1, 0.25)]
            cells = f"{len(ratio)} | {middle:.2f} | {low:.2f} to {high:.2f} | {within[0]:.0%} | {within[1]:.0%}"
            rows.append(f"| {words} | {cells} |")
    return "\n".join(rows)


def known(found: list[Case]) -> list[Case]:
    """Those that the Monte Carlo knows and that somebody might count."""
    total = [(c, c.uncollided + c.scattered) for c in found]
    return [c for c, counts in total if counts > FAINT and c.error < KNOWN * counts]


def backwards(lines: Floats, way: Crossed) -> tuple[Floats, Crossed]:
    """`lines_of` cases and what is on them, with source and detector exchanged."""
    return lines[:, [3, 4, 5, 0, 1, 2, 6, 7, 8, 9]], replace(way, place=1.0 - way.place)


def rows_of(found: list[Case], lines: Floats, way: Crossed, detector: Detector) -> Rows:
    """What the network is fitted to, of cases that cross one box with something in it; ``lines`` are their `lines_of`.

    Of those that are not `known` it is how many counts there are at most.
    """
    features, walls, thin_m = features_of(lines)
    number = jnp.array([ENERGIES_KEV.index(c.energy_kev) for c in found])

    def one(number: jax.Array, way: Crossed) -> tuple[jax.Array, jax.Array]:
        """Depth the short way, and what a wide wall with it scatters."""
        assert way.shape is not None
        tables = (detector.attenuation_1_m, detector.scatter_1_m, detector.line_energy_kev)
        square = replace(way, length_m=way.shape.thin_m, shape=None)
        depth, share, energy_kev = (x[number] for x in tables)
        slab = scattered_counts(depth, share, energy_kev, detector.surrounds, square)
        return slab.depth[0], slab.counts[0]

    depth, slab = (np.asarray(x, float) for x in jax.jit(jax.vmap(one))(number, way))
    direct, scattered, error = (np.array([getattr(c, k) for c in found]) for k in ("uncollided", "scattered", "error"))
    total, sure = np.maximum(direct + scattered, 1e-30), {id(c) for c in known(found)}
    is_known = np.array([id(c) in sure for c in found])
    relative = error / total
    slab, direct = (np.maximum(x, 1e-30) for x in (slab, direct))
    most = np.maximum(total * (1.0 + 3.0 * np.minimum(relative, 3.0)), FAINT)
    rows = Rows(
        features=features, depth=depth / walls, growth=np.log(slab / np.maximum(depth, 1e-30)) + depth,
        energy_kev=np.array([c.energy_kev for c in found]), direct=direct, slab=slab,
        counts=np.where(is_known, total, most), error=np.where(is_known, relative, KNOWN), known=is_known.astype(float),
    )  # fmt: skip
    some = thin_m > 1e-6
    return Rows(*(x[some] for x in rows))


@app.default
def main(
    *, seeds: Annotated[int, Parameter(help="Sets of cases; the last is not fitted to.")] = 3,
    photons: Annotated[int, Parameter(help="Photons of each run.")] = 40_000,
    detector: Annotated[str, Parameter(help="Detector, by its name.")] = "nai_2x2",
    steps: Annotated[int, Parameter(help="Steps of the fit.")] = 250_000,
    out: Annotated[Path, Parameter(help="Folder of the results.")] = Path("runs/transport"),
) -> None:  # fmt: skip
    """Compare, fit, and write the table."""
    found: list[Case] = []
    lines, parts = [], []
    for own, ends, way in cases(detector, seeds, photons):
        found += own
        lines.append(ends)
        parts.append(way)
    write_table(out / "walls.csv", found)
    print(told(found))
    last = max(c.seed for c in found)
    print("Those that were not fitted to:\n" + told([c for c in found if c.seed == last]))
    chosen = np.array([i for i, c in enumerate(found) if c.seed < max(last, 2)])
    way = jax.tree.map(lambda *x: jnp.concatenate(x)[chosen], *parts)
    rows = rows_of([found[i] for i in chosen], np.vstack(lines)[chosen], way, detector_of(load_library(), detector))
    into = np.array([i for i in chosen if found[i].kind in ENCLOSED])
    lines, way = backwards(np.vstack(lines)[into], jax.tree.map(lambda *x: jnp.concatenate(x)[into], *parts))
    back = rows_of([found[i] for i in into], lines, way, detector_of(load_library(), detector))
    rows = Rows(*map(np.concatenate, zip(rows, back._replace(error=back.error + ALIKE), strict=True)))
    (out / "network.csv").write_text(table_of(fitted(rows, lines, steps)), encoding="utf-8")


if __name__ == "__main__":
    app()
