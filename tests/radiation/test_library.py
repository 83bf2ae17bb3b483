"""Nuclides, materials and their tables."""

from pathlib import Path

import numpy as np
import pytest

from swarmsim.config.errors import InputError
from swarmsim.config.files import packaged_dir
from swarmsim.config.load import load_model, load_named
from swarmsim.config.radiation import Detector, Material
from swarmsim.radiation import Library, build_detector, load_library
from swarmsim.radiation.attenuation import coefficients, linear_attenuation, mass_attenuation
from tests.radiation.points import MOUNT

# NIST tables at 59.5, 662, 1173 and 1332 keV, cm2/g
NIST = {
    "air": (0.188, 0.0771, 0.0587, 0.0550),
    "water": (0.207, 0.0857, 0.0653, 0.0612),
    "concrete": (0.269, 0.0788, 0.0600, 0.0562),
    "brick": (0.266, 0.0772, 0.0587, 0.0551),
    "steel": (1.230, 0.0735, 0.0553, 0.0518),
    "lead": (5.12, 0.1111, 0.0620, 0.0564),
    "wood": (0.195, 0.0816, 0.0622, 0.0583),
    "soil": (0.325, 0.0768, 0.0584, 0.0548),
    "sodium_iodide": (6.58, 0.0769, 0.0536, 0.0500),
}
LINES = {
    "Co-60": ((1173.2, 99.85), (1332.5, 99.98)),
    "Cs-137": ((661.7, 85.0),),
    "Ir-192": ((316.5, 82.8), (468.1, 47.8), (308.5, 29.7), (296.0, 28.7)),
    "Ba-133": ((356.0, 62.1), (81.0, 32.9), (302.9, 18.3)),
    "Am-241": ((59.5, 36.0),),
    "Eu-152": ((121.8, 28.4), (344.3, 26.6), (1408.0, 20.8)),
    "Na-22": ((1274.5, 99.94), (511.0, 180.0)),
    "I-131": ((364.5, 81.2),),
    "K-40": ((1460.8, 10.66),),
}
YEAR_S, DAY_S = 3.15576e7, 86400.0
HALF_LIVES_S = {"Co-60": 5.2713 * YEAR_S, "Cs-137": 30.17 * YEAR_S, "I-131": 8.02 * DAY_S, "Ir-192": 73.83 * DAY_S}


@pytest.mark.parametrize("name", NIST)
def test_mass_attenuation_is_nists(library: Library, name: str) -> None:
    values = mass_attenuation(library.material(name), [59.5, 662.0, 1173.0, 1332.0])
    np.testing.assert_allclose(values, NIST[name], rtol=0.008)


@pytest.mark.parametrize("name", LINES)
def test_main_lines(library: Library, name: str) -> None:
    lines = library.nuclide(name).lines
    for energy, percent in LINES[name]:
        found = sum(x.yield_percent for x in lines if abs(x.energy_kev - energy) < 0.3)
        assert found == pytest.approx(percent, rel=0.005)


@pytest.mark.parametrize("name", HALF_LIVES_S)
def test_half_lives(library: Library, name: str) -> None:
    assert library.nuclide(name).half_life_s == pytest.approx(HALF_LIVES_S[name], rel=0.002)


def test_absorption_edge_is_a_step(library: Library) -> None:
    below, above = mass_attenuation(library.material("lead"), [88.0, 88.01])
    assert above / below == pytest.approx(7.683 / 1.910, rel=0.01)


def test_density_enters_linearly(library: Library) -> None:
    concrete = library.material("concrete")
    assert float(linear_attenuation(concrete, 662.0)) == pytest.approx(18.1, rel=0.01)  # 1.81 mean free paths in 10 cm
    doubled = concrete.model_copy(update={"density_kg_m3": 2 * concrete.density_kg_m3})
    assert linear_attenuation(doubled, 662.0) == pytest.approx(2 * linear_attenuation(concrete, 662.0))


