"""The network of `swarmsim.site.wall_network`, fitted to the Monte Carlo of walls."""

from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.transport.walk import Floats
from swarmsim.radiation.walls import REFERENCE_KEV, log_share
from swarmsim.site.surfaces import FEATURES, Box, surroundings
from swarmsim.site.wall_network import COEFFICIENTS, OUTPUTS, Network, outputs

UNITS = (40, 40)  # of the hidden layers
BATCH = 2048
AT_ONCE = 1000  # steps
RATE = 4e-3  # of the first step; it falls to nothing like a cosine
FLAT = 2.0  # standard deviations from which on a case counts less
KNOWN = 0.03  # relative error that a case counts with, beside that of the Monte Carlo
OUTLIERS = 5e-4  # part of the cases beyond either end of a feature's range
HELD = 0.003  # of the squared change from the one but last depth to the last
WIDE = 0.06  # cases of infinite walls, over all others
WIDE_ERROR = 0.01
EDGES = 0.2  # of those
WITHIN = 20  # one in so many lines leads out of a wall as well
WITHIN_ERROR = 0.4
EDGE_ERROR = 0.04
DEEP = 0.15  # cases with deeper matter, over all others
DEEPER = (1.5, 6.0)  # so many times
DEEPEST = 40.0  # mean free paths
UNBOUNDED = 1e3  # walls in turn, of which no table says that too much passes
NOTHING = 1e-7  # counts, whose logarithm is a number


class Rows(NamedTuple):
    """Cases [n]: counts over those of the bare source."""

    features: Floats  # [n, FEATURES]
    depth: Floats  # of a wall
    growth: Floats
    energy_kev: Floats
    direct: Floats  # what arrives unscattered
    slab: Floats  # what a wide wall scatters that is crossed squarely
    counts: Floats  # of the Monte Carlo
    error: Floats  # relative
    known: Floats  # 1; 0 where counts are so faint that they are known to be below ``counts`` alone


def features_of(lines: Floats) -> tuple[Floats, Floats, Floats]:
    """Features [n, FEATURES], walls in turn and metres the short way [n] of `experiments.transport.walls.lines_of`."""
    columns = list(jnp.asarray(lines.T, jnp.float32))
    found = jax.jit(surroundings)(Box(columns[:3], columns[3:6], columns[6:9], columns[9]))
    features, walls, thin_m = np.stack(found.features, axis=1), found.walls, found.thin_m
    return features.astype(float), np.asarray(walls, float), np.asarray(thin_m, float)


def wide(rng: np.random.Generator, rows: Rows, n: int) -> Rows:
    """``n`` walls of 200 m to 5 km that are crossed squarely, with the lines of others.

    They are slabs, or half a slab where the line crosses the edge: two of those make a slab, and photons go from the
    one to the other a few free paths at most.
    """
    between = ((0.001, 0.4), (200.0, 5e3), (0.3, 30.0), (0.3, 30.0))
    thickness, side, *ways = (np.exp(rng.uniform(*np.log(ends), n)) for ends in between)
    aside, edge = rng.uniform(-0.3, 0.3, (n, 2)) * side[:, None], rng.random(n) < EDGES
    aside[edge, 0] = side[edge] - 0.01 * rng.random(edge.sum()) * np.minimum(*ways)[edge]
    half, none = np.stack([0.5 * thickness, side, side], axis=1), np.zeros((n, 1))
    start, end = (np.hstack([(x * (half[:, 0] + way))[:, None], aside]) for x, way in zip((-1, 1), ways, strict=True))
    turned = np.argsort(rng.random((n, 3)), axis=1)
    start, end, half = (np.take_along_axis(x, turned, axis=1) for x in (start, end, half))
    features, _, _ = features_of(np.hstack([start, end, half, none]))
    like = rng.integers(0, len(rows.depth), n)
    return Rows(
        features=features, depth=rows.depth[like], growth=rows.growth[like], energy_kev=rows.energy_kev[like],
        direct=np.zeros(n), slab=np.ones(n), counts=np.where(edge, 0.5, 1.0),
        error=np.where(edge, EDGE_ERROR, WIDE_ERROR) - KNOWN, known=np.ones(n),
    )  # fmt: skip


def within(rng: np.random.Generator, rows: Rows, lines: Floats) -> Rows:
    """The sources of other cases [n] moved into the walls, which are to be about slabs there."""
    n = len(lines)
    half, wall = lines[:, 6:9], lines[:, 9]
    deep = np.where(wall > 0.0, wall, half.min(axis=1)) * rng.random(n)
    place, axis = rng.uniform(-1.0, 1.0, (n, 3)) * half, rng.integers(0, 3, n)
    every = np.arange(n)
    place[every, axis] = np.where(rng.random(n) < 0.5, -1.0, 1.0) * (half[every, axis] - deep)
    features, _, _ = features_of(np.hstack([place, lines[:, 3:]]))
    like = rng.integers(0, len(rows.depth), n)
    return Rows(
        features=features, depth=rows.depth[like], growth=rows.growth[like], energy_kev=rows.energy_kev[like],
        direct=np.zeros(n), slab=np.ones(n), counts=np.ones(n), error=np.full(n, WITHIN_ERROR), known=np.ones(n),
    )  # fmt: skip


