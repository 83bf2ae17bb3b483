"""The photon Monte Carlo against published build-up, closed forms and the tables made with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.transport.walk import infinite, medium, shell, slab
from swarmsim.radiation import Library, load_library, scattering
from swarmsim.radiation.attenuation import linear_attenuation
from swarmsim.radiation.dose import per_fluence

PHOTONS = 40_000


@pytest.fixture(scope="module")
def library() -> Library:
    return load_library()


def exposure(energy: np.ndarray) -> np.ndarray:
    return per_fluence("air_kerma", energy)


# ANSI/ANS-6.4.3-1991, exposure build-up at 1, 2 and 4 mean free paths
PUBLISHED = {
    ("water", 1000.0): (2.08, 3.62, 7.68),
    ("steel", 1000.0): (1.85, 2.85, 5.30),
    ("water", 500.0): (2.44, 4.88, 12.8),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "energy"), PUBLISHED)
def test_published_exposure_build_up(library: Library, name: str, energy: float) -> None:
    material = library.material(name)
    tables, mu = medium(material, energy, exposure), float(linear_attenuation(material, energy))
    depths = np.array([1.0, 2.0, 4.0])
    edges = np.stack([0.96 * depths, 1.04 * depths], axis=1).ravel() / mu
    scattered, _ = infinite(jax.random.key(0), tables, jnp.float32(energy), jnp.asarray(edges, jnp.float32), PHOTONS)
    np.testing.assert_allclose(1.0 + np.asarray(scattered)[::2], PUBLISHED[name, energy], rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "metres", "energy"), [("concrete", 0.10, 662.0), ("lead", 0.002, 160.0)])
def test_the_tables_are_what_it_gives(library: Library, name: str, metres: float, energy: float) -> None:
    material = library.material(name)
    depth = float(linear_attenuation(material, energy)) * metres
    arguments = (jnp.float32(x) for x in (energy, metres, 5.0 - 0.5 * metres, 5.0 - 0.5 * metres))
    tally = slab(jax.random.key(1), medium(material, energy), *arguments, 4 * PHOTONS)
    table = scattering.scattered_photons(material, np.array([energy]))[0, :, 1].sum(axis=-1)
    expected = np.exp(np.interp(np.log(depth), np.log(scattering.depths()), np.log(table)))
    assert float(tally.total) == pytest.approx(expected, rel=0.06, abs=4 * float(tally.error))
    assert float(jnp.sum(tally.spectrum)) == pytest.approx(float(tally.total), rel=1e-3)


def test_no_photon_is_made_by_a_shell_of_low_absorption(library: Library) -> None:
    """Photons out of a thin shell of water: at most one each; the few that are missing fell below 30 keV."""
    water = library.material("water")
    mu = float(linear_attenuation(water, 1000.0))
    arguments = (jnp.float32(x) for x in (1000.0, 0.1, 1.0, 1e3))
    tally = shell(jax.random.key(2), medium(water, 1000.0), *arguments, PHOTONS)
    total = float(tally.total) + np.exp(-0.1 * mu)
    assert 0.9 < total < 1.0


@pytest.mark.slow
def test_a_spherical_shell_scatters_less_towards_the_detector_than_a_slab(library: Library) -> None:
    """A wide slab sends photons from its whole area; a shell around the source only what leaves it outwards."""
    concrete = library.material("concrete")
    tables = medium(concrete, 662.0)
    around = shell(jax.random.key(3), tables, *(jnp.float32(x) for x in (662.0, 0.1, 1.0, 10.0)), PHOTONS)
    wide = slab(jax.random.key(3), tables, *(jnp.float32(x) for x in (662.0, 0.1, 1.0, 8.9)), PHOTONS)
    assert float(around.total) == pytest.approx(0.375, rel=0.03)
    assert float(wide.total) == pytest.approx(0.574, rel=0.03)
