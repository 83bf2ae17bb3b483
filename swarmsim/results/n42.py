"""A mission's measurements as ANSI N42.42-2012 documents: one for each vehicle with a detector, one for the spectrum.

The standard has one instrument to a document, so that every vehicle has its own: ``<vehicle>.n42`` with a
``RadMeasurement`` for each sample (spectrum, counts by energy window, ambient dose equivalent rate, place) and their
sum as ``DerivedData``. ``spectrum.n42`` has the spectrum near the source, its expected background and the nuclide.
"""

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from uuid import UUID

import numpy as np

from swarmsim.atomic_folder import atomic_folder
from swarmsim.config.errors import InputError
from swarmsim.config.names import one_of
from swarmsim.config.radiation import Detector as DetectorSpec
from swarmsim.results import n42_elements as n42
from swarmsim.results.counted import Counted
from swarmsim.results.n42_elements import Element
from swarmsim.results.names import N42
from swarmsim.results.out_folder import EXPORT, check_folder, told_of
from swarmsim.results.places import places_of
from swarmsim.results.record import Floats, Samples, Spectrum
from swarmsim.results.spectra import SampleSpectra, sample_spectra
from swarmsim.runtime.simulation import Simulation
from swarmsim.versions import package_versions
from swarmsim.world.model import World

SPECTRUM = "spectrum"
START = datetime(2000, 1, 1, tzinfo=UTC)
"""When missions start where nothing else is said: simulated time has no date."""
_SIMULATED = "Simulated by swarmsim: mission {name}, seed {seed}. Times count from the mission's start, {start}."
_DOSE = (
    "Dose rates are ambient dose equivalent rates derived from the counts by energy window (of a counter without "
    "energy resolution: from its counts, calibrated to Cs-137), background included."
)
_NO_SPECTRA = "The detector resolves no energies: there are counts alone, and no spectra."
_IDEALISED = "Counts of this idealised detector stand for the time told, which is longer than between two measurements."
_SPECTRA = "Spectra of samples were drawn after the flight: their sums over the energy windows are the counts recorded."


def write_n42(
    simulation: Simulation,
    counted: Counted,
    out: Path | str,
    *,
    vehicles: Sequence[str] | None = None,
    start: datetime = START,
    force: bool = False,
    world: World | None = None,
) -> tuple[Path, ...]:
    """Write the documents of one mission to the folder ``out``, all or none, and return their paths.

    Args:
        simulation: that flew the mission.
        counted: a `MissionRecord`, or what `read_counts` found in a run directory.
        out: folder, which must not exist unless ``force`` is given.
        vehicles: names of those whose samples are written; all with samples by default.
        start: when the mission began; UTC where it has no time zone.
        force: replace an earlier export.
        world: the mission's, if it was flown with other values than its seed's own.

    Raises:
        InputError: ``out`` cannot be used, a vehicle has no samples, or no vehicle has.
    """
    out, start = Path(out), start if start.tzinfo else start.replace(tzinfo=UTC)
    chosen = _chosen(simulation, counted, vehicles)
    with told_of(out), atomic_folder(out, partial(check_export, force=force)) as folder:
        for name in chosen:
            _write_vehicle(simulation, counted, name, folder / f"{name}{N42}", start, world)
        if counted.spectrum is not None:
            _write_spectrum(simulation, counted, counted.spectrum, folder / f"{SPECTRUM}{N42}", start)
        written = sorted(path.name for path in folder.iterdir())
    return tuple(out / name for name in written)


def _chosen(simulation: Simulation, counted: Counted, vehicles: Sequence[str] | None) -> list[str]:
    """Names of the vehicles whose samples are written."""
    names = [member.name for member in simulation.scenario.members]
    found = [names[number] for number in np.unique(counted.samples.vehicle)]
    if not found:
        raise InputError.of("no detector has measured anything in this mission", given=counted.name)
    for name in vehicles or ():
        if name not in found:
            raise InputError.of("there are no samples of this vehicle", given=name, allowed=one_of(found))
    return found if vehicles is None else list(dict.fromkeys(vehicles))


def check_export(out: Path, force: bool) -> None:
    """Raise `InputError` where the folder ``out`` cannot be made or replaced."""
    check_folder(out, force, EXPORT)


def _heading(counted: Counted, start: datetime, remarks: Sequence[str]) -> list[Element]:
    told = _SIMULATED.format(name=counted.name, seed=counted.seed, start=n42.moment(start, 0.0))
    return n42.heading((told, *remarks), _version())


def _version() -> str:
    return package_versions(())["swarmsim"]


def _uuid(*content: object) -> UUID:
    """An identifier of a document that the same content always has."""
    digest = hashlib.sha256()
    for part in content:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else str(part).encode())
    return UUID(bytes=digest.digest()[:16], version=4)


