"""Pulse heights of a bare cylindrical crystal by Monte Carlo, from its material and dimensions alone (host side).

A parallel beam meets the end face. Photons are followed through coherent and Compton scattering, photoelectric
absorption with K X-rays, and pair production with both annihilation photons; electrons stop where they are set free.
The first interaction is forced, so that the result is the distribution of pulses per photon that interacts.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.radiation import CRYSTAL_MAX_KEV, Material
from swarmsim.radiation.elements import ELECTRON_KEV, ENERGY_RANGE_KEV
from swarmsim.radiation.interactions import QUANTILES, Interactions, interactions, scattered_fraction

Floats = NDArray[np.float64]

ENERGIES_KEV = np.array([
    30.0, 36.0, 45.0, 60.0, 80.0, 105.0, 140.0, 190.0, 250.0, 330.0, 430.0, 560.0, 720.0, 930.0, 1200.0, 1550.0, 2000.0,
    2600.0, CRYSTAL_MAX_KEV,
])  # fmt: skip
"""Energies of the Monte Carlo; everything between them is interpolated."""
BELOW, ABOVE = 48, 16
"""Bins of the continuum up to the Compton edge, and from there to the full energy."""
_PHOTONS = 12_000  # at each energy: the share of the peak is known to 1 or 2 per cent
_LOST_KEV = 2.0  # less than this missing from the full energy: a pulse in the peak


@dataclass(frozen=True)
class PulseHeights:
    """Pulses for photons of `ENERGIES_KEV` [e]; the shares sum to 1."""

    deposits: Floats  # [e] pulses above 1 keV per photon that interacts other than by coherent scattering
    full: Floats  # [e] full-energy peak
    x_ray: Floats  # [e] a K X-ray escaped
    single: Floats  # [e] one annihilation photon escaped
    double: Floats  # [e] both did
    continuum: Floats  # [e, BELOW + ABOVE] by deposited energy in its own scale, see `deposit_edges`
    x_ray_kev: float = 0.0  # energy that an escaping K X-ray takes along; 0 without


def compton_edge_kev(energy_kev: Floats) -> Floats:
    """Largest energy deposited by one Compton event: E 2k / (1 + 2k), k = E / 511 keV."""
    k = energy_kev / ELECTRON_KEV
    return energy_kev * 2 * k / (1 + 2 * k)


def deposit_edges(energy_kev: float) -> Floats:
    """Edges [BELOW + ABOVE + 1] in keV of the continuum's bins: even to the Compton edge and beyond."""
    edge = float(compton_edge_kev(np.asarray(energy_kev)))
    return np.concatenate([np.linspace(0.0, edge, BELOW + 1), np.linspace(edge, energy_kev, ABOVE + 1)[1:]])


def without_coherent(table: Interactions) -> Floats:
    """Linear attenuation [g] in 1/m by what leaves energy behind."""
    return table.attenuation_1_m * (1.0 - table.coherent)


@lru_cache(maxsize=64)
def _pulse_heights(material: str, radius_m: float, length_m: float) -> PulseHeights:
    model = Material.model_validate_json(material)
    table = interactions(model, ENERGY_RANGE_KEV[0], ENERGIES_KEV[-1] * 1.001)
    x_ray = max((s.alpha_kev for s in table.shells if s.edge_kev < 60.0), default=0.0)
    rows = [
        _shares(deposits, e, x_ray) for e, deposits in zip(ENERGIES_KEV, _run(table, radius_m, length_m), strict=True)
    ]
    deposits_, full, single_x, single, double, continuum = (np.array(column) for column in zip(*rows, strict=True))
    return PulseHeights(deposits_, full, single_x, single, double, continuum, x_ray)


def pulse_heights(material: Material, radius_m: float, length_m: float) -> PulseHeights:
    """Pulse heights of a crystal; kept for the next detector with the same one."""
    return _pulse_heights(material.model_dump_json(), radius_m, length_m)


def _shares(deposit: Floats, energy: float, x_ray: float) -> tuple[float, float, float, float, float, Floats]:
    """Shares of the pulses ``deposit`` [n] in keV; the fields of `PulseHeights` in their order."""
    pulses = deposit[deposit > 1.0]
    weight = np.ones(len(pulses))
    full = np.abs(pulses - energy) < _LOST_KEV
    weight[full] = 0.0
    shares = [float(full.sum())]
    # K-beta lies a few keV above K-alpha: one peak stands for both
    for lost, reach in ((x_ray, 0.2 * x_ray), (ELECTRON_KEV, _LOST_KEV), (2 * ELECTRON_KEV, _LOST_KEV)):
        apart = np.abs(pulses - (energy - lost))
        inside, around = weight * (apart < reach), weight * (apart < 3 * reach)
        # what lies evenly about the peak belongs to the continuum
        even = 0.5 * (around.sum() - inside.sum())
        peak = max(float(inside.sum() - even), 0.0) if lost > 0.0 and energy - lost > 1.0 else 0.0
        shares.append(peak)
        if peak > 0.0:
            weight = np.where(inside > 0.0, weight * even / inside.sum(), weight)
    continuum = np.histogram(pulses, deposit_edges(energy), weights=weight)[0]
    total = max(len(pulses), 1)
    full_, x_ray_, single, double = (share / total for share in shares)
    return len(pulses) / len(deposit), full_, x_ray_, single, double, continuum / total


