"""Detector samples of a mission from the readings of its groups: counts by energy window, and dose rates."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from swarmsim.kept import kept
from swarmsim.radiation.dose_operator import DoseOperator, dose_operator
from swarmsim.radiation.library import Library
from swarmsim.radiation.rate import most_shown
from swarmsim.results.record import Phase, Samples, Window
from swarmsim.results.saturation import saturated
from swarmsim.runtime.simulation import Simulation
from swarmsim.world.model import Group

SAMPLE = ("time_s", "position_m", "axis", "counts", "exposure_s")
"""Columns that samples have in common with readings."""
READ = (*SAMPLE, "rois")

_kept_operator = kept(16)(dose_operator)
"""It takes a tenth of a second, and all missions of a batch have the same."""


def windows_of(simulation: Simulation) -> tuple[Window, ...]:
    """The energy windows in keV of the team's detectors, lowest first; none where they resolve no energies."""
    scenario = simulation.scenario
    specs = [scenario.detectors[spec.detector.model] for spec in scenario.vehicles if spec.detector is not None]
    edges = {spec.spectrometer.rois_kev for spec in specs if spec.spectrometer is not None}
    return tuple(sorted({window for each in edges for window in pairwise(each)}))


def operator_of(simulation: Simulation, number: int) -> DoseOperator:
    """How the detector of vehicle ``number`` tells the dose rate, by its nominal data."""
    scenario = simulation.scenario
    mount = scenario.vehicles[number].detector
    assert mount is not None
    library = Library(nuclides=(), materials=tuple(scenario.materials.values()))
    return _kept_operator(scenario.detectors[mount.model], library, scenario.mission.detection)


def measured_rows(simulation: Simulation, group: Group, rows: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of `Samples` apart from ``phase``, from readings of a group with the columns `READ` and ``vehicle``."""
    operator = operator_of(simulation, int(np.asarray(group.member)[0]))
    counts = np.asarray(rows["rois"], float)
    rates = operator.rates(counts, np.asarray(rows["exposure_s"], float))
    windows = windows_of(simulation)
    by_window = np.full((len(counts), len(windows)), np.nan)
    own = list(pairwise(operator.edges_kev))
    by_window[:, [windows.index(window) for window in own]] = counts[:, : len(own)]
    mount = simulation.scenario.vehicles[int(np.asarray(group.member)[0])].detector
    assert mount is not None
    background = simulation.scenario.detectors[mount.model].background.rate_cps
    return {name: rows[name] for name in (*SAMPLE, "vehicle")} | {
        "highest_cps": np.full(len(counts), most_shown(operator.paralyzable_s, operator.non_paralyzable_s)),
        "quiet_cps": np.full(len(counts), background if operator.paralyzable_s > 0.0 else 0.0),
        "windows": by_window,
        "live_s": rates.live_s,
        "dose_rate_usv_h": rates.ambient_usv_h,
        "dose_rate_std_usv_h": rates.ambient_std_usv_h,
        "kerma_rate_ugy_h": rates.kerma_ugy_h,
    }


def samples_of(found: Sequence[Mapping[str, np.ndarray]], phases: Sequence[Phase]) -> Samples:
    """Samples in the order of time, from parts as `measured_rows` makes them."""
    if not found:
        nothing = np.zeros(0)
        return Samples(np.zeros(0, np.int32), np.zeros(0, str), nothing, np.zeros((0, 3)), nothing, nothing, nothing)
    joined = {name: np.concatenate([rows[name] for rows in found]) for name in found[0]}
    order = np.argsort(joined["time_s"], kind="stable")
    rows = {name: values[order] for name, values in joined.items()}
    highest, quiet = rows.pop("highest_cps"), rows.pop("quiet_cps")
    exposure_s = np.asarray(rows["exposure_s"], float)
    return Samples(
        phase=_phase_names(rows["vehicle"], rows["time_s"], phases),
        count_rate_cps=rows["counts"] / rows["exposure_s"],
        saturated=saturated(rows["vehicle"], np.asarray(rows["counts"], float), exposure_s, highest, quiet),
        **rows,
    )


def _phase_names(vehicle: np.ndarray, time_s: np.ndarray, phases: Sequence[Phase]) -> np.ndarray:
    """Name of the phase [n] that a vehicle was in: of those that it has a part in, the one that began last."""
    names = np.full(len(vehicle), "", dtype=f"<U{max([1, *(len(p.name) for p in phases)])}")
    for phase in sorted(phases, key=lambda p: p.start_s):
        names[np.isin(vehicle, phase.vehicles) & (time_s > phase.start_s)] = phase.name
    return names
