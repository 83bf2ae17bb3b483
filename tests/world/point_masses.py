"""Vehicles in traffic: the right of way with usual values, and flights of point masses that obey it."""

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.policies.follow import PACE_M_S2
from swarmsim.pytree import pytree
from swarmsim.world.right_of_way import kept_aside, right_of_way

RADIUS_M, HALF_HEIGHT_M, SEPARATION_M = 0.515, 0.15, 6.0  # of a Tarot T650
GROUND_SEPARATION_M = 2.0
ALTITUDE_M = 20.0
DT_S = 0.1
ALL_PAIRS = 10_000
_right_of_way = jax.jit(right_of_way, static_argnames=("window", "dense_max"))


def cloud(seed, count, per_vehicle_m2=900.0, depth=20.0):
    side = np.sqrt(count * per_vehicle_m2)
    return np.random.default_rng(seed).uniform(0.0, [side, side, depth], (count, 3)).astype(np.float32)


def traffic(position, velocity=None, **changes):
    """`right_of_way` of multirotors under way, 20 m above ground, unless told otherwise."""
    count = len(position)
    position = jnp.asarray(position, jnp.float32)
    given = {
        "height_m": jnp.full(count, ALTITUDE_M),
        "flies": jnp.ones(count, bool),
        "active": jnp.ones(count, bool),
        "rank": jnp.arange(count),
        "radius_m": jnp.full(count, RADIUS_M),
        "separation_m": jnp.float32(SEPARATION_M),
        "ground_separation_m": jnp.float32(GROUND_SEPARATION_M),
    } | {k: v if isinstance(v, int) else jnp.asarray(v) for k, v in changes.items()}
    velocity = jnp.zeros((count, 3)) if velocity is None else jnp.asarray(velocity, jnp.float32)
    return _right_of_way(position, velocity, **given)


def overlapping(p, exists, active):
    """Which vehicles [V] under way overlap another one, as upright cylinders; ``p`` [V, 3] are their middles."""
    apart = jnp.abs(p[:, None] - p[None])
    pair = exists[:, None] & exists & (active[:, None] | active) & ~jnp.eye(len(p), dtype=bool)
    beside = jnp.linalg.norm(apart[..., :2], axis=-1) < 2.0 * RADIUS_M
    return jnp.any(pair & beside & (apart[..., 2] < 2.0 * HALF_HEIGHT_M), axis=1)


@pytree
class Flown:
    time_s: jax.Array  # [] when the last one landed, or when patience ended
    landed: jax.Array  # [V] bool
    collided: jax.Array  # [V] bool
    nearest_m: jax.Array  # [V] smallest distance while under way


