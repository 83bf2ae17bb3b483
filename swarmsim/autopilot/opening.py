"""One function for every link: `open_vehicle` makes the `VehicleLink` that a link string means."""

import contextlib
from dataclasses import dataclass
from pathlib import Path

from swarmsim.autopilot.link import VehicleLink
from swarmsim.autopilot.mavlink.transport import ALLOWED as MAVLINK
from swarmsim.autopilot.mavlink.transport import parse_link
from swarmsim.config.errors import InputError
from swarmsim.config.scenario import Scenario

ARDRONE, PELICAN, SIMULATED = "ardrone", "pelican", "sim"
PROFILES = {ARDRONE: "ardrone2", PELICAN: "pelican", SIMULATED: "sim"}
"""Profiles of the links that are not MAVLink; each kind of link has one."""
ALLOWED = "ardrone:HOST[:COMMANDS:NAVDATA] (UDP ports), pelican:DEVICE[:BAUD], sim: (simulated in this process)"
BAUD = 57_600
_BAUD_MAX, _PORT_MAX = 10_000_000, 65_535


@dataclass(frozen=True)
class ArdroneAddress:
    """Where an AR.Drone is; ports that are None are those of its settings."""

    host: str
    commands: int | None = None
    navdata: int | None = None


@dataclass(frozen=True)
class PelicanAddress:
    """The serial device of a Pelican."""

    device: str
    baud: int = BAUD


@dataclass(frozen=True)
class SimulatedAddress:
    """A vehicle that is simulated in this process."""


def kind_of(link: str) -> str:
    """``ardrone``, ``pelican``, ``sim``, or ``mavlink`` for everything else."""
    kind = link.strip().partition(":")[0]
    return kind if kind in PROFILES else "mavlink"


def log_suffix(link: str) -> str:
    """How the file is called that a link's log is written to: ``.tlog`` of MAVLink, ``.log`` of the others."""
    return ".tlog" if kind_of(link) == "mavlink" else ".log"


def parse(link: str) -> ArdroneAddress | PelicanAddress | SimulatedAddress | str:
    """What a link string means; a MAVLink link as it is. Raises `InputError` with all allowed forms."""
    kind, text = kind_of(link), link.strip()
    rest = text.partition(":")[2]
    if kind == PELICAN:
        device, colon, baud = rest.rpartition(":")
        device, number = (device, _number(baud, _BAUD_MAX)) if colon else (rest, BAUD)
        if device and number is not None:
            return PelicanAddress(device, number)
    elif kind == SIMULATED:
        if not rest and text.endswith(":"):
            return SimulatedAddress()
    elif kind == ARDRONE:
        host, *ports = rest.split(":")
        numbers = [_number(port, _PORT_MAX) for port in ports]
        if host and " " not in host and len(ports) in (0, 2) and None not in numbers:
            return ArdroneAddress(host, *numbers)
    else:
        with contextlib.suppress(InputError):
            parse_link(text)
            return text
    raise InputError.of("this is no link to a vehicle", path="--link", given=link, allowed=f"{ALLOWED}; {MAVLINK}")


def _number(text: str, most: int) -> int | None:
    if not (text.isascii() and text.isdigit() and len(text) <= 8):
        return None
    return int(text) if 0 < int(text) <= most else None


def open_vehicle(
    link: str, *, profile: str = "auto", system: int | None = None, log: Path | None = None,
    key_file: Path | None = None, dry: bool = False, timeout_s: float = 10.0,
    simulated: tuple[Scenario, str] | None = None,
) -> VehicleLink:  # fmt: skip
    """Open ``link`` and find the vehicle there.

    ``profile`` is px4 or ardupilot for MAVLink, ardrone2, pelican, or auto; ``system`` (its system id) and ``key_file``
    (the signing key) are of MAVLink alone. ``log`` is the file that everything sent and received is written to, named
    with `log_suffix`; a simulated vehicle has none. ``simulated`` is the mission and the name of the vehicle that
    ``sim:`` simulates. With ``dry`` nothing is sent that moves the vehicle. Raises `InputError` for what cannot be
    meant, `LinkError` when no such vehicle is heard within ``timeout_s``.
    """
    address = parse(link)
    kind = kind_of(link)
    if isinstance(address, str):
        if profile in PROFILES.values():
            raise _other_profile(link, profile, "px4, ardupilot or auto")
        from swarmsim.autopilot.mavlink import MavlinkVehicle

        return MavlinkVehicle(
            address, autopilot=profile, system=system, log=log, key_file=key_file, dry=dry, timeout_s=timeout_s
        )
    if profile not in ("auto", PROFILES[kind]):
        raise _other_profile(link, profile, f"{PROFILES[kind]} or auto")
    for name, value in (("--system", system), ("--signing-key", key_file)):
        if value is not None:
            raise InputError.of(f"{name} is of MAVLink links alone", path=name, given=str(value))
    if isinstance(address, SimulatedAddress):
        return _simulated(simulated)
    if isinstance(address, ArdroneAddress):
        return _ardrone(address, log, dry, timeout_s)
    return _pelican(address, log, dry, timeout_s)


def _simulated(of: tuple[Scenario, str] | None) -> VehicleLink:
    if of is None:
        raise InputError.of(
            "a simulated vehicle is as old as its flight: there is none to be found", path="--link", given="sim:"
        )
    from swarmsim.autopilot.simulated import simulated_vehicle

    return simulated_vehicle(*of, of[0].mission.seed)


def _other_profile(link: str, profile: str, allowed: str) -> InputError:
    return InputError.of(f"the link {link} has no such profile", path="--profile", given=profile, allowed=allowed)


def _ardrone(address: ArdroneAddress, log: Path | None, dry: bool, timeout_s: float) -> VehicleLink:
    from swarmsim.autopilot.ardrone import ArdroneSettings, ArdroneVehicle
    from swarmsim.autopilot.settings import load_settings

    settings = load_settings(PROFILES[ARDRONE], ArdroneSettings)
    if address.commands is not None and address.navdata is not None:
        ports = {"command_port": address.commands, "navdata_port": address.navdata}
        settings = settings.model_copy(update=ports)
    return ArdroneVehicle(address.host, settings, log=log, dry=dry, timeout_s=timeout_s)


def _pelican(address: PelicanAddress, log: Path | None, dry: bool, timeout_s: float) -> VehicleLink:
    from swarmsim.autopilot.pelican import PelicanSettings, PelicanVehicle
    from swarmsim.autopilot.settings import load_settings

    settings = load_settings(PROFILES[PELICAN], PelicanSettings)
    return PelicanVehicle(address.device, settings, baud=address.baud, log=log, dry=dry, timeout_s=timeout_s)
