"""Makes the tables of scattered photons, ``configs/elements/scattering.csv``, by Monte Carlo.

    python -m experiments.transport.generate [FILE]

takes about ten minutes on one GPU of a data centre and four hours on two cores.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.transport.walk import infinite, medium, slab
from swarmsim.config.files import packaged_dir
from swarmsim.config.radiation import Material
from swarmsim.radiation.attenuation import linear_attenuation
from swarmsim.radiation.library import load_library
from swarmsim.radiation.scattering import absorption

ENERGIES_KEV = (35.0, 45.0, 60.0, 80.0, 95.0, 120.0, 160.0, 220.0, 350.0, 500.0, 662.0, 1000.0, 1500.0, 2600.0)
DEPTHS = (0.05, 0.2, 0.5, 1.0, 2.0, 4.0, 7.0, 11.0, 15.0)  # mean free paths
POSITIONS = (0.1, 0.5, 0.9)  # of the slab's middle, as a share of the way from the source to the detector
WAY_M = 10.0
PHOTONS = 3_000_000
TIN = Material(name="tin", density_kg_m3=7310, composition={"Sn": 1.0}, source="NIST density")


def slabs(material: Material) -> list[list[float]]:
    """Rows of one material: energy, depth, position, scattered photons in each bin."""
    rows = []
    for energy in ENERGIES_KEV:
        tables, mu = medium(material, energy), float(linear_attenuation(material, energy))
        for depth in DEPTHS:
            thickness = depth / mu
            for number, position in enumerate(POSITIONS):
                gaps = (position * WAY_M, (1.0 - position) * WAY_M)
                found = slab(
                    jax.random.key(number), tables, jnp.float32(energy), jnp.float32(thickness),
                    *(jnp.float32(max(gap - 0.5 * thickness, 0.05)) for gap in gaps), PHOTONS,
                )  # fmt: skip
                rows.append((energy, depth, position, found.spectrum))
    return [[e, d, p, *np.asarray(s, float)] for e, d, p, s in rows]


def surroundings(material: Material) -> list[list[float]]:
    """The same in an infinite medium, over the photons of the bare source; there is no position, it is given as 0."""
    rows = []
    depths = np.array(DEPTHS)
    edges = np.stack([0.95 * depths, 1.05 * depths], axis=1).ravel()
    for energy in ENERGIES_KEV:
        tables, mu = medium(material, energy), float(linear_attenuation(material, energy))
        _, spectrum = infinite(
            jax.random.key(0), tables, jnp.float32(energy), jnp.asarray(edges / mu, jnp.float32), PHOTONS
        )
        bare = np.asarray(spectrum, float)[::2] * np.exp(-depths)[:, None]
        rows += [[energy, depth, 0.0, *row] for depth, row in zip(depths, bare, strict=True)]
    return rows


def main(file: Path) -> None:
    """Write the table."""
    library = load_library()
    lines = [
        "# Scattered photons above 30 keV over the photons of the bare source at the same distance, in 8 bins of equal",
        "# width in ln(energy) from 30 keV to the energy of the source; behind a slab of so many mean free paths,",
        "# its middle at ``position`` of 10 m on the way; air: in an infinite medium. ``absorption`` is the",
        "# photoelectric over the incoherent cross section at 100 keV. By experiments/transport/generate.py.",
        "material,absorption,energy_kev,depth_mfp,position," + ",".join(f"s{k}" for k in range(8)),
    ]
    for name in ("air", "water", "concrete", "steel", "tin", "lead"):
        material = TIN if name == "tin" else library.material(name)
        for row in (surroundings if name == "air" else slabs)(material):
            lines.append(f"{name},{absorption(material):.4g}," + ",".join(f"{x:.3g}" for x in row))
        print(name, flush=True)
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else packaged_dir() / "elements" / "scattering.csv")
