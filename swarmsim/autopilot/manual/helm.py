"""Who flies the vehicle, its policy or the pilot; the pilot's part runs in a thread of its own.

This takeover is ours: setpoints go on, from the pilot, and he hands the vehicle back. An operator who changes the mode
of the autopilot takes over for good, and no setpoint is sent any more (`swarmsim.autopilot.control`).
"""

import math
import threading
import time
from collections.abc import Callable

from swarmsim.autopilot.control import Control, State
from swarmsim.autopilot.guard import Guard
from swarmsim.autopilot.link import Setpoint, Vector
from swarmsim.autopilot.manual.pilot import Pilot, place_of
from swarmsim.autopilot.manual.rejoin import Rejoin
from swarmsim.autopilot.manual.sticks import CENTRED, Event, Reading, Source
from swarmsim.config.autopilot import Autopilot

STUCK_S = 1.0  # the flight has not acted on what the pilot asked for: it plans


class Helm:
    """Decides whose setpoints are streamed: those that `offer` brings from the policy, or the pilot's.

    The flight asks `wish` and `handed_back` in each step, and answers by ending the vehicle's part or with `resume`.
    The pilot may take over at any time; before the vehicle follows setpoints that has effect once it does.
    """

    def __init__(
        self, source: Source, control: Control, guard: Guard, settings: Autopilot, speed_max_m_s: float,
        tell: Callable[[str], None],
    ):  # fmt: skip
        """The policy flies; ``source`` is open; ``tell`` is given each change of who flies, in any thread."""
        self._source, self._control, self._guard, self._tell = source, control, guard, tell
        self._manual, self._period_s = settings.manual, 1.0 / settings.stream_hz
        reverses = control.link.identity.reverses
        self._pilot = Pilot(settings.manual, guard, speed_max_m_s=speed_max_m_s, reverses=reverses)
        self._lock = threading.Lock()  # of all that follows; those of control and stream are taken inside it
        self._flies = False  # the pilot, or he will
        self._begins = False  # with his next setpoint
        self._handing = False  # he has handed it back, and the mission has not taken it yet
        self._waits = False  # his sticks do not count until they are centred
        self._wish: Event | None = None
        self._wished_s = 0.0
        self._rejoin: Rejoin | None = None
        self._flown_m = 0.0  # by the pilot since he took over
        self._before: Vector | None = None  # where it was then
        self._lost: str | None = None
        self.setpoint: Setpoint | None = None
        """The pilot's last one."""
        self.over = False
        """Whether the vehicle has no further part in the mission; the flight tells."""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pilot", daemon=True)

    # Called by the flight

    def start(self) -> None:
        """Begin to read the device."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; the device is left to who opened it."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    @property
    def flies(self) -> bool:
        """Whether the pilot flies, as soon as the vehicle follows setpoints."""
        return self._flies

    def offer(self, setpoint: Setpoint) -> Setpoint | None:
        """Stream the policy's setpoint, or what leads to it; what was streamed, None if the pilot flies."""
        with self._lock:
            if self._flies:
                return None
            if self._rejoin is not None:
                way = self._rejoin.setpoint(setpoint, self._control.link.telemetry(), time.monotonic())
                if way is None:
                    self._rejoin = None
                setpoint = setpoint if way is None else way
            self._control.offer(setpoint)
            return setpoint

    def handed_back(self) -> float | None:
        """How far the pilot has flown, m, where he wants the policy to go on: join, then `resume`."""
        return self._flown_m if self._handing else None

    def resume(self) -> bool:
        """The policy flies again; False where the pilot has taken it back meanwhile."""
        with self._lock:
            if not self._handing:
                return False
            self._flies = self._handing = False
            self._rejoin = Rejoin(self._manual, self._guard, self._control.link.telemetry(), time.monotonic())
            return True

    def wish(self) -> Event | None:
        """LAND or RETURN once, where the pilot asks for it; nobody flies it by setpoints then."""
        with self._lock:
            wish, self._wish = self._wish, None
            if wish is not None:
                self._flies = self._handing = False
        return wish

    def line(self) -> str:
        """Who flies, and what can be done, for the user."""
        state = self._control.state
        if self.over and state is State.STANDS:
            return "[its part is over, the others go on]  Ctrl-C: end the mission"
        if state is State.FOLLOWS:
            who = "YOU fly" if self._flies else "its policy flies"
        elif state in (State.STANDS, State.STARTS):
            who = f"it {state.value}" + (", then YOU fly" if self._flies else "")
        else:
            return f"[{_WORDS[state]}]"
        t = self._control.link.telemetry()
        if t.velocity_m_s is not None and t.position_m is not None:
            speed, up = math.hypot(*t.velocity_m_s), t.position_m[2] - self._guard.ground_m
            who += f" {speed:.1f} m/s" + (f", {up:.1f} m up" if self._guard.flies else "")
            who += ", holding" if self._flies and self._pilot.holds else ""
        return f"[{who}]  {self._lost or self._source.told(self._flies)}"

    # The pilot's thread

    def _run(self) -> None:
        due = time.monotonic()
        while not self._over.wait(max(0.0, due - time.monotonic())):
            try:
                self.look(time.monotonic())
            except Exception as error:  # whatever it is, the flight has to know that nobody flies
                self._control.failed(f"flying by hand has failed: {error!r}")
                return
            due = max(due + self._period_s, time.monotonic() - self._period_s)

    def look(self, now_s: float) -> None:
        """Read the device once, and do what it asks for."""
        reading = self._source.read(now_s)
        self._tell_lost(reading)
        with self._lock:
            for event in reading.events:
                self._asked(event, now_s)
            if self._wish is not None and now_s - self._wished_s > STUCK_S:
                self._control.ask(self._wish.value)
            lost = reading.lost is not None  # found again, it may be anywhere
            self._waits = lost or (self._waits and not reading.sticks.centred)
            if not self._flies or not self._follows:
                self._begins = self._flies
                return
            t = self._control.link.telemetry()
            if self._begins:
                self._begins = False
                self._pilot.begin(t)
            sticks = CENTRED if self._waits or self._handing else reading.sticks
            self.setpoint = self._pilot.setpoint(sticks, t, now_s)
            self._control.offer(self.setpoint, by_hand=True)
            here = place_of(t)
            if here is not None:
                self._flown_m += math.dist(here, self._before) if self._before is not None else 0.0
                self._before = here

    @property
    def _follows(self) -> bool:
        return self._control.state is State.FOLLOWS and self._control.alarm is None

    def _asked(self, event: Event, now_s: float) -> None:
        if self.over or self._control.state in _WORDS:
            return
        if event in (Event.LAND, Event.RETURN):
            if self._follows:
                self._wished_s = now_s if self._wish is None else self._wished_s
                self._wish = event
            else:
                self._tell(f"it does not {event.value} now: it does not follow yet (Ctrl-C ends the flight)")
        elif not self._flies:
            self._take()
            self._waits = event is Event.HOLD
        elif event is Event.HOLD or self._handing:
            if self._handing:
                self._tell("the pilot flies on")
            self._waits, self._handing = event is Event.HOLD, False
        elif self._follows:
            self._handing = True
            self._tell("the pilot hands it back")
        else:
            self._flies = False
            self._tell("its policy will fly")

    def _take(self) -> None:
        self._flies, self._begins, self._handing, self._rejoin = True, True, False, None
        self._flown_m, self._before = 0.0, None
        self._tell("the pilot takes over" if self._follows else "the pilot will fly as soon as it follows")

    def _tell_lost(self, reading: Reading) -> None:
        if (reading.lost is None) != (self._lost is None):
            self._tell("the pilot is heard again" if reading.lost is None else f"{reading.lost}: sticks are centred")
        self._lost = reading.lost


_WORDS = {
    State.ENDS: "the autopilot lands, returns or stops it, as it was asked to",
    State.HOLDS: "the autopilot holds it, as it was asked to",
    State.RELEASED: "somebody else flies it: no setpoint is sent any more",
}
