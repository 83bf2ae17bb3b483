"""Photons that walls of a site scatter: several walls in turn, foliage, ends inside of houses and within walls."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation import Detector, load_library
from swarmsim.radiation.rate import transmission
from swarmsim.site import Site, crossed
from swarmsim.site.model import walls_among
from tests.site.yards import make_site

HOUSE = (5.0, 4.0, 2.0)
FAR = ((0.0, 0.0, -9999.0), (0.0, 0.0, 0.0), 0.0, 0.0, "air")


@pytest.fixture(scope="module")
def detector(detectors: dict[tuple[str, str], Detector]) -> Detector:
    return detectors["nai_2x2", "physical"]


def yard(detector: Detector, *boxes: tuple) -> Site:
    """A site with up to four boxes (centre, half extent, wall, material) far above the ground."""
    rows = [(centre, half, 0.0, wall, material) for centre, half, wall, material in boxes]
    site = make_site(rows + [FAR] * (4 - len(rows)), terrain=np.full((2, 2), -5e3), materials=detector.material_names)
    densities = [load_library().material(name).density_kg_m3 for name in detector.material_names]
    return replace(site, wall_kg_m3=jnp.asarray(walls_among(densities), jnp.float32))


@jax.jit
def _counts(detector: Detector, site: Site, a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    def one(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        direct, scattered = transmission(detector, nuclide, crossed(site, a, b))
        return direct[line], scattered[line]

    nuclide = jnp.int32(detector.nuclide_names.index("Cs-137"))
    line = jnp.argmin(jnp.abs(detector.line_energy_kev[nuclide] - 661.7))
    return jax.vmap(one)(a, b)


def counts(detector: Detector, site: Site, a: object, b: object) -> tuple[np.ndarray, np.ndarray]:
    """Direct and scattered counts over those of the bare source, of the 662 keV line."""
    a, b = np.broadcast_arrays(np.atleast_2d(np.asarray(a, np.float32)), np.atleast_2d(np.asarray(b, np.float32)))
    direct, scattered = _counts(detector, site, jnp.asarray(a), jnp.asarray(b))
    return np.asarray(direct), np.asarray(scattered)


@pytest.mark.slow
def test_foliage_behind_a_wall_is_no_wall(detector: Detector) -> None:
    """It is 3 kg/m3: 24 kg/m2 against 460 of the concrete."""
    source, place = (-10.0, 0.0, 0.0), (20.0, 0.0, 0.3)
    slab = ((-8.0, 0.0, 0.0), (0.1, 300.0, 300.0), 0.0, "concrete")
    house = ((-10.0, 0.0, 0.0), (5.0, 4.0, 3.0), 0.2, "concrete")
    trees = ((6.0, 0.0, 0.0), (4.0, 4.0, 4.0), 0.0, "vegetation")
    for wall in (slab, house):
        bare, behind = (counts(detector, yard(detector, wall, *more), source, place)[1][0] for more in ((), (trees,)))
        assert behind == pytest.approx(bare, rel=0.25)
        assert behind < bare


@pytest.mark.slow
def test_a_sheet_of_steel_counts_before_a_thicker_board(detector: Detector) -> None:
    steel = ((-8.0, 0.0, 0.0), (0.02, 1.0, 1.0), 0.0, "steel")
    board = ((10.0, 0.0, 0.0), (0.06, 30.0, 30.0), 0.0, "wood")
    way = crossed(yard(detector, steel, board), jnp.array([-10.0, 0.0, 0.0]), jnp.array([20.0, 0.0, 0.3]))
    alone = crossed(yard(detector, steel), jnp.array([-10.0, 0.0, 0.0]), jnp.array([20.0, 0.0, 0.3]))
    board_only = crossed(yard(detector, board), jnp.array([-10.0, 0.0, 0.0]), jnp.array([20.0, 0.0, 0.3]))
    part = 0.04 * 7860 / (0.04 * 7860 + 0.12 * 500)
    expected = part * alone.shape.scattered + (1.0 - part) * board_only.shape.scattered
    np.testing.assert_allclose(way.shape.scattered, expected, rtol=0.1, atol=0.05)


@pytest.mark.parametrize("wall", [0.05, 0.2])
def test_a_detector_in_a_house_counts_as_one_outside_does_from_within(detector: Detector, wall: float) -> None:
    """Photons go both ways alike, but for their energy: a source outside and a detector inside, or the reverse."""
    site = yard(detector, ((0.0, 0.0, 0.0), HOUSE, wall, "concrete"))
    inside = [(0.0, 3.4, 0.0), (3.0, -2.0, 0.5), (-4.0, 1.0, -1.0), (0.0, 0.0, 0.0)]
    outside = [(0.0, 40.0, 0.0), (30.0, 5.0, 8.0), (-9.0, 20.0, 3.0), (3.0, -9.0, 1.0)]
    for place in inside:
        out, into = (sum(counts(detector, site, *ends)) for ends in ((place, outside), (outside, place)))
        assert (np.abs(np.log(into / out)) < np.log(1.6)).all(), (place, into / out)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.0, 45.0, 60.0])
@pytest.mark.parametrize(("half", "wall"), [((8.0, 50.0, 3.0), 0.1), ((8.0, 50.0, 3.0), 0.3), ((0.2, 50.0, 50.0), 0.0)])
def test_counts_change_steadily_as_a_source_goes_into_a_wall(
    detector: Detector, half: tuple[float, float, float], wall: float, degrees: float
) -> None:
    """Along the normal, the detector always in the same direction."""
    site, inner = yard(detector, ((0.0, 0.0, 0.0), half, wall, "concrete")), half[0] - wall if wall else -half[0]
    x = np.linspace(inner - 0.2, half[0] + 0.2, 4001)
    source = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
    angle = np.radians(degrees)
    total = sum(counts(detector, site, source, source + 30.0 * np.array([np.cos(angle), np.sin(angle), 0.0])))
    assert np.max(np.abs(np.diff(np.log(total)))) < 0.02


@pytest.mark.parametrize("material", [("concrete", 0.1), ("concrete", 0.05), ("steel", 0.01), ("wood", 0.06)])
def test_more_walls_in_turn_never_let_more_through(detector: Detector, material: tuple[str, float]) -> None:
    name, thickness = material

    def wall(k: int) -> tuple:
        return ((8.0 * k, 0.0, 1.0), (0.5 * thickness, 1.0, 1.0), 0.0, name)

    ends = (-5.0, 0.0, 1.0), (40.0, 0.0, 1.5)
    totals = [sum(counts(detector, yard(detector, *map(wall, range(n))), *ends))[0] for n in range(1, 5)]
    assert (np.diff(totals) < 0.0).all(), totals


def test_a_third_wall_comes_in_steadily(detector: Detector) -> None:
    """As it grows from nothing to the thickest of three, it changes places with each of the others."""
    walls = [((0.0, 0.0, 1.0), (0.05, 1.0, 1.0), 0.0, "concrete"), ((8.0, 0.0, 1.0), (0.08, 3.0, 3.0), 0.0, "concrete")]
    site = yard(detector, *walls, ((16.0, 0.0, 1.0), (1.0, 20.0, 20.0), 0.0, "concrete"))
    half_extent = site.obstacles.half_extent_m
    assert float(site.obstacles.centre_m[2, 0]) == 16.0
    ends = jnp.array([[-5.0, 0.0, 1.0]]), jnp.array([[40.0, 0.0, 1.5]])

    def of(thickness: jax.Array) -> jax.Array:
        boxes = replace(site.obstacles, half_extent_m=half_extent.at[2, 0].set(0.5 * thickness))
        return sum(_counts(detector, replace(site, obstacles=boxes), *ends))[0]

    parts = jax.vmap(of)(jnp.linspace(1e-3, 0.4, 400))
    steps = np.diff(np.log(np.asarray(parts)))
    assert steps.max() < 0.01
    assert steps.min() > -0.04
