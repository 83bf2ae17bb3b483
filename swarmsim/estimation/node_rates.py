"""Rates of one source at the nodes of windows: window by window, or with a thread of an accelerator for each node."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation.nodes import Nodes, inverse_square_gain
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.roi_lines import Lines, RoiRates, line_shapes, packed_lines, roi_rates_and_slopes
from swarmsim.scalars import over_vehicles
from swarmsim.site.rays import Crossed, stretched

LARGEST = 256  # elements of what a thread takes apart: a line's tables of scattered counts


def at_nodes(
    crossed: Crossed,
    nodes: Nodes,
    detector: Detector,
    lines: Lines,
    source: Source,
    factors: jax.Array,
    *,
    by: tuple[int, ...],
    places: int,
) -> RoiRates:
    """What comes of the parts of the ways that ``nodes`` stand for, or of ``places`` neighbours together."""
    weight, way = inverse_square_gain(nodes.position_m - source.position_m, nodes), stretched(crossed, factors)
    return roi_rates_and_slopes(detector, source, way, nodes.position_m, nodes.axis, by, weight, places, lines)


def at_nodes_by_threads(
    crossed: Crossed,
    nodes: Nodes,
    which: np.ndarray,
    detectors: Sequence[Detector],
    count: jax.Array,
    source: Source,
    factors: jax.Array,
    *,
    by: tuple[int, ...],
    platform: str | None = None,
) -> RoiRates:
    """`at_nodes` of each by itself, with a thread for each, which goes through the lines.

    Their derivatives take the spectrum of the scattered photons to be the one on their own way. ``which`` [n] are
    the numbers of the detectors, which are `alike`, ``count`` [] the lines that are gone through. ``platform`` is that
    of `swarmsim.scalars.over_vehicles`.
    """
    # without what belongs to other nuclides and other things than rates
    bare = jax.tree.map(lambda _: np.zeros(1, np.float32), detectors[0])
    shapes, packed = line_shapes(detectors[0]), jnp.stack([packed_lines(detector) for detector in detectors])
    needed = tuple(
        jnp.stack([jnp.asarray(x) for x in of])
        for of in zip(*((d.radius_m, d.length_m, d.near, d.surrounds) for d in detectors), strict=True)
    )

    def one(
        own: tuple[Crossed, Nodes], which: jax.Array, needed: Any, packed: jax.Array, count: jax.Array,
        source: Source, factors: jax.Array,
    ) -> RoiRates:  # fmt: skip
        radius, length, near, surrounds = (x[which] for x in needed)
        crystal = replace(bare, radius_m=radius, length_m=length, near=near, surrounds=surrounds)
        of = Lines(packed=packed[which][source.nuclide], count=count, shapes=shapes)
        crossed, nodes = jax.tree.map(lambda x: x[None], own)
        found = at_nodes(crossed, nodes, crystal, of, source, factors, by=by, places=1)
        return jax.tree.map(lambda x: x[0], found)

    found: RoiRates = over_vehicles(one, (0, 0, *[None] * 5), small=LARGEST, beside=True, platform=platform)(
        (crossed, nodes), jnp.asarray(which, jnp.int32), needed, packed, count, source, factors
    )
    return found


def alike(detectors: Sequence[Detector]) -> bool:
    """Whether `at_nodes_by_threads` can take these together: of one kind, with as many lines and regions."""
    return len({(d.kind, line_shapes(d), np.shape(d.yields), np.shape(d.near)) for d in detectors}) == 1


def sums_of_rays(found: RoiRates, rays: int) -> RoiRates:
    """Rates of the ways, from those of the parts that each of their ``rays`` nodes stands for."""
    rates, slopes = (
        jnp.sum(x.reshape(x.shape[0] // rays, rays, *x.shape[1:]), axis=1) for x in (found.rates, found.slopes)
    )
    return found._replace(rates=rates, slopes=slopes)
