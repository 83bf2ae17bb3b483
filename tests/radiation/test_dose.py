"""Dose rates against published gamma constants."""

import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation import Library, build_dosimeter, net_rate
from swarmsim.radiation.dose import per_fluence
from tests.radiation.points import point, through

UP = jnp.array([0.0, 0.0, 1.0])

# Ambient dose equivalent at 1 m in uSv/h per GBq, above 30 keV (Otto, Journal of Radiological Protection 36, 2016, 215)
GAMMA_CONSTANTS = {"Co-60": 354.0, "Cs-137": 92.7, "Ir-192": 139.0, "Na-22": 336.0}


@pytest.mark.parametrize("nuclide", GAMMA_CONSTANTS)
def test_gamma_constant(library: Library, nuclide: str) -> None:
    dosimeter = build_dosimeter(library)
    place = jnp.array([0.0, 0.0, 1.0])
    found = float(net_rate(dosimeter, point(dosimeter, nuclide, 1e9), through(dosimeter), place, UP))
    assert found == pytest.approx(GAMMA_CONSTANTS[nuclide], rel=0.05)


def test_air_kerma_of_cobalt(library: Library) -> None:
    """0.307 mGy m2 / (h GBq) is the air-kerma-rate constant of Co-60 (ICRU)."""
    dosimeter = build_dosimeter(library, "air_kerma")
    place = jnp.array([0.0, 2.0, 0.0])
    found = float(net_rate(dosimeter, point(dosimeter, "Co-60", 1e9), through(dosimeter), place, UP))
    assert found == pytest.approx(307.0 / 4.0, rel=0.02)


def test_exposure_build_up_of_air(library: Library) -> None:
    """20 m of air at Co-60: 1.11 in exposure, hardly more than unscattered photons give."""
    dosimeter = build_dosimeter(library, "air_kerma")
    source, place = point(dosimeter, "Co-60", 1e9), jnp.array([20.0, 0.0, 0.0])
    arguments = (dosimeter, source, through(dosimeter, air=20.0), place, UP)
    ratio = float(net_rate(*arguments)) / float(net_rate(*arguments, uncollided=True))
    assert ratio == pytest.approx(1.11, rel=0.02)


def test_a_wall_lowers_it(library: Library) -> None:
    dosimeter = build_dosimeter(library)
    source, place = point(dosimeter, "Cs-137", 1e9), jnp.array([5.0, 0.0, 0.0])
    rates = [float(net_rate(dosimeter, source, through(dosimeter, lead=x), place, UP)) for x in (0.0, 0.01, 0.05)]
    assert rates[0] > rates[1] > rates[2] > 0.0
    assert rates[1] / rates[0] == pytest.approx(0.39, rel=0.1)  # broad beam: a half-value layer is 0.7 cm


def test_conversion_is_the_published_table() -> None:
    np.testing.assert_allclose(per_fluence("ambient_dose_equivalent", np.array([60.0, 1000.0])), (0.51, 5.20))
