"""What ends a vehicle's part in the mission: the operator, the vehicle's own failsafes, and what we watch ourselves."""

import math
import time
from dataclasses import dataclass
from enum import Enum

from swarmsim.autopilot.link import Mode, Setpoint, Telemetry, Vector
from swarmsim.config.autopilot import Watchdogs

UNSEEN_S = 1.0  # between two looks: what was seen before counts no more

_WHY = "it does not follow; they may not reach it (uplink), or a fence or a limit of its own keeps it"


class Action(Enum):
    """What we do about it."""

    RELEASE = "release"  # send nothing more: somebody else flies
    HOLD = "hold"
    END = "end"  # land or return, as the settings say


@dataclass(frozen=True)
class Alarm:
    """Something that ends the mission's command of the vehicle."""

    action: Action
    reason: str  # a sentence
    takeover: bool = False  # by the operator


@dataclass
class Watch:
    """Judges telemetry while the vehicle follows setpoints."""

    limits: Watchdogs
    _before: Telemetry | None = None  # with the last position but one

    def check(self, t: Telemetry, now_s: float | None = None) -> Alarm | None:
        """What is wrong now, the gravest first; None if nothing is."""
        now = time.monotonic() if now_s is None else now_s
        silent = None if t.heard_s is None else now - t.heard_s
        if silent is None or silent > self.limits.heartbeat_s:
            since = "no heartbeat came" if silent is None else f"no heartbeat came for {silent:.1f} s"
            return Alarm(Action.END, f"{since}: the link is lost, and the autopilot's own failsafe has to act")
        changed = self.disarmed(t) or self.mode_changed(t)
        if changed is not None:
            return changed
        if t.pose_s is None or now - t.pose_s > self.limits.position_s:
            since = "no position came" if t.pose_s is None else f"no position came for {now - t.pose_s:.1f} s"
            return Alarm(
                Action.END,
                f"{since}, the last heartbeat {silent:.1f} s ago: check the link, the GNSS receiver and the estimate",
            )
        if t.position_m is None:
            return Alarm(Action.END, "its place is not known: the autopilot has restarted, with another origin")
        jumped = self._jumped(t)
        if jumped is not None:
            return Alarm(Action.END, f"its measured position jumped by {jumped:.1f} m: its state estimate was reset")
        if t.estimate_ok is False:
            return Alarm(Action.END, "the autopilot's state estimate has failed")
        if t.battery is not None and t.battery < self.limits.battery:
            return Alarm(
                Action.END,
                f"the battery is at {100 * t.battery:.0f} %, watchdogs.battery is {100 * self.limits.battery:.0f} %",
            )
        return None

    def forget(self) -> None:
        """The next position is the first one."""
        self._before = None

    def _jumped(self, t: Telemetry) -> float | None:
        """How far the position jumped since the last one, if that is farther than it can have moved."""
        before, self._before = self._before, t
        if before is None or before.position_m is None or before.pose_s is None:
            return None
        assert t.position_m is not None
        assert t.pose_s is not None
        apart = math.dist(t.position_m, before.position_m)
        speed = max(math.hypot(*(one.velocity_m_s or (0.0,))) for one in (before, t))
        moved = 2.0 * speed * (t.pose_s - before.pose_s)
        return apart if apart > self.limits.jump_m + moved else None

    def disarmed(self, t: Telemetry) -> Alarm | None:
        """The alarm if the vehicle is no longer armed."""
        if t.armed is not False:
            return None
        return Alarm(Action.RELEASE, "the vehicle was disarmed though we had not asked for it")

    def mode_changed(self, t: Telemetry) -> Alarm | None:
        """The alarm if the vehicle no longer follows setpoints."""
        if t.mode is Mode.FOLLOW:
            return None
        if t.failsafe:
            return Alarm(Action.RELEASE, f"a failsafe of the autopilot acts, it is in mode {t.mode_name}")
        return Alarm(Action.RELEASE, f"the operator took over with mode {t.mode_name}", takeover=True)


@dataclass
class Following:
    """Judges whether a vehicle follows the positions that are streamed.

    An autopilot that gets no setpoint any more may stay in its mode and brake (ArduPilot), while all its telemetry
    goes on.
    """

    limits: Watchdogs
    _seen_s: float = -math.inf
    _near_s: float = 0.0  # when it was last near enough
    _stood: tuple[float, Vector] | None = None  # since when it has been around which place

    def check(self, t: Telemetry, setpoint: Setpoint | None, now_s: float | None = None) -> Alarm | None:
        """What is wrong now, with the ``setpoint`` that is streamed; nothing where that has no position."""
        now, limits = time.monotonic() if now_s is None else now_s, self.limits
        if setpoint is None or setpoint.position_m is None or t.position_m is None:
            self.forget()
            return None
        if now - self._seen_s > UNSEEN_S:
            self._near_s, self._stood = now, None
        self._seen_s = now
        apart = math.dist(setpoint.position_m, t.position_m)
        if apart <= limits.away_m:
            self._near_s = now
        if apart <= limits.stuck_m or self._stood is None or math.dist(t.position_m, self._stood[1]) > limits.stuck_m:
            self._stood = now, t.position_m
        for does, since, most in (("was", self._near_s, limits.away_s), ("stood", self._stood[0], limits.stuck_s)):
            if now - since > most:
                for_s = f"for {now - since:.1f} s, {apart:.1f} m now"
                return Alarm(Action.HOLD, f"the vehicle {does} away from its setpoints {for_s}: {_WHY}")
        return None

    def forget(self) -> None:
        """What was seen counts no more."""
        self._seen_s = -math.inf
