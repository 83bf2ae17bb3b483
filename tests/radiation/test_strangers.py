"""Nuclides that are not looked for: their spectra, and what identification makes of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.load import load_named
from swarmsim.radiation import Detector, Library, build_detector, identify, restrict
from swarmsim.radiation.identify import UNKNOWN
from swarmsim.radiation.lines import DEPTHS, GAINS
from swarmsim.radiation.strangers import other_nuclides, others_than, shield_count
from swarmsim.radiation.templates import shielded, stranger_shares, tables
from tests.radiation.points import MOUNT

Detectors = dict[tuple[str, str], Detector]
MAIN_LINES = {"Sb-124": (602.7, 97.8), "Co-58": (810.8, 99.4), "In-111": (245.4, 94.1), "Au-198": (411.8, 95.6)}


@pytest.mark.parametrize("name", MAIN_LINES)
def test_main_lines_are_the_published_ones(name: str) -> None:
    energy, percent = MAIN_LINES[name]
    lines = next(nuclide for nuclide in other_nuclides() if nuclide.name == name).lines
    assert any(abs(x.energy_kev - energy) < 0.5 and abs(x.yield_percent / percent - 1.0) < 0.02 for x in lines)


def test_none_of_the_list_is_in_the_library(library: Library) -> None:
    names = [nuclide.name for nuclide in other_nuclides()]
    assert names == sorted(set(names))
    assert len(names) > 100
    assert not set(names) & set(library.nuclide_names)
    assert [nuclide.name for nuclide in others_than(["Sb-124"])] == [name for name in names if name != "Sb-124"]


def test_their_spectra_are_those_of_the_templates(detectors: Detectors) -> None:
    """The library's own nuclides by both ways, behind the shields that both have; half the summed differences."""
    detector = detectors["nai_2x2", "physical"]
    n, shields = len(detector.nuclide_names), shield_count(detector.material_names)
    templates = np.asarray(jax.jit(tables)(detector).sources)[:, :, 0].reshape(n, shields + 1, len(GAINS), -1)
    by_line = np.asarray(detector.known_spectrum).reshape(-1, shields, *templates.shape[2:])[:n]
    apart = 0.5 * np.abs(np.delete(templates, 2, axis=1) - by_line).sum(axis=-1)  # [n, shields, gains]
    assert shields == 2 + 4 * len(DEPTHS)
    assert np.mean(apart) < 0.035
    assert np.max(np.mean(apart, axis=(0, 2))) < 0.08
    assert np.sum(stranger_shares(detector)) == pytest.approx(1.0)


def test_what_is_left_out_is_a_stranger(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    n = len(detector.nuclide_names)
    assert np.asarray(detector.stranger).tolist() == [0.0] * n + [1.0] * (len(detector.known_names) - n)
    few = restrict(restrict(detector, ("Cs-137", "Co-60", "Am-241")), ("Co-60",))
    strangers = {name for name, is_one in zip(few.known_names, np.asarray(few.stranger), strict=True) if is_one}
    assert strangers == set(few.known_names) - {"Co-60"}


@pytest.mark.slow
def test_a_nuclide_of_the_list_is_unknown_and_named_as_alike(library: Library, detectors: Detectors) -> None:
    """600 counts each, bare and behind 5 mm of steel, on a background of twice the rate: no name of the library."""
    detector, names = detectors["nai_2x2", "physical"], ("Sb-124", "Tl-201", "In-111", "Co-58", "Au-198", "Y-88")
    own = tuple(nuclide for nuclide in other_nuclides() if nuclide.name in names)
    other = build_detector(load_named("detectors", "nai_2x2"), MOUNT, Library(own, library.materials), "physical")
    steel = jnp.arange(len(other.material_names)) == other.material_names.index("steel")
    rng, live = np.random.default_rng(3), 600.0 / (0.5 * float(detector.background_cps))
    run = jax.jit(identify)
    for number, nuclide in enumerate(own):
        for wall_m in (0.0, 0.005):
            shape = np.asarray(shielded(other, jnp.int32(number), wall_m * steel), np.float64)
            mean = 600.0 * shape / shape.sum() + live * np.asarray(detector.background_spectrum)
            found = run(detector, jnp.asarray(rng.poisson(mean), jnp.float32), jnp.float32(live))
            assert int(found.nuclide) == UNKNOWN
            assert detector.known_names[int(found.stranger)] == nuclide.name
            assert float(found.alike) > 0.5
