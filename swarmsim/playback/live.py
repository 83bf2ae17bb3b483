"""A mission under way in the Rerun viewer, while a vehicle is flown outside: `LiveView`."""

import queue
import threading
import time
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from swarmsim.autopilot.link import Setpoint, Telemetry
from swarmsim.config.errors import InputError
from swarmsim.playback.blueprint import live_blueprint
from swarmsim.playback.colours import rgba, team_colours
from swarmsim.playback.entities import TIMELINE, path_of
from swarmsim.playback.recording import send_site
from swarmsim.playback.vehicles import MOVED_M, send_look
from swarmsim.results.tracks import still_vehicle
from swarmsim.runtime.live import LiveMission, LiveStep
from swarmsim.runtime.simulation import Simulation

RATE_HZ = 5.0
WAITING = 8  # steps that may wait for the viewer; more are dropped
_CLOSE_S = 3.0
_SETPOINT = "#F0E442"
_PATH = [200, 200, 200, 255]


@dataclass(frozen=True)
class _Shown:
    """What is logged of one step; everything is a copy."""

    time_s: float
    team: tuple[tuple[str, np.ndarray, np.ndarray], ...]
    rates_cps: dict[str, float]
    path_m: np.ndarray | None
    setpoint: Setpoint | None
    telemetry: Telemetry


class LiveView:
    """Shows each step of a flight in a viewer that runs elsewhere.

    The flight never waits for it: `observe` copies a few arrays at 5 Hz and returns; a thread of its own logs them. A
    viewer that is slow misses steps (``dropped``), one that is closed misses the rest.
    """

    def __init__(self, simulation: Simulation, live: LiveMission, vehicle: str, url: str):
        """Connect to the viewer at ``url`` (rerun+http://HOST:PORT/proxy); raises `InputError` for a wrong one."""
        self._simulation, self._live, self._vehicle = simulation, live, vehicle
        scenario = simulation.scenario
        self._stream = rr.RecordingStream("swarmsim", recording_id=f"live-{scenario.mission.name}-{time.time_ns()}")
        self._stream.set_log_tick_enabled(False)
        self._stream.set_log_time_enabled(False)
        try:
            self._stream.connect_grpc(url, default_blueprint=self._layout())
        except (RuntimeError, ValueError) as error:
            raise InputError.of(
                f"this is no address of a Rerun viewer ({error})", path="--live-url", given=url,
                allowed="rerun+http://HOST:PORT/proxy",
            ) from error  # fmt: skip
        self.dropped = 0
        self._next_s = 0.0
        self._last: dict[str, np.ndarray] = {}  # where each trail has come to
        self._told = ""
        self._path: np.ndarray | None = None
        self._queue: queue.Queue[_Shown | None] = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._run, name="live-view", daemon=True)
        self._thread.start()

    def observe(self, step: LiveStep, setpoint: Setpoint | None, telemetry: Telemetry) -> None:
        """Take a step of the flight (`swarmsim.autopilot.flight.Observer`); returns at once."""
        now = time.monotonic()
        if now < self._next_s:
            return
        self._next_s = now + 1.0 / RATE_HZ
        if self._queue.full():
            self.dropped += 1
            return
        live = self._live
        shown = _Shown(step.time_s, live.team(), live.count_rates_cps(), live.path_m(), setpoint, telemetry)
        self._queue.put_nowait(shown)  # this thread alone puts

    def close(self) -> None:
        """Log what waits and leave the viewer; waits for 3 s at most."""
        end = time.monotonic() + _CLOSE_S
        while self._queue.full() and self._thread.is_alive() and time.monotonic() < end:
            time.sleep(0.01)
        if not self._queue.full():
            self._queue.put_nowait(None)
        self._thread.join(max(0.0, end - time.monotonic()))

    def _layout(self) -> rrb.Blueprint:
        names = [member.name for member in self._simulation.scenario.members]
        return live_blueprint(self._simulation.site_model, names, self._vehicle)

    def _run(self) -> None:
        self._begin()
        while (shown := self._queue.get()) is not None:
            self._show(shown)
        self._stream.disconnect()

    def _begin(self) -> None:
        stream, scenario = self._stream, self._simulation.scenario
        stream.send_recording_name(f"{scenario.mission.name}, {self._vehicle} flown outside")
        send_site(stream, self._simulation.site_model)
        vehicles = [still_vehicle(self._simulation, number) for number in range(len(scenario.members))]
        for vehicle, colour in zip(vehicles, team_colours(vehicles), strict=True):
            send_look(stream, vehicle, colour)
            look = rr.LineStrips3D.from_fields(colors=[rgba(colour)], radii=rr.Radius.ui_points(1.2))
            stream.log(path_of("world/trails", vehicle.name), look, static=True)
            for plot in ("height", "rate"):
                line = rr.SeriesLines(names=[vehicle.name], colors=[rgba(colour)], widths=[1.5])
                stream.log(path_of(f"plots/{plot}", vehicle.name), line, static=True)

        line = rr.SeriesLines(names=["horizontal"], colors=[rgba(_SETPOINT)], widths=[1.5])
        stream.log("plots/error/from_setpoint", line, static=True)

    def _show(self, shown: _Shown) -> None:
        stream = self._stream
        stream.set_time(TIMELINE, duration=shown.time_s)
        for name, position, quaternion in shown.team:
            pose = rr.Transform3D(translation=position, quaternion=rr.Quaternion(xyzw=quaternion[[1, 2, 3, 0]]))
            stream.log(path_of("world/vehicles", name), pose)
            before = self._last.setdefault(name, position)
            if float(np.linalg.norm(position - before)) > MOVED_M:
                strip = rr.LineStrips3D.from_fields(strips=[np.stack([before, position])])
                stream.log(path_of("world/trails", name), strip)
                self._last[name] = position
            stream.log(path_of("plots/height", name), rr.Scalars(float(position[2])))
        for name, rate in shown.rates_cps.items():
            stream.log(path_of("plots/rate", name), rr.Scalars(rate))
        self._show_command(shown)

    def _show_command(self, shown: _Shown) -> None:
        """The planned path, the setpoint and how far the vehicle is from it, its mode and its battery."""
        stream, t, s = self._stream, shown.telemetry, shown.setpoint
        old = self._path
        if shown.path_m is not None and (old is None or not np.array_equal(shown.path_m, old)):
            self._path = shown.path_m
            strip = rr.LineStrips3D([shown.path_m], colors=[_PATH], radii=rr.Radius.ui_points(0.8))
            stream.log("world/planned", strip)
        place = None if s is None else s.position_m
        if place is None:
            stream.log("world/setpoint", rr.Clear(recursive=False))
        else:
            stream.log("world/setpoint", rr.Points3D([place], radii=rr.Radius.ui_points(5.0), colors=[rgba(_SETPOINT)]))
            if t.position_m is not None:
                apart = float(np.hypot(*(np.asarray(place) - np.asarray(t.position_m))[:2]))
                stream.log("plots/error/from_setpoint", rr.Scalars(apart))
        if t.battery is not None:
            stream.log(path_of("plots/battery", self._vehicle), rr.Scalars(100.0 * t.battery))
        armed = {True: "armed", False: "disarmed", None: "arming unknown"}[t.armed]
        told = f"{self._vehicle}: {t.mode_name}, {armed}"
        if told != self._told:
            self._told = told
            stream.log("log/vehicle", rr.TextLog(told, level=rr.TextLogLevel.INFO))
