"""Detectors for estimates: rates by region and their slopes, and tables of few lines against those of all."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation import Detector
from swarmsim.radiation.coarse import coarse
from swarmsim.radiation.detector import Source
from swarmsim.radiation.rate import roi_rates
from swarmsim.radiation.roi_lines import roi_rates_and_slopes
from swarmsim.site import Crossed
from swarmsim.site.rays import Shape, stretched, wide
from swarmsim.site.wall_network import COEFFICIENTS, OUTPUTS

Detectors = dict[tuple[str, str], Detector]
MATERIALS = ("air", "concrete", "steel")
LINES = 8  # as the localisation has


def ways(detector: Detector, seed: int, count: int, walls: float = 0.3) -> tuple[Crossed, jax.Array, jax.Array]:
    """Drawn places around a source at the origin, seen through air and up to so much concrete."""
    rng = np.random.default_rng(seed)
    other = np.random.default_rng(count)
    place = rng.normal(size=(count, 3))
    place *= rng.uniform(3.0, 60.0, (count, 1)) / np.linalg.norm(place, axis=1, keepdims=True)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    length = np.zeros((count, len(detector.material_names)))
    length[:, detector.material_names.index("air")] = np.linalg.norm(place, axis=1)
    length[:, detector.material_names.index("concrete")] = rng.uniform(0.0, walls, count)
    between = rng.uniform(0.05, 0.95, length.shape)
    f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    shape = Shape(
        thin_m=f32(length * np.where(rng.random(length.shape) < 0.5, 1.0, rng.uniform(0.3, 1.0, length.shape))),
        scattered=f32(_coefficients(rng.uniform(0.1, 1.0, count), other)),
        closed=f32(rng.integers(2, size=count)), walls=f32(other.uniform(1.0, 2.0, count)),
        ground=f32(np.sort(rng.uniform(0.0, 1.0, (count, 2)))[:, ::-1]), low=f32(other.uniform(0.0, 1.0, count)),
    )  # fmt: skip
    return Crossed(length_m=f32(length), place=f32(between), shape=shape), f32(place), f32(axis)


def _coefficients(share: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Of walls with about that ``share``: they change with the energy and the growth as those of the network do."""
    found = rng.normal(0.0, [0.15, 0.05, 0.05], (len(share), OUTPUTS // COEFFICIENTS, COEFFICIENTS))
    found[:, :, 0] += np.log(share)[:, None]
    return found.reshape(len(share), OUTPUTS)


def thicker(way: Crossed, material: int, factor: float) -> Crossed:
    return stretched(way, jnp.ones(way.length_m.shape[1]).at[material].set(factor))


def source(nuclide: int) -> Source:
    return Source(position_m=jnp.zeros(3), activity_bq=jnp.float32(1e8), nuclide=jnp.int32(nuclide))


@jax.jit
def _each(detector: Detector, nuclide: jax.Array, way: Crossed, place: jax.Array, axis: jax.Array) -> jax.Array:
    one = Source(position_m=jnp.zeros(3), activity_bq=jnp.float32(1e8), nuclide=nuclide)
    return jax.vmap(lambda w, p, a: roi_rates(detector, one, w, p, a))(way, place, axis)


_with_slopes = jax.jit(roi_rates_and_slopes, static_argnames="by")


@pytest.mark.parametrize("kind", ["physical", "paper_ideal"])
@pytest.mark.parametrize("name", ["Co-60", "Cs-137", "Ba-133", "Am-241"])
def test_rates_with_slopes_are_the_rates_and_slopes_their_differences(
    detectors: Detectors, kind: str, name: str
) -> None:
    d = detectors["nai_1p5x1p5", kind]
    k = d.nuclide_names.index(name)
    way, place, axis = ways(d, k, 24)
    columns, step = [d.material_names.index(name) for name in ("air", "concrete")], 0.05
    found = _with_slopes(d, source(k), way, place, axis, by=tuple(columns))
    rates, slopes = np.asarray(found.rates, float), np.asarray(found.slopes, float)
    np.testing.assert_allclose(rates, _each(d, jnp.int32(k), way, place, axis), rtol=2e-4, atol=1e-6 * rates.max())
    up, down = (
        np.stack([_each(d, jnp.int32(k), thicker(way, m, np.exp(s)), place, axis) for m in columns], axis=1)
        for s in (step, -step)
    )
    difference = (up - down) / (2.0 * step)
    # of the largest: that the spectrum softens with depth is left out
    assert np.max(np.abs(slopes - difference)) <= 0.15 * np.max(np.abs(difference))


@pytest.mark.parametrize("name", ["Co-60", "Cs-137", "Am-241"])
def test_slopes_by_leaves_are_those_of_what_surrounds(detectors: Detectors, name: str) -> None:
    """Leaves beside air and walls: neither of them makes the other more of a wall."""
    d = detectors["nai_1p5x1p5", "physical"]
    k, leaves = d.nuclide_names.index(name), d.material_names.index("vegetation")
    way, place, axis = ways(d, k, 24)
    crowns = jnp.asarray(np.random.default_rng(k).uniform(0.5, 12.0, 24), jnp.float32)
    assert way.shape is not None
    shape = replace(way.shape, thin_m=way.shape.thin_m.at[:, leaves].set(crowns))
    way = replace(way, length_m=way.length_m.at[:, leaves].set(crowns), shape=shape)
    _, slopes, _ = _with_slopes(d, source(k), way, place, axis, by=(leaves,))
    # of all regions together, to which it does not matter that the spectrum softens
    up, down = (
        np.sum(_each(d, jnp.int32(k), thicker(way, leaves, np.exp(s)), place, axis), axis=1) for s in (0.05, -0.05)
    )
    difference = (up - down) / 0.1
    found = np.sum(np.asarray(slopes)[:, 0], axis=1)
    assert np.max(np.abs(found - difference)) <= 0.03 * np.max(np.abs(difference))


def test_a_way_without_a_shape_has_wide_walls_and_no_ground(detectors: Detectors) -> None:
    d = detectors["nai_1p5x1p5", "physical"]
    way, place, axis = ways(d, 5, 6)
    shape = wide(way.length_m, jnp.zeros((6, 2)))
    columns = tuple(d.material_names.index(name) for name in ("air", "concrete"))
    found, expected = (
        _with_slopes(d, source(0), replace(way, shape=each), place, axis, by=columns) for each in (None, shape)
    )
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5 * float(jnp.max(jnp.abs(other))))


def test_few_lines_keep_the_counts_of_every_nuclide_behind_concrete(detectors: Detectors) -> None:
    full = detectors["nai_1p5x1p5", "physical"]
    few = coarse(full, LINES, MATERIALS)
    assert few.material_names == MATERIALS
    assert few.yields.shape == (len(full.nuclide_names), LINES)
    columns = jnp.array([full.material_names.index(name) for name in MATERIALS])
    way, place, axis = ways(full, 0, 200)
    assert way.shape is not None
    shape = replace(way.shape, thin_m=way.shape.thin_m[:, columns])
    less = Crossed(length_m=way.length_m[:, columns], place=way.place[:, columns], shape=shape)
    worst = {}
    for k, name in enumerate(full.nuclide_names):
        exact, found = (
            np.asarray(_each(d, jnp.int32(k), w, place, axis), float).sum(axis=1) for d, w in ((full, way), (few, less))
        )
        worst[name] = float(np.max(np.abs(found / exact - 1.0)))
    assert max(worst.values()) < 0.06, worst
    assert worst["Pu-239"] > 1e-3  # its lines are put together: the test could tell


def test_a_nuclide_with_few_lines_keeps_its_tables(detectors: Detectors) -> None:
    full = detectors["nai_1p5x1p5", "physical"]
    few = coarse(full, LINES, full.material_names)
    for name in ("Co-60", "Cs-137"):
        k = full.nuclide_names.index(name)
        way, place, axis = ways(full, k, 20)
        exact, found = (np.asarray(_each(d, jnp.int32(k), way, place, axis), float) for d in (full, few))
        np.testing.assert_allclose(found, exact, rtol=0.01, atol=1e-3 * exact.max())


def test_materials_without_a_table_are_refused(detectors: Detectors) -> None:
    with pytest.raises(ValueError, match="not in tuple"):
        coarse(detectors["nai_1p5x1p5", "physical"], LINES, ("air", "unobtainium"))
