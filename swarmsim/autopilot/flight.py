"""One flight: a vehicle outside flies its part of a mission, from preflight to where it stands again.

The thread of the flight steps the mission in real time, with the vehicle where it is measured, and offers the commands
of the mission's policy. The mission's time stands still while a phase is planned and while the vehicle takes off.
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from swarmsim.autopilot.control import Control, State
from swarmsim.autopilot.convert import body_of, setpoint_of
from swarmsim.autopilot.flown import FlownLog
from swarmsim.autopilot.frames import Geodetic, enu_of_geodetic, yaw_of_quaternion
from swarmsim.autopilot.guard import Guard
from swarmsim.autopilot.link import LinkError, Setpoint, Telemetry, Vector, VehicleLink
from swarmsim.autopilot.manual.helm import Helm
from swarmsim.autopilot.manual.sticks import Source
from swarmsim.autopilot.under_way import refuse_under_way
from swarmsim.config.autopilot import Autopilot
from swarmsim.runtime.live import LiveMission, LiveStep
from swarmsim.runtime.uninterrupted import uninterrupted
from swarmsim.vehicles.state import RigidState

LANDS_M = 1.2  # above where it started: a mission's descent below it ends with the autopilot's own landing
DESCENT_M_S = 0.1
JOIN_M = 3.0  # times the height of take-off: so far along its path a vehicle may join it


class Observer(Protocol):
    """Sees a flight, once in each step of the mission; it must return at once."""

    def __call__(self, step: LiveStep, setpoint: Setpoint | None, telemetry: Telemetry) -> None:
        """A step, what was offered in it (None while the vehicle does not follow us), and the vehicle then."""


class Flight:
    """Flies one vehicle; `fly` may be called once."""

    def __init__(
        self, link: VehicleLink, live: LiveMission, settings: Autopilot, outline_m: np.ndarray, flies: bool,
        tell: Callable[[str], None], observer: Observer | None = None, pilot: Source | None = None,
    ):  # fmt: skip
        """``live`` is prepared; ``outline_m`` [V, 2] bounds where positions may lie; ``tell`` prints a line.

        A ``pilot``'s device, open, lets him take the vehicle over and hand it back.
        """
        self.link, self.live, self.settings, self.flies = link, live, settings, flies
        self._tell, self._observer = tell, observer
        rest = live.body()
        x, y, z = (float(v) for v in rest.position_m)
        self._rest: Vector = (x, y, z)
        guard = Guard(limits=settings.limits, outline_m=outline_m, ground_m=self._rest[2], flies=flies)
        self.control = Control(link, settings, guard, flies, self._stage)
        self.helm = (
            None if pilot is None else Helm(pilot, self.control, guard, settings, live.speed_max_m_s, self._stage)
        )
        self.log = FlownLog()
        self._wanted = False  # a phase asks for the vehicle, which does not follow us yet
        self._waits = False  # it holds until its next phase
        self._landed_in: int | None = None  # phase that it ended by landing
        self._left = False  # its part in the mission has ended
        self._planner: threading.Thread | None = None  # begins phases; nobody else may touch ``live`` meanwhile

    def on_telemetry(self, t: Telemetry) -> None:
        """Called by the link's reader whenever mode or arming may have changed."""
        self.control.on_telemetry(t)

    def fly(self) -> None:
        """From preflight to the end; raises `LinkError` where the vehicle does not do what is needed."""
        self._stage("preflight")
        refuse_under_way(self.link)
        self.link.preflight(self._tell, self.settings.ready_s)
        self.link.align(place_in_mission(self.link.telemetry(), self._rest, self.settings))
        self.live.start()
        self.control.stream.start()
        if self.helm is not None:
            self.helm.start()
        try:
            self._mission()
        except KeyboardInterrupt:
            self._tell(f"stopped by the user: {self.settings.at_end}")
            self._stop()
            raise
        except BaseException:  # whatever it was, the vehicle must not fly on without anybody who commands it
            self.control.emergency()
            raise
        finally:
            if self.helm is not None:
                self.helm.close()
            self.control.stream.close()
            with uninterrupted():
                self._planned()  # what it works on is not whole before
            if self.control.alarm is not None:  # the first cause, not what came of it
                self.log.ended = self.control.alarm.reason

    def _stop(self) -> None:
        try:
            self.control.stop()
        except LinkError as error:
            self._tell(str(error))
            self.control.emergency()
        except BaseException:  # stopped once more, perhaps before the vehicle had done what it was asked for
            self.control.emergency()
            raise

    def _stage(self, name: str) -> None:
        self._tell(name)
        self.log.event(name)

    def _mission(self) -> None:
        """Step the mission in real time until the vehicle's part is over, then until the mission is."""
        live, control = self.live, self.control
        self._begin()
        due = time.monotonic()
        while True:
            self._wanted = self._wanted and live.phase() is not None  # it may have ended while the vehicle landed
            if self._wanted and control.state is State.STANDS:
                self._take_off()
                due = time.monotonic()
            control.watch()
            t = self.link.telemetry()
            step = live.step(self._body(t), 1.0 if t.battery is None else t.battery)
            offered = self._command(step, t) if control.state is State.FOLLOWS else None
            if self._observer is not None:
                self._observer(step, offered, t)
            if step.begins:
                self._plan(step)
                due = time.monotonic()
            self._leave_if_over()
            stands = control.stands()
            if (step.over and not self._by_hand) or (stands and self._left and live.over_without_vehicle()):
                break
            due = max(due + live.period_s, time.monotonic() - live.period_s)
            time.sleep(max(0.0, due - time.monotonic()))
        if control.state is State.FOLLOWS:
            control.end(self.settings.at_end)
        while not control.stands():
            time.sleep(live.period_s)
        self._leave_if_over()

    def _plan(self, step: LiveStep) -> None:
        """Begin phases, which may take seconds: the vehicle holds meanwhile."""
        if self.control.state is State.FOLLOWS and not self._by_hand:
            self.control.hold()
        self.log.event("plan " + ", ".join(step.begins))
        self._begin()

    def _planned(self) -> None:
        if self._planner is not None:
            self._planner.join()

    def _begin(self) -> None:
        """Begin the phases that are due, with the watchdogs at work; a hold is not renewed, so that it ends in time."""
        failed: list[BaseException] = []

        def plan() -> None:
            try:
                self.live.begin_phases()
            except BaseException as error:  # raised again by the thread of the flight
                failed.append(error)

        self._planner = threading.Thread(target=plan, name="planner", daemon=True)
        self._planner.start()
        while self._planner.is_alive():
            self._planner.join(self.live.period_s)
            self.control.watch(renew=False)
        if failed:
            raise failed[0]
        phase = self.live.phase()
        asked = phase is not None and phase != self._landed_in and not self._left
        self._wanted = asked and self.control.state is not State.FOLLOWS

    def _take_off(self) -> None:
        """Have the vehicle follow us: from the ground it takes off first."""
        self._wanted = False
        t = self.link.telemetry()
        if t.position_m is None or t.quaternion is None:
            raise LinkError("the vehicle tells no position or attitude any more: check its state estimate")
        x, y, z = t.position_m
        first = self.live.step(self._body(t), 1.0 if t.battery is None else t.battery)
        if first.in_phase:
            setpoint_of(first.command)  # one that no autopilot takes is refused on the ground
        height = self.settings.take_off_m if self.flies else 0.0
        if self.control.start((x, y, z + height), yaw_of_quaternion(t.quaternion)):
            self._stage("mission")
            self.live.join(self._body(self.link.telemetry()), JOIN_M * height)

    def _command(self, step: LiveStep, t: Telemetry) -> Setpoint | None:
        """Offer the policy's setpoint, or end the vehicle's part where the mission is done with it."""
        control = self.control
        if self._flown_by_hand(step, t):
            self._waits = False
            return None if self.helm is None else self.helm.setpoint
        if not step.in_phase:
            if not self._waits:
                self._waits = True
                control.hold()
            if not step.begins and not self.live.has_phase_to_come():
                control.end(self.settings.at_end)
            return None
        self._waits = False
        setpoint = setpoint_of(step.command)
        if self._descends(setpoint, t):
            self._landed_in = self.live.phase()
            control.end("land")
            return None
        offered: Setpoint | None = setpoint
        if self.helm is None:
            control.offer(setpoint)
        else:
            offered = self.helm.offer(setpoint)
        if offered is not None:
            self.log.row(step.time_s, offered, t, self.live.path_m, by_hand=offered is not setpoint)
        return offered

    @property
    def _by_hand(self) -> bool:
        """Whether a pilot flies."""
        return self.helm is not None and self.helm.flies and self.control.state is State.FOLLOWS

    def _flown_by_hand(self, step: LiveStep, t: Telemetry) -> bool:
        """Do what the pilot asks for; whether the vehicle is none of the policy's in this step."""
        if self.helm is None:
            return False
        wish, flown_m = self.helm.wish(), self.helm.handed_back()
        if wish is not None:
            self.log.ended = f"{wish.value}: the pilot asked for it"
            self._landed_in = self.live.phase()
            self.control.end(wish.value)
            return True
        if flown_m is not None:
            self.live.join(self._body(t), flown_m)
            self._waits = False  # handed back between phases it has to hold anew, however short it was flown by hand
            if self.helm.resume():
                self._stage("mission")
        elif self.helm.flies and self.helm.setpoint is not None:
            self.log.row(step.time_s, self.helm.setpoint, t, self.live.path_m, by_hand=True)
        return self.helm.flies

    def _descends(self, s: Setpoint, t: Telemetry) -> bool:
        """Whether the mission brings it down where autopilots land by themselves."""
        if not self.flies or s.position_m is None or s.velocity_m_s is None or t.position_m is None:
            return False
        low = s.position_m[2] - self._rest[2] < LANDS_M and t.position_m[2] - self._rest[2] < 2.0 * LANDS_M
        return low and s.velocity_m_s[2] < -DESCENT_M_S

    def _leave_if_over(self) -> None:
        """End the vehicle's part: something was wrong, or it has ended its phases and none is to come."""
        alarm = self.control.alarm
        if alarm is not None and not self._left:
            self.live.leave()
            self._left = True
            if not self.live.over_without_vehicle():
                self._tell("its part of the mission is over; the other vehicles go on until Ctrl-C or their end")
        elif self.control.state is not State.FOLLOWS and not self._wanted and not self.live.has_phase_to_come():
            self._left = True
        if self.helm is not None:
            self.helm.over = self._left

    def _body(self, t: Telemetry) -> RigidState:
        """The vehicle's body in the mission. One that stands is on the ground, whatever its receiver says."""
        body = body_of(t, self.live.body())
        if self.control.state is State.STANDS:
            place: Any = np.append(body.position_m[:2], self._rest[2]).astype(np.float32)
            body = replace(body, position_m=place)
        return body


def place_in_mission(t: Telemetry, start_m: Vector, settings: Autopilot) -> Vector:
    """Where in the mission's world the vehicle stands: at its start there, or where a stated origin has it.

    Raises `LinkError` where the vehicle tells no place on the Earth, or stands too far from its start.
    """
    if settings.origin is None:
        return start_m
    if t.place is None:
        raise LinkError(
            "the mission states where its origin lies (autopilot.origin), but the vehicle tells no place on the Earth: "
            "wait for its receiver, or set autopilot.origin to null to take its place for its start in the mission"
        )
    east, north, _ = enu_of_geodetic(t.place, Geodetic(**settings.origin.model_dump()))
    apart = math.hypot(east - start_m[0], north - start_m[1])
    if apart > settings.start_m:
        raise LinkError(
            f"the vehicle stands {apart:.1f} m from its start in the mission, {east - start_m[0]:+.1f} m east and "
            f"{north - start_m[1]:+.1f} m north of it (autopilot.start_m is {settings.start_m:g}): carry it there, or "
            "change position_m of the vehicle or autopilot.origin"
        )
    return float(east), float(north), start_m[2]


__all__ = ["Flight", "Observer", "place_in_mission"]
