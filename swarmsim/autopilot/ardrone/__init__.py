"""Parrot AR.Drone 2.0: AT commands and navdata over UDP.

Source: Parrot, AR.Drone Developer Guide, SDK 2.0 (19 December 2012).
"""

from swarmsim.autopilot.ardrone.settings import ArdroneSettings
from swarmsim.autopilot.ardrone.vehicle import ArdroneVehicle

__all__ = ["ArdroneSettings", "ArdroneVehicle"]
