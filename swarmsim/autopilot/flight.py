"""One flight: a vehicle outside flies its part of a mission, from preflight to where it stands again.

Three threads meet here. The link's reader tells of mode changes at once, and an operator's halts the stream before
anything else; the stream sends setpoints; this one steps the mission in real time and decides.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from swarmsim.autopilot.convert import body_of, hold_at, setpoint_of
from swarmsim.autopilot.flown import FlownLog
from swarmsim.autopilot.guard import Guard, RefusedError
from swarmsim.autopilot.link import LinkError, Mode, Setpoint, Telemetry, VehicleLink
from swarmsim.autopilot.stream import SetpointStream
from swarmsim.autopilot.watch import Action, Alarm, Watch
from swarmsim.config.autopilot import Autopilot
from swarmsim.runtime.live import LiveMission, LiveStep
from swarmsim.vehicles.state import RigidState

STREAMED_S = 1.5  # of setpoints before a vehicle that asks for them is told to follow (PX4 asks for 1 s)
CLIMBED = 0.85  # of the height of take-off, from which on the mission flies it
LANDS_M = 1.2  # above where it started: a mission's descent below it ends with the autopilot's own landing
DESCENT_M_S = 0.1
JOIN_M = 3.0  # times the height of take-off: so far along its path a vehicle may join it

_MODES = {"land": Mode.LAND, "hold": Mode.HOLD, "return": Mode.RETURN}


class Flight:
    """Flies one vehicle; `fly` may be called once."""

    def __init__(
        self, link: VehicleLink, live: LiveMission, settings: Autopilot, outline_m: np.ndarray, flies: bool,
        tell: Callable[[str], None],
    ):  # fmt: skip
        """``live`` is prepared; ``outline_m`` [V, 2] bounds where positions may lie; ``tell`` prints a line."""
        self.link, self.live, self.settings, self.flies = link, live, settings, flies
        self._tell = tell
        rest = live.body()
        self._rest = tuple(float(v) for v in rest.position_m)
        self._watch = Watch(settings.watchdogs)
        guard = Guard(limits=settings.limits, outline_m=outline_m, ground_m=self._rest[2], flies=flies)
        self.stream = SetpointStream(
            link.send, guard, settings.stream_hz, settings.watchdogs.stale_s, self._on_stale, self._on_error
        )
        self.log = FlownLog()
        self._lock = threading.Lock()
        self._alarm: Alarm | None = None
        self._following = False  # it flies by our setpoints; a change of its mode is then not ours
        self._flown_s: float | None = None  # when its part in the mission ended
        self._lands_itself = self._landed = False
        self.takeover_s: tuple[float, float] | None = None  # when a takeover was seen, and when the stream was halted

    def on_telemetry(self, t: Telemetry) -> None:
        """Called by the link's reader whenever mode or arming may have changed: a takeover halts the stream here."""
        if not self._following:
            return
        changed = self._watch.mode_changed(t)
        if changed is None and t.armed is False:
            changed = self._watch.check(t)
        if changed is not None and changed.action is Action.RELEASE:
            seen = time.monotonic()
            self._following = False
            self.stream.halt()
            self.takeover_s = seen, time.monotonic()
            self._raise(changed)

    def fly(self) -> None:
        """From preflight to the end; raises `LinkError` where the vehicle does not do what is needed."""
        self._stage("preflight")
        refuse_under_way(self.link)
        self.link.preflight(self._tell, self.settings.ready_s)
        self.link.align(self._rest)  # type: ignore[arg-type]
        self.live.start()
        self.stream.start()
        try:
            self._begin()
            self._mission()
        except KeyboardInterrupt:
            self._tell(f"stopped by the user: {self.settings.at_end}")
            self._stop()
            raise
        except LinkError:
            self._emergency()
            raise
        finally:
            self.stream.close()

    def _stop(self) -> None:
        """Ctrl-C: end the flight as the settings say, and wait until the vehicle stands."""
        t = self.link.telemetry()
        if self._flown_s is None and t.armed:
            self._end(self.settings.at_end)
        while self._flown_s is not None and not self._stands(self.link.telemetry()):
            time.sleep(self.live.period_s)

    def _stage(self, name: str) -> None:
        self._tell(name)
        self.log.event(name)

    def _begin(self) -> None:
        """Armed, in the air, and following our setpoints."""
        s, link = self.settings, self.link
        x, y, z = self._rest
        height = s.take_off_m if self.flies else 0.0
        yaw = float(np.arctan2(*_heading(self.live.body().quaternion)))
        above = Setpoint(position_m=(x, y, z + height), velocity_m_s=(0.0, 0.0, 0.0), yaw_rad=yaw)
        waiting = above if self.flies else hold_at(link.telemetry(), flies=False)
        if link.streams_first:
            self.stream.resume()
            self.stream.offer(waiting, keep=True)
            time.sleep(STREAMED_S)
        self._stage("arm")
        link.follow(s.answer_s)
        link.arm(s.answer_s)
        if self.flies:
            self._stage("take off")
            if not link.streams_first:
                link.take_off(height, s.take_off_s)
            self._climb(z + CLIMBED * height, s.take_off_s)
        if not link.streams_first:
            self.stream.resume()
            self.stream.offer(waiting, keep=True)
        self._following = True
        self.on_telemetry(link.telemetry())

    def _climb(self, height_m: float, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while True:
            t = self.link.telemetry()
            if t.position_m is not None and t.position_m[2] >= height_m:
                return
            if t.armed is False:
                raise LinkError(
                    "it disarmed during take-off: " + (" ".join(self.link.messages()) or "it did not say why")
                )
            if time.monotonic() > deadline:
                now = "unknown" if t.position_m is None else f"{t.position_m[2] - self._rest[2]:.1f} m"
                raise LinkError(f"it did not climb within {timeout_s:g} s: its height is {now}; {_told(self.link)}")
            time.sleep(0.05)

    def _mission(self) -> None:
        """Step the mission in real time until the vehicle's part is over, then until the mission is."""
        self._stage("mission")
        live = self.live
        live.begin_phases()
        live.join(self._body(self.link.telemetry()), JOIN_M * self.settings.take_off_m if self.flies else 0.0)
        due = time.monotonic()
        while True:
            t = self.link.telemetry()
            if self._flown_s is None:
                self._raise(self._watch.check(t))
                if self._alarm is not None:
                    self._handle(self._alarm)
            step = live.step(self._body(t), 1.0 if t.battery is None else t.battery)
            if self._flown_s is None:
                self._command(step, t)
            if step.begins:
                self._plan(step)
                due = time.monotonic()
            stands = self._stands(t)
            if step.over or (stands and live.over_without_vehicle()):
                break
            due = max(due + live.period_s, time.monotonic() - live.period_s)
            time.sleep(max(0.0, due - time.monotonic()))
        if self._flown_s is None:
            self._end(self.settings.at_end)
        while not self._stands(self.link.telemetry()):
            time.sleep(live.period_s)

    def _stands(self, t: Telemetry) -> bool:
        """Whether the vehicle is done: it has landed, holds, or somebody else flies it. Raises where it never lands."""
        if self._flown_s is None:
            return False
        if not self._lands_itself or t.armed is False or self.link.dry:
            if self._lands_itself and not self._landed:
                self._landed = True
                self._stage("landed")
            return True
        if time.monotonic() - self._flown_s > self.settings.land_s:
            raise LinkError(f"it has not landed within {self.settings.land_s:g} s; {_told(self.link)}")
        return False

    def _body(self, t: Telemetry) -> RigidState:
        """The vehicle's body in the mission. One that has landed stands on the ground, whatever its receiver says."""
        body = body_of(t, self.live.body())
        if self._landed:
            place: Any = np.append(body.position_m[:2], self._rest[2]).astype(np.float32)
            body = replace(body, position_m=place)
        return body

    def _command(self, step: LiveStep, t: Telemetry) -> None:
        """Offer the policy's setpoint, or end the vehicle's part where the mission is done with it."""
        if not step.in_phase and not step.begins:
            self._end(self.settings.at_end)
            return
        setpoint = setpoint_of(step.command)
        self.log.row(step.time_s, setpoint, t, self.live.path_m)
        if self._descends(setpoint, t):
            self._end("land")
            return
        try:
            self.stream.offer(setpoint)
        except RefusedError as error:
            self._raise(Alarm(Action.END, f"the mission's setpoint was refused: {error}"))

    def _descends(self, s: Setpoint, t: Telemetry) -> bool:
        """Whether the mission brings it down where autopilots land by themselves."""
        if not self.flies or s.position_m is None or s.velocity_m_s is None or t.position_m is None:
            return False
        low = s.position_m[2] - self._rest[2] < LANDS_M and t.position_m[2] - self._rest[2] < 2.0 * LANDS_M
        return low and s.velocity_m_s[2] < -DESCENT_M_S

    def _plan(self, step: LiveStep) -> None:
        """Begin phases, which may take seconds: the vehicle holds meanwhile."""
        if self._flown_s is None and not self.stream.halted:
            self.stream.offer(hold_at(self.link.telemetry(), self.flies), keep=True)
        self.log.event("plan " + ", ".join(step.begins))
        self.live.begin_phases()

    def _handle(self, alarm: Alarm) -> None:
        """Do what an alarm asks for; the vehicle's part in the mission has ended."""
        self._stage(alarm.reason)
        self.log.ended = alarm.reason
        if alarm.action is Action.RELEASE:
            self.stream.halt()
            self._following, self._flown_s = False, time.monotonic()
        else:
            if alarm.action is Action.HOLD:
                self._enter(Mode.HOLD)
                time.sleep(self.settings.watchdogs.hold_s)
            self._end(self.settings.watchdogs.then)
        self.live.leave()

    def _end(self, how: str) -> None:
        """Leave setpoints for the autopilot's own mode; setpoints stop when it is in it."""
        how = how if self.flies or how == "return" else "hold"
        self._stage(how)
        self._enter(_MODES[how])
        self._flown_s, self._lands_itself = time.monotonic(), self.flies and how != "hold"

    def _enter(self, mode: Mode) -> None:
        self._following = False
        try:
            self.link.enter(mode, self.settings.answer_s)
        finally:
            self.stream.halt()

    def _emergency(self) -> None:
        """Something failed: in the air, ask for what the settings say without waiting for an answer."""
        self._following = False
        self.stream.halt()
        t = self.link.telemetry()
        if t.armed and t.mode is Mode.FOLLOW:
            self._tell(f"asking for {self.settings.watchdogs.then} because of that")
            self.link.request(_MODES[self.settings.watchdogs.then])

    def _on_stale(self) -> None:
        if self._following:
            stale = self.settings.watchdogs.stale_s
            self._raise(Alarm(Action.HOLD, f"the mission gave no setpoint for {stale:g} s: this computer is too slow"))

    def _on_error(self, error: Exception) -> None:
        self._raise(Alarm(Action.END, f"a setpoint could not be sent: {error}"))

    def _raise(self, alarm: Alarm | None) -> None:
        """Remember the first alarm: they are latched."""
        with self._lock:
            if self._alarm is None and alarm is not None:
                self._alarm = alarm


def refuse_under_way(link: VehicleLink) -> None:
    """Raise `LinkError` if the vehicle is armed: somebody flies it, or a flight of ours was interrupted."""
    if link.telemetry().armed:
        raise LinkError(
            "the vehicle is armed: somebody else flies it, or an earlier flight was interrupted. Have it disarmed (the "
            "operator, or swarmsim fly MISSION --vehicle NAME --recover land), then start again"
        )


def _told(link: VehicleLink) -> str:
    messages = link.messages()
    return "it says: " + " / ".join(messages[-5:]) if messages else "it has not said why"


def _heading(quaternion: Any) -> tuple[float, float]:
    w, x, y, z = (float(v) for v in quaternion)
    return 2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)


__all__ = ["Flight", "refuse_under_way"]
