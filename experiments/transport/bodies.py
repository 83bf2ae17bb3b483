"""Photon Monte Carlo among bodies: a source in a house or a container, and detectors anywhere outside.

Flights are exact: what a ray crosses is known in closed form, so that a photon is made to collide somewhere on it, and
every collision adds the expectation at every detector. Delta tracking (Woodcock) gives the same, but wastes nearly all
of its steps in the empty inside of a house, and does not know the chance that a photon leaves without a collision.
Between the bodies there is nothing.
"""

from functools import partial
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

from experiments.transport.walk import Medium, at, chords, collide, isotropic, next_events
from swarmsim.radiation.elements import CUT_KEV

COLLISIONS = 40


class Bodies(Protocol):
    """Convex pieces of matter that do not overlap, each of one of the media."""

    @property
    def material(self) -> jax.Array:
        """[i] int32 medium of each piece."""

    def crossings(self, place: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Distances [n, i] at which rays from ``place`` [n, 3] in ``direction`` [n, 3] enter and leave each piece.

        What lies behind a ray counts as left at 0, and a piece that it does not meet as left where it was entered.
        """


class Boxes(NamedTuple):
    """Boxes along the axes."""

    low_m: jax.Array  # [i, 3]
    high_m: jax.Array  # [i, 3]
    material: jax.Array  # [i] int32

    def crossings(self, place: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        """See `Bodies`. Slab method of Kay and Kajiya, SIGGRAPH 1986."""
        inverse = (1.0 / jnp.where(jnp.abs(direction) < 1e-9, 1e-9, direction))[:, None]
        first, second = (self.low_m - place[:, None]) * inverse, (self.high_m - place[:, None]) * inverse
        enter = jnp.maximum(jnp.max(jnp.minimum(first, second), axis=2), 0.0)
        return enter, jnp.maximum(jnp.min(jnp.maximum(first, second), axis=2), enter)


class Shell(NamedTuple):
    """A spherical shell around the origin, seen from within its outer sphere."""

    inner_m: jax.Array  # []
    outer_m: jax.Array  # []
    material: jax.Array  # [2] int32: before the cavity, and after it

    def crossings(self, place: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        """See `Bodies`."""
        first, empty, second = chords(place, direction, self.inner_m, self.outer_m)
        enter = jnp.stack([jnp.zeros_like(first), first + empty], axis=1)
        return enter, jnp.stack([first, first + empty + second], axis=1)


class Seen(NamedTuple):
    """Photons at each detector over those of the bare source at its distance."""

    uncollided: jax.Array  # [d]
    scattered: jax.Array  # [d]
    error: jax.Array  # [d] standard error of the latter


def lengths(bodies: Bodies, place: jax.Array, target: jax.Array) -> jax.Array:
    """Metres [n, i] of each piece between ``place`` [n, 3] and ``target`` [3]."""
    gap = target - place
    far = jnp.linalg.norm(gap, axis=1, keepdims=True)
    enter, leave = bodies.crossings(place, gap / far)
    return jnp.minimum(leave, far) - jnp.minimum(enter, far)


def attenuation(media: tuple[Medium, ...], energy: jax.Array) -> jax.Array:
    """Attenuation [n, m] in 1/m of every medium."""
    return jnp.stack([at(m, m.attenuation_1_m, energy) for m in media], axis=1)


@partial(jax.jit, static_argnames=("photons", "collisions"))
def seen(
    key: jax.Array,
    media: tuple[Medium, ...],
    bodies: Bodies,
    energy_kev: jax.Array,
    source_m: jax.Array,
    detectors_m: jax.Array,
    photons: int,
    collisions: int = COLLISIONS,
) -> Seen:
    """Point source at ``source_m`` [3], point detectors at ``detectors_m`` [d, 3], both in no body."""
    first_key, walk_key = jax.random.split(key)
    one_hot = (bodies.material[:, None] == jnp.arange(len(media))).astype(jnp.float32)  # [i, m]
    bare = 1.0 / (4.0 * jnp.pi * jnp.sum((detectors_m - source_m) ** 2, axis=1))

    def expected(
        target: jax.Array, place: jax.Array, direction: jax.Array, energy: jax.Array, weight: jax.Array, of: jax.Array
    ) -> jax.Array:
        """Fluence [n] at a detector from collisions at ``place`` in the media ``of`` [n]."""
        gap = target - place
        far = jnp.linalg.norm(gap, axis=1)
        metres = lengths(bodies, place, target) @ one_hot
        score = jnp.zeros_like(energy)
        for number, m in enumerate(media):
            for after, density in next_events(m, energy, direction, gap / far[:, None]):
                kept = jnp.maximum(after, CUT_KEV)
                left = jnp.exp(-jnp.sum(attenuation(media, kept) * metres, axis=1)) * at(m, m.response, kept)
                score = score + jnp.where((of == number) & (after > CUT_KEV), density * left, 0.0)
        return weight * score / far**2

    def body(i: int, s: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        place, direction, energy, weight, each = s
        flight, interaction = jax.random.split(jax.random.fold_in(walk_key, i))
        enter, leave = bodies.crossings(place, direction)
        mu = attenuation(media, energy) @ one_hot.T
        depth = mu * (leave - enter)
        before = jnp.sum(jnp.where(enter[:, None] < enter[:, :, None], depth[:, None], 0.0), axis=2)
        inside = -jnp.expm1(-jnp.sum(depth, axis=1))
        wanted = -jnp.log1p(-jax.random.uniform(flight, inside.shape) * inside)[:, None]
        chosen = jnp.argmax(jnp.where((depth > 0.0) & (before <= wanted), before, -1.0), axis=1)[:, None]

        def of_chosen(values: jax.Array) -> jax.Array:
            return jnp.take_along_axis(values, chosen, axis=1)

        into = jnp.clip((wanted - of_chosen(before)) / of_chosen(mu), 0.0, of_chosen(leave - enter))
        place, weight = place + direction * (of_chosen(enter) + into), weight * inside
        of = bodies.material[chosen[:, 0]]
        each = each + jax.lax.map(lambda t: expected(t, place, direction, energy, weight, of), detectors_m)
        new = [collide(interaction, m, energy, weight, direction) for m in media]
        energy, weight = (jnp.select([of == k for k in range(len(new))], [x[j] for x in new]) for j in (0, 1))
        direction = jnp.select([(of == k)[:, None] for k in range(len(new))], [x[2] for x in new])
        return place, direction, energy, weight, each

    n = photons
    start = (
        jnp.broadcast_to(source_m, (n, 3)), isotropic(first_key, n), jnp.full(n, energy_kev), jnp.ones(n),
        jnp.zeros((detectors_m.shape[0], n)),
    )  # fmt: skip
    *_, each = jax.lax.fori_loop(0, collisions, body, start)
    way = jnp.stack([lengths(bodies, source_m[None], target)[0] for target in detectors_m])  # [d, i]
    uncollided = jnp.exp(-way @ (one_hot @ attenuation(media, energy_kev[None])[0]))
    return Seen(uncollided, jnp.mean(each, axis=1) / bare, jnp.std(each, axis=1) / jnp.sqrt(n) / bare)
