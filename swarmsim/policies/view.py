"""What a policy is given: its task, and a view of what its vehicle could know. One vehicle each."""

from typing import Any

import jax

from swarmsim.estimation.radiation_map import MappingParams, RadiationMap
from swarmsim.estimation.recursive_map import Binned, read
from swarmsim.policies.path import Path
from swarmsim.pytree import pytree
from swarmsim.sensors.radiation import Reading
from swarmsim.sensors.suite import Readings
from swarmsim.site import Site
from swarmsim.world.radio import Heard


@pytree
class Task:
    """What a vehicle is to do in a phase."""

    settings: Any  # numbers of the phase's settings, as an object with their names
    site: Site  # the true one, whatever `knowledge.site` is; shared by all vehicles
    home_m: jax.Array  # [2] where the vehicle started the mission, world
    yaw_rad: jax.Array  # [] its heading then, counter-clockwise from east
    params: Any  # its own parameters, e.g. ``params.control.speed_max_m_s``
    rank: jax.Array  # [] int32: number among the vehicles of the phase
    path: Path | None  # of a planner; None for a policy that needs none
    known: Any  # what the policy's own `task` made of the scenario, shared by all vehicles; None without it


@pytree
class Belief:
    """What the team knows of the radiation, shared by all vehicles, as of the last decision."""

    params: MappingParams
    binned: Binned

    def map(self) -> RadiationMap:
        """The map of the count rate with its standard deviation: costs a solution, so ask in a slow policy only."""
        return read(self.params, self.binned)


@pytree
class View:
    """What one vehicle knows now. World ENU, body FLU."""

    time_s: jax.Array  # [] since the mission began
    position_m: jax.Array  # [3] world
    quaternion: jax.Array  # [4] w x y z, body to world
    velocity_m_s: jax.Array  # [3] world
    angular_velocity_rad_s: jax.Array  # [3] body
    battery: jax.Array  # [] share of the capacity that is left
    height_m: jax.Array  # [] of its feet above what is below: ground, a roof or a deck; zero for a rover
    hold: jax.Array  # [] bool: another vehicle has the right of way
    push_m: jax.Array  # [3] displacement that keeps apart from it, world
    nearest_m: jax.Array  # [] distance of the nearest other vehicle; inf where none is near
    reading: Reading | None  # of its detector (without the axis U); None without one
    heard: Heard | None  # from its team mates; None if no policy of the mission listens
    belief: Belief | None  # None where the mission maps nothing
    sensors: Readings | None = None  # of its navigation sensors, at the last judging period; None if no policy senses
