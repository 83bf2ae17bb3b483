"""Counts behind walls against the Monte Carlo's tables and published figures."""

import numpy as np
import pytest

from swarmsim.config.radiation import Material
from swarmsim.radiation import Detector, Library, line_rates, scattering
from swarmsim.radiation.attenuation import linear_attenuation
from tests.radiation.points import point, through

PLACE, UP = np.array([0.0, 0.0, 10.0], np.float32), np.array([0.0, 0.0, 1.0], np.float32)


def transmitted(library: Library, name: str, metres: float, energy: float, position: int = 1) -> float:
    """All photons above 30 keV behind a slab, over those of the bare source."""
    material = library.material(name)
    depth = float(linear_attenuation(material, energy)) * metres
    photons = scattering.scattered_photons(material, np.array([energy])).sum(axis=-1)
    fit = scattering.fitted(photons)[0, position]
    return float(np.exp(-depth) + scattering.evaluated(fit, np.asarray(depth)))


@pytest.mark.parametrize(
    ("name", "metres", "energy", "expected"),
    [
        ("concrete", 0.10, 662.0, 0.73), ("concrete", 0.20, 1253.0, 0.415), ("brick", 0.36, 662.0, 0.0914),
        ("steel", 0.002, 662.0, 1.02), ("air", 20.0, 1250.0, 0.87 * 1.30),
    ],
)  # fmt: skip
def test_slabs_of_the_reference(library: Library, name: str, metres: float, energy: float, expected: float) -> None:
    assert transmitted(library, name, metres, energy) == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("name", ["air", "water", "concrete", "steel", "lead"])
def test_the_fit_is_the_table(library: Library, name: str) -> None:
    """Total counts within 4 % of the Monte Carlo up to 8 mean free paths, at its own energies."""
    energies = np.array([60.0, 220.0, 662.0, 1500.0])
    photons = scattering.scattered_photons(library.material(name), energies).sum(axis=-1)
    fits, depth = scattering.fitted(photons), scattering.depths()
    shallow = depth < 8.0
    for k, p in np.ndindex(len(energies), len(scattering.POSITIONS)):
        total = photons[k, :, p] + np.exp(-depth)
        fitted = scattering.evaluated(fits[k, p], depth) + np.exp(-depth)
        np.testing.assert_allclose(fitted[shallow], total[shallow], rtol=0.045)


def test_a_material_of_the_tables_is_itself_and_others_lie_between(library: Library) -> None:
    energy = np.array([300.0])
    light, heavy = (scattering.scattered_photons(library.material(n), energy).sum() for n in ("concrete", "steel"))
    between = Material(name="slag", density_kg_m3=3000, composition={"Fe": 0.4, "O": 0.4, "Si": 0.2}, source="test")
    own = scattering.scattered_photons(between, energy).sum()
    assert min(light, heavy) < own < max(light, heavy)


def test_a_wall_near_the_source_differs_by_little(library: Library) -> None:
    for metres in (0.05, 0.1, 0.2):
        near, half = (transmitted(library, "concrete", metres, 662.0, position) for position in (0, 1))
        assert near == pytest.approx(half, rel=0.15)
        assert near != half


def test_counts_use_the_position_of_the_wall(detectors: dict[tuple[str, str], Detector]) -> None:
    detector = detectors["nai_2x2", "physical"]
    source = point(detector, "Cs-137")
    near, middle, half, far = (
        float(np.sum(line_rates(detector, source, through(detector, place, concrete=0.36), PLACE, UP)[1]))
        for place in (0.05, 0.3, 0.5, 0.9)
    )
    assert half == far
    assert near < middle < half  # behind a thick wall, one near the source lets less through


def test_scattered_photons_are_counted_by_their_own_efficiency(
    library: Library, detectors: dict[tuple[str, str], Detector]
) -> None:
    """Softer photons are counted more often: behind concrete the counts rise above the photons."""
    detector = detectors["nai_2x2", "physical"]
    source = point(detector, "Cs-137")
    free, _ = line_rates(detector, source, through(detector), PLACE, UP)
    direct, scattered = line_rates(detector, source, through(detector, concrete=0.1), PLACE, UP)
    counts = float(np.sum(direct + scattered) / np.sum(free))
    photons = transmitted(library, "concrete", 0.1, 661.66)
    assert photons * 1.08 < counts < photons * 1.35


def test_lead_hardens_and_its_fluorescence_shows(library: Library) -> None:
    """Behind lead most scattered photons of a 150 keV source are K X-rays of 72 to 88 keV."""
    photons = scattering.scattered_photons(library.material("lead"), np.array([160.0]))[0, 4, 1]
    energy = scattering.bin_energies(np.array([160.0]))[0]
    x_rays = photons[(energy > 65.0) & (energy < 95.0)].sum()
    assert x_rays > 0.4 * photons.sum()
