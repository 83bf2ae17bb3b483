"""Makes the table of photons that the ground scatters, ``configs/elements/ground.csv``, by Monte Carlo.

    python -m experiments.transport.ground [FILE] [--photons N]

takes some minutes on one core. A point source above an even half space of soil, point detectors above it too. The free
path in soil is a decimetre, short against the heights, so that the result depends on the ratios of the heights and the
distance alone.
"""

from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from cyclopts import App, Parameter

from experiments.transport.generate import ENERGIES_KEV
from experiments.transport.walk import Floats, Medium, at, collide, isotropic, medium, next_events
from swarmsim.config.files import packaged_dir
from swarmsim.radiation.elements import CUT_KEV
from swarmsim.radiation.library import load_library
from swarmsim.radiation.scattering import BINS

SOURCE_M = 1.0  # above the ground
HEIGHTS_M = (0.5, 1.0, 3.0, 10.0, 30.0)  # of the detectors
APART_M = (0.5, 2.0, 6.0, 20.0, 60.0)  # level distances
COLLISIONS = 25
TOGETHER = 50_000  # photons that are followed at a time
MATERIAL = "soil"

app = App(name="ground", help=__doc__, help_format="plaintext")


@partial(jax.jit, static_argnames=("photons", "collisions"))
def half_space(
    key: jax.Array,
    m: Medium,
    energy_kev: jax.Array,
    source_m: jax.Array,
    detectors_m: jax.Array,
    photons: int,
    collisions: int = COLLISIONS,
) -> tuple[jax.Array, jax.Array]:
    """Photons from the ground z < 0 over those of the bare source [d, BINS], and the standard error [d] of their sum.

    Source at ``source_m`` [] above the origin, detectors at ``detectors_m`` [d, 3].
    """
    n = photons
    first_key, walk_key = jax.random.split(key)
    down = isotropic(first_key, n)
    down = down.at[:, 2].set(-jnp.maximum(jnp.abs(down[:, 2]), 1e-4))
    place = (down * (source_m / -down[:, 2:])).at[:, 2].set(0.0)
    source = jnp.array([0.0, 0.0, 1.0]) * source_m
    bare = 1.0 / (4.0 * jnp.pi * jnp.sum((detectors_m - source) ** 2, axis=1))

    def body(i: int, s: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        place, direction, energy, weight, spectrum, each = s
        flight, interaction = jax.random.split(jax.random.fold_in(walk_key, i))
        mu, rise = at(m, m.attenuation_1_m, energy), direction[:, 2]
        length = jnp.where(rise > 0.0, -place[:, 2] / jnp.maximum(rise, 1e-9), 1e6)
        inside = -jnp.expm1(-mu * length)
        flown = -jnp.log1p(-jax.random.uniform(flight, (n,)) * inside) / mu
        weight, place = weight * inside, place + direction * flown[:, None]
        place = place.at[:, 2].min(-1e-6)

        def seen(target: jax.Array) -> tuple[jax.Array, jax.Array]:
            gap = target - place
            far = jnp.linalg.norm(gap, axis=1)
            toward = gap / far[:, None]
            left = -place[:, 2] / toward[:, 2]
            bins, total = jnp.zeros(BINS), jnp.zeros(n)
            for after, density in next_events(m, energy, direction, toward):
                kept = jnp.maximum(after, CUT_KEV)
                through = jnp.exp(-at(m, m.attenuation_1_m, kept) * left) * at(m, m.response, kept)
                score = weight * density * through * (after > CUT_KEV) / far**2
                number = jnp.floor(BINS * jnp.log(kept / CUT_KEV) / jnp.log(energy_kev / CUT_KEV))
                number = jnp.clip(number, 0, BINS - 1)
                bins = bins + jnp.sum(score[:, None] * (number[:, None] == jnp.arange(BINS)), axis=0)
                total = total + score
            return bins, total

        bins, total = jax.lax.map(seen, detectors_m)
        energy, weight, direction = collide(interaction, m, energy, weight, direction)
        return place, direction, energy, weight, spectrum + bins, each + total

    d = detectors_m.shape[0]
    start = (place, down, jnp.full(n, energy_kev), jnp.full(n, 0.5), jnp.zeros((d, BINS)), jnp.zeros((d, n)))
    *_, spectrum, each = jax.lax.fori_loop(0, collisions, body, start)
    return spectrum / n / bare[:, None], jnp.std(each, axis=1) / jnp.sqrt(n) / bare


def views() -> Floats:
    """Places [d, 3] of the detectors."""
    return np.array([(apart, 0.0, height) for height, apart in product(HEIGHTS_M, APART_M)])


@app.default
def main(
    file: Annotated[Path | None, Parameter(help="Where to; the packaged table by default.")] = None, *,
    photons: Annotated[int, Parameter(help="Photons of each energy.")] = 400_000,
) -> None:  # fmt: skip
    """Write the table."""
    material, places = load_library().material(MATERIAL), views()
    lines = [
        "# Photons above 30 keV that an even ground of soil scatters to a detector, over those of the bare source,",
        f"# in {BINS} bins of equal width in ln(energy) from 30 keV to the energy of the source, which lies",
        f"# {SOURCE_M:g} m above the ground; the detector's height above it and level distance from the source.",
        "# By experiments/transport/ground.py.",
        "energy_kev,height_m,apart_m," + ",".join(f"s{k}" for k in range(BINS)),
    ]
    for energy in ENERGIES_KEV:
        f32 = partial(jnp.asarray, dtype=jnp.float32)
        tables, runs = medium(material, energy), -(-photons // TOGETHER)
        parts = [
            half_space(jax.random.key(k), tables, f32(energy), f32(SOURCE_M), f32(places), TOGETHER)
            for k in range(runs)
        ]
        found = np.mean([np.asarray(part, float) for part, _ in parts], axis=0)
        error = np.sqrt(np.mean([np.square(np.asarray(e, float)) for _, e in parts], axis=0) / runs)
        for place, row in zip(places, found, strict=True):
            lines.append(f"{energy:g},{place[2]:g},{place[0]:g}," + ",".join(f"{x:.3g}" for x in row))
        print(f"{energy:g} keV, known to {np.max(error / found.sum(axis=1)):.1%} at worst", flush=True)
    file = file or packaged_dir() / "elements" / "ground.csv"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    app()
