"""The scattered photons of walls of finite size in the limits that are known, and float32 where it could cancel."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation import Detector, roi_lines, roi_rates, spectrum_rate
from swarmsim.radiation.detector import AIR, Source
from swarmsim.radiation.rate import from_ground, line_rates, transmission
from swarmsim.radiation.roi_lines import RoiRates, roi_rates_and_slopes
from swarmsim.radiation.walls import MOST
from swarmsim.site import Crossed
from swarmsim.site.rays import Shape, stretched
from swarmsim.site.wall_network import COEFFICIENTS, DEPTHS, OUTPUTS, network
from tests.radiation.points import point, through

Detectors = dict[tuple[str, str], Detector]
PLACE, UP = jnp.array([0.0, 0.0, 10.0]), jnp.array([0.0, 0.0, 1.0])
slopes_of = jax.jit(roi_rates_and_slopes, static_argnames=("by",))
transmitted = jax.jit(transmission)


def shaped(
    way: Crossed, share: float | np.ndarray = 1.0, closed: float = 0.0, walls: float = 1.0, thin: float = 1.0,
    ground: float = 0.0, by: tuple[float, float] = (0.0, 0.0),
) -> Crossed:  # fmt: skip
    """``way`` with all of its matter in such a wall; ``by`` are the coefficients of the energy and the growth."""
    f32, of_photons = jnp.float32, np.zeros((len(DEPTHS), COEFFICIENTS))
    of_photons[:, 0] = np.log(share)
    of_photons[:, 1:] = by
    shape = Shape(
        thin_m=way.length_m * thin, scattered=f32(of_photons.reshape(OUTPUTS)), closed=f32(closed), walls=f32(walls),
        ground=jnp.full(2, ground, f32), low=f32(ground > 0.0),
    )  # fmt: skip
    return replace(way, shape=shape)


def scattered(detector: Detector, way: Crossed, nuclide: str = "Cs-137") -> np.ndarray:
    return np.asarray(transmitted(detector, jnp.int32(detector.nuclide_names.index(nuclide)), way)[1])


def test_a_wide_wall_that_is_crossed_squarely_is_a_slab(detectors: Detectors) -> None:
    d = detectors["nai_2x2", "physical"]
    for metres in (0.0, 0.01, 0.1, 0.5):
        way = through(d, concrete=metres, air=10.0)
        np.testing.assert_allclose(scattered(d, shaped(way)), scattered(d, way), rtol=1e-5)


def test_a_wall_scatters_as_far_as_it_is_seen_and_air_does_not_care(detectors: Detectors) -> None:
    d = detectors["nai_2x2", "physical"]
    wall, air = through(d, concrete=0.1), through(d, air=30.0)
    np.testing.assert_allclose(scattered(d, shaped(wall, share=0.3)), 0.3 * scattered(d, wall), rtol=1e-5)
    np.testing.assert_allclose(scattered(d, shaped(air, share=0.3, closed=1.0)), scattered(d, air), rtol=1e-4)


def test_no_wall_makes_much_more_of_a_source(detectors: Detectors) -> None:
    """Whatever a table may say of what it was not fitted to."""
    d = detectors["nai_2x2", "physical"]
    for metres in (0.03, 0.3, 1.0, 3.0):
        for walls in (1.0, 2.0):
            way = shaped(through(d, concrete=metres), share=1e12, walls=walls)
            assert scattered(d, way).max() < 1.001 * MOST
            assert metres > 1.0 or scattered(d, way).max() > 0.999 * MOST
            _, slopes, _ = slopes_of(
                d, point(d, "Cs-137"), jax.tree.map(lambda x: x[None], way), PLACE[None], UP[None], by=(0,)
            )  # fmt: skip
            assert np.isfinite(slopes).all()


def test_derivatives_are_numbers_for_nuclides_of_few_lines_as_well(detectors: Detectors) -> None:
    """The lines that they lack have neither energy nor attenuation."""
    d = detectors["nai_2x2", "physical"]
    ways = [shaped(through(d, **matter), 0.5, 1.0) for matter in ({"air": 9.0}, {"concrete": 0.2, "air": 9.0}, {})]
    way = jax.tree.map(lambda *x: jnp.stack(x), *ways)
    places, axes = jnp.tile(PLACE, (3, 1)), jnp.tile(UP, (3, 1))
    by = tuple(d.material_names.index(name) for name in ("concrete", AIR))
    assert float(jnp.min(jnp.sum(d.yields > 0.0, axis=1))) < d.yields.shape[1]
    for nuclide in d.nuclide_names:
        rates, slopes, _ = slopes_of(d, point(d, nuclide), way, places, axes, by=by)
        assert np.isfinite(rates).all()
        assert np.isfinite(slopes).all()
        assert np.any(np.asarray(slopes[1, 0]) != 0.0)


def test_an_accelerator_takes_some_lines_at_a_time(detectors: Detectors, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as the nuclide with most of them has; their number need not be a multiple."""
    d = detectors["nai_2x2", "physical"]
    ways = [shaped(through(d, **matter), 0.5, 1.0) for matter in ({"air": 9.0}, {"concrete": 0.2, "air": 9.0})]
    way = jax.tree.map(lambda *x: jnp.stack(x), *ways)
    places, axes, by = jnp.tile(PLACE, (2, 1)), jnp.tile(UP, (2, 1)), (d.material_names.index("concrete"),)
    sources = [point(d, name) for name in ("Co-60", "Cs-137", "Eu-152")]
    own = np.asarray(d.yields)[[int(source.nuclide) for source in sources]]
    most = int(np.max(np.flatnonzero(own.any(axis=0)))) + 1
    alone = [roi_rates_and_slopes(d, source, way, places, axes, by) for source in sources]
    monkeypatch.setattr(roi_lines, "on_processor", lambda: False)
    together = next(k for k in range(2, 9) if most % k and d.yields.shape[1] % k)
    monkeypatch.setattr(roi_lines, "LINES_TOGETHER", together)
    every = jax.tree.map(lambda *x: jnp.stack(x), *sources)
    found = jax.vmap(lambda source: roi_rates_and_slopes(d, source, way, places, axes, by))(every)
    for number, one in enumerate(alone):
        for x, y in zip(found, one, strict=True):
            np.testing.assert_allclose(x[number], y, rtol=2e-5, atol=1e-6 * float(jnp.max(jnp.abs(y))))
    asked = jnp.array([True, False, True])  # one of them for nothing

    def some(source: Source, asked: jax.Array) -> RoiRates:
        return roi_rates_and_slopes(d, source, way, places, axes, by, asked=asked)

    for one, other in zip(jax.vmap(some)(every, asked), found, strict=True):
        np.testing.assert_allclose(one[asked], other[asked], rtol=1e-6)
    assert not any(jnp.any(x) for x in some(sources[1], jnp.array(False)))


