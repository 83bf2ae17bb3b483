"""Photon Monte Carlo in one material: behind a slab, outside a spherical shell, and in an infinite medium.

Every photon carries a weight: absorption lowers it, and a flight through a finite body is made to collide in it. What
reaches the detector is added up as an expectation at every collision or flight, so that no photon has to hit it.
Lengths are in metres, energies in keV. Results are the scattered photons above `CUT_KEV` at the detector over those
of the bare source at the same distance, in `BINS` bins of equal width in ln(energy) from `CUT_KEV` to the energy of
the source.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.radiation import Material
from swarmsim.radiation.elements import CUT_KEV, ELECTRON_KEV
from swarmsim.radiation.interactions import coherent_density, interactions, klein_nishina, scattered_fraction
from swarmsim.radiation.scattering import BINS

Floats = NDArray[np.float64]

COLLISIONS = 60


class Medium(NamedTuple):
    """`Interactions` on the device; coherent scattering with its normalisation for next events."""

    first: jax.Array  # [] ln keV of the grid's first point
    step: jax.Array  # []
    attenuation_1_m: jax.Array  # [g]
    coherent: jax.Array  # [g]
    compton: jax.Array  # [g]
    pair: jax.Array  # [g]
    fluorescence: jax.Array  # [g, k]
    lines: jax.Array  # [k, 3] K-alpha and K-beta energy, share of K-alpha
    compton_cosine: jax.Array  # [g, q]
    coherent_cosine: jax.Array  # [g, q]
    compton_norm: jax.Array  # [g] integral of Klein-Nishina over the cosine
    coherent_norm: jax.Array  # [g] integral of F^2 (1 + c^2)
    weights: jax.Array  # [n]
    screening: jax.Array  # [n]
    response: jax.Array  # [g] weight of a photon in the tallies, over that of a photon of the source


class Tally(NamedTuple):
    """Scattered photons over those of the bare source, and their standard error."""

    spectrum: jax.Array  # [BINS]
    total: jax.Array  # []
    error: jax.Array  # []


def medium(material: Material, energy_kev: float, response: Callable[[Floats], Floats] | None = None) -> Medium:
    """Tables for photons of ``energy_kev`` and all that they give rise to.

    ``response`` weighs photons by their energy, such as a detector's efficiency; without it each counts as one.
    """
    table = interactions(material, CUT_KEV, max(energy_kev, 1.1 * ELECTRON_KEV) * 1.0001)
    f32 = partial(jnp.asarray, dtype=jnp.float32)
    energy = np.exp(table.log_energy)
    cosine = 1.0 - 2.0 * np.concatenate([[0.0], np.geomspace(1e-8, 1.0, 4000)])[::-1]
    return Medium(
        first=f32(table.log_energy[0]),
        step=f32(table.log_energy[1] - table.log_energy[0]),
        attenuation_1_m=f32(table.attenuation_1_m),
        coherent=f32(table.coherent),
        compton=f32(table.compton),
        pair=f32(table.pair),
        fluorescence=f32(table.fluorescence),
        lines=f32(np.array([(s.alpha_kev, s.beta_kev, s.alpha_share) for s in table.shells]).reshape(-1, 3)),
        compton_cosine=f32(table.compton_cosine),
        coherent_cosine=f32(table.coherent_cosine),
        compton_norm=f32([np.trapezoid(klein_nishina(e, cosine), cosine) for e in energy]),
        coherent_norm=f32(
            [np.trapezoid(coherent_density(e, cosine, table.weights, table.screening), cosine) for e in energy]
        ),
        weights=f32(table.weights),
        screening=f32(table.screening),
        response=f32(np.ones_like(energy) if response is None else response(energy) / response(np.array([energy_kev]))),
    )


def at(m: Medium, values: jax.Array, energy: jax.Array) -> jax.Array:
    """A table [g] or [g, k] at energies [n]."""
    place = jnp.clip((jnp.log(energy) - m.first) / m.step, 0.0, values.shape[0] - 1.001)
    row = place.astype(jnp.int32)
    part = (place - row).reshape(-1, *(1,) * (values.ndim - 1))
    return (1.0 - part) * values[row] + part * values[row + 1]


def _drawn(m: Medium, quantiles: jax.Array, energy: jax.Array, u: jax.Array, v: jax.Array) -> jax.Array:
    """Cosines [n] drawn from a table of quantiles; ``v`` chooses the row, so that the mean over rows is linear."""
    place = jnp.clip((jnp.log(energy) - m.first) / m.step, 0.0, quantiles.shape[0] - 1.001)
    row = (place + v).astype(jnp.int32)
    along = u * (quantiles.shape[1] - 1)
    left = jnp.minimum(along.astype(jnp.int32), quantiles.shape[1] - 2)
    part = along - left
    return (1.0 - part) * quantiles[row, left] + part * quantiles[row, left + 1]


def _turned(direction: jax.Array, cosine: jax.Array, azimuth: jax.Array) -> jax.Array:
    """Directions [n, 3] after scattering by angles with ``cosine`` [n]."""
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine * cosine, 0.0))
    helper = jnp.where(jnp.abs(direction[:, :1]) < 0.7, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    u = jnp.cross(direction, helper)
    u = u / jnp.linalg.norm(u, axis=1, keepdims=True)
    v = jnp.cross(direction, u)
    across = jnp.cos(azimuth)[:, None] * u + jnp.sin(azimuth)[:, None] * v
    new = cosine[:, None] * direction + sine[:, None] * across
    return new / jnp.linalg.norm(new, axis=1, keepdims=True)


def isotropic(key: jax.Array, n: int) -> jax.Array:
    """Unit vectors [n, 3] in all directions alike."""
    vector = jax.random.normal(key, (n, 3))
    return vector / jnp.linalg.norm(vector, axis=1, keepdims=True)


def collide(
    key: jax.Array, m: Medium, energy: jax.Array, weight: jax.Array, direction: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Energy, weight and direction of the photons [n] after an interaction."""
    n = energy.shape[0]
    keys = jax.random.split(key, 5)
    u, v, w, azimuth = jax.random.uniform(keys[0], (4, n))
    coherent, compton, pair = (at(m, t, energy) for t in (m.coherent, m.compton, m.pair))
    shells = at(m, m.fluorescence, energy)
    left = coherent + compton + pair + jnp.sum(shells, axis=1)
    choice = jax.random.uniform(keys[1], (n,)) * left
    is_coherent, is_compton = choice < coherent, (choice >= coherent) & (choice < coherent + compton)
    is_pair = (choice >= coherent + compton) & (choice < coherent + compton + pair)
    cosine = _drawn(m, m.compton_cosine, energy, u, v)
    cosine = jnp.where(is_coherent, _drawn(m, m.coherent_cosine, energy, u, v), cosine)
    scattered = energy * scattered_fraction(energy, cosine)
    new = jnp.where(is_coherent, energy, jnp.where(is_compton, scattered, jnp.where(is_pair, ELECTRON_KEV, 0.0)))
    if m.lines.shape[0]:
        ends = coherent + compton + pair
        for k in range(m.lines.shape[0]):
            chosen = (choice >= ends) & (choice < ends + shells[:, k])
            line = jnp.where(w < m.lines[k, 2], m.lines[k, 0], m.lines[k, 1])
            new, ends = jnp.where(chosen, line, new), ends + shells[:, k]
    deflected = _turned(direction, cosine, 2.0 * jnp.pi * azimuth)
    turned = jnp.where((is_coherent | is_compton)[:, None], deflected, isotropic(keys[2], n))
    weight = weight * left * jnp.where(is_pair, 2.0, 1.0) * (new > CUT_KEV)
    return jnp.maximum(new, CUT_KEV), weight, turned