def flown(way, speed):
    """Flight of point masses along ways [V, N, 3] at speeds [N - 1]; vehicles of non-finite ways do not exist.

    A vehicle follows a reference that waits for traffic and for a vehicle that lags behind, as the world and its
    follower do, by position and velocity control with the gains, the acceleration and the climb of a small multirotor.
    """
    count = way.shape[0]
    leg = jnp.linalg.norm(jnp.diff(way, axis=1), axis=-1)
    end = jnp.cumsum(leg, axis=1)
    exists = jnp.isfinite(end[:, -1])

    def reference(progress):
        k = jnp.minimum(jnp.sum(progress[:, None] >= end, axis=1), leg.shape[1] - 1)[:, None]
        a, b = (jnp.take_along_axis(way, i[..., None], axis=1)[:, 0] for i in (k, k + 1))
        length, last = (jnp.take_along_axis(x, k, axis=1)[:, 0] for x in (leg, end))
        done = progress - last + length
        pace = jnp.minimum(speed[k[:, 0]], jnp.sqrt(2.0 * jnp.maximum(jnp.minimum(done, length - done), 0.0)) + 0.3)
        along = (b - a) / jnp.maximum(length, 1e-6)[:, None]
        return a + done[:, None] * along, pace[:, None] * along, pace

    def shortened(v, limit):
        return v * jnp.minimum(1.0, limit / jnp.maximum(jnp.linalg.norm(v, axis=-1, keepdims=True), 1e-6))

    def tick(carry):
        number, p, v, progress, go, push, hold, flown = carry
        active, height = exists & ~flown.landed, p[:, 2] - HALF_HEIGHT_M
        rules = traffic(p, v, height_m=height, active=active, held=hold)
        push, aside = kept_aside(push, rules.push_m, height, jnp.ones(count, bool), jnp.float32(SEPARATION_M), DT_S)
        hold = rules.hold | aside
        here, velocity, pace = reference(progress)
        lag = jnp.linalg.norm(here - p, axis=-1)
        change = PACE_M_S2 * DT_S / jnp.maximum(pace, 0.3)
        go = go + jnp.clip(jnp.where(hold, 0.0, jnp.clip(2.0 - lag, 0.0, 1.0)) - go, -change, change)
        for _ in range(4):
            wanted = shortened(1.2 * (here + push - p), 8.0) + go[:, None] * velocity
            v = jnp.where(active[:, None], v + shortened(2.8 * (wanted - v), 4.0) * DT_S / 4, 0.0)
            p = p + v * DT_S / 4
            stands = p[:, 2] < HALF_HEIGHT_M
            v = v.at[:, 2].set(jnp.where(stands, jnp.maximum(v[:, 2], 0.0), v[:, 2]))
            p = p.at[:, 2].max(HALF_HEIGHT_M)
        progress = jnp.minimum(progress + go * pace * DT_S, end[:, -1])
        flown = Flown(
            time_s=number * DT_S,
            landed=flown.landed | ((progress > end[:, -1] - 0.01) & (p[:, 2] < HALF_HEIGHT_M + 0.1)),
            collided=flown.collided | overlapping(p, exists, active),
            nearest_m=jnp.minimum(flown.nearest_m, jnp.where(active, rules.nearest_m, jnp.inf)),
        )
        return number + 1, p, v, progress, go, push, hold, flown

    no, still = jnp.zeros(count, bool), jnp.zeros((count, 3))
    start = Flown(time_s=jnp.float32(0.0), landed=no, collided=no, nearest_m=jnp.full(count, jnp.inf))
    begin = (jnp.int32(0), way[:, 0], still, jnp.zeros(count), jnp.zeros(count), still, no, start)
    under_way = lambda c: (c[0] < 8000) & jnp.any(exists & ~c[-1].landed)  # noqa: E731
    return jax.lax.while_loop(under_way, tick, begin)[-1]


def tour(pads, *stops):
    """Ways [V, N, 3]: climb from the pads [V, 2], fly over the stops [V, 2], return and land."""
    points = [pads, pads, *stops, pads, pads]
    heights = [HALF_HEIGHT_M, *[ALTITUDE_M] * (len(points) - 2), HALF_HEIGHT_M]
    ways = [np.c_[np.asarray(p, float), np.full(len(pads), z)] for p, z in zip(points, heights, strict=True)]
    return jnp.asarray(np.stack(ways, axis=1), jnp.float32)


def speeds(legs, cruise=5.0):
    return jnp.array([2.0, *[cruise] * (legs - 2), 1.2])


def random_tour(seed):
    """2 to 30 vehicles on pads between touching distance + 0.5 m and 20 m apart, which cross each other's ways."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 31))
    gap = rng.choice([2.0 * RADIUS_M + 0.5, rng.uniform(2.0 * RADIUS_M + 0.5, 20.0)])
    pads, side = np.zeros((0, 2)), gap * np.sqrt(count)
    while len(pads) < count:
        pad = rng.uniform(-0.5, 0.5, 2) * side
        free = np.all(np.hypot(*(pads - pad).T) >= gap)
        pads, side = (np.r_[pads, [pad]], side) if free else (pads, 1.002 * side)
    way = np.full((30, 6, 3), np.nan, np.float32)
    way[:count] = tour(pads, rng.uniform(-60.0, 60.0, (count, 2)), rng.uniform(-60.0, 60.0, (count, 2)))
    return jnp.asarray(way)