@pytest.mark.parametrize("walls", [1.0, 2.0])
def test_the_share_is_that_of_the_depth_of_a_wall(detectors: Detectors, walls: float) -> None:
    d, share, line = detectors["nai_2x2", "physical"], np.array([0.5, 0.4, 0.8, 0.2, 0.3]), 3  # the line of 662 keV
    mu = float(through(d, steel=1.0).length_m @ d.attenuation_1_m[d.nuclide_names.index("Cs-137"), line])
    between = [(0.4 * 0.8) ** 0.5, 0.5]
    depths = [*DEPTHS, (DEPTHS[1] * DEPTHS[2]) ** 0.5, 0.1]
    for depth, expected in zip(depths, [*share, *between], strict=True):
        way = through(d, steel=depth * walls / mu)
        found = scattered(d, shaped(way, share=share, walls=walls))[line] / scattered(d, way)[line]
        assert found == pytest.approx(expected, rel=1e-3)


def test_the_share_changes_with_the_energy_and_the_growth(detectors: Detectors) -> None:
    """By the formula of the module; the slab's growth is what is left of its counts."""
    d, by = detectors["nai_2x2", "physical"], (0.3, -0.2)
    for nuclide, line in (("Cs-137", 3), ("Co-60", 0), ("Am-241", 0)):
        n = d.nuclide_names.index(nuclide)
        way = through(d, concrete=0.1)
        t = float(way.length_m @ d.attenuation_1_m[n, line])
        slab, found = (scattered(d, each, nuclide)[line] for each in (way, shaped(way, share=0.7, by=by)))
        growth, level = np.log(slab / t) + t, np.log(float(d.line_energy_kev[n, line]) / 662.0)
        lowest, highest, least, most = network().lines
        expected = np.log(0.7) + by[0] * np.clip(level, lowest, highest) + by[1] * (np.clip(growth, least, most) - 1.0)
        assert np.log(found / slab) == pytest.approx(expected, abs=2e-3)


DEEP = np.exp([0.0, 0.0, 0.0, 0.0, 30.0])  # far more from the deepest walls than from thinner ones


