"""Photons that a box scatters, over those of an infinitely wide wall that the line crosses squarely.

A network with two hidden layers makes of the features of a line and a box (`swarmsim.site.surfaces`) the coefficients
of

    ln P = a + b ln(E / 662 keV) + c (g - 1)

at each of `DEPTHS` of a wall in mean free paths, for photons with the energy E and the growth g that the wall's
material and its place have (`swarmsim.radiation.walls`). Its units are f(x) = (x + sqrt(x^2 + 1)) / 2 (squareplus:
Barron, arXiv 2112.11687). Beyond the range of what it was fitted to, features stay at the end of that.

The weights (``configs/elements/walls.csv``) are fitted to the Monte Carlo of buildings and walls drawn at random, by
``experiments/transport/walls.py``.
"""

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.files import packaged_dir
from swarmsim.scalars.graph import varying_axes
from swarmsim.site import network_kernel
from swarmsim.site.surfaces import FEATURES, Box, Surroundings, surroundings

DEPTHS = (0.25, 0.75, 2.25, 6.75, 20.25)
"""Depths of a wall in mean free paths, each three times the one before."""
COEFFICIENTS = 3
"""At each depth: of 1, ln(E / 662 keV) and g - 1."""
OUTPUTS = len(DEPTHS) * COEFFICIENTS

Array = jax.Array | NDArray[np.float32]


class Network(NamedTuple):
    """The table, as `table_of` writes it."""

    low: Array  # [FEATURES] range
    high: Array
    middle: Array  # [FEATURES]; features are taken less this, over the scale
    scale: Array
    lines: Array  # [4] range of ln(E / 662 keV), of g
    weights: tuple[Array, ...]  # of each layer [units, inputs]
    biases: tuple[Array, ...]  # [units]


@lru_cache(maxsize=1)
def network() -> Network:
    """The project's (host)."""
    return network_of((packaged_dir() / "elements" / "walls.csv").read_text(encoding="utf-8"))


def network_of(table: str) -> Network:
    """That of a table; raises `ValueError` where its parts do not go together."""
    rows: dict[str, list[list[float]]] = {}
    for line in table.splitlines():
        name, _, values = line.partition(",")
        if values and not line.startswith("#"):
            rows.setdefault(name, []).append([float(x) for x in values.split(",")])
    parts = {name: np.array(of, np.float32) for name, of in rows.items()}
    layers = sum(name.startswith("weights") for name in parts)
    weights = tuple(parts[f"weights{k}"] for k in range(layers))
    biases = tuple(parts[f"biases{k}"][0] for k in range(layers))
    ends = [len(FEATURES), *(len(b) for b in biases)]
    found = [w.shape for w in weights]
    if found != list(zip(ends[1:], ends[:-1], strict=True)) or ends[-1] != OUTPUTS:
        raise ValueError(f"weights of shapes {found} do not lead from {len(FEATURES)} features to {OUTPUTS} outputs")
    low, high, middle, scale, lines = (parts[name][0] for name in Network._fields[:5])
    return Network(low, high, middle, scale, lines, weights, biases)


def table_of(net: Network) -> str:
    """The network as a table: a row for each range, each layer's biases, and each of its units' weights."""
    rows = [(name, [getattr(net, name)]) for name in Network._fields[:5]]
    for k, (weights, biases) in enumerate(zip(net.weights, net.biases, strict=True)):
        rows += [(f"biases{k}", [biases]), (f"weights{k}", list(weights))]
    return "".join(f"{name},{','.join(f'{x:.5g}' for x in row)}\n" for name, of in rows for row in of)


def scattered(box: Box, net: Network | None = None) -> tuple[jax.Array, Surroundings]:
    """Coefficients [OUTPUTS, n] of ln P of each line and the box that it meets, and what they are made of.

    They are 0, those of a slab, where an end of the line lies in the middle of the matter.
    """
    around = surroundings(box)
    return outputs(jnp.stack(around.features), net) * around.among, around


def outputs(features: jax.Array, net: Network | None = None) -> jax.Array:
    """[OUTPUTS, n] of features [FEATURES, n]."""
    fixed, net = net is None, net or network()
    low, high, middle, scale = (jnp.asarray(x)[:, None] for x in net[:4])
    x = (jnp.clip(features, low, high) - middle) / scale
    if fixed and jax.default_backend() == "gpu" and network_kernel.suits(x) and not varying_axes(x):
        return network_kernel.evaluated(x, net.weights, net.biases)
    for number, (weights, biases) in enumerate(zip(net.weights, net.biases, strict=True)):
        if number:
            x = network_kernel.squareplus(x)
        x = jnp.matmul(jnp.asarray(weights), x, precision=jax.lax.Precision.HIGHEST) + jnp.asarray(biases)[:, None]
    return x
