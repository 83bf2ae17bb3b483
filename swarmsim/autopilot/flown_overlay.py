"""What a flight adds to its run's folder: the simulated track, the errors against it and the plan, pictures of all."""

from pathlib import Path
from typing import Any

import numpy as np

from swarmsim.autopilot.compare import Track, compare
from swarmsim.autopilot.flown import FlownLog
from swarmsim.autopilot.simulated_track import simulate, write_simulated
from swarmsim.playback.flown_figure import write_figure
from swarmsim.playback.overlay import Overlay
from swarmsim.playback.recording import write_recording
from swarmsim.results.names import FIGURES, RECORDING
from swarmsim.results.record import MissionRecord
from swarmsim.runtime.live import LiveMission
from swarmsim.runtime.simulation import Simulation


def flown_track(log: FlownLog, *, by_hand: bool = True) -> Track:
    """Where the vehicle was measured, on the mission's clock; with or without what was flown by hand."""
    rows = np.asarray(log.rows, np.float64)
    if not len(rows):
        return Track(np.zeros(0), np.zeros((0, 3)))
    known = np.isfinite(rows[:, 8:11]).all(axis=1) & np.r_[np.diff(rows[:, 0]) > 0.0, True]
    if not by_hand:
        known &= ~np.asarray(log.by_hand, bool)
    return Track(rows[known, 0], rows[known, 8:11])


def write_overlay(
    folder: Path, simulation: Simulation, live: LiveMission, record: MissionRecord, vehicle: str, log: FlownLog
) -> dict[str, Any]:
    """Fly the mission again with its own simulated vehicle and compare; returns what the errors sum up to.

    Writes the simulated track and the planned paths as tables, the figure ``flown``, and the recording anew, with all
    three tracks and the errors. ``record`` is that of the flight: ``live`` is taken back to the mission's beginning.
    Raises `LinkError` where the simulated vehicle is commanded what cannot be sent.
    """
    simulated, planned = simulate(simulation, live)
    flown, judged = flown_track(log), flown_track(log, by_hand=False)
    made = compare(judged, planned, simulated)
    offset = log.rows[0][0] - log.rows[0][1]  # from the flight's clock to the mission's
    marks = tuple((when + offset, f"{vehicle}: {what}") for when, what in log.events)
    overlay = Overlay(vehicle, flown, judged, made, planned, simulated, marks)
    write_simulated(folder, simulated, planned)
    write_figure(overlay, simulation.site_model, folder / FIGURES)
    new = folder / f"{RECORDING}.new"  # the viewer's old file stays whole until the new one is
    try:
        write_recording(record, simulation.site_model, new, overlay)
        new.replace(folder / RECORDING)
    finally:
        new.unlink(missing_ok=True)
    return made.report()
