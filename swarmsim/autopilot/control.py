"""Control of one vehicle outside: taking it, keeping it, and giving it up, whatever the reason.

Three threads meet here. The link's reader tells of mode changes at once, and an operator's halts the stream before
anything else; the stream sends setpoints; the thread of the flight arms, watches and ends.
"""

import contextlib
import threading
import time
from collections.abc import Callable

import numpy as np

from swarmsim.autopilot.convert import hold_at
from swarmsim.autopilot.guard import Guard, RefusedError
from swarmsim.autopilot.link import LinkError, Mode, Setpoint, Telemetry, Vector, VehicleLink
from swarmsim.autopilot.pulse import stopped
from swarmsim.autopilot.state import ARMS, State
from swarmsim.autopilot.stream import SetpointStream
from swarmsim.autopilot.watch import Action, Alarm, Following, Watch
from swarmsim.config.autopilot import Autopilot

STREAMED_S = 1.5  # of setpoints before a vehicle that asks for them is told to follow (PX4 asks for 1 s)
CLIMBED = 0.85  # of the height of take-off, from which on the mission flies it
RESTS_M_S, RESTS_S = 0.1, 3.0  # a rover on its way home has arrived when it has been that slow for so long
POLL_S = 0.05
ASK_AGAIN_S = 1.0  # in an emergency, where the vehicle says that it still follows

MODES = {"land": Mode.LAND, "hold": Mode.HOLD, "return": Mode.RETURN}


