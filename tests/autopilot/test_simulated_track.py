"""The simulated track of a flight: collected from a rehearsal, written and read back."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from swarmsim.autopilot.compare import Planned, Simulated, Track
from swarmsim.autopilot.flown import FlownLog
from swarmsim.autopilot.flown_overlay import flown_track
from swarmsim.autopilot.link import Setpoint, Telemetry
from swarmsim.autopilot.simulated_track import (
    PLANNED,
    SIMULATED,
    has_simulated,
    read_simulated,
    simulate,
    write_simulated,
)
from swarmsim.config.errors import InputError
from swarmsim.control.commands import PositionCommand

LINES = [np.array([[0.0, 0, 5], [10, 0, 5]]), np.array([[10.0, 0, 5], [10, 10, 5]])]


@dataclass
class FakeMission:
    """A vehicle that flies line 0 for 5 s, waits for 2 s, and then flies line 1 for 5 s; 20 steps a second."""

    tick: int = 0

    def start(self):
        self.tick = 0

    def begin_phases(self):
        return ()

    @property
    def time_s(self):
        return self.tick / 20.0

    def phase(self):
        return 0 if self.time_s <= 5.0 else 1 if 7.0 < self.time_s <= 12.0 else None

    def has_phase_to_come(self):
        return self.time_s <= 7.0

    def path_m(self):
        return LINES[0 if self.time_s < 6.0 else 1]

    def body(self):
        along = min(2.0 * self.time_s, 10.0)
        more = np.clip(2.0 * (self.time_s - 7.0), 0.0, 10.0)
        return SimpleNamespace(position_m=np.array([along, more, 5.0]))

    def step(self, body, battery):
        del body, battery
        time_s = self.time_s
        self.tick += 1
        command = PositionCommand(
            position_m=np.zeros(3), velocity_m_s=np.zeros(3), acceleration_m_s2=np.zeros(3), yaw_rad=np.zeros(()),
            hold_position=np.ones(()),
        )  # fmt: skip
        return SimpleNamespace(time_s=time_s, command=command, begins=(), over=False, in_phase=self.phase() is not None)


def test_a_rehearsal_gives_track_and_paths_of_every_phase():
    mission = SimpleNamespace(seed=7, phases=[SimpleNamespace(time_limit_s=100.0)])
    phases = [SimpleNamespace(name="out"), SimpleNamespace(name="up")]
    simulation = SimpleNamespace(scenario=SimpleNamespace(mission=mission), plan=SimpleNamespace(phases=phases))
    found, planned = simulate(simulation, FakeMission())
    assert [path.phase for path in planned] == ["out", "up"]
    np.testing.assert_array_equal(planned[1].points_m, LINES[1])
    assert found.seed == 7
    assert found.track.time_s[-1] == pytest.approx(12.0, abs=0.1)
    assert not ((found.track.time_s > 5.1) & (found.track.time_s < 6.9)).any()
    assert found.phase[0] == 0
    assert found.phase[-1] == 1


def test_tables_are_read_back(tmp_path):
    time = np.arange(0.0, 5.0, 0.05)
    track = Track(time, np.stack([time, -time, 0.5 * time], axis=1))
    phase = np.where(time < 2.0, 0, np.where(time < 3.0, -1, 1))
    planned = (Planned("out", LINES[0]), Planned("up", LINES[1]))
    assert not has_simulated(tmp_path)
    write_simulated(tmp_path, Simulated(track, phase, 11), planned)
    assert has_simulated(tmp_path)
    found, paths = read_simulated(tmp_path)
    np.testing.assert_array_equal(found.track.position_m, track.position_m)
    np.testing.assert_array_equal(found.phase, phase)
    assert found.seed == 11
    assert [path.phase for path in paths] == ["out", "up"]
    np.testing.assert_array_equal(paths[1].points_m, LINES[1])


def test_a_mission_without_paths_is_read_back(tmp_path):
    write_simulated(tmp_path, Simulated(Track(np.arange(3.0), np.zeros((3, 3))), np.full(3, -1)), ())
    assert read_simulated(tmp_path)[1] == ()


@pytest.mark.parametrize("name", [SIMULATED, PLANNED])
def test_damaged_tables_are_told(name, tmp_path):
    write_simulated(tmp_path, Simulated(Track(np.arange(3.0), np.zeros((3, 3))), np.full(3, -1)), ())
    (tmp_path / name).write_bytes(b"PAR1 no more")
    with pytest.raises(InputError, match="damaged"):
        read_simulated(tmp_path)


def test_the_flown_track_has_what_was_measured():
    log = FlownLog()
    setpoint = Setpoint(position_m=(0.0, 0.0, 1.0))
    for time_s, place in ((0.0, (1.0, 2.0, 3.0)), (0.05, None), (0.1, (1.5, 2.0, 3.0))):
        log.row(time_s, setpoint, Telemetry(position_m=place), lambda: None)
    track = flown_track(log)
    assert track.time_s.tolist() == [0.0, 0.1]
    assert track.position_m[1].tolist() == [1.5, 2.0, 3.0]
    log.row(0.15, setpoint, Telemetry(position_m=(9.0, 9.0, 9.0)), lambda: None, by_hand=True)
    assert flown_track(log).time_s.tolist() == [0.0, 0.1, 0.15]
    assert flown_track(log, by_hand=False).time_s.tolist() == [0.0, 0.1]
    assert len(flown_track(FlownLog()).time_s) == 0
