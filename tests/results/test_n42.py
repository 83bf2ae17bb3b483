"""Counts of a flown mission by energy window, its spectra and its N42.42 documents."""

import dataclasses
import json
import re
from collections.abc import Callable
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow.parquet as pq
import pytest

import swarmsim
from swarmsim.cli import main
from swarmsim.config.errors import InputError
from swarmsim.results import run_directory
from swarmsim.results.counted import read_counts
from swarmsim.results.n42 import write_n42
from swarmsim.results.n42_elements import NAMESPACE, channel_data, duration, moment
from swarmsim.results.places import geographic, places_of
from swarmsim.results.spectra import SampleSpectra, sample_spectra
from swarmsim.results.summary import summary
from tests import synthetic
from tests.results.n42_reader import FREE, NAME, channels, check_order, texts

MISSION = """
name: stand
site: meadows
engine: analytic
seed: 3
timing: {decision_period_s: 0.5}
sources: [{nuclide: Cs-137, position_m: [-200, 60], height_m: 0.5, activity_mbq: 3000}]
vehicles:
  - {name: near, type: tarot_t650, position_m: [-197, 60]}
  - {name: far, type: tarot_t650, position_m: [-190, 40]}
  - {name: tube, type: tube_t650, position_m: [-180, 60]}
phases: [{name: wait, who: all, policy: hold, time_limit_s: 3}]
"""
TUBE = """
extends: tarot_t650
name: tube_t650
detector: {model: geiger_sbm20, position_m: [0.0, 0.0, -0.1], axis: [0.0, 0.0, 1.0]}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("stand")
    (made / "configs" / "vehicles").mkdir(parents=True)
    (made / "configs" / "missions").mkdir()
    (made / "configs" / "vehicles" / "tube_t650.yaml").write_text(TUBE, encoding="utf-8")
    (made / "configs" / "missions" / "stand.yaml").write_text(MISSION, encoding="utf-8")
    return made


@pytest.fixture(scope="module")
def simulation(folder: Path) -> swarmsim.Simulation:
    return swarmsim.build(swarmsim.load(folder / "configs" / "missions" / "stand.yaml"))


@pytest.fixture(scope="module")
def record(simulation: swarmsim.Simulation) -> swarmsim.MissionRecord:
    made = swarmsim.mission_record(simulation, simulation.rollout(3), 0)
    spectrum = synthetic.mission(log_hz=5.0, sample_hz=2.0).spectrum
    return dataclasses.replace(made, spectrum=dataclasses.replace(spectrum, detector="nai_1p5x1p5"))


@pytest.fixture(scope="module")
def run(simulation: swarmsim.Simulation, record: swarmsim.MissionRecord, folder: Path) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_directory.figures, "write", lambda record, site, path: path.mkdir())
        patch.setattr(run_directory, "write_recording", lambda record, site, path: path.write_bytes(b"rrd"))
        swarmsim.write_run(simulation, [record], folder / "run")
    return folder / "run"


@pytest.fixture(scope="module")
def near(simulation: swarmsim.Simulation, record: swarmsim.MissionRecord) -> SampleSpectra:
    return sample_spectra(simulation, record, "near")


@pytest.fixture(scope="module")
def documents(run: Path) -> dict[str, ElementTree.Element]:
    assert main(["export-n42", str(run), "--start", "2026-05-04T09:30:00"]) == 0
    return {path.stem: ElementTree.parse(path).getroot() for path in (run / "n42").iterdir()}


def test_every_exposure_is_logged_with_its_windows(record: swarmsim.MissionRecord) -> None:
    samples = record.samples
    for number, period, resolves in ((0, 0.09, True), (1, 0.09, True), (2, None, False)):
        own = samples.rows(samples.vehicle == number)
        if period is not None:
            np.testing.assert_allclose(own.time_s, period * np.arange(1, len(own.time_s) + 1), atol=1e-4)
            assert len(own.time_s) == int(3.0 / period + 1e-6)
            np.testing.assert_array_equal(own.windows.sum(axis=1), own.counts)
        assert len(own.time_s)
        assert np.isfinite(own.windows).all() == resolves
        assert np.isnan(own.windows).all() != resolves
        assert np.all(own.live_s <= own.exposure_s)
        assert np.all(own.dose_rate_usv_h >= 0.0)
        assert np.all(own.kerma_rate_ugy_h <= own.dose_rate_usv_h)
    assert len(record.windows_kev) == 14


def test_dose_rates_are_those_of_the_source(record: swarmsim.MissionRecord) -> None:
    """92.7 uSv/h from 1 GBq of Cs-137 in 1 m (Otto, 2016), and a background of some 0.1 uSv/h."""
    samples, (source,) = record.samples, record.sources
    for number in range(2):  # a tube has too few counts, and counts scattered photons too high
        own = samples.rows(samples.vehicle == number)
        squared = ((own.position_m - source.position_m) ** 2).sum(axis=1)
        expected = np.mean(92.7 * source.activity_mbq / 1000 / squared) + 0.15
        mean = own.dose_rate_usv_h @ own.exposure_s / own.exposure_s.sum()
        assert mean == pytest.approx(expected, rel=0.2)
    told = summary(record, swarmsim.results.summary.Timings())
    assert told["true_sources"][0]["dose_rate_1m_usv_h"] == pytest.approx(92.7 * 3.0, rel=0.02)
    assert told["dose_rate"]["vehicle"] == "near"
    surely = samples.dose_rate_usv_h - 2.0 * samples.dose_rate_std_usv_h
    assert told["dose_rate"]["greatest_usv_h"] == pytest.approx(samples.dose_rate_usv_h[np.argmax(surely)])
    assert json.dumps(told["dose_rate"])
    assert told["dose_rate"]["greatest_std_usv_h"] > 0.0
    assert not told["dose_rate"]["lower_bounds"]
    saturated = summary(dataclasses.replace(record, status="saturated"), swarmsim.results.summary.Timings())[
        "dose_rate"
    ]
    assert saturated["greatest_std_usv_h"] is None
    assert saturated["lower_bounds"]


def test_spectra_keep_the_counts_of_every_window(
    simulation: swarmsim.Simulation, record: swarmsim.MissionRecord, near: SampleSpectra
) -> None:
    assert near.counts.shape == (len(near.samples.time_s), len(near.edge_kev) - 1)
    centre = 0.5 * (near.edge_kev[1:] + near.edge_kev[:-1])
    ends = [-np.inf, *(window[1] for window in record.windows_kev[:-1]), np.inf]
    for number, (low, high) in enumerate(pairwise(ends)):
        inside = (centre > low) & (centre <= high)
        np.testing.assert_array_equal(near.counts[:, inside].sum(axis=1), near.samples.windows[:, number])
    again = sample_spectra(simulation, record, "near")
    np.testing.assert_array_equal(again.counts, near.counts)


def test_spectra_have_the_shape_that_is_expected(near: SampleSpectra) -> None:
    """The photopeak of Cs-137 fills the middle of its window, not all of it (7 % resolution: 20 keV)."""
    centre = 0.5 * (near.edge_kev[1:] + near.edge_kev[:-1])
    total = near.counts.sum(axis=0)
    peak = np.abs(centre - 661.7) < 30.0
    assert total[peak].sum() > 3 * total[np.abs(centre - 740.0) < 30.0].sum() > 0
    assert np.average(centre[peak], weights=total[peak]) == pytest.approx(661.7, abs=4.0)


def test_a_counter_without_energies_has_no_spectra(
    simulation: swarmsim.Simulation, record: swarmsim.MissionRecord
) -> None:
    with pytest.raises(InputError, match="no spectrometer"):
        sample_spectra(simulation, record, "tube")
    with pytest.raises(InputError, match=r"(?s)no such vehicle.*near"):
        sample_spectra(simulation, record, "nobody")


def test_the_run_has_it_all_as_tables(run: Path, record: swarmsim.MissionRecord) -> None:
    table = pq.read_table(run / "measurements.parquet")
    samples = record.samples
    resolved = samples.vehicle < 2
    for number, window in enumerate(record.windows_kev):
        values = table[f"counts_{window[0]:g}_{window[1]:g}_kev"].to_pylist()
        assert [v for v, own in zip(values, resolved, strict=True) if own] == samples.windows[resolved, number].tolist()
        assert {v for v, own in zip(values, resolved, strict=True) if not own} == {None}
    np.testing.assert_allclose(table["dose_rate_usv_h"].to_numpy(), samples.dose_rate_usv_h, rtol=1e-6)
    spectrum = pq.read_table(run / "spectrum.parquet")
    np.testing.assert_array_equal(spectrum["counts"].to_numpy(), record.spectrum.counts)
    np.testing.assert_array_equal(spectrum["energy_kev"].to_numpy(), record.spectrum.energy_kev)
    assert float(spectrum.schema.metadata[b"live_time_s"]) == record.spectrum.live_time_s


def test_counts_are_read_back(run: Path, record: swarmsim.MissionRecord) -> None:
    read = read_counts(run)
    assert (read.name, read.seed, read.windows_kev) == (record.name, record.seed, record.windows_kev)
    for name in ("vehicle", "counts", "windows", "phase", "time_s"):
        np.testing.assert_array_equal(getattr(read.samples, name), getattr(record.samples, name))
    np.testing.assert_array_equal(read.spectrum.counts, record.spectrum.counts)


def test_documents_follow_the_schema(documents: dict[str, ElementTree.Element]) -> None:
    assert set(documents) == {"near", "far", "tube", "spectrum"}
    for root in documents.values():
        identifiers = [element.get("id") for element in root.iter() if element.get("id")]
        assert len(set(identifiers)) == len(identifiers)
        for element in root.iter():
            tag = element.tag.removeprefix(f"{{{NAMESPACE}}}")
            children = [child.tag.removeprefix(f"{{{NAMESPACE}}}") for child in element]
            if tag == "RadInstrumentData":
                first = next(k for k, child in enumerate(children) if child in FREE)
                assert set(children[first:]) <= FREE
                children = children[:first]
            check_order(tag, children)
            if tag.endswith(("Name", "Identifier", "Version")) and not children:
                assert re.fullmatch(NAME, element.text), element.text
            for name, value in element.attrib.items():
                if name.endswith(("Reference", "References")):
                    assert set(value.split()) <= set(identifiers)


def test_documents_hold_the_counts(
    documents: dict[str, ElementTree.Element], record: swarmsim.MissionRecord, near: SampleSpectra
) -> None:
    root, samples = documents["near"], near.samples
    spectra = [channels(text) for text in texts(root, "RadMeasurement/Spectrum/ChannelData")]
    np.testing.assert_array_equal(spectra, near.counts)
    windows = [np.array(text.split(), float) for text in texts(root, "RadMeasurement/GrossCounts/CountData")]
    np.testing.assert_array_equal(windows, samples.windows)
    np.testing.assert_array_equal(channels(texts(root, "DerivedData/Spectrum/ChannelData")[0]), near.counts.sum(axis=0))
    doses = np.array(texts(root, "RadMeasurement/DoseRate/DoseRateValue"), float)
    np.testing.assert_allclose(doses, samples.dose_rate_usv_h, rtol=1e-4)
    seconds = [
        (datetime.fromisoformat(text) - datetime.fromisoformat("2026-05-04T09:30:00+00:00")).total_seconds()
        for text in texts(root, "RadMeasurement/StartDateTime")
    ]
    np.testing.assert_allclose(seconds, samples.time_s - samples.exposure_s, atol=1e-3)
    live = [float(text[2:-1]) for text in texts(root, "RadMeasurement/Spectrum/LiveTimeDuration")]
    np.testing.assert_allclose(live, samples.live_s, atol=1e-5)
    assert not texts(documents["tube"], "RadMeasurement/Spectrum/ChannelData")
    tube = record.samples.rows(record.samples.vehicle == 2)
    assert [float(t) for t in texts(documents["tube"], "RadMeasurement/GrossCounts/CountData")] == tube.counts.tolist()
    assert texts(documents["spectrum"], "AnalysisResults/NuclideAnalysisResults/Nuclide/NuclideName") == ["Co-60"]


def test_places_are_relative_to_the_site(documents: dict[str, ElementTree.Element], near: SampleSpectra) -> None:
    path = "RadMeasurement/RadInstrumentState/StateVector/RelativeLocation"
    azimuth, inclination, distance = (
        np.array(texts(documents["near"], f"{path}/{name}"), float)
        for name in ("RelativeLocationAzimuthValue", "RelativeLocationInclinationValue", "DistanceValue")
    )
    level = distance * np.cos(np.radians(inclination))
    east, north = level * np.sin(np.radians(azimuth)), level * np.cos(np.radians(azimuth))
    found = np.stack([east, north, distance * np.sin(np.radians(inclination))], axis=1)
    np.testing.assert_allclose(found, near.samples.position_m, atol=2e-3)


def test_places_of_a_site_with_a_projection_are_on_the_globe() -> None:
    """500 km east in UTM zone 33 is the meridian 15 E, along which a metre is a metre times 0.9996."""
    reference = {"crs": "EPSG:32633", "easting_m": 5e5, "northing_m": 5.4e6, "elevation_m": 300.0}
    reference |= {"metres_per_projected_metre": 1.0 / 0.9996}
    places = np.array([[0.0, 0.0, 0.0], [0.0, 1000.0, 20.0], [1000.0, 0.0, 0.0]])
    latitude, longitude, elevation = geographic(reference, places)
    np.testing.assert_allclose(longitude[:2], 15.0, atol=1e-9)
    assert latitude[1] - latitude[0] == pytest.approx(1000.0 / 111_212.0, rel=1e-3)
    assert longitude[2] - longitude[0] == pytest.approx(
        1000.0 / (111_320.0 * np.cos(np.radians(latitude[0]))), rel=3e-3
    )
    np.testing.assert_allclose(elevation, [300.0, 320.0, 300.0])
    meaning, located = places_of({"georeference": reference})
    assert "WGS 84" in meaning
    assert [child.tag for child in located(places)[0]] == ["LatitudeValue", "LongitudeValue", "ElevationValue"]


@pytest.mark.parametrize(
    ("counts", "text"),
    [
        ([22, 5, 0, 2, 1, 0, 0, 3, 4, 0, 0, 0, 0, 0, 0, 0, 0, 1], "22 5 0 1 2 1 0 2 3 4 0 8 1"),  # of the standard
        ([0, 0, 0], "0 3"),
        ([0, 7, 0], "0 1 7 0 1"),
        ([1], "1"),
    ],
)
def test_counted_zeroes(counts: list[int], text: str) -> None:
    assert channel_data(counts).text == text
    np.testing.assert_array_equal(channels(text), counts)


def test_times() -> None:
    assert [duration(s) for s in (0.09, 1.0, 0.0899982, 0.0)] == ["PT0.09S", "PT1S", "PT0.089998S", "PT0S"]
    assert moment(datetime.fromisoformat("2026-05-04T11:30:00+02:00"), 0.0005) == "2026-05-04T09:30:00.000Z"


def leave(_: Path) -> None:
    """Change nothing."""


def without_windows(run: Path) -> None:
    table = pq.read_table(run / "measurements.parquet")
    pq.write_table(
        table.select(["vehicle", "phase", "time_s"]).replace_schema_metadata({}), run / "measurements.parquet"
    )


def broken(run: Path) -> None:
    (run / "measurements.parquet").write_bytes(b"not a table")


def occupied(run: Path) -> None:
    (run / "n42").mkdir()
    (run / "n42" / "thesis.tex").touch()


@pytest.mark.parametrize(
    ("spoil", "arguments", "text"),
    [
        (leave, ["--vehicle", "nobody"], "no samples of this vehicle"),
        (without_windows, [], "no counts by energy window"),
        (broken, [], "cannot be read as a table"),
        (occupied, ["--force"], "something else than an export"),
        (lambda run: (run / "measurements.parquet").unlink(), [], "not the folder of a run"),
        (lambda run: (run / "scenario.yaml").unlink(), [], "not the folder of a run"),
    ],
)
def test_wrong_input_ends_with_a_sentence(
    run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[Path], None],
    arguments: list[str],
    text: str,
) -> None:
    copy = tmp_path / "run"
    copy.mkdir()
    for name in ("scenario.yaml", "measurements.parquet"):
        (copy / name).write_bytes((run / name).read_bytes())
    spoil(copy)
    before = set(copy.rglob("*"))
    assert main(["export-n42", str(copy), *arguments]) == 2
    assert text in capsys.readouterr().err
    assert set(copy.rglob("*")) == before


def test_an_export_is_replaced_only_if_asked(simulation: swarmsim.Simulation, record, tmp_path: Path) -> None:
    paths = write_n42(simulation, record, tmp_path / "n42", vehicles=["tube"])
    assert [path.name for path in paths] == ["spectrum.n42", "tube.n42"]
    with pytest.raises(InputError, match=r"(?s)already, an export.*--force"):
        write_n42(simulation, record, tmp_path / "n42")
    write_n42(simulation, dataclasses.replace(record, spectrum=None), tmp_path / "n42", vehicles=["tube"], force=True)
    assert [path.name for path in (tmp_path / "n42").iterdir()] == ["tube.n42"]


def test_the_spectrum_near_the_source_began_with_its_first_sample(
    simulation: swarmsim.Simulation, record, tmp_path: Path
) -> None:
    later = dataclasses.replace(record, spectrum=dataclasses.replace(record.spectrum, begin_s=73.5))
    start = datetime.fromisoformat("2026-05-04T09:30:00+00:00")
    path = write_n42(simulation, later, tmp_path / "n42", vehicles=["tube"], start=start)[0]
    begun = texts(ElementTree.parse(path).getroot(), "RadMeasurement/StartDateTime")[0]
    assert (datetime.fromisoformat(begun) - start).total_seconds() == pytest.approx(73.5)


def test_a_mission_without_samples_says_so(simulation: swarmsim.Simulation, record, tmp_path: Path) -> None:
    nothing = dataclasses.replace(record, samples=record.samples.rows(slice(0, 0)))
    with pytest.raises(InputError, match="no detector has measured"):
        write_n42(simulation, nothing, tmp_path / "n42")
    assert not (tmp_path / "n42").exists()
