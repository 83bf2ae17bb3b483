"""Stand-ins of vehicles that are flown by sticks: tilt, climb and turn as a `Motion`, and their life in real time."""

import math
import threading
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType

import numpy as np
from pydantic import Field

from swarmsim.autopilot.frames import yaw_of_quaternion
from swarmsim.autopilot.outer_loop import GRAVITY_M_S2
from swarmsim.autopilot.standin.body import Body, Motion, Sensed
from swarmsim.autopilot.standin.settings import DefaultVehicle
from swarmsim.config.base import Lag, Model, NonNegative

SINK_M_S = 0.5
"""Descent that is commanded on the ground: it keeps the motors off."""
BEHIND_S = 1.0
"""How far the pacing may fall behind the clock before it gives up catching up."""


class TiltSettings(Model):
    """How a stand-in answers to a tilt: ``lag_s`` of the attitude, ``drag_1_s`` of the velocity over the air."""

    lag_s: Lag
    drag_1_s: NonNegative


class StickSettings(Model):
    """What every stand-in of this kind has; ``step_s`` is the period of its controller."""

    step_s: float = Field(ge=0.005, le=0.1)
    default: DefaultVehicle
    tilting: TiltSettings


@dataclass(frozen=True)
class Sticks:
    """What is commanded: tilt forward and to the left, climb, and turn counter-clockwise."""

    forward_rad: float = 0.0
    left_rad: float = 0.0
    climb_m_s: float = 0.0
    turn_rad_s: float = 0.0


class Tilting:
    """From sticks to motions of a body that follows velocities: tilt accelerates, drag brakes."""

    def __init__(self, settings: TiltSettings, yaw_rad: float):
        """Level and at rest."""
        self._settings = settings
        self.yaw_rad = yaw_rad
        self.tilt_rad = np.zeros(2)  # forward, left
        self.velocity_m_s = np.zeros(2)  # east, north

    def fly(self, sticks: Sticks, dt: float) -> Motion:
        """The motion of the next ``dt`` s by tilt."""
        s = self._settings
        wanted = np.array([sticks.forward_rad, sticks.left_rad])
        self.tilt_rad += min(1.0, dt / s.lag_s) * (wanted - self.tilt_rad)
        self.yaw_rad += sticks.turn_rad_s * dt
        pushed = _turned(GRAVITY_M_S2 * np.tan(self.tilt_rad), self.yaw_rad) - s.drag_1_s * self.velocity_m_s
        self.velocity_m_s = self.velocity_m_s + dt * pushed
        return self._motion(pushed, sticks.climb_m_s)

    def move(self, forward_m_s: float, left_m_s: float, climb_m_s: float, turn_rad_s: float, dt: float) -> Motion:
        """The motion of the next ``dt`` s by velocities, in the vehicle's heading."""
        self.yaw_rad += turn_rad_s * dt
        wanted = _turned(np.array([forward_m_s, left_m_s]), self.yaw_rad)
        pushed = (wanted - self.velocity_m_s) / (4.0 * self._settings.lag_s)
        self.velocity_m_s = self.velocity_m_s + dt * pushed
        self.tilt_rad = np.arctan(_turned(pushed, -self.yaw_rad) / GRAVITY_M_S2)
        return self._motion(pushed, climb_m_s)

    def stand(self) -> Motion:
        """On the ground."""
        self.tilt_rad, self.velocity_m_s = np.zeros(2), np.zeros(2)
        return Motion(velocity_m_s=(0.0, 0.0, -SINK_M_S), yaw_rad=self.yaw_rad)

    def _motion(self, pushed: np.ndarray, climb_m_s: float) -> Motion:
        east, north = (float(v) for v in self.velocity_m_s)
        return Motion(
            velocity_m_s=(east, north, climb_m_s),
            acceleration_m_s2=(float(pushed[0]), float(pushed[1]), 0.0),
            yaw_rad=self.yaw_rad,
        )


def _turned(x: np.ndarray, angle_rad: float) -> np.ndarray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([c * x[0] - s * x[1], s * x[0] + c * x[1]])


class StickStandin(ABC):
    """A stand-in that steps a body: `step` by a test, or in real time (times ``speed``) as a context manager."""

    exit_code: int | None = None

    def __init__(self, body: Body, settings: StickSettings, speed: float = 1.0):
        """At rest; nothing runs before `step` or ``with``."""
        self.body, self.speed = body, speed
        self.tilting = Tilting(settings.tilting, yaw_of_quaternion(body.sensed.quaternion))
        self.time_s = 0.0
        self.lateness_s = 0.0
        self.log: list[str] = []
        """What has happened, in sentences."""
        self._error: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)

    @property
    @abstractmethod
    def mode(self) -> str:
        """What it does, in its own words."""

    @property
    @abstractmethod
    def armed(self) -> bool:
        """Whether its motors run."""

    @abstractmethod
    def receive(self) -> None:
        """Take what has come over the wire."""

    @abstractmethod
    def command(self, sensed: Sensed, dt: float) -> Motion:
        """The motion of the next ``dt`` s."""

    @abstractmethod
    def tell(self) -> None:
        """Send what is due."""

    def step(self) -> None:
        """One step: the wire, the controller, the body, the telemetry."""
        dt = self.body.step_s
        self.receive()
        motion = self.command(self.body.sensed, dt)
        self.body.step(motion, self.armed)
        self.time_s += dt
        self.tell()

    def wait(self, seconds: float) -> bool:
        """Wait; whether it has ended meanwhile."""
        return self._stop.wait(seconds)

    def __enter__(self) -> "StickStandin":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(5.0)
        if self._error is not None and error is None:
            raise self._error

    def _run(self) -> None:
        try:
            self._paced()
        except Exception as error:  # told by __exit__, in the thread that waits for the end
            self._error = error
            self._stop.set()

    def _paced(self) -> None:
        due = time.monotonic()
        period = self.body.step_s / self.speed
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            self.step()
            due += period
            late = time.monotonic() - due
            self.lateness_s = max(self.lateness_s, late)
            if late > BEHIND_S:
                due += late
