"""Vehicles that speak MAVLink 2: PX4 and ArduPilot, copters and rovers.

What differs between autopilots stands as data in ``configs/autopilots``; NED, FRD and message names stay inside.
"""

from swarmsim.autopilot.mavlink.connection import Connection, LinkStatistics
from swarmsim.autopilot.mavlink.profile import Profile, load_profile
from swarmsim.autopilot.mavlink.vehicle import MavlinkVehicle

__all__ = ["Connection", "LinkStatistics", "MavlinkVehicle", "Profile", "load_profile"]