def test_names_are_sorted_and_unknown_ones_refused(library: Library) -> None:
    assert list(library.nuclide_names) == sorted(library.nuclide_names)
    assert list(library.material_names) == sorted(library.material_names)
    with pytest.raises(InputError, match="Co-60"):
        library.nuclide("Co60")
    with pytest.raises(InputError, match="concrete"):
        library.material("concreet")


def test_a_line_beyond_a_table_is_an_error(library: Library) -> None:
    with pytest.raises(InputError, match="reach from 20 to 10000 keV"):
        mass_attenuation(library.material("air"), 15_000.0)


def test_new_files_are_found_without_code(library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in ("nuclides", "materials"):
        (tmp_path / "configs" / kind).mkdir(parents=True)
    (tmp_path / "configs/nuclides/Zr-95.yaml").write_text(
        "name: Zr-95\nhalf_life_s: 5.532e6\nsource: test\nlines: [{energy_kev: 756.7, yield_percent: 54.4}]\n"
    )
    (tmp_path / "configs/materials/sand.yaml").write_text(
        "name: sand\ndensity_kg_m3: 1600\nsource: test\ncomposition: {Si: 0.4674, O: 0.5326}\n"
    )
    monkeypatch.chdir(tmp_path)
    extended = load_library()
    assert set(extended.nuclide_names) - set(library.nuclide_names) == {"Zr-95"}
    assert set(extended.material_names) - set(library.material_names) == {"sand"}
    detector = build_detector(load_named("detectors", "nai_2x2"), MOUNT, extended, "physical")
    assert "Zr-95" in detector.nuclide_names
    assert "sand" in detector.material_names


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("{H: 0.0221", "{Hh: 0.0221", "no element Hh"),
        ("{H: 0.0221", "{H: 0.221", "add up to"),
        ("{H: 0.0221", "{H: -0.0221", "composition.H"),
        ("density_kg_m3: 2300", "density_kg_m3: -1", "density_kg_m3"),
    ],
)
def test_malformed_material(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (packaged_dir() / "materials/concrete.yaml").read_text()
    assert old in text
    (tmp_path / "concrete.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        load_model(tmp_path / "concrete.yaml", Material)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("model: paralyzable", "model: non_paralyzable", "hybrid"),
        (
            "crystal: sodium_iodide",
            "efficiency: [{energy_kev: 60, efficiency: 0.1}, {energy_kev: 662, efficiency: 0.01}]",
            "no energy resolution",
        ),
        ("crystal: sodium_iodide\n", "", "give crystal"),
        ("threshold_kev: 30.0", "threshold_kev: 3000.0", "below"),
    ],
)
def test_malformed_detector(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (packaged_dir() / "detectors/nai_2x2.yaml").read_text()
    assert old in text
    (tmp_path / "nai_2x2.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        load_model(tmp_path / "nai_2x2.yaml", Detector)


@pytest.mark.parametrize("name", ["nai_1p5x1p5", "nai_2x2"])
def test_every_number_of_a_detector_has_a_source(name: str) -> None:
    spec = load_named("detectors", name)
    covered = {key.split(".")[0] for key in spec.sources}
    assert covered == {key for key, value in spec if value is not None} - {"name", "sources"}
    assert {f"background.{k}" for k in type(spec.background).model_fields} <= set(spec.sources)


def test_incoherent_scattering_is_that_of_free_electrons_at_high_energy(library: Library) -> None:
    """Klein-Nishina at 662 keV: 0.2563 barn per electron (Hubbell 1975); water has 0.5551 mol of electrons per gram."""
    found = coefficients(library.material("water"), 662.0).incoherent
    assert float(found) == pytest.approx(0.2563 * 0.602214 * 0.5551, rel=0.003)


def test_pair_production_begins_at_its_threshold(library: Library) -> None:
    lead = library.material("lead")
    below, above, published = coefficients(lead, [1000.0, 1100.0, 2000.0]).pair
    assert below == 0.0
    assert 0.0 < above < 0.001
    assert published == pytest.approx((1.875 + 0.0) * 0.602214 / 207.2, rel=0.01)  # barn per atom, XCOM
