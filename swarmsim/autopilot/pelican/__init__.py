"""AscTec Pelican: the serial interface of its AutoPilot's low-level processor.

Source: Ascending Technologies, AscTec Hummingbird with AutoPilot User's Manual; AscTec wiki.
"""

from swarmsim.autopilot.pelican.settings import PelicanSettings
from swarmsim.autopilot.pelican.vehicle import PelicanVehicle

__all__ = ["PelicanSettings", "PelicanVehicle"]