def _run(table: Interactions, radius: float, length: float) -> Floats:
    """Deposited energy [e, n] in keV for a parallel beam on the end face, the first interaction forced."""
    rng = np.random.default_rng(1)
    n = len(ENERGIES_KEV) * _PHOTONS
    energy = np.repeat(ENERGIES_KEV, _PHOTONS)
    even = (np.arange(n) % _PHOTONS + 0.5) / _PHOTONS
    across, azimuth = radius * np.sqrt(even), 2 * np.pi * rng.random(n)
    mu = _at(table, without_coherent(table), energy)
    depth = -np.log1p(rng.random(n) * np.expm1(-mu * length)) / mu
    place = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), depth], axis=1)
    direction = np.broadcast_to([0.0, 0.0, 1.0], (n, 3)).copy()
    deposit, event = np.zeros(n), np.arange(n)
    forced = True
    while len(energy):
        if not forced:
            mu = _at(table, table.attenuation_1_m, energy)
            place = place + direction * (rng.exponential(size=len(energy)) / mu)[:, None]
            inside = (place[:, 0] ** 2 + place[:, 1] ** 2 < radius**2) & (place[:, 2] > 0) & (place[:, 2] < length)
            place, direction, energy, event = place[inside], direction[inside], energy[inside], event[inside]
        left, direction, again = _interact(rng, table, energy, direction, forced)
        np.add.at(deposit, event, energy - left - again * ELECTRON_KEV)
        # both photons of an annihilation go on, in opposite directions
        alive, twin = left > ENERGY_RANGE_KEV[0], again > 0
        np.add.at(deposit, event[~alive], left[~alive])
        place = np.concatenate([place[alive], place[twin]])
        direction = np.concatenate([direction[alive], -direction[twin]])
        energy = np.concatenate([left[alive], np.full(twin.sum(), ELECTRON_KEV)])
        event = np.concatenate([event[alive], event[twin]])
        forced = False
    return deposit.reshape(len(ENERGIES_KEV), _PHOTONS)


def _at(table: Interactions, values: Floats, energy: Floats) -> Floats:
    return np.interp(np.log(energy), table.log_energy, values)


def _interact(
    rng: np.random.Generator, table: Interactions, energy: Floats, direction: Floats, forced: bool
) -> tuple[Floats, Floats, Floats]:
    """Energy of the photon that goes on [n], its direction, and 1 where a second one of 511 keV goes the other way."""
    n = len(energy)
    coherent, compton, pair = (_at(table, x, energy) for x in (table.coherent, table.compton, table.pair))
    coherent = np.zeros(n) if forced else coherent
    shells = [_at(table, table.fluorescence[:, k], energy) for k in range(len(table.shells))]
    whole = 1.0 - _at(table, table.coherent, energy) if forced else np.ones(n)
    choice = rng.random(n) * whole
    is_coherent, is_compton = choice < coherent, (choice >= coherent) & (choice < coherent + compton)
    ends = coherent + compton
    is_pair = (choice >= ends) & (choice < ends + pair)
    ends = ends + pair
    cosine = np.where(is_coherent, _cosine(rng, table, table.coherent_cosine, energy), 0.0)
    cosine = np.where(is_compton, _cosine(rng, table, table.compton_cosine, energy), cosine)
    left = np.where(is_coherent, energy, np.where(is_compton, energy * scattered_fraction(energy, cosine), 0.0))
    left = np.where(is_pair, ELECTRON_KEV, left)
    for shell, share in zip(table.shells, shells, strict=True):
        chosen = (choice >= ends) & (choice < ends + share)
        left = np.where(chosen, np.where(rng.random(n) < shell.alpha_share, shell.alpha_kev, shell.beta_kev), left)
        ends = ends + share
    scattered = is_coherent | is_compton
    turned = np.where(scattered[:, None], _deflected(rng, direction, cosine), _isotropic(rng, n))
    return left, turned, is_pair.astype(float)


def _cosine(rng: np.random.Generator, table: Interactions, quantiles: Floats, energy: Floats) -> Floats:
    step = table.log_energy[1] - table.log_energy[0]
    place = np.clip((np.log(energy) - table.log_energy[0]) / step, 0, len(quantiles) - 1.001)
    row = (place + rng.random(len(energy))).astype(int)
    along = rng.random(len(energy)) * (QUANTILES - 1)
    column = along.astype(int)
    part = along - column
    return np.asarray((1 - part) * quantiles[row, column] + part * quantiles[row, column + 1])


def _isotropic(rng: np.random.Generator, n: int) -> Floats:
    vector = rng.normal(size=(n, 3))
    return np.asarray(vector / np.linalg.norm(vector, axis=1, keepdims=True))


def _deflected(rng: np.random.Generator, direction: Floats, cosine: Floats) -> Floats:
    """Directions [n, 3] after scattering by angles with ``cosine`` [n], with a random azimuth."""
    helper = np.where(np.abs(direction[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(direction, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(direction, u)
    azimuth = 2 * np.pi * rng.random(len(cosine))[:, None]
    sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))[:, None]
    return np.asarray(cosine[:, None] * direction + sine * (np.cos(azimuth) * u + np.sin(azimuth) * v))
