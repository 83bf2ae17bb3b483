"""A vehicle in this process, over swarmsim's own physics and in real time: `SimulatedLink`, the link ``sim:``."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import numpy as np

from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.link import Identity, LinkError, Mode, Setpoint, Telemetry, Vector
from swarmsim.autopilot.settings import load_settings
from swarmsim.autopilot.standin.activities import Activity, Follow, Hold, Idle, Land, Return, TakeOff, vector
from swarmsim.autopilot.standin.body import Body, Motion, SimulatedBody, alone_of
from swarmsim.autopilot.standin.settings import Manners
from swarmsim.autopilot.standin.targets import Target
from swarmsim.config.base import Delay, Duration, Length
from swarmsim.config.scenario import Scenario

BEHIND_S = 0.5  # simulated time lags behind by more: it is told, and not made up for

_MODES = MappingProxyType({Mode.HOLD: Hold, Mode.LAND: Land, Mode.RETURN: Return})


class SimulatedManners(Manners):
    """How the simulated vehicle behaves: ``configs/autopilots/simulated.yaml``."""

    setpoint_s: Duration
    return_height_m: Length
    return_wait_s: Delay


def load_manners() -> SimulatedManners:
    """Those of the working folder's ``configs`` or the shipped ones."""
    return load_settings("simulated", SimulatedManners)


def simulated_vehicle(scenario: Scenario, vehicle: str, seed: int = 0) -> "SimulatedLink":
    """The link to a vehicle of a mission that is simulated alone on its site; it compiles for seconds."""
    manners = load_manners()
    return SimulatedLink(SimulatedBody(alone_of(scenario, vehicle, manners.step_s), seed), manners)


