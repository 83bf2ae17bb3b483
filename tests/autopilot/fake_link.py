"""A vehicle behind `VehicleLink` that flies straight to where it is told, for tests of what commands it."""

import threading
import time
from collections.abc import Callable

import numpy as np

from swarmsim.autopilot.link import Identity, LinkError, Mode, Setpoint, Telemetry, Vector


class FakeLink:
    """A copter or rover without dynamics: it moves with the speed that it is told; ``faults`` are set by tests."""

    dry = False

    def __init__(self, *, streams_first: bool = True, flies: bool = True):
        self.identity = Identity("px4" if streams_first else "ardupilot", "copter" if flies else "rover", 1, 1)
        self.streams_first, self.flies, self.arms = streams_first, flies, True
        self.place, self.velocity = np.zeros(3), np.zeros(3)
        self.armed, self.mode, self.failsafe, self.battery, self.estimate = False, Mode.HOLD, False, 0.9, True
        self.heard = self.posed = True
        self.sent: list[tuple[float, Setpoint]] = []
        self.asked: list[str] = []
        self.refuse: set[str] = set()
        self.ground_m, self.sinks_m_s = 0.0, 4.0
        self._goal: Setpoint | None = None
        self._tell: Callable[[Telemetry], None] | None = None
        self._last, self._over = time.monotonic(), threading.Event()
        self._heard_s = self._posed_s = time.monotonic()
        threading.Thread(target=self._run, daemon=True).start()

    def on_mode(self, tell: Callable[[Telemetry], None]) -> None:
        self._tell = tell

    def telemetry(self) -> Telemetry:
        return Telemetry(
            heard_s=self._heard_s,
            pose_s=self._posed_s,
            position_m=tuple(float(v) for v in self.place),  # type: ignore[arg-type]
            velocity_m_s=tuple(float(v) for v in self.velocity),  # type: ignore[arg-type]
            quaternion=(1.0, 0.0, 0.0, 0.0),
            angular_velocity_rad_s=(0.0, 0.0, 0.0),
            armed=self.armed,
            mode=self.mode,
            mode_name=self.mode.value.upper(),
            on_ground=bool(self.place[2] <= self.ground_m + 0.01),
            battery=self.battery,
            estimate_ok=self.estimate,
            ready_to_arm=True,
            failsafe=self.failsafe,
            gnss_fix=6,
        )

    def change(self, mode: Mode, *, failsafe: bool = False, armed: bool | None = None) -> None:
        """The vehicle's state changes by itself, or by the operator's hand."""
        self.mode, self.failsafe = mode, failsafe
        self.armed = self.armed if armed is None else armed
        if self._tell is not None:
            self._tell(self.telemetry())

    def align(self, world_m: Vector) -> None:
        self.place, self.ground_m = np.asarray(world_m, float), world_m[2]

    def preflight(self, tell: Callable[[str], None], timeout_s: float) -> None:
        self._ask("preflight")

    def send(self, setpoint: Setpoint) -> None:
        self._ask("send", keep=False)
        self.sent.append((time.monotonic(), setpoint))
        self._goal = setpoint

    def follow(self, timeout_s: float) -> None:
        self._ask("follow")
        self.mode = Mode.FOLLOW

    def arm(self, timeout_s: float) -> None:
        self._ask("arm")
        self.armed = True

    def disarm(self, timeout_s: float) -> None:
        self._ask("disarm")
        self.armed = False

    def take_off(self, height_m: float, timeout_s: float) -> None:
        self._ask("take_off")
        self._goal = Setpoint(position_m=tuple(self.place + np.array([0.0, 0.0, height_m])))  # type: ignore[arg-type]

    def enter(self, mode: Mode, timeout_s: float) -> None:
        self._ask(mode.value)
        self._goal, self.mode = None, mode

    def request(self, mode: Mode) -> None:
        self.asked.append(f"request {mode.value}")
        self.mode = mode

    def messages(self) -> list[str]:
        return ["it is a fake"]

    def close(self) -> None:
        self._over.set()

    def _ask(self, what: str, *, keep: bool = True) -> None:
        if keep:
            self.asked.append(what)
        if what in self.refuse:
            raise LinkError(f"{what} was refused: it is a test")

    def _run(self) -> None:
        while not self._over.wait(0.005):
            now = time.monotonic()
            dt, self._last = now - self._last, now
            self._heard_s = now if self.heard else self._heard_s
            self._posed_s = now if self.posed else self._posed_s
            goal, self.velocity = self._goal, np.zeros(3)
            if not self.armed:
                continue
            if self.mode in (Mode.LAND, Mode.RETURN):
                self.velocity = np.array([0.0, 0.0, -self.sinks_m_s])
                if self.place[2] <= self.ground_m:
                    self.place[2], self.velocity, self.armed = self.ground_m, np.zeros(3), False
            elif goal is not None and goal.position_m is not None:
                offset = np.asarray(goal.position_m) - self.place
                far = float(np.linalg.norm(offset))
                self.velocity = offset / max(far, 1e-9) * min(6.0, 4.0 * far)
            elif goal is not None and goal.velocity_m_s is not None:
                self.velocity = np.asarray(goal.velocity_m_s)
            self.place = self.place + dt * self.velocity
