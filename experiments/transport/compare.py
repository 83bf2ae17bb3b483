"""Counts of a detector behind slabs: the model that missions use against the Monte Carlo.

    python -m experiments.transport.compare [--photons N] [--out FOLDER]

writes ``slabs.csv`` and ``slabs.png``. On two cores give fewer photons.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from cyclopts import App, Parameter

from experiments.transport.walk import Floats, medium, slab
from swarmsim.config.load import load_named
from swarmsim.config.radiation import Detector as DetectorSpec
from swarmsim.config.radiation import DetectorMount, Line, Nuclide
from swarmsim.pytree import on_device
from swarmsim.radiation import Detector, Library, build_detector, load_library
from swarmsim.radiation.attenuation import linear_attenuation
from swarmsim.radiation.rate import transmission
from swarmsim.radiation.response import build_response
from swarmsim.site import Crossed

mpl.use("Agg")
from matplotlib import pyplot as plt

SLABS_M = (
    ("concrete", 0.05), ("concrete", 0.10), ("concrete", 0.20), ("concrete", 0.36), ("steel", 0.002), ("steel", 0.006),
    ("steel", 0.020), ("lead", 0.01), ("lead", 0.05), ("brick", 0.24), ("wood", 0.05), ("glass", 0.006),
)  # fmt: skip
ENERGIES_KEV = (60.0, 122.0, 356.0, 662.0, 1173.0, 1332.0)
PLACES = (0.15, 0.5, 0.85)
WAY_M = 8.0
FAINT = 1e-4  # transmissions below this are neither measured nor modelled well, and nobody counts them

app = App(name="compare", help=__doc__, help_format="plaintext")


@dataclass(frozen=True)
class Case:
    """One slab, energy and place: counts over those of the bare source."""

    material: str
    thickness_m: float
    energy_kev: float
    place: float
    uncollided: float
    monte_carlo: float
    error: float
    model: float
    model_uncollided: float


def detector_of(library: Library, name: str) -> Detector:
    """The detector with one nuclide for each energy."""
    nuclides = tuple(
        Nuclide(
            name=f"line-{e:g}", half_life_s=1.0, lines=(Line(energy_kev=e, yield_percent=100.0),), source="one line"
        )
        for e in ENERGIES_KEV
    )
    spec: DetectorSpec = load_named("detectors", name)
    mount = DetectorMount(model=name, position_m=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    return build_detector(spec, mount, Library(nuclides, library.materials), "physical")


def efficiency(library: Library, name: str) -> tuple[Floats, Floats]:
    """Energies and counts per photon of a detector, for photons that come from around."""
    spec: DetectorSpec = load_named("detectors", name)
    assert spec.crystal is not None
    response = build_response(spec, library.material(spec.crystal), library.material(spec.housing.material))
    energy = np.geomspace(30.5, 3000.0, 120)
    chord = spec.diameter_mm * spec.length_mm / (spec.diameter_mm + 2 * spec.length_mm) * 2e-3
    seen = -np.expm1(-response.attenuation_1_m(energy) * chord)
    return energy, seen * response.counts(energy) * response.housing_transmission(energy)


def cases(name: str, photons: int) -> list[Case]:
    """Every slab, energy and place."""
    library = load_library()
    detector, (grid, counted) = detector_of(library, name), efficiency(library, name)

    def response(energy: Floats) -> Floats:
        return np.interp(energy, grid, counted)

    found = []
    for material_name, thickness in SLABS_M:
        material = library.material(material_name)
        for number, energy in enumerate(ENERGIES_KEV):
            tables = medium(material, energy, response)
            uncollided = float(np.exp(-linear_attenuation(material, energy) * thickness))
            for place in PLACES:
                gaps = (place * WAY_M - 0.5 * thickness, (1.0 - place) * WAY_M - 0.5 * thickness)
                tally = slab(
                    jax.random.key(7), tables, jnp.float32(energy), jnp.float32(thickness),
                    *(jnp.float32(g) for g in gaps), photons,
                )  # fmt: skip
                direct, scattered = modelled(detector, number, {material_name: (thickness, place)})
                found.append(
                    Case(material_name, thickness, energy, place, uncollided, uncollided + float(tally.total),
                         float(tally.error), direct + scattered, direct)
                )  # fmt: skip
    return found


def modelled(detector: Detector, number: int, crossed: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Unscattered and scattered counts of the line ``number`` over those of the bare source.

    ``crossed`` has the length in m and the place along the way, from 0 to 1, of each material.
    """
    materials = len(detector.material_names)
    length, place = np.zeros(materials), np.full(materials, 0.5)
    for name, (metres, share) in crossed.items():
        index = detector.material_names.index(name)
        length[index], place[index] = metres, share
    way = Crossed(length_m=on_device(length), place=on_device(place))
    direct, scattered = transmission(detector, jnp.int32(number), way)
    return float(direct[0]), float(scattered[0])


def draw(found: list[Case], file: Path) -> None:
    """Model over Monte Carlo against the transmission."""
    figure, axis = plt.subplots(figsize=(7, 4.2), layout="constrained")
    seen = [c for c in found if c.monte_carlo > FAINT]
    for name in dict.fromkeys(c.material for c in seen):
        own = [c for c in seen if c.material == name]
        error = [c.error / c.monte_carlo for c in own]
        axis.errorbar(
            [c.monte_carlo for c in own], [c.model / c.monte_carlo for c in own], error, fmt="o", ms=4, label=name
        )
    axis.axhspan(0.9, 1.1, color="0.9", zorder=0)
    axis.axhline(1.0, color="0.5", lw=0.8)
    axis.set(xscale="log", xlabel="counts behind the slab over counts of the bare source", ylabel="model / Monte Carlo")
    axis.legend(frameon=False, ncols=2)
    figure.savefig(file, dpi=160)


@app.default
def main(
    *, photons: Annotated[int, Parameter(help="Photons of each run.")] = 1_000_000,
    detector: Annotated[str, Parameter(help="Detector, by its name.")] = "nai_2x2",
    out: Annotated[Path, Parameter(help="Folder of the results.")] = Path("runs/transport"),
) -> None:  # fmt: skip
    """Compare, and write table and figure."""
    found = cases(detector, photons)
    out.mkdir(parents=True, exist_ok=True)
    names = list(Case.__dataclass_fields__)
    rows = [",".join(f"{v:.4g}" if isinstance(v, float) else v for v in (getattr(c, n) for n in names)) for c in found]
    (out / "slabs.csv").write_text("\n".join([",".join(names), *rows]) + "\n", encoding="utf-8")
    draw(found, out / "slabs.png")
    seen = [c for c in found if c.monte_carlo > FAINT]
    ratio = np.array([c.model / c.monte_carlo for c in seen])
    print(f"{len(seen)} cases: median {np.median(ratio):.3f}, {np.mean(np.abs(ratio - 1) < 0.1):.1%} within 10 %")
    for c in sorted(seen, key=lambda c: -abs(c.model / c.monte_carlo - 1))[:12]:
        print(f"  {c.material} {c.thickness_m:g} m, {c.energy_kev:g} keV at {c.place:g}: {c.monte_carlo:.4g} "
              f"+- {c.error:.2g}, model {c.model:.4g} ({c.model / c.monte_carlo - 1:+.1%})")  # fmt: skip


if __name__ == "__main__":
    app()