def _spectrum(energy: jax.Array, score: jax.Array, source_kev: jax.Array) -> jax.Array:
    """Scores [n] added up in the bins of their energies."""
    number = jnp.floor(BINS * jnp.log(energy / CUT_KEV) / jnp.log(source_kev / CUT_KEV))
    number = jnp.clip(number, 0, BINS - 1)
    return jnp.sum(score[:, None] * (number[:, None] == jnp.arange(BINS)), axis=0)


def _result(spectrum: jax.Array, each: jax.Array) -> Tally:
    n = each.shape[0]
    return Tally(spectrum / n, jnp.mean(each), jnp.std(each) / jnp.sqrt(n))


def next_events(
    m: Medium, energy: jax.Array, direction: jax.Array, toward: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], ...]:
    """Energy [n] after, and density [n] per steradian of, each kind of interaction that sends a photon ``toward``."""
    cosine = jnp.clip(jnp.sum(direction * toward, axis=1), -1.0, 1.0)
    kn = klein_nishina(energy, cosine) / at(m, m.compton_norm, energy)
    rayleigh = coherent_density(energy, cosine, m.weights, m.screening) / at(m, m.coherent_norm, energy)
    per_steradian, isotropic = 1.0 / (2.0 * jnp.pi), 1.0 / (4.0 * jnp.pi)
    events = [
        (energy * scattered_fraction(energy, cosine), at(m, m.compton, energy) * kn * per_steradian),
        (energy, at(m, m.coherent, energy) * rayleigh * per_steradian),
        (jnp.full_like(energy, ELECTRON_KEV), 2.0 * at(m, m.pair, energy) * isotropic),
    ]
    shells = at(m, m.fluorescence, energy)
    for k in range(m.lines.shape[0]):
        for column, share in ((0, m.lines[k, 2]), (1, 1.0 - m.lines[k, 2])):
            events.append((jnp.full_like(energy, m.lines[k, column]), shells[:, k] * share * isotropic))
    return tuple(events)


