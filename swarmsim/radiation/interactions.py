"""How photons interact in a material, as tables to draw from: processes, angles, fluorescence (host side).

Compton scattering follows Klein and Nishina for free electrons, with XCOM's incoherent cross section; coherent
scattering the atoms' form factors in Molière's approximation, with XCOM's coherent cross section; pair production gives
two photons of 511 keV where it happens; photoelectric absorption above a K edge gives that shell's X-rays. The rest
(electrons' bremsstrahlung, L X-rays) is absorbed on the spot.
"""

from dataclasses import dataclass
from typing import TypeVar, cast

import jax
import numpy as np
from numpy.typing import NDArray

from swarmsim.config.radiation import Material
from swarmsim.radiation.attenuation import coefficients
from swarmsim.radiation.elements import ELECTRON_KEV, Element, KShell, elements

Floats = NDArray[np.float64]
Array = TypeVar("Array", Floats, jax.Array)
"""Cross sections are written once for the host and for the Monte Carlo on the device."""

KEV_ANGSTROM = 12.398420  # h c
QUANTILES = 129
_MOLIERE = ((0.1, 6.0), (0.55, 1.2), (0.35, 0.3))  # amplitude and scale: Molière, Z. Naturforsch. 2a, 1947, 133
_BOHR_ANGSTROM = 0.529177


def scattered_fraction(energy_kev: Array | float, cosine: Array | float) -> Array:
    """Energy [...] of a Compton photon over that of the incident one: 1 / (1 + E (1 - cos) / 511 keV)."""
    return cast(Array, 1.0 / (1.0 + energy_kev / ELECTRON_KEV * (1.0 - cosine)))


def klein_nishina(energy_kev: Array | float, cosine: Array) -> Array:
    """Differential Klein-Nishina cross section per unit cosine, in units of 2 pi r_e^2: it integrates to 4/3 at E = 0.

    Knoll, Radiation Detection and Measurement, 4th ed., section 2.III.
    """
    ratio: Array = scattered_fraction(energy_kev, cosine)
    return cast(Array, 0.5 * ratio**2 * (ratio + 1.0 / ratio - 1.0 + cosine**2))


def coherent_density(energy_kev: Array | float, cosine: Array, weights: Array, screening: Array) -> Array:
    """Coherent scattering per unit cosine [...], not normalised: Thomson's cross section times the squared form factor.

    ``weights`` [n] and ``screening`` [n] are those of `Interactions`.
    """
    squared = (4.0 * np.pi * energy_kev / KEV_ANGSTROM) ** 2 * (0.5 * (1.0 - cosine))
    return cast(Array, form_factor_squared(squared, weights, screening) * (1.0 + cosine**2))


def form_factor_squared(transfer_squared_1_a2: Array, weights: Array, screening: Array) -> Array:
    """Squared form factor [...] of the mixture over its value in the forward direction.

    ``transfer_squared_1_a2`` [...] is the squared momentum transfer (q / hbar)^2 in 1/angstrom^2; of each element
    (f / Z)^2 with f / Z = sum a_i / (1 + (q R / b_i)^2), R the Thomas-Fermi radius (Molière's fit of its screening
    function).
    """
    scaled = transfer_squared_1_a2[..., None] * screening**2
    factor = sum(a / (1.0 + scaled / b**2) for a, b in _MOLIERE)
    return cast(Array, factor**2 @ weights)


@dataclass(frozen=True)
class Interactions:
    """Processes in one material over a grid of ln(energy); linear in it."""

    log_energy: Floats  # [g] ln keV, evenly spaced
    attenuation_1_m: Floats  # [g] of all processes
    coherent: Floats  # [g] share of the interactions
    compton: Floats  # [g]
    pair: Floats  # [g]
    fluorescence: Floats  # [g, k] interactions that give a K photon of each element with a K edge in the table
    shells: tuple[KShell, ...]  # [k]
    compton_cosine: Floats  # [g, QUANTILES] quantiles of the cosine of the Compton angle
    coherent_cosine: Floats  # [g, QUANTILES] same for coherent scattering
    weights: Floats  # [n] of the elements in the squared form factor: atoms per unit mass times Z^2, normalised
    screening: Floats  # [n] Thomas-Fermi radius of the elements in angstrom

    @property
    def absorbed(self) -> Floats:
        """Share [g] of the interactions after which no photon is left."""
        return 1.0 - self.coherent - self.compton - self.pair - self.fluorescence.sum(axis=1)


def interactions(material: Material, energy_min_kev: float, energy_max_kev: float, points: int = 192) -> Interactions:
    """Tables of a material between two energies."""
    energy = np.geomspace(energy_min_kev, energy_max_kev, points)
    parts = coefficients(material, energy)
    present = [(elements()[symbol], share) for symbol, share in material.mass_fractions.items()]
    weights = np.array([share / e.atomic_weight * e.number**2 for e, share in present])
    screening = np.array([0.88534 * _BOHR_ANGSTROM * e.number ** (-1 / 3) for e, _ in present])
    weights = weights / weights.sum()
    shells = [(e, share, e.k_shell) for e, share in present if e.k_shell is not None]
    emitted = [_k_photons(material, e, shell, energy) for e, _, shell in shells]
    return Interactions(
        log_energy=np.log(energy),
        attenuation_1_m=parts.total * 0.1 * material.density_kg_m3,
        coherent=parts.coherent / parts.total,
        compton=parts.incoherent / parts.total,
        pair=parts.pair / parts.total,
        fluorescence=np.stack(emitted, axis=1) / parts.total[:, None] if emitted else np.zeros((points, 0)),
        shells=tuple(shell for _, _, shell in shells),
        compton_cosine=_compton_quantiles(energy),
        coherent_cosine=_coherent_quantiles(energy, weights, screening),
        weights=weights,
        screening=screening,
    )


def _k_photons(material: Material, element: Element, shell: KShell, energy: Floats) -> Floats:
    """K photons of one element per unit of mass thickness [g], cm2/g."""
    alone = material.model_copy(update={"composition": {element.symbol: 1.0}})
    own = material.mass_fractions[element.symbol] * coefficients(alone, energy).photoelectric
    return np.where(energy > shell.edge_kev, own * shell.photons, 0.0)


def _quantiles(cosine: Floats, density: Floats) -> Floats:
    """Quantiles [g, QUANTILES] of distributions ``density`` [g, c] over ``cosine`` [g, c]."""
    step = np.diff(cosine, axis=1)
    sums = np.cumsum(0.5 * step * (density[:, 1:] + density[:, :-1]), axis=1)
    cumulative = np.concatenate([np.zeros((len(sums), 1)), sums], axis=1)
    share = np.linspace(0.0, 1.0, QUANTILES)
    return np.stack([np.interp(share, c / c[-1], x) for c, x in zip(cumulative, cosine, strict=True)])


def _compton_quantiles(energy: Floats) -> Floats:
    cosine = np.broadcast_to(np.linspace(-1.0, 1.0, 1001), (len(energy), 1001))
    return _quantiles(cosine, klein_nishina(energy[:, None], cosine))


def _coherent_quantiles(energy: Floats, weights: Floats, screening: Floats) -> Floats:
    # fine in the forward direction, where nearly all coherent photons go
    cosine = 1.0 - 2.0 * np.concatenate([[0.0], np.geomspace(1e-8, 1.0, 600)])[::-1]
    density = coherent_density(energy[:, None], cosine, weights, screening)
    return _quantiles(np.broadcast_to(cosine, density.shape), density)