def deeper(rng: np.random.Generator, rows: Rows, n: int) -> Rows:
    """``n`` of the cases with the matter `DEEPER` times as deep: no more than before comes through it."""
    like = rng.integers(0, len(rows.depth), n)
    growth, features = rows.growth[like], rows.features[like]
    times = np.exp(rng.uniform(*np.log(DEEPER), n))
    depth = np.minimum(rows.depth[like] * times, DEEPEST)
    whole = depth * (1.0 + features[:, FEATURES.index("two")])  # of both walls
    return Rows(
        features=features, depth=depth, growth=growth, energy_kev=rows.energy_kev[like],
        direct=rows.direct[like] ** times, slab=whole * np.exp(growth - whole), counts=rows.counts[like],
        error=rows.error[like], known=np.zeros(n),
    )  # fmt: skip


def deviations(net: Network, rows: Rows) -> jax.Array:
    """ln of model over Monte Carlo [n], without the bound of deep walls: what it holds back would never be mended."""
    of = outputs(rows.features.T, net).T
    depth, energy_kev, growth = (jnp.asarray(x)[:, None] for x in (rows.depth, rows.energy_kev, rows.growth))
    ln_share, _, _ = log_share(of, depth, energy_kev, growth, jnp.asarray(UNBOUNDED), net.lines)
    return jnp.log((rows.direct + rows.slab * jnp.exp(ln_share[:, 0]) + NOTHING) / rows.counts)


def fitted(rows: Rows, lines: Floats, steps: int, seed: int = 0) -> Network:
    """The network with the smallest `deviations`, a robust mean of their squares, by Adam (Kingma and Ba, 2015).

    ``lines`` are the `experiments.transport.walls.lines_of` some or all of the cases.
    """
    rng = np.random.default_rng(seed)
    low, high = np.quantile(rows.features, [OUTLIERS, 1.0 - OUTLIERS], axis=0)
    levels = np.log(np.array([rows.energy_kev.min(), rows.energy_kev.max()]) / REFERENCE_KEV)
    ranges = np.concatenate([levels, np.quantile(rows.growth, [OUTLIERS, 1.0 - OUTLIERS])])
    count = len(rows.depth)
    more = wide(rng, rows, int(WIDE * count)), within(rng, rows, lines[::WITHIN]), deeper(rng, rows, int(DEEP * count))
    rows = Rows(*(jnp.asarray(np.concatenate(x), jnp.float32) for x in zip(rows, *more, strict=True)))
    clipped = np.clip(np.asarray(rows.features), low, high)
    sizes = (len(FEATURES), *UNITS, OUTPUTS)
    layers = []
    for number, (inputs, units) in enumerate(pairwise(sizes)):
        last = number == len(UNITS)
        layers.append((rng.normal(0.0, (0.1 if last else 1.0) / inputs**0.5, (units, inputs)), np.zeros(units)))
    one = [jnp.asarray(x, jnp.float32) for x in (low, high, clipped.mean(axis=0), clipped.std(axis=0) + 1e-6, ranges)]
    layers = jax.tree.map(partial(jnp.asarray, dtype=jnp.float32), layers)

    def net_of(layers: list[tuple[jax.Array, jax.Array]]) -> Network:
        return Network(*one, weights=tuple(w for w, _ in layers), biases=tuple(b for _, b in layers))

    def loss(layers: list[tuple[jax.Array, jax.Array]], some: Rows) -> jax.Array:
        net = net_of(layers)
        apart = deviations(net, some)
        away = jnp.where(some.known > 0.0, jnp.abs(apart), jnp.maximum(apart, 0.0)) / (KNOWN + some.error)
        # few walls are as deep as the last of `DEPTHS`: of others it is as at the one before
        deepest = outputs(some.features.T, net)[-2 * COEFFICIENTS :]
        change = deepest[COEFFICIENTS:] - deepest[:COEFFICIENTS]
        held = HELD * jnp.mean(jnp.sum(change * change, axis=0))
        return jnp.mean(jnp.where(away < FLAT, away * away, FLAT * (2.0 * away - FLAT))) + held

    optimiser = optax.adam(optax.cosine_decay_schedule(RATE, steps))

    @jax.jit
    def many(layers, state, keys):  # type: ignore[no-untyped-def]
        def step(carry, key):  # type: ignore[no-untyped-def]
            layers, state = carry
            chosen = jax.random.randint(key, (BATCH,), 0, len(rows.depth))
            slope = jax.grad(loss)(layers, jax.tree.map(lambda x: x[chosen], rows))
            change, state = optimiser.update(slope, state)
            return (optax.apply_updates(layers, change), state), None

        return jax.lax.scan(step, (layers, state), keys)[0]

    state = optimiser.init(layers)
    for part in range(-(-steps // AT_ONCE)):
        layers, state = many(layers, state, jax.random.split(jax.random.key(seed + part), AT_ONCE))
    return jax.tree.map(np.asarray, net_of(layers))
