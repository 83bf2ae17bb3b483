"""What the stand-in answers: commands, parameters, missions, time. Everything else is passed over."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmsim.autopilot.standin.core import Autopilot, Command
from swarmsim.autopilot.standin.messages import Streams
from swarmsim.autopilot.standin.targets import Target

ACCEPTED, UNSUPPORTED, DENIED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_UNSUPPORTED, mav.MAV_RESULT_DENIED
HIGH_M = 1e4
"""Largest altitude of a place in a command."""

# What REQUEST_DATA_STREAM of ArduPilot brings
_DATA_STREAMS = {
    mav.MAV_DATA_STREAM_EXTENDED_STATUS: ("SYS_STATUS", "GPS_RAW_INT"),
    mav.MAV_DATA_STREAM_POSITION: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    mav.MAV_DATA_STREAM_EXTRA1: ("ATTITUDE",),
    mav.MAV_DATA_STREAM_EXTRA2: ("VFR_HUD",),
    mav.MAV_DATA_STREAM_EXTRA3: ("BATTERY_STATUS", "EKF_STATUS_REPORT", "SYSTEM_TIME"),
}


class Requests:
    """Messages to the autopilot, taken to where they belong."""

    def __init__(self, pilot: Autopilot, streams: Streams):
        """Answer for ``pilot``."""
        self._pilot, self._streams = pilot, streams
        self._handlers: dict[str, Callable[[Any], None]] = {
            "HEARTBEAT": self._heartbeat,
            "COMMAND_LONG": self._command_long,
            "COMMAND_INT": self._command_int,
            "SET_MODE": self._set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._pilot.setpoint,
            "SET_POSITION_TARGET_GLOBAL_INT": self._pilot.setpoint,
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "MISSION_REQUEST_LIST": self._mission_list,
            "MISSION_COUNT": self._mission_refused,
            "MISSION_CLEAR_ALL": self._mission_cleared,
            "REQUEST_DATA_STREAM": self._data_stream,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
        }
        self._commands: dict[int, Callable[[Command], int | list[int]]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mav.MAV_CMD_DO_SET_MODE: self._do_set_mode,
            mav.MAV_CMD_RUN_PREARM_CHECKS: lambda _: self._pilot.prearm_checks(),
            mav.MAV_CMD_NAV_TAKEOFF: self._pilot.take_off,
            mav.MAV_CMD_NAV_LAND: lambda _: self._mode_of_role("land"),
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self._mode_of_role("return"),
            mav.MAV_CMD_NAV_LOITER_UNLIM: lambda _: self._mode_of_role("hold"),
            mav.MAV_CMD_DO_REPOSITION: self._reposition,
            mav.MAV_CMD_DO_CHANGE_SPEED: lambda _: ACCEPTED,
            mav.MAV_CMD_DO_SET_HOME: self._set_home,
            mav.MAV_CMD_GET_HOME_POSITION: lambda _: self._sent("HOME_POSITION"),
            mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: lambda _: self._sent("AUTOPILOT_VERSION"),
            mav.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mav.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mav.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
        }

    def receive(self, message: Any) -> None:
        """Do what one message says, if it is for this vehicle."""
        handler = self._handlers.get(message.get_type())
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        whom = message.get_srcSystem(), message.get_srcComponent()
        mine = system in (0, self._pilot.system) and component in (0, self._pilot.component)
        if handler is not None and mine and whom != (self._pilot.system, self._pilot.component):
            handler(message)

    def _heartbeat(self, message: Any) -> None:
        self._pilot.heard[message.get_srcSystem()] = self._pilot.time_s

    # Commands

    def _command_long(self, message: Any) -> None:
        p = (message.param1, message.param2, message.param3, message.param4, message.param5, message.param6)
        self._do(Command(message.command, (*p, message.param7), message.get_srcSystem(), message.get_srcComponent()))

    def _command_int(self, message: Any) -> None:
        p = (message.param1, message.param2, message.param3, message.param4, message.x * 1e-7, message.y * 1e-7)
        whom = message.get_srcSystem(), message.get_srcComponent()
        self._do(Command(message.command, (*p, message.z), *whom, frame=message.frame))

    def _do(self, command: Command) -> None:
        known = self._commands.get(command.number)
        results = UNSUPPORTED if known is None else known(command)
        for result in [results] if isinstance(results, int) else results:
            self._pilot.send(
                mav.MAVLink_command_ack_message(command.number, result, 0, 0, command.system, command.component)
            )

    def _arm_disarm(self, command: Command) -> int:
        if command.params[0] == 1.0:
            return self._pilot.arm(force=command.params[1] in (2989.0, 21196.0))
        return self._pilot.disarm_command(command) if command.params[0] == 0.0 else DENIED

    def _do_set_mode(self, command: Command) -> list[int]:
        base, main, sub = command.params[:3]
        if not all(map(math.isfinite, (base, main))) or not int(base) & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return [DENIED]
        number = int(main)
        if self._pilot.type_number == mav.MAV_AUTOPILOT_PX4:
            number = int(main) << 16 | (int(sub) if math.isfinite(sub) else 0) << 24
        return self._pilot.set_mode(self._mode_named(number))

    def _set_mode(self, message: Any) -> None:
        if message.base_mode & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            results = self._pilot.set_mode(self._mode_named(message.custom_mode))
            whom = message.get_srcSystem(), message.get_srcComponent()
            self._pilot.send(mav.MAVLink_command_ack_message(self._pilot.set_mode_told_as, results[-1], 0, 0, *whom))

    def _mode_named(self, number: int) -> str | None:
        return next((name for name, known in self._pilot.modes.items() if known == number), None)

    def _mode_of_role(self, role: str) -> int:
        name = next((name for name, its in self._pilot.roles.items() if its == role), None)
        return UNSUPPORTED if name is None else self._pilot.set_mode(name)[-1]

    def _reposition(self, command: Command) -> int:
        """Fly to a place: HOLD there on PX4, GUIDED on ArduPilot."""
        pilot = self._pilot
        latitude, longitude, altitude = command.params[4:7]
        if not pilot.armed or not all(map(math.isfinite, (latitude, longitude))) or abs(latitude) > 90.0:
            return pilot.refused
        if not math.isfinite(altitude):
            altitude = pilot.place().altitude_m
        elif abs(altitude) > HIGH_M:
            return pilot.refused
        elif command.frame in (mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT):
            altitude += pilot.home_altitude_m
        role = "hold" if pilot.type_number == mav.MAV_AUTOPILOT_PX4 else "follow"
        result = self._mode_of_role(role)
        x, y, z = map(float, pilot.world_of(latitude, longitude, altitude))
        target = Target(position_m=(x, y, z))
        if result == ACCEPTED and not pilot.reaches(target):
            return pilot.refused
        if result == ACCEPTED and (pilot.airborne or not pilot.flies):
            pilot.follow(target)
        return result

    def _set_home(self, command: Command) -> int:
        pilot = self._pilot
        if command.params[0] == 1.0:
            pilot.home_m = np.array(pilot.sensed.position_m)
            return ACCEPTED
        place = command.params[4:7]
        if not all(map(math.isfinite, place)) or abs(place[0]) > 90.0 or abs(place[2]) > HIGH_M:
            return DENIED
        pilot.home_m = pilot.world_of(*place)
        return ACCEPTED

    def _sent(self, name: str) -> int:
        return ACCEPTED if self._streams.send(name) else self._pilot.refused

    def _request_message(self, command: Command) -> int:
        name = self._streams.name_of(_whole(command.params[0]))
        return UNSUPPORTED if name is None else self._sent(name)

    def _set_interval(self, command: Command) -> int:
        return ACCEPTED if self._streams.set(_whole(command.params[0]), command.params[1]) else self._pilot.refused

    def _get_interval(self, command: Command) -> int:
        number = _whole(command.params[0])
        if not 0 <= number <= 65535:
            return self._pilot.refused
        self._pilot.send(mav.MAVLink_message_interval_message(number, self._streams.interval_us(number)))
        return ACCEPTED

    # Parameters

    def _param_list(self, message: Any) -> None:
        for name in self._pilot.parameters.names:
            self._pilot.send(self._pilot.parameters.message(name))

    def _param_read(self, message: Any) -> None:
        name = self._pilot.parameters.asked(_text(message.param_id), message.param_index)
        if name is not None:
            self._pilot.send(self._pilot.parameters.message(name))

    def _param_set(self, message: Any) -> None:
        name = self._pilot.parameters.set(_text(message.param_id), message.param_value, message.param_type)
        if name is not None:
            self._pilot.send(self._pilot.parameters.message(name))

    # Missions: there are none

    def _mission_list(self, message: Any) -> None:
        whom = message.get_srcSystem(), message.get_srcComponent()
        self._pilot.send(mav.MAVLink_mission_count_message(*whom, 0, message.mission_type))

    def _mission_refused(self, message: Any) -> None:
        self._mission_answer(message, mav.MAV_MISSION_ACCEPTED if message.count == 0 else mav.MAV_MISSION_UNSUPPORTED)

    def _mission_cleared(self, message: Any) -> None:
        self._mission_answer(message, mav.MAV_MISSION_ACCEPTED)

    def _mission_answer(self, message: Any, result: int) -> None:
        whom = message.get_srcSystem(), message.get_srcComponent()
        self._pilot.send(mav.MAVLink_mission_ack_message(*whom, result, message.mission_type))

    # Streams and time

    def _data_stream(self, message: Any) -> None:
        """ArduPilot's older way of asking for telemetry."""
        if self._pilot.type_number == mav.MAV_AUTOPILOT_PX4:
            return
        groups = (
            _DATA_STREAMS.values() if message.req_stream_id == 0 else [_DATA_STREAMS.get(message.req_stream_id, ())]
        )
        rate = message.req_message_rate if message.start_stop else 0
        for name in (name for group in groups for name in group):
            number = getattr(mav, f"MAVLINK_MSG_ID_{name}")
            self._streams.set(number, 1e6 / rate if rate > 0 else -1.0)

    def _timesync(self, message: Any) -> None:
        if message.tc1 == 0:
            now = round(self._pilot.time_s * 1e9)
            self._pilot.send(mav.MAVLink_timesync_message(now, message.ts1))

    def _ping(self, message: Any) -> None:
        if message.target_system == 0:
            whom = message.get_srcSystem(), message.get_srcComponent()
            self._pilot.send(mav.MAVLink_ping_message(message.time_usec, message.seq, *whom))


def _whole(value: float) -> int:
    """A number of a message, -1 for what is none."""
    return int(value) if math.isfinite(value) and abs(value) < 2**31 else -1


def _text(name: str | bytes) -> str:
    raw = name if isinstance(name, bytes) else name.encode("utf-8", "replace")
    return raw.split(b"\0")[0].decode("ascii", "replace")
