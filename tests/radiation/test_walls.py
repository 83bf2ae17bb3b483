"""The scattered photons of walls of finite size in the limits that are known, and float32 where it could cancel."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation import Detector, roi_rates, spectrum_rate
from swarmsim.radiation.detector import AIR
from swarmsim.radiation.rate import from_ground, line_rates, transmission
from swarmsim.radiation.walls import constants
from swarmsim.site import Crossed
from swarmsim.site.rays import Shape
from tests.radiation.points import point, through

Detectors = dict[tuple[str, str], Detector]
PLACE, UP = jnp.array([0.0, 0.0, 10.0]), jnp.array([0.0, 0.0, 1.0])


def shaped(way: Crossed, spread: float = 1.0, closed: float = 0.0, thin: float = 1.0, ground: float = 0.0) -> Crossed:
    """``way`` with all of its matter in such a wall."""
    f32 = jnp.float32
    shape = Shape(
        thin_m=way.length_m * thin, spread=f32(spread), closed=f32(closed), ground=jnp.full(2, ground, jnp.float32)
    )
    return replace(way, shape=shape)


def scattered(detector: Detector, way: Crossed, nuclide: str = "Cs-137") -> np.ndarray:
    return np.asarray(transmission(detector, jnp.int32(detector.nuclide_names.index(nuclide)), way)[1])


def test_a_wide_wall_that_is_crossed_squarely_is_a_slab(detectors: Detectors) -> None:
    d = detectors["nai_2x2", "physical"]
    for metres in (0.0, 0.01, 0.1, 0.5):
        way = through(d, concrete=metres, air=10.0)
        np.testing.assert_allclose(scattered(d, shaped(way)), scattered(d, way), rtol=1e-5)


def test_a_wall_scatters_as_far_as_it_is_seen_and_air_does_not_care(detectors: Detectors) -> None:
    d = detectors["nai_2x2", "physical"]
    wall, air = through(d, concrete=0.1), through(d, air=30.0)
    np.testing.assert_allclose(scattered(d, shaped(wall, spread=0.3)), 0.3 * scattered(d, wall), rtol=1e-5)
    np.testing.assert_allclose(scattered(d, shaped(air, spread=0.3, closed=1.0)), scattered(d, air), rtol=1e-4)


def test_the_other_walls_of_a_building_scatter_too(detectors: Detectors) -> None:
    d, k = detectors["nai_2x2", "physical"], constants()
    way = through(d, lead=0.2)  # so thick that nothing comes back
    np.testing.assert_allclose(
        scattered(d, shaped(way, spread=0.0, closed=1.0)), k.around * scattered(d, way), rtol=1e-3
    )
    thin = through(d, steel=1e-4)
    found, slab = scattered(d, shaped(thin, spread=0.0, closed=1.0)), scattered(d, thin)
    np.testing.assert_allclose(found[3], (k.around + k.back) * slab[3], rtol=0.02)  # the line of 662 keV


def test_scattered_photons_take_the_short_way(detectors: Detectors) -> None:
    """Crossed at 75 degrees, far more comes through than behind a slab as thick as the line is long in the wall."""
    d = detectors["nai_2x2", "physical"]
    steep = through(d, concrete=0.2 / 0.26)
    square = scattered(d, through(d, concrete=0.2))
    found = scattered(d, shaped(steep, thin=0.26))
    assert np.all(found[:1] > 10.0 * scattered(d, steep)[:1])
    assert np.all(found[:1] < square[:1])


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-7, 1e3])
def test_no_thickness_is_too_small_or_too_large(detectors: Detectors, length: float) -> None:
    d = detectors["nai_2x2", "physical"]

    def total(way: Crossed) -> jax.Array:
        return jnp.sum(transmission(d, jnp.int32(0), way)[1])

    way = shaped(through(d, steel=length), spread=0.0, closed=1.0, thin=0.01)
    value, slopes = jax.value_and_grad(total)(way)
    assert np.isfinite(float(value))
    assert 0.0 <= float(value) < 1.0
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(slopes))


def test_photons_from_the_ground_are_softer_and_are_counted(detectors: Detectors) -> None:
    d = detectors["nai_2x2", "physical"]
    source = point(d, "Cs-137")
    free, above = (shaped(through(d, air=10.0), ground=share) for share in (0.0, 1.0))
    (direct, without), (same, with_ground) = (line_rates(d, source, way, PLACE, UP) for way in (free, above))
    np.testing.assert_allclose(same, direct, rtol=1e-6)
    added = float(jnp.sum(with_ground - without) / jnp.sum(direct + without))
    assert 0.6 < added < 1.0
    spectra = [np.asarray(spectrum_rate(d, source, way, PLACE, UP)) for way in (free, above)]
    energy = np.asarray(d.energy_kev)
    assert np.average(energy, weights=spectra[1] - spectra[0] + 1e-9) < 300.0
    assert spectra[1].sum() == pytest.approx(float(jnp.sum(direct + with_ground)), rel=1e-3)
    rois = roi_rates(d, source, above, PLACE, UP)
    assert float(jnp.sum(rois)) == pytest.approx(float(jnp.sum(direct + with_ground)), rel=1e-3)


def test_the_ideal_detector_knows_no_ground(detectors: Detectors) -> None:
    d = detectors["nai_2x2", "paper_ideal"]
    assert AIR in d.material_names
    assert not np.any(from_ground(d, jnp.int32(0), shaped(through(d, air=10.0), ground=1.0)))