class SimulatedLink:
    """A body that a thread steps in real time; a `VehicleLink`.

    It takes off by command, follows positions before velocities, holds when setpoints stop, and disarms when it has
    landed or crashed. Its estimate is the truth.
    """

    dry = False
    streams_first = False
    arms = True

    def __init__(self, body: Body, manners: SimulatedManners):
        """The body stands, disarmed; the thread runs at once."""
        self.identity = Identity("sim", "copter" if body.flies else "rover", 1, 1)
        self._body, self._manners = body, manners
        self._lock = threading.Lock()  # of all that follows
        self._offset: np.ndarray = np.zeros(3) - body.sensed.position_m
        self._home = np.array(body.sensed.position_m)
        self._armed, self._mode, self._failsafe = False, Mode.HOLD, False
        self._activity: Activity = self._make(Idle)
        self._offered_s = -math.inf
        self._words: list[str] = []
        self._callback: Callable[[Telemetry], None] | None = None
        self._error: Exception | None = None
        self._telemetry = self._told()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="simulated vehicle", daemon=True)
        self._thread.start()

    # what it tells

    def telemetry(self) -> Telemetry:
        """See `VehicleLink.telemetry`."""
        return self._telemetry

    def on_mode(self, callback: Callable[[Telemetry], None]) -> None:
        """See `VehicleLink.on_mode`."""
        self._callback = callback

    def messages(self) -> list[str]:
        """See `VehicleLink.messages`."""
        with self._lock:
            words, self._words = self._words, []
        return words

    def align(self, world_m: Vector) -> None:
        """See `VehicleLink.align`."""
        with self._lock:
            self._offset = np.asarray(world_m, np.float64) - self._body.sensed.position_m
            self._telemetry = self._told()

    def preflight(self, tell: Callable[[str], None], timeout_s: float) -> None:
        """See `VehicleLink.preflight`: it is ready unless it is broken."""
        self._alive("be checked")
        tell("a simulated vehicle: nothing real moves")

    # what it is told

    def send(self, setpoint: Setpoint) -> None:
        """See `VehicleLink.send`."""
        if self._error is not None:
            raise LinkError(f"the simulation of the vehicle has failed: {self._error}")
        with self._lock:
            self._offered_s = time.monotonic()
            if self._mode is not Mode.FOLLOW or not self._armed:
                return
            target = self._target(setpoint)
            if isinstance(self._activity, Follow):
                self._activity.target = target
            else:
                self._activity = self._make(Follow, target=target)

    def follow(self, timeout_s: float) -> None:
        """See `VehicleLink.follow`; without setpoints it holds."""
        self._alive("follow")
        with self._changing():
            self._activity = self._resting()
            self._mode, self._failsafe = Mode.FOLLOW, False

    def arm(self, timeout_s: float) -> None:
        """See `VehicleLink.arm`."""
        self._alive("arm")
        with self._changing():
            self._home = np.array(self._body.sensed.position_m)
            self._activity = self._resting()
            self._armed = True

    def disarm(self, timeout_s: float) -> None:
        """Stop the motors, where it stands; raises `LinkError` in the air."""
        with self._changing():
            if self._armed and self._body.flies and not self._body.sensed.landed:
                raise LinkError("it flies: it is not disarmed in the air; have it land first")
            self._disarmed()

    def take_off(self, height_m: float, timeout_s: float) -> None:
        """See `VehicleLink.take_off`."""
        self._alive("take off")
        with self._lock:
            if not self._armed or self._mode is not Mode.FOLLOW:
                raise LinkError("it takes off where it is armed and follows: have it follow, then arm, then take off")
            if self._body.flies:
                self._activity = self._make(TakeOff, top_m=float(self._body.sensed.position_m[2]) + height_m)

    def enter(self, mode: Mode, timeout_s: float) -> None:
        """See `VehicleLink.enter`."""
        self._alive(mode.value)
        self.request(mode)

    def request(self, mode: Mode) -> None:
        """See `VehicleLink.request`."""
        if mode not in _MODES:
            raise LinkError(f"a simulated vehicle has no mode {mode.value}: {', '.join(m.value for m in _MODES)}")
        with self._changing():
            self._activity = self._resting() if mode is Mode.HOLD else self._make(_MODES[mode], **self._way(mode))
            self._mode, self._failsafe = mode, False

    def close(self) -> None:
        """See `VehicleLink.close`."""
        self._over.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    # inside

    def _alive(self, what: str) -> None:
        if self._error is not None:
            raise LinkError(f"it cannot {what}: the simulation of the vehicle has failed: {self._error}")
        if not self._body.sensed.intact:
            raise LinkError(f"it cannot {what}: it has crashed")

    def _make(self, kind: Any, **fields: Any) -> Any:
        return kind(self._manners, self._body.flies, yaw_of_quaternion(self._body.sensed.quaternion), **fields)

    def _resting(self) -> Activity:
        flies = self._body.flies and not self._body.sensed.landed
        kind = Hold if flies or not self._body.flies else Idle
        made: Activity = self._make(kind)
        return made

    def _way(self, mode: Mode) -> dict[str, Any]:
        if mode is not Mode.RETURN:
            return {}
        m = self._manners
        return {"home_m": self._home, "cruise_m": float(self._home[2]) + m.return_height_m, "wait_s": m.return_wait_s}

    def _target(self, s: Setpoint) -> Target:
        """The setpoint in the body's own world, which `align` may have moved against the mission's."""
        velocity, ahead = s.velocity_m_s, None
        if s.body and velocity is not None:
            ahead, yaw = velocity[0], yaw_of_quaternion(self._body.sensed.quaternion)
            c, w = math.cos(yaw), math.sin(yaw)
            velocity = (c * velocity[0] - w * velocity[1], w * velocity[0] + c * velocity[1], velocity[2])
        none = (None, None, None)
        return Target(
            position_m=none if s.position_m is None else vector(np.asarray(s.position_m) - self._offset),
            velocity_m_s=none if velocity is None else velocity,
            acceleration_m_s2=none if s.acceleration_m_s2 is None else s.acceleration_m_s2,
            yaw_rad=s.yaw_rad,
            yaw_rate_rad_s=s.yaw_rate_rad_s,
            ahead_m_s=ahead,
        )

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Change the state under the lock; whoever listens is told after it, as it may wait for who sends."""
        with self._lock:
            before = self._mode, self._armed
            yield
            self._telemetry = told = self._told()
            changed = (self._mode, self._armed) != before
        if changed and self._callback is not None:
            self._callback(told)

    def _disarmed(self) -> None:
        self._activity, self._armed = self._make(Idle), False

    def _told(self) -> Telemetry:
        sensed, now = self._body.sensed, time.monotonic()
        return Telemetry(
            heard_s=now,
            pose_s=now,
            position_m=vector(sensed.position_m + self._offset),
            velocity_m_s=vector(sensed.velocity_m_s),
            quaternion=tuple(float(x) for x in sensed.quaternion),  # type: ignore[arg-type]
            angular_velocity_rad_s=vector(sensed.angular_velocity_rad_s),
            armed=self._armed,
            mode=self._mode,
            mode_name=self._mode.value.upper(),
            on_ground=bool(sensed.landed),
            battery=float(sensed.charge),
            estimate_ok=True,
            ready_to_arm=bool(sensed.intact),
            failsafe=self._failsafe,
        )

    def _run(self) -> None:
        """Step in real time until it is closed."""
        due, told = time.monotonic(), False
        while not self._over.wait(max(0.0, due - time.monotonic())):
            try:
                with self._changing():
                    motion, armed = self._motion(), self._armed
                self._body.step(motion, armed)
            except Exception as error:  # of the physics; who flies it is told by its next call
                self._error = error
                return
            due += self._manners.step_s
            if time.monotonic() - due > BEHIND_S:
                due = time.monotonic()
                if not told:
                    told = True
                    self._words.append("this computer is too slow: simulated time lags behind")

    def _motion(self) -> Motion:
        """What the body is to do in the next step, after what its state asks for."""
        sensed = self._body.sensed
        if self._armed and not sensed.intact:
            self._words.append("it has crashed, and was disarmed")
            self._disarmed()
        elif self._armed and self._activity.done and self._mode in (Mode.LAND, Mode.RETURN) and self._body.flies:
            self._disarmed()
        elif self._armed and isinstance(self._activity, Follow):
            silent = time.monotonic() - self._offered_s
            if silent > self._manners.setpoint_s:
                self._words.append(f"no setpoint came for {silent:.1f} s: it holds")
                self._activity = self._resting()
                self._mode, self._failsafe = Mode.HOLD, True
        return self._activity.motion(sensed, self._manners.step_s) if self._armed else Motion()