def _write_vehicle(
    simulation: Simulation, counted: Counted, name: str, path: Path, start: datetime, world: World | None
) -> None:
    number = next(k for k, member in enumerate(simulation.scenario.members) if member.name == name)
    mount = simulation.scenario.vehicles[number].detector
    assert mount is not None
    spec = simulation.scenario.detectors[mount.model]
    spectra = None if spec.spectrometer is None else sample_spectra(simulation, counted, name, world)
    samples = counted.samples.rows(counted.samples.vehicle == number) if spectra is None else spectra.samples
    meaning, located = places_of(simulation.site_model.report)
    remarks = [meaning, _DOSE, _NO_SPECTRA if spectra is None else _SPECTRA]
    remarks += [_IDEALISED] if simulation.scenario.mission.detection == "paper_ideal" else []
    vehicle = simulation.scenario.members[number].type
    uuid = _uuid(counted.name, counted.seed, name, start, samples.time_s, samples.position_m, samples.counts)
    with n42.document(path, uuid) as file:
        n42.write(file, _heading(counted, start, remarks))
        n42.write(file, [n42.instrument(name, vehicle, f"{vehicle} with {spec.name}", _version()), *n42.detector(spec)])
        n42.write(file, _measurements(samples, spectra, located(samples.position_m), counted, spec, start))
        if spectra is not None:
            n42.write(file, [_sum(spectra, start)])


def _measurements(
    samples: Samples,
    spectra: SampleSpectra | None,
    places: Sequence[Element],
    counted: Counted,
    spec: DetectorSpec,
    start: datetime,
) -> Iterator[Element]:
    """A measurement for each sample."""
    assert samples.live_s is not None
    assert samples.dose_rate_usv_h is not None
    counts = samples.counts[:, None] if spectra is None else _own_windows(samples, counted, spec)
    for k, place in enumerate(places):
        own, live, real = f"M{k + 1}", float(samples.live_s[k]), float(samples.exposure_s[k])
        live = min(live, real)
        content = [] if spectra is None else [n42.spectrum(f"{own}-S", live, n42.channel_data(spectra.counts[k]))]
        content += [
            n42.gross_counts(f"{own}-C", live, counts[k], by_window=spectra is not None),
            n42.dose_rate(f"{own}-D", float(samples.dose_rate_usv_h[k])),
            n42.instrument_state(place),
        ]
        begin = n42.moment(start, float(samples.time_s[k]) - real)
        yield n42.measurement("RadMeasurement", own, "Foreground", begin, real, content)


def _own_windows(samples: Samples, counted: Counted, spec: DetectorSpec) -> Floats:
    """Counts [n, R] by the windows of the detector ``spec``."""
    assert samples.windows is not None
    assert spec.spectrometer is not None
    edges = spec.spectrometer.rois_kev
    columns = [counted.windows_kev.index(window) for window in itertools.pairwise(edges)]
    return samples.windows[:, columns]


def _sum(spectra: SampleSpectra, start: datetime) -> Element:
    """The sum of a vehicle's samples."""
    samples = spectra.samples
    assert samples.live_s is not None
    real, live = float(samples.exposure_s.sum()), float(samples.live_s.sum())
    total = n42.spectrum("sum-S", min(live, real), n42.channel_data(spectra.counts.sum(axis=0, dtype=np.int64)))
    begin = n42.moment(start, float(samples.time_s[0] - samples.exposure_s[0]))
    remark = "Sum of all measurements above; its real time is the sum of theirs."
    return n42.measurement("DerivedData", "sum", "Foreground", begin, real, [total], remark)


def _write_spectrum(simulation: Simulation, counted: Counted, spectrum: Spectrum, path: Path, start: datetime) -> None:
    spec, live = simulation.scenario.detectors[spectrum.detector], float(spectrum.live_time_s)
    remark = (
        "The spectrum that the nuclide was identified by: summed over the samples of this detector model near the "
        "source, and drawn by itself, so that its total differs from theirs by statistics."
    )
    background = n42.element("ChannelData", n42.numbers(spectrum.background))
    begin = n42.moment(start, spectrum.begin_s)
    with n42.document(path, _uuid(counted.name, counted.seed, SPECTRUM, start, spectrum.counts)) as file:
        n42.write(file, _heading(counted, start, [remark]))
        n42.write(
            file, [n42.instrument("team", spec.name, f"all vehicles with {spec.name}", _version()), *n42.detector(spec)]
        )
        taken = [n42.spectrum("near-S", live, n42.channel_data(spectrum.counts))]
        n42.write(file, [n42.measurement("RadMeasurement", "near", "Foreground", begin, live, taken)])
        natural = [n42.spectrum("background-S", live, background)]
        n42.write(
            file, [n42.measurement("RadMeasurement", "background", "Background", begin, live, natural, "Expected.")]
        )
        n42.write(file, [n42.nuclide("near", spectrum.nuclide, float(spectrum.confidence), spectrum.sure)])
