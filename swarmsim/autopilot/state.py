"""Who moves the vehicle: `State`."""

from enum import Enum

ARMS = "arm"  # the stage of a flight from which on its vehicle may leave the ground


class State(Enum):
    """Who moves the vehicle."""

    STANDS = "stands"  # nobody: it is disarmed, or has not been armed yet
    STARTS = "starts"  # it is being armed and takes off
    FOLLOWS = "follows"  # our setpoints
    ENDS = "ends"  # the autopilot, which lands or returns because we asked for it
    HOLDS = "holds"  # the autopilot, which holds in the air because we asked for it
    RELEASED = "released"  # somebody else, for good