class Control:
    """What we may do to one vehicle, and what we do when something is wrong."""

    def __init__(self, link: VehicleLink, settings: Autopilot, guard: Guard, flies: bool, stage: Callable[[str], None]):
        """``stage`` is told what begins, in a word or a sentence."""
        self.link, self.settings, self.flies, self._guard = link, settings, flies, guard
        self.state = State.STANDS
        self.alarm: Alarm | None = None
        self.takeover_s: tuple[float, float] | None = None  # when an operator's was seen, and when the stream halted
        dogs = settings.watchdogs
        self.stream = SetpointStream(
            link.send,
            guard,
            settings.stream_hz,
            dogs.stale_s,
            dogs.planning_s,
            self._on_stale,
            lambda error: self.failed(f"a setpoint could not be sent: {error}"),
        )
        self._stage, self._watch, self._following = stage, Watch(dogs), Following(dogs)
        self._stuck: threading.Timer | None = None  # acts for the thread of the flight if that does not
        self._acts = False  # that thread has taken notice of what is wrong
        self._lock = threading.Lock()
        self._mode: Mode | None = None  # the mode that we brought about; another one is somebody else's
        self._armed = False  # we armed it, or it took off for us
        self._last: Setpoint | None = None
        self._by_hand = False  # a pilot gave it
        self._pauses = 0  # of this program, that were seen
        self._taken: Alarm | None = None  # it is somebody else's, whatever was wrong before
        self._ended_s = 0.0  # when the autopilot was asked to end
        self._asked_s: float | None = None  # when a mode was last asked for

    # What is seen

    def on_telemetry(self, t: Telemetry) -> None:
        """Called by the link's reader whenever mode or arming may have changed: a takeover halts the stream here."""
        if self._mode is not Mode.FOLLOW:
            return
        changed = self._watch.disarmed(t) if self._armed else None
        changed = changed or self._watch.mode_changed(t)
        if changed is not None:
            seen = time.monotonic()
            self._mode, self._taken = None, changed
            self.stream.halt()
            if changed.takeover:
                self.takeover_s = seen, time.monotonic()
            self._raise(changed)

    def watch(self, renew: bool = True) -> bool:
        """Look for what is wrong and act on it; whether it is still ours. ``renew`` keeps what was offered."""
        if renew:
            self.stream.renew()
        t = self.link.telemetry()
        pauses, paused_s = self.stream.pulse.pauses()
        paused, self._pauses = pauses > self._pauses, pauses
        if self.state in (State.STARTS, State.FOLLOWS):
            if self._armed and paused:
                self._raise(Alarm(Action.HOLD, stopped(paused_s)))
            elif self._armed and self._mode is Mode.FOLLOW:  # or something else was asked for
                self._raise(self._watch.check(t))
                where = None if t.position_m is None else self._guard.left(t.position_m)
                if where is not None:
                    self._raise(Alarm(Action.END, f"the vehicle is {where}"))
            watched = self._armed and self.state is State.FOLLOWS and not self._by_hand
            self._raise(self._following.check(t, self._last if watched else None))
            if self.alarm is not None:
                self._handle(self.alarm)
        return self.alarm is None

    # What is done

    def start(self, above_m: Vector, yaw_rad: float) -> bool:
        """Arm it, have it take off to ``above_m`` and follow our setpoints; whether it does: else see ``alarm``."""
        s, link = self.settings, self.link
        height = s.take_off_m
        above = Setpoint(position_m=above_m, velocity_m_s=(0.0, 0.0, 0.0), yaw_rad=yaw_rad)
        waiting = above if self.flies else hold_at(link.telemetry(), flies=False)
        if not self._may_start(waiting):
            return False
        self.state = State.STARTS
        self._pauses, _ = self.stream.pulse.pauses()
        self._watch.forget()
        self._following.forget()
        if link.streams_first:
            self.stream.resume()
            self.offer(waiting, keep=True)
            time.sleep(STREAMED_S)
        self._stage(ARMS)
        link.follow(s.answer_s)
        self._mode = Mode.FOLLOW
        link.arm(s.answer_s)
        self._armed = link.arms
        self.on_telemetry(link.telemetry())  # an operator may have taken over while it armed
        if self.flies and self.watch():
            self._stage("take off")
            if not link.streams_first:
                link.take_off(height, s.take_off_s)
            self._armed = True
            self._climb(above_m[2] - (1.0 - CLIMBED) * height, above_m[2] - height, s.take_off_s)
        if self.alarm is None and not link.streams_first:
            self.stream.resume()
            self.offer(waiting, keep=True)
        self.on_telemetry(link.telemetry())
        if self.watch():
            self.state = State.FOLLOWS
        return self.state is State.FOLLOWS

    def _may_start(self, waiting: Setpoint) -> bool:
        """Whether it may be armed: nothing is wrong, nobody else has armed it, it may be where it is to wait."""
        if self.alarm is not None:
            return False
        if self.link.telemetry().armed:
            self._released("somebody else has armed the vehicle, and flies it: nothing is asked of it")
            return False
        self.stream.halt()
        self._guard.forget()
        self.offer(waiting)  # refused now rather than in the air; nothing is sent while the stream is halted
        if self.alarm is not None:
            self._stage(self.alarm.reason)
        return self.alarm is None

    def _climb(self, height_m: float, ground_m: float, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while self.watch():
            t = self.link.telemetry()
            if t.position_m is not None and t.position_m[2] >= height_m:
                return
            if time.monotonic() > deadline:
                now = "unknown" if t.position_m is None else f"{t.position_m[2] - ground_m:.1f} m"
                raise LinkError(f"it did not climb within {timeout_s:g} s: its height is {now}; {_told(self.link)}")
            time.sleep(POLL_S)

    def offer(self, setpoint: Setpoint, *, keep: bool = False, by_hand: bool = False) -> None:
        """Have a setpoint sent from now on; one that must not be sent ends the vehicle's part.

        One that a pilot gave ``by_hand`` is not watched for being followed: he sees it himself.
        """
        try:
            self.stream.offer(setpoint, keep=keep)
            self._last, self._by_hand = setpoint, by_hand
        except RefusedError as error:
            self._raise(Alarm(Action.END, f"a setpoint was refused: {error}"))

    def hold(self) -> None:
        """Hold where it was last told to be, for as long as nothing else is offered."""
        last, t = self._last, self.link.telemetry()
        if self.flies and last is not None and last.position_m is not None:
            self.offer(
                Setpoint(position_m=last.position_m, velocity_m_s=(0.0, 0.0, 0.0), yaw_rad=last.yaw_rad), keep=True
            )
        else:
            self.offer(hold_at(t, self.flies), keep=True)

    def end(self, how: str) -> None:
        """Leave setpoints for the autopilot's own land, hold or return; setpoints stop when it is in it."""
        how = how if self.flies or how == "return" else "hold"
        self._stage(how)
        self._enter(MODES[how])
        if self.state is not State.RELEASED:
            self.state = State.HOLDS if self.flies and how == "hold" else State.ENDS
            self._ended_s = self._slow_s = time.monotonic()

    def stands(self) -> bool:
        """Whether nothing is left to do: it has landed, holds, or somebody else flies it.

        Raises `LinkError` where it has not landed in time.
        """
        if self.state is not State.ENDS:
            return self.state in (State.STANDS, State.HOLDS, State.RELEASED)
        t, now = self.link.telemetry(), time.monotonic()
        if t.armed is False:
            self._stage("landed" if self.flies else "disarmed")
            self.state, self._armed, self._mode = State.STANDS, False, None
            return True
        if t.mode not in {self._mode, Mode.LAND if self._mode is Mode.RETURN else self._mode} and not t.failsafe:
            self._released(f"the operator took over with mode {t.mode_name}")
            return True
        if not self.flies and self._at_rest(t, now):
            self.link.disarm(self.settings.answer_s)
            return False
        if now - self._ended_s > self.settings.land_s:
            raise LinkError(
                f"it has not {'landed' if self.flies else 'stopped'} within {self.settings.land_s:g} s "
                f"(autopilot.land_s); {_told(self.link)}"
            )
        return False

    def stop(self) -> None:
        """The user stops: end as the settings say, and wait until the vehicle stands."""
        self._awake()
        if self.state is State.STARTS and not self.link.telemetry().armed:
            self.stream.halt()
            self._mode, self.state = None, State.STANDS
            self.link.disarm(self.settings.answer_s)  # our command to arm may be on its way
        elif self.state in (State.STARTS, State.FOLLOWS):
            self.end(self.settings.at_end)
        while not self.stands():
            time.sleep(POLL_S)

    def emergency(self) -> None:
        """Something failed: in the air, ask for what the settings say until it does that, or somebody else flies it."""
        self._settle()
        ours = {Mode.FOLLOW}
        if self._mode is Mode.HOLD and self.state in (State.STARTS, State.FOLLOWS):
            ours.add(Mode.HOLD)  # it was to hold for a while only
        self._awake()
        if self.state is State.STARTS and not self.link.telemetry().armed:
            with contextlib.suppress(LinkError):  # our command to arm may be on its way
                self.link.disarm(self.settings.answer_s)
        self._mode = None
        self.stream.halt()
        how = self.settings.watchdogs.then
        end, asks = time.monotonic() + self.settings.land_s, False
        while (t := self.link.telemetry()).armed and t.mode in ours:
            now, before = time.monotonic(), self._asked_s
            if not asks:
                self._stage(f"asking for {how} because of that")
            # again only where it has said since that it does not: an operator may take over while nothing is heard
            if before is None or (
                t.heard_s is not None and t.heard_s > before and (not asks or now - before > ASK_AGAIN_S)
            ):
                self._asked_s = now
                self.link.request(MODES[how])
            asks = True
            if now > end:
                self._stage(f"it has not told for {self.settings.land_s:g} s that it does: its own failsafe has to act")
                return
            time.sleep(POLL_S)
        if asks:
            self._stage(f"it is in mode {t.mode_name}{'' if t.armed else ', disarmed'}; nothing more is asked of it")

    # Inside

    def _at_rest(self, t: Telemetry, now_s: float) -> bool:
        moves = t.velocity_m_s is None or float(np.hypot(*t.velocity_m_s[:2])) > RESTS_M_S
        if moves:
            self._slow_s = now_s
        return now_s - self._slow_s > (RESTS_S if self._mode is Mode.RETURN else 0.5)

    def _handle(self, alarm: Alarm) -> None:
        """Do what an alarm asks for; the vehicle's part in the mission has ended."""
        self._awake()
        self._stage(alarm.reason)
        if alarm.action is Action.RELEASE:
            self._release()
            return
        then = MODES[self.settings.watchdogs.then]
        begun = self._mode is then  # while this thread was stuck
        if alarm.action is Action.HOLD and not begun and not self._held():
            return
        self.end(self.settings.watchdogs.then)

    def _held(self) -> bool:
        """Hold for the time that the settings say; whether it still does: an operator may take over meanwhile."""
        self._stage("hold")
        self._enter(Mode.HOLD)
        until = time.monotonic() + self.settings.watchdogs.hold_s
        while self.state is not State.RELEASED and time.monotonic() < until:
            t = self.link.telemetry()
            if t.mode is not Mode.HOLD or t.armed is False:
                self._released(f"the operator took over with mode {t.mode_name}")
            time.sleep(POLL_S)
        return self.state is not State.RELEASED

    def _enter(self, mode: Mode) -> None:
        """Change the mode, unless the one that it is in is neither of ours: that is a takeover."""
        self._settle()
        now, before = self.link.telemetry(), self._mode
        ours = {Mode.FOLLOW, Mode.TAKEOFF, before, mode}
        self._mode = None  # the change that comes is ours
        if self.state is State.FOLLOWS and self.alarm is None:
            self.hold()  # until the mode has changed
        if self._taken is not None:
            self._released(self._taken.reason)
            return
        if now.mode not in ours:
            self._released(f"it is in mode {now.mode_name}, which was not ours: nothing more was asked of it")
            return
        try:
            self._asked_s = time.monotonic()
            self.link.enter(mode, self.settings.answer_s)
            self._mode = mode
        except BaseException:  # it holds as we had asked, until somebody asks for something else
            self._mode = before if before is Mode.HOLD else None
            raise
        finally:
            self.stream.halt()

    def _released(self, reason: str) -> None:
        self._stage(reason)
        self._raise(Alarm(Action.RELEASE, reason, takeover=True))
        self._release()

    def _release(self) -> None:
        self.stream.halt()
        self._mode, self.state = None, State.RELEASED

    def _on_stale(self, age_s: float) -> None:
        if self._mode is not Mode.FOLLOW:
            return
        if self.stream.pulse.just_woke():
            self._raise(Alarm(Action.HOLD, stopped(age_s)))
            self.stream.halt()
            threading.Thread(target=self._hold_here, name="awake", daemon=True).start()  # the stream's must run
        else:
            self._raise(
                Alarm(Action.HOLD, f"the mission gave no setpoint for {age_s:.1f} s: this computer is too slow")
            )
            self._hold_here()

    def _hold_here(self) -> None:
        """Ask for a hold, unless the thread of the flight acts on the alarm: it may be stuck."""
        self._settle()
        stuck = threading.Timer(self.settings.watchdogs.hold_s, self._on_stuck)
        stuck.daemon = True
        if self._asks(Mode.HOLD, stuck):
            stuck.start()

    def ask(self, how: str) -> None:
        """Ask for land or return from any thread: that of the flight, which is to `end`, may be stuck."""
        self._asks(MODES[how if self.flies or how == "return" else "hold"], None)

    def _asks(self, mode: Mode, stuck: threading.Timer | None) -> bool:
        """Ask a vehicle that follows for a mode, unless the thread of the flight acts; ``stuck`` is for it to stop."""
        with self._lock:
            if self._acts or self._mode is not Mode.FOLLOW or self.link.telemetry().mode is not Mode.FOLLOW:
                return False
            self._mode, self._asked_s, self._stuck = mode, time.monotonic(), stuck
        self.stream.halt()
        self.link.request(mode)
        return True

    def _settle(self) -> None:
        """After a pause of this program look again: an operator may have taken over meanwhile."""
        self.stream.pulse.settle(lambda: self.link.telemetry().heard_s, self.settings.watchdogs.heartbeat_s)

    def _on_stuck(self) -> None:
        """The thread of the flight has not acted on an alarm: what comes after the hold is asked for here."""
        self._settle()
        with self._lock:
            if self._stuck is None or self._mode is not Mode.HOLD or self.link.telemetry().mode is not Mode.HOLD:
                return
            self._mode, self._asked_s = MODES[self.settings.watchdogs.then], time.monotonic()
            self.link.request(self._mode)

    def _awake(self) -> None:
        """The thread of the flight acts."""
        with self._lock:
            self._acts = True
            if self._stuck is not None:
                self._stuck.cancel()
                self._stuck = None

    def failed(self, reason: str) -> None:
        """Something of ours has failed: the vehicle's part ends; any thread may tell."""
        self._raise(Alarm(Action.END, reason))

    def _raise(self, alarm: Alarm | None) -> None:
        """Remember the first alarm: they are latched."""
        with self._lock:
            if self.alarm is None and alarm is not None:
                self.alarm = alarm


def _told(link: VehicleLink) -> str:
    messages = link.messages()
    return "it says: " + " / ".join(messages[-5:]) if messages else "it has not said why"


__all__ = ["Control", "State"]