@pytest.mark.parametrize("walls", [1.0, 2.0])
def test_deeper_walls_let_no_more_pass(detectors: Detectors, walls: float) -> None:
    """Whatever the last depth of a table says; from the last but one on, as the slab's counts fall."""
    d, line = detectors["nai_2x2", "physical"], 3
    mu = float(through(d, steel=1.0).length_m @ d.attenuation_1_m[d.nuclide_names.index("Cs-137"), line])
    ways = [through(d, steel=t * walls / mu) for t in np.linspace(DEPTHS[-2], DEPTHS[-1], 30)]
    found = [scattered(d, shaped(way, share=DEEP, walls=walls))[line] for way in ways]
    slab = scattered(d, ways[0])[line]
    assert found[0] == pytest.approx(slab, rel=1e-3)
    assert np.max(found) < 1.3 * slab  # the growth still rises a little
    np.testing.assert_allclose(found[-1], slab, rtol=0.3)


@pytest.mark.parametrize(
    ("share", "thicknesses", "walls"),
    [
        (np.array([0.5, 0.4, 0.8, 0.2, 0.3]), (0.05, 0.11, 0.25), 1.0),
        (DEEP, (0.5, 0.7), 1.0),  # bounded by what the last depth but one lets pass
        (DEEP, (0.9,), 2.0),
        (1e12, (0.1, 0.3), 1.0),  # and by the bare source
    ],
)
def test_derivatives_by_the_thickness_are_those_of_the_counts(
    detectors: Detectors, share: float | np.ndarray, thicknesses: tuple[float, ...], walls: float
) -> None:
    """Of walls whose share changes with depth, energy and growth: against differences."""
    d, concrete = detectors["nai_2x2", "physical"], detectors["nai_2x2", "physical"].material_names.index("concrete")
    for metres in thicknesses:
        way = shaped(through(d, concrete=metres), share=share, walls=walls, by=(0.3, -0.2))
        more = [stretched(way, jnp.ones(len(d.material_names)).at[concrete].set(f)) for f in (0.99, 1.01)]
        places, axes = PLACE[None], UP[None]
        one = lambda w: jax.tree.map(lambda x: x[None], w)  # noqa: E731
        rates = [slopes_of(d, point(d, "Cs-137"), one(w), places, axes, by=(concrete,)) for w in (way, *more)]
        # of all regions together, to which it does not matter that the spectrum softens
        difference = float(jnp.sum(rates[2][0] - rates[1][0])) / 0.02
        assert float(jnp.sum(rates[0][1])) == pytest.approx(difference, rel=0.01)


def test_scattered_photons_take_the_short_way(detectors: Detectors) -> None:
    """Crossed at 75 degrees, far more comes through than behind a slab as thick as the line is long in the wall."""
    d = detectors["nai_2x2", "physical"]
    steep = through(d, concrete=0.2 / 0.26)
    square = scattered(d, through(d, concrete=0.2))
    found = scattered(d, shaped(steep, thin=0.26))
    assert np.all(found[:1] > 10.0 * scattered(d, steep)[:1])
    np.testing.assert_allclose(found, square, rtol=1e-4)


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-7, 1e3])
def test_no_thickness_is_too_small_or_too_large(detectors: Detectors, length: float) -> None:
    d = detectors["nai_2x2", "physical"]

    def total(way: Crossed) -> jax.Array:
        return jnp.sum(transmission(d, jnp.int32(0), way)[1])

    way = shaped(through(d, steel=length), share=0.3, closed=1.0, walls=2.0, thin=0.01)
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


def test_thick_walls_of_a_building_leave_the_same_of_the_ground_for_every_view(detectors: Detectors) -> None:
    d, n = detectors["nai_2x2", "physical"], jnp.int32(0)

    def shine(metres: float, ground: float, closed: float) -> np.ndarray:
        return np.asarray(from_ground(d, n, shaped(through(d, concrete=metres), closed=closed, ground=ground)))

    above, aside = shine(0.5, 0.9, 1.0), shine(0.5, 0.05, 1.0)
    np.testing.assert_allclose(above, aside, rtol=1e-3)
    assert (above < shine(0.5, 0.9, 0.0)).all()
    np.testing.assert_allclose(shine(1e-6, 0.9, 1.0), shine(1e-6, 0.9, 0.0), rtol=1e-2)


def test_the_ideal_detector_knows_no_ground(detectors: Detectors) -> None:
    d = detectors["nai_2x2", "paper_ideal"]
    assert AIR in d.material_names
    assert not np.any(from_ground(d, jnp.int32(0), shaped(through(d, air=10.0), ground=1.0)))
