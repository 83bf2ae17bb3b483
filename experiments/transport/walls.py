"""Counts from sources in and behind walls that are drawn at random: the model against the Monte Carlo.

    python -m experiments.transport.walls [--seeds 3] [--photons N] [--out FOLDER]

writes ``walls.csv``, prints how far the model is from the Monte Carlo, and the constants that fit best, as the rows of
``configs/elements/walls.csv``. Thirty minutes on one core.
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
from scipy.optimize import least_squares

from experiments.transport.bodies import Boxes, seen
from experiments.transport.compare import ENERGIES_KEV, FAINT, detector_of, efficiency
from experiments.transport.sites import Block, modelled, site_of, ways
from experiments.transport.tables import write_table
from experiments.transport.walk import Floats, Medium, medium
from swarmsim.radiation import Detector, load_library
from swarmsim.radiation.walls import scattered_counts
from swarmsim.site import Crossed
from swarmsim.site.surfaces import Box, Constants, constants, scattered_share

ENERGIES = (60.0, 122.0, 356.0, 662.0, 1332.0), (0.1, 0.2, 0.2, 0.25, 0.25)  # and how often they are drawn
MATERIALS = ("concrete", "brick", "steel", "lead"), (0.4, 0.25, 0.25, 0.1)
THICKNESS_M = {"concrete": (0.04, 0.3), "brick": (0.08, 0.36), "steel": (0.001, 0.02), "lead": (0.001, 0.02)}
RUNS = {"inside": 30, "container": 8, "cube": 4, "wall": 24, "square": 3, "behind": 14, "block": 12}  # of each seed
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
POSITIVE = (
    "width",
    "softer",
    "forward",
    "back",
    "between_slant",
    "between_steep",
    "lost",
    "lost_slant",
)  # constants of which the logarithms are fitted
MOST_STEPS = 40
FLAT = 0.07  # deviation of a logarithm above which a case counts less
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

    material = str(rng.choice(MATERIALS[0], p=MATERIALS[1]))
    thickness = between(*THICKNESS_M[material])
    energy = float(rng.choice(ENERGIES[0], p=ENERGIES[1]))
    if energy < 100.0 and material in ("concrete", "brick"):
        thickness = min(thickness, 0.12)
    x, y, z = between(1.0, 7.0), between(1.0, 7.0), between(2.2, 8.0)
    if kind == "container":
        material, thickness = "steel", between(0.001, 0.006)
        x, y, z = 0.5 * between(2.0, 12.2), 0.5 * between(2.0, 2.6), between(2.0, 3.0)
    elif kind == "cube":
        x = y = z = 1.0 + thickness
    elif kind == "square":
        y, z = between(8.0, 15.0), between(8.0, 15.0)
    elif kind == "block":
        x, y, z = (between(0.5, 4.0) * THICKNESS_M[material][1] for _ in range(3))
    low, high = np.array([-x, -y, -z if kind in ("cube", "square") else 0.0]), np.array([x, y, z])
    if kind == "cube":
        source = np.zeros(3)
    elif kind in ENCLOSED:
        least, most = low + thickness, high - thickness
        margin = np.minimum(0.25, 0.3 * (most - least))
        source = rng.uniform(least + margin, most - margin)
        if rng.random() < 0.5:
            source[2] = least[2] + min(0.5, 0.4 * (most[2] - least[2]))
    elif kind in ("behind", "block"):
        source = np.array([-x - between(0.3, 8.0), rng.uniform(-y, y), rng.uniform(min(0.3, 0.5 * z), min(2.0, z))])
    else:
        if rng.random() < 0.5:
            thickness = between(0.5, 1.5) * THICKNESS_M[material][1] / 2
        low[0], high[0] = -0.5 * thickness, 0.5 * thickness
        near, aside = (0.2, y) if kind == "wall" else (0.3, 1.0)
        source = np.array([low[0] - between(near, 8.0), rng.uniform(-aside, aside), rng.uniform(0.3, min(2.0, z))])
    block = Block(tuple(low), tuple(high), 0.0 if kind in SOLID else thickness, material)
    pieces = np.array([[low, high]]) if kind in SOLID else shell_of(low, high, thickness)
    return Drawn(kind, material, energy, block, pieces, source, _beyond(rng, kind, source, np.array([low, high])))


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
        if kind == "block":  # too small to be met by chance
            way = rng.uniform(*box) - source
            way /= np.linalg.norm(way)
        ends = np.sort((box - source) / np.where(np.abs(way) < 1e-9, 1e-9, way), axis=0)
        if ends[1].min() > max(ends[0].max(), 0.0):
            distance = float(np.exp(rng.uniform(np.log(1.0), np.log(30.0))))
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
            bodies = Boxes(*(jnp.asarray(pieces[:, k], jnp.float32) for k in (0, 1)), jnp.zeros(6, jnp.int32))
            places = [jnp.asarray(x, jnp.float32) for x in (case.energy_kev, case.source_m, case.detectors_m)]
            found = seen(
                jax.random.key(run), (tables(case.material, case.energy_kev),), bodies, *places, photons, COLLISIONS
            )
            way = ways(site_of([case.block], detector.material_names, ground=False), *places[1:])
            direct, scattered, _ = modelled(detector, number, way)
            mc = (np.asarray(x, float) for x in (found.uncollided, found.scattered, found.error))
            yield (
                [
                    Case(kind, case.material, case.energy_kev, case.block.wall_m, seed, run, *row[:3], float(row[3]))
                    for row in zip(*mc, direct + scattered, strict=True)
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


def deviations(found: list[Case], lines: Floats, way: Crossed, detector: Detector) -> Callable[[Constants], jax.Array]:
    """Logarithm of model over Monte Carlo [n] of the `known` cases, for any constants.

    ``lines`` are the `lines_of` the cases; every case crosses one box.
    """
    chosen = set(map(id, known(found)))
    rows = np.array([i for i, c in enumerate(found) if id(c) in chosen])
    number = jnp.array([ENERGIES_KEV.index(found[i].energy_kev) for i in rows])
    some, places = jax.tree.map(lambda x: x[rows], way), list(jnp.asarray(lines[rows].T, jnp.float32))
    box = Box(places[:3], places[3:6], places[6:9], places[9])
    direct, scattered = (
        jnp.array([getattr(found[i], name) for i in rows], jnp.float32) for name in ("uncollided", "scattered")
    )

    def apart(k: Constants) -> jax.Array:
        assert some.shape is not None
        seen = replace(some, shape=replace(some.shape, share=jnp.stack(scattered_share(box, k).share, axis=-1)))

        def one(number: jax.Array, way: Crossed) -> jax.Array:
            tables = (detector.attenuation_1_m, detector.scatter_1_m, detector.line_energy_kev)
            return scattered_counts(*(x[number] for x in tables), detector.surrounds, way, k).counts[0]

        return jnp.log((direct + jax.vmap(one)(number, seen)) / (direct + scattered))

    return apart


def fitted(apart: Callable[[Constants], jax.Array], start: Constants) -> Constants:
    """The constants with the smallest `deviations`: robust least squares, of the logarithms of `POSITIVE` ones."""
    log = [name in POSITIVE for name in Constants._fields]

    def of(values: Floats | jax.Array) -> Constants:
        return Constants(*(jnp.exp(x) if is_log else x for x, is_log in zip(values, log, strict=True)))

    value = jax.jit(lambda x: apart(of(x)))
    slope = jax.jit(jax.jacfwd(lambda x: apart(of(x))))
    best = least_squares(
        lambda x: np.asarray(value(jnp.asarray(x, jnp.float32)), float),
        [np.log(x) if is_log else x for x, is_log in zip(start, log, strict=True)],
        jac=lambda x: np.asarray(slope(jnp.asarray(x, jnp.float32)), float),
        loss="cauchy",
        x_scale="jac",
        f_scale=FLAT,
        max_nfev=MOST_STEPS,
    )
    return Constants(*map(float, of(best.x)))


@app.default
def main(
    *, seeds: Annotated[int, Parameter(help="Sets of cases; the last is not fitted to.")] = 3,
    photons: Annotated[int, Parameter(help="Photons of each run.")] = 40_000,
    detector: Annotated[str, Parameter(help="Detector, by its name.")] = "nai_2x2",
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
    rows = np.array([i for i, c in enumerate(found) if c.seed < max(last, 2)])
    way = jax.tree.map(lambda *x: jnp.concatenate(x)[rows], *parts)
    own = deviations([found[i] for i in rows], np.vstack(lines)[rows], way, detector_of(load_library(), detector))
    best = fitted(own, constants())
    print("Constants:\n" + "\n".join(f"{name},{value:.4g}" for name, value in best._asdict().items()))


if __name__ == "__main__":
    app()
