"""What every link from our physics to firmware can do (`FirmwareLink`), and whose actuator is which."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarmsim.autopilot.frames import Geodetic, geodetic_of_enu
from swarmsim.autopilot.link import LinkError
from swarmsim.config.errors import InputError
from swarmsim.config.vehicles import Multirotor, SkidSteer
from swarmsim.sitl.plant import ACTUATORS, Sensed, Truth
from swarmsim.sitl.settings import SitlSettings

Array = NDArray[np.float64]

MATCHES_DEG = 25.0
"""A motor of the vehicle's file is at most so far from the azimuth that the firmware's frame has it at."""


class FirmwareError(LinkError):
    """The firmware ended or does not answer; the message says which and what to do."""


@dataclass(frozen=True)
class Seat:
    """One vehicle behind firmware."""

    name: str
    number: int  # in the team of the plant, and of the firmware's instance
    flies: bool
    motors: tuple[int, ...]  # the firmware's output of each rotor of the file, in its order; of a rover left and right
    origin: Geodetic  # of the world


class FirmwareLink(Protocol):
    """A link to the firmware of one vehicle."""

    seat: Seat
    address: str
    restarts: int  # times that the firmware has begun anew during the session

    def connected(self) -> bool:
        """Whether the firmware has come; to be asked again and again. Never waits."""

    def tell(self, truth: Truth, sensed: Sensed, tick: int) -> None:
        """Send what its sensors read; raises `FirmwareError` when it has ended."""

    def hear(self, timeout_s: float) -> bool:
        """Wait until it has answered what it was told last; False when the time is up."""

    @property
    def actuators(self) -> Array:
        """[8] what it wants of the actuators, the latest."""

    def close(self) -> None:
        """Close the link."""


def seat_of(name: str, number: int, vehicle: Multirotor | SkidSteer, settings: SitlSettings, origin: Geodetic) -> Seat:
    """The vehicle ``number`` of a plant. Raises `InputError` where the firmware has no frame with its rotors."""
    if isinstance(vehicle, SkidSteer):
        channels = settings.rover_channels
        return Seat(name, number, False, (channels.left, channels.right), origin)
    count = len(vehicle.rotors)
    if not settings.motors_deg:
        motors = tuple(range(count))
    elif count in settings.motors_deg:
        motors = _matched(name, vehicle, settings.motors_deg[count])
    else:
        known = ", ".join(map(str, settings.motors_deg))
        raise InputError.of(
            f"{settings.autopilot} has no frame for the rotors of '{name}'", given=f"{count} rotors", allowed=known
        )
    return Seat(name, number, True, motors, origin)


def _matched(name: str, vehicle: Multirotor, azimuths_deg: tuple[float, ...]) -> tuple[int, ...]:
    """Number of the firmware's motor at each rotor of the vehicle's file."""
    motors = []
    for rotor in vehicle.rotors:
        x, y, _ = rotor.position_m
        azimuth = np.degrees(np.arctan2(-y, x))
        apart = np.abs((np.asarray(azimuths_deg) - azimuth + 180.0) % 360.0 - 180.0)
        motors.append(int(np.argmin(apart)))
        if apart.min() > MATCHES_DEG:
            raise InputError.of(
                f"a rotor of '{name}' is where the firmware's X frame has none", given=f"azimuth {azimuth:.0f} deg",
                allowed=", ".join(f"{a:g}" for a in azimuths_deg),
            )  # fmt: skip
    if len(set(motors)) != len(motors):
        raise InputError.of(f"two rotors of '{name}' are at one motor of the firmware's X frame", given=str(motors))
    return tuple(motors)


def ordered(seat: Seat, outputs: Array) -> Array:
    """The plant's actuators [8] from the firmware's ``outputs`` [n], already -1 to 1."""
    actuators = np.zeros(ACTUATORS)
    actuators[: len(seat.motors)] = np.asarray(outputs)[list(seat.motors)]
    return actuators


def place_of(seat: Seat, position_m: Array) -> Geodetic:
    """Where a position [3] of the world lies on the Earth."""
    return geodetic_of_enu(position_m, seat.origin)
