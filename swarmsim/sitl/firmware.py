"""Firmware as processes of ours: a start command for each vehicle, and the parameters that suit it."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarmsim.config.errors import InputError
from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.sitl.link import FirmwareError, Seat
from swarmsim.vehicles.state import GRAVITY_M_S2

PLACEHOLDERS = "{instance}, {sysid}, {kind}, {folder}, {home} and {params}"
STARTS = {"px4": "SWARMSIM_PX4_SITL", "ardupilot": "SWARMSIM_ARDUPILOT_SITL"}
"""Environment variables with the start command of each kind."""
ENDS_S = 3.0
_FRAMES = {4: 1, 6: 2, 8: 3}  # FRAME_CLASS of ArduPilot
TOLD_LINES = 12
PRINTED = "firmware.log"  # in each vehicle's folder


def parameters_of(autopilot: str, vehicle: Multirotor | SkidSteer) -> dict[str, float]:
    """Parameters by which the firmware knows the vehicle: its rotors and the thrust that holds it, or its drive."""
    if isinstance(vehicle, SkidSteer):
        return _drive(autopilot, vehicle)
    rotor = vehicle.rotor
    hover = np.sqrt(GRAVITY_M_S2 * vehicle.mass_kg / len(vehicle.rotors) / rotor.thrust_coefficient_n_s2)
    share = float(hover / rotor.speed_max_rad_s)
    if autopilot == "ardupilot":  # thrust goes with the square of the output
        return {
            "FRAME_CLASS": _FRAMES.get(len(vehicle.rotors), 1),
            "FRAME_TYPE": 1,
            "MOT_THST_EXPO": 1.0,
            "MOT_THST_HOVER": round(min(max(share**2, 0.125), 0.6875), 4),
        }
    parameters: dict[str, float] = {"CA_ROTOR_COUNT": len(vehicle.rotors), "MPC_THR_HOVER": round(min(share, 0.8), 4)}
    for number, placed in enumerate(vehicle.rotors):
        x, y, _ = placed.position_m
        moment = 0.05 if placed.spin == "ccw" else -0.05
        parameters |= {
            f"CA_ROTOR{number}_PX": x,
            f"CA_ROTOR{number}_PY": -y,
            f"CA_ROTOR{number}_KM": moment,
        }
    return parameters


def _drive(autopilot: str, vehicle: SkidSteer) -> dict[str, float]:
    """Parameters of a skid-steer rover: full output is its greatest speed (as `plant` takes it), track and limits."""
    control = vehicle.control
    if autopilot == "ardupilot":
        return {"CRUISE_SPEED": control.speed_max_m_s / 2, "CRUISE_THROTTLE": 50.0}
    return {
        "RD_WHEEL_TRACK": vehicle.wheels.track_m,
        "RO_MAX_THR_SPEED": control.speed_max_m_s,
        "RO_SPEED_LIM": control.speed_max_m_s,
        "RO_ACCEL_LIM": control.acceleration_max_m_s2,
        "RO_DECEL_LIM": control.acceleration_max_m_s2,
        "RO_YAW_RATE_LIM": round(float(np.degrees(control.yaw_rate_max_rad_s)), 2),
    }


class Firmware:
    """The firmware of one vehicle as a process, its output in ``folder``/firmware.log."""

    def __init__(self, command: str, autopilot: str, seat: Seat, vehicle: Multirotor | SkidSteer, folder: Path):
        """Start it; raises `InputError` for a command with an unknown name in braces."""
        self.name, self.folder = seat.name, folder
        folder.mkdir(parents=True, exist_ok=True)
        parameters = parameters_of(autopilot, vehicle)
        file = folder / "vehicle.parm"
        file.write_text("".join(f"{name},{value:g}\n" for name, value in parameters.items()), encoding="utf-8")
        place = seat.origin
        known = {
            "instance": seat.number,
            "sysid": seat.number + 1,
            "kind": "copter" if seat.flies else "rover",
            "folder": folder,
            "home": f"{place.latitude_deg:.7f},{place.longitude_deg:.7f},{place.altitude_m:g},0",
            "params": file,
        }
        try:
            line = command.format(**known)
        except (KeyError, IndexError, ValueError) as error:
            raise InputError.of(
                "the start command has an unknown name in braces", path="--start", given=str(error),
                allowed=PLACEHOLDERS + "; other braces are written twice",
            ) from error  # fmt: skip
        named = {f"PX4_PARAM_{name}": f"{value:g}" for name, value in parameters.items()} if autopilot == "px4" else {}
        self.log = folder / PRINTED
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                ["/bin/sh", "-c", line],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for us: the firmware ends when we end it
                env=os.environ | named,
            )

    def check(self) -> None:
        """Raise `FirmwareError` if it has ended."""
        code = self._process.poll()
        if code is not None:
            last = "\n  ".join(self.log.read_text(errors="replace").splitlines()[-TOLD_LINES:])
            raise FirmwareError(f"the firmware of {self.name} has ended with code {code}; it printed last:\n  {last}")

    def stop(self) -> None:
        """End it and all that it started."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            try:
                os.killpg(self._process.pid, number)
            except ProcessLookupError:
                break
            end = time.monotonic() + (ENDS_S if number == signal.SIGTERM else 1.0)
            try:
                while self._process.poll() is None and time.monotonic() < end:
                    time.sleep(0.05)
            except BaseException:  # Ctrl-C once more: there is no time to end by itself
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                raise
        self._process.wait()


def check_all(processes: Sequence[Firmware]) -> None:
    """Raise `FirmwareError` if one of them has ended."""
    for process in processes:
        process.check()
