"""A stand-in in lockstep with its test: no sockets, no threads, no clock; everything that it says is kept."""

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.standin.body import Body
from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.autopilot.standin.settings import load_settings
from swarmsim.autopilot.standin.vehicle import Standin

POSITION, VELOCITY = 3576, 3527
LOCAL, OFFSET, BODY, BODY_OFFSET = 1, 7, 8, 9
READY_S = 6.0


class Bench:
    """A stand-in and the client that a test plays."""

    def __init__(self, autopilot: str, *, flies: bool = True, body: Body | None = None, system: int = 1):
        settings = load_settings(autopilot)
        self.standin = Standin(body or KinematicBody(flies=flies), settings, system=system)
        self.standin.sent = lambda message: self.heard.append((self.standin.time_s, message))
        self.heard: list[tuple[float, Any]] = []
        self.system = system

    def advance(self, seconds: float) -> "Bench":
        self.standin.advance(seconds)
        return self

    def all(self, name: str) -> list[Any]:
        return [message for _, message in self.heard if message.get_type() == name]

    def last(self, name: str) -> Any:
        return self.all(name)[-1]

    def forget(self) -> None:
        self.heard.clear()

    def command(self, number: int, *params: float, **fields: Any) -> list[int]:
        """Results that a command is acknowledged with."""
        before = len(self.all("COMMAND_ACK"))
        seven = [*params, *[0.0] * (7 - len(params))]
        self.standin.deliver(mav.MAVLink_command_long_message(self.system, 1, number, 0, *seven), **fields)
        return [ack.result for ack in self.all("COMMAND_ACK")[before:] if ack.command == number]

    def set_mode(self, main: int, sub: int = 0) -> list[int]:
        return self.command(mav.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def arm(self, arm: int = 1, force: float = 0.0) -> list[int]:
        return self.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, arm, force)

    def setpoint(
        self, mask: int, frame: int = LOCAL, position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), yaw=0.0, rate=0.0
    ) -> None:
        """NED."""
        self.standin.deliver(
            mav.MAVLink_set_position_target_local_ned_message(
                0, self.system, 1, frame, mask, *position, *velocity, 0.0, 0.0, 0.0, yaw, rate
            )
        )

    def stream(self, seconds: float, hz: float = 20.0, **setpoint: Any) -> "Bench":
        """Setpoints at a rate."""
        setpoint.setdefault("mask", POSITION)
        for _ in range(round(seconds * hz)):
            self.setpoint(**setpoint)
            self.advance(1.0 / hz)
        return self

    @property
    def position(self) -> tuple[float, float, float]:
        """North, east, down of where it was switched on."""
        x, y, z = self.standin.pilot.local.to_local(self.standin.body.sensed.position_m)
        return float(x), float(y), float(z)

    @property
    def height(self) -> float:
        return -self.position[2]

    @property
    def custom_mode(self) -> int:
        return self.last("HEARTBEAT").custom_mode

    def until(self, condition: Any, seconds: float) -> float:
        """Advance until a condition holds; how long that took."""
        start = self.standin.time_s
        while not condition():
            if self.standin.time_s - start > seconds:
                raise AssertionError(f"not within {seconds} s: {self.standin.mode}, {self.position}")
            self.advance(0.1)
        return self.standin.time_s - start

    def telemetry(self, *names: str, hz: float = 10.0) -> None:
        for name in names:
            self.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, getattr(mav, f"MAVLINK_MSG_ID_{name}"), 1e6 / hz)


def px4_mode(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


def px4_flying(height: float = 5.0, **fields: Any) -> Bench:
    """In OFFBOARD at a height."""
    bench = Bench("px4", **fields).advance(READY_S).stream(1.5, position=(0.0, 0.0, -height))
    assert bench.set_mode(6) == [0, 0]
    assert bench.arm() == [0]
    bench.stream(12.0, position=(0.0, 0.0, -height))
    assert math.isclose(bench.height, height, abs_tol=0.3)
    return bench


def ardupilot_flying(height: float = 5.0, **fields: Any) -> Bench:
    """In GUIDED after a take-off."""
    bench = Bench("ardupilot", **fields).advance(READY_S)
    assert bench.set_mode(4) == [0]
    assert bench.arm() == [0]
    assert bench.command(mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height) == [0]
    bench.advance(10.0)
    assert math.isclose(bench.height, height, abs_tol=0.3)
    return bench
