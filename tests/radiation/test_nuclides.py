"""The shipped nuclides against textbook values, which are independent of the tables that the files were made from."""

from itertools import pairwise

import pytest

from swarmsim.radiation import Library
from swarmsim.radiation.attenuation import mass_attenuation

DAY_S, YEAR_S = 86400.0, 3.15576e7

# Energy keV, photons per 100 decays of the named nuclide (of the parent for a chain) and relative tolerance: Gilmore,
# Practical Gamma-ray Spectrometry, appendix B, and the evaluations of the Laboratoire National Henri Becquerel.
TEXTBOOK = {
    "U-235": ((185.7, 57.1, 0.02), (143.8, 10.9, 0.02), (163.4, 5.07, 0.02), (205.3, 5.02, 0.02), (84.2, 6.7, 0.05)),
    "U-238": ((63.3, 3.75, 0.05), (1001.0, 0.842, 0.02), (766.4, 0.317, 0.03)),
    "Pu-239": ((51.6, 0.0272, 0.02), (129.3, 0.0063, 0.02), (375.0, 0.00155, 0.02), (413.7, 0.00147, 0.02)),
    "Th-232": (
        (2614.5, 35.8, 0.01),
        (583.2, 30.5, 0.01),
        (911.2, 26.2, 0.11),
        (969.0, 15.9, 0.11),
        (238.6, 43.5, 0.01),
    ),
    "F-18": ((511.0, 193.5, 0.005),),
    "Ga-67": ((93.3, 39.0, 0.03), (184.6, 21.2, 0.03), (300.2, 16.7, 0.03), (393.5, 4.6, 0.03)),
    "Zn-65": ((1115.5, 50.2, 0.02), (511.0, 2.84, 0.02)),
    "Bi-207": ((569.7, 97.8, 0.005), (1063.7, 74.6, 0.01), (1770.2, 6.87, 0.01)),
    "Lu-177": ((208.4, 10.4, 0.01), (112.9, 6.2, 0.02)),
    "Xe-133": ((81.0, 37.5, 0.03), (30.8, 38.5, 0.05), (35.0, 9.1, 0.05)),  # K X-rays of Cs: alpha, beta
    "Ba-133": ((356.0, 62.05, 0.01), (30.8, 96.2, 0.03), (35.0, 22.7, 0.03)),  # K X-rays of Cs
    "Cs-137": ((661.7, 85.0, 0.01), (32.0, 5.54, 0.03), (36.4, 1.32, 0.03)),  # K X-rays of Ba
    "I-131": ((364.5, 81.2, 0.01), (284.3, 6.1, 0.02)),
}
HALF_LIVES = {
    "U-235": (7.04e8 * YEAR_S, 0.002),
    "U-238": (4.468e9 * YEAR_S, 0.002),
    "Pu-239": (24_110 * YEAR_S, 0.002),
    "Th-232": (1.405e10 * YEAR_S, 0.005),
    "F-18": (109.77 * 60, 0.002),
    "Ga-67": (3.2617 * DAY_S, 0.002),
    "Zn-65": (244.0 * DAY_S, 0.002),
    "Bi-207": (32.2 * YEAR_S, 0.03),  # evaluations give 31.6 to 32.9 years
    "Lu-177": (6.647 * DAY_S, 0.002),
    "Xe-133": (5.245 * DAY_S, 0.002),
}


@pytest.mark.parametrize("name", TEXTBOOK)
def test_lines_are_the_textbooks(library: Library, name: str) -> None:
    for energy, percent, tolerance in TEXTBOOK[name]:
        found = sum(x.yield_percent for x in library.nuclide(name).lines if abs(x.energy_kev - energy) < 0.35)
        assert found == pytest.approx(percent, rel=tolerance), energy


@pytest.mark.parametrize("name", HALF_LIVES)
def test_half_lives_are_the_textbooks(library: Library, name: str) -> None:
    expected, tolerance = HALF_LIVES[name]
    assert library.nuclide(name).half_life_s == pytest.approx(expected, rel=tolerance)


def test_daughters_are_weighted_with_their_branching(library: Library) -> None:
    """Bi-212 decays to Tl-208 in 35.94 % and Tl-208 emits 2614.5 keV in 99.75 %, 583.2 keV in 85.0 % of its decays."""
    lines = {round(x.energy_kev): x.yield_percent for x in library.nuclide("Th-232").lines}
    assert lines[2615] == pytest.approx(0.3594 * 99.75, rel=0.002)
    assert lines[583] / lines[2615] == pytest.approx(85.0 / 99.75, rel=0.005)


def test_lines_are_in_order_and_within_the_materials(library: Library) -> None:
    for nuclide in library.nuclides:
        energies = [line.energy_kev for line in nuclide.lines]
        assert all(a < b for a, b in pairwise(energies)), nuclide.name
        for material in library.materials:
            assert (mass_attenuation(material, energies) > 0).all()


def test_annihilation_gives_at_most_two_photons(library: Library) -> None:
    for name in ("F-18", "Na-22", "Zn-65"):
        (annihilation,) = (x.yield_percent for x in library.nuclide(name).lines if abs(x.energy_kev - 511.0) < 0.1)
        assert 0.0 < annihilation <= 200.0