@partial(jax.jit, static_argnames=("photons", "collisions"))
def slab(
    key: jax.Array,
    m: Medium,
    energy_kev: jax.Array,
    thickness_m: jax.Array,
    before_m: jax.Array,
    behind_m: jax.Array,
    photons: int,
    collisions: int = COLLISIONS,
) -> Tally:
    """Point source ``before_m`` in front of a slab of infinite width, point detector ``behind_m`` behind it."""
    keys = jax.random.split(key, 4)
    n = photons
    cosine = jnp.maximum(jax.random.uniform(keys[0], (n,)), 1e-4)
    azimuth = 2.0 * jnp.pi * jax.random.uniform(keys[1], (n,))
    sine = jnp.sqrt(1.0 - cosine**2)
    direction = jnp.stack([cosine, sine * jnp.cos(azimuth), sine * jnp.sin(azimuth)], axis=1)
    place = (direction * (before_m / cosine)[:, None]).at[:, 0].set(0.0)
    bare = 1.0 / (4.0 * jnp.pi * (before_m + thickness_m + behind_m) ** 2)

    def body(i: int, s: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        place, direction, energy, weight, spectrum, each = s
        k1, k2 = jax.random.split(jax.random.fold_in(keys[2], i))
        mu, along = at(m, m.attenuation_1_m, energy), direction[:, 0]
        ahead = jnp.where(along > 0.0, thickness_m - place[:, 0], place[:, 0])
        length = jnp.minimum(ahead / jnp.maximum(jnp.abs(along), 1e-9), 1e6)
        inside = -jnp.expm1(-mu * length)
        flown = -jnp.log1p(-jax.random.uniform(k1, (n,)) * inside) / mu
        weight, place = weight * inside, place + direction * flown[:, None]
        place = place.at[:, 0].set(jnp.clip(place[:, 0], 0.0, thickness_m))
        gap = jnp.stack([thickness_m + behind_m - place[:, 0], -place[:, 1], -place[:, 2]], axis=1)
        far = jnp.linalg.norm(gap, axis=1)
        toward = gap / far[:, None]
        left = (thickness_m - place[:, 0]) / toward[:, 0]
        for after, density in next_events(m, energy, direction, toward):
            kept = jnp.exp(-at(m, m.attenuation_1_m, jnp.maximum(after, CUT_KEV)) * left) * (after > CUT_KEV)
            score = weight * density * kept * at(m, m.response, jnp.maximum(after, CUT_KEV)) / far**2 / bare
            spectrum, each = spectrum + _spectrum(after, score, energy_kev), each + score
        energy, weight, direction = collide(k2, m, energy, weight, direction)
        return place, direction, energy, weight, spectrum, each

    start = (place, direction, jnp.full(n, energy_kev), jnp.full(n, 0.5), jnp.zeros(BINS), jnp.zeros(n))
    *_, spectrum, each = jax.lax.fori_loop(0, collisions, body, start)
    return _result(spectrum, each)


@partial(jax.jit, static_argnames=("photons", "collisions"))
def shell(
    key: jax.Array,
    m: Medium,
    energy_kev: jax.Array,
    thickness_m: jax.Array,
    inner_m: jax.Array,
    distance_m: jax.Array,
    photons: int,
    collisions: int = COLLISIONS,
) -> Tally:
    """Point source in the middle of a spherical shell, detector at ``distance_m`` from it, outside."""
    keys = jax.random.split(key, 2)
    n, outer_m = photons, inner_m + thickness_m
    direction = isotropic(keys[0], n)

    def body(i: int, s: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        place, direction, energy, weight, spectrum, each = s
        k1, k2 = jax.random.split(jax.random.fold_in(keys[1], i))
        mu = at(m, m.attenuation_1_m, energy)
        first, empty, second = chords(place, direction, inner_m, outer_m)
        whole = first + second
        leaves = weight * jnp.exp(-mu * whole) * at(m, m.response, energy)
        # at the detector's sphere the photon crosses at an angle: flux = crossings / cosine
        across = jnp.linalg.norm(jnp.cross(place, direction), axis=1) / distance_m
        score = jnp.where(i > 0, leaves / jnp.sqrt(jnp.maximum(1.0 - across**2, 1e-6)), 0.0)
        spectrum, each = spectrum + _spectrum(energy, score, energy_kev), each + score
        inside = -jnp.expm1(-mu * whole)
        flown = -jnp.log1p(-jax.random.uniform(k1, (n,)) * inside) / mu
        flown = flown + jnp.where(flown > first, empty, 0.0)
        place = place + direction * flown[:, None]
        energy, weight, direction = collide(k2, m, energy, weight * inside, direction)
        return place, direction, energy, weight, spectrum, each

    start = (jnp.zeros((n, 3)), direction, jnp.full(n, energy_kev), jnp.ones(n), jnp.zeros(BINS), jnp.zeros(n))
    *_, spectrum, each = jax.lax.fori_loop(0, collisions, body, start)
    return _result(spectrum, each)


def chords(
    place: jax.Array, direction: jax.Array, inner_m: jax.Array, outer_m: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Lengths [n] along rays in the shell before the cavity, in the cavity, and after it."""
    along = jnp.sum(place * direction, axis=1)
    across = jnp.sum(place * place, axis=1) - along**2
    end = -along + jnp.sqrt(jnp.maximum(outer_m**2 - across, 0.0))
    half = jnp.sqrt(jnp.maximum(inner_m**2 - across, 0.0))
    enter, leave = jnp.maximum(-along - half, 0.0), jnp.maximum(-along + half, 0.0)
    end = jnp.maximum(end, leave)
    return enter, leave - enter, end - leave


@partial(jax.jit, static_argnames=("photons", "collisions"))
def infinite(
    key: jax.Array,
    m: Medium,
    energy_kev: jax.Array,
    edges_m: jax.Array,
    photons: int,
    collisions: int = COLLISIONS,
) -> tuple[jax.Array, jax.Array]:
    """Scattered photons over the *unscattered* ones in spherical shells between ``edges_m`` [k + 1] around the source.

    Returns their number [k], and the spectrum [k, BINS].
    """
    keys = jax.random.split(key, 2)
    n, edges = photons, edges_m.shape[0]

    def body(i: int, s: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        place, direction, energy, weight, tracks = s
        k1, k2 = jax.random.split(jax.random.fold_in(keys[1], i))
        mu = at(m, m.attenuation_1_m, energy)
        along = jnp.sum(place * direction, axis=1)[:, None]
        root = jnp.sqrt(jnp.maximum(along**2 - jnp.sum(place**2, axis=1)[:, None] + edges_m**2, 0.0))
        enter, leave = jnp.maximum(-along - root, 0.0), jnp.maximum(-along + root, 0.0)
        weighed = weight * at(m, m.response, energy)
        track = weighed[:, None] * (jnp.exp(-mu[:, None] * enter) - jnp.exp(-mu[:, None] * leave)) / mu[:, None]
        number = jnp.floor(BINS * jnp.log(energy / CUT_KEV) / jnp.log(energy_kev / CUT_KEV))
        chosen = jnp.clip(number, 0, BINS - 1)[:, None] == jnp.arange(BINS)
        tracks = tracks + jnp.where(i > 0, jnp.einsum("nk,nb->kb", track, chosen.astype(jnp.float32)), 0.0)
        place = place + direction * (jax.random.exponential(k1, (n,)) / mu)[:, None]
        energy, weight, direction = collide(k2, m, energy, weight, direction)
        return place, direction, energy, weight, tracks

    start = (
        jnp.zeros((n, 3)), isotropic(keys[0], n), jnp.full(n, energy_kev), jnp.ones(n), jnp.zeros((edges, BINS)),
    )  # fmt: skip
    *_, tracks = jax.lax.fori_loop(0, collisions, body, start)
    mu = at(m, m.attenuation_1_m, energy_kev[None])[0]
    unscattered = (jnp.exp(-mu * edges_m[:-1]) - jnp.exp(-mu * edges_m[1:])) / mu
    spectrum = jnp.diff(tracks, axis=0) / n / unscattered[:, None]
    return jnp.sum(spectrum, axis=1), spectrum
