"""The link of each kind of firmware."""

from swarmsim.sitl.ardupilot import ArdupilotLink
from swarmsim.sitl.link import FirmwareLink, Seat
from swarmsim.sitl.px4 import Px4Link
from swarmsim.sitl.settings import SitlSettings

_LINKS: dict[str, type[Px4Link] | type[ArdupilotLink]] = {"px4": Px4Link, "ardupilot": ArdupilotLink}


def open_link(seat: Seat, settings: SitlSettings) -> FirmwareLink:
    """Listen for the firmware of one vehicle; raises `FirmwareError` where another program does already."""
    return _LINKS[settings.autopilot](seat, settings)
