"""One mission's world: all that is true of it and does not change while it runs.

Every leaf may carry a leading axis of missions, so that a mass, a wind, an activity or a dead time is swept without
compiling anew. What decides the compiled program is static: periods, the engine, the groups' kinds and sizes.
"""

from typing import Any

import jax

from swarmsim.pytree import pytree, static
from swarmsim.radiation.background import BackgroundField
from swarmsim.radiation.detector import Source
from swarmsim.scalars import Layout
from swarmsim.sensors.radiation import Counter, Departures
from swarmsim.site import Site
from swarmsim.site.walls import Walls
from swarmsim.world.emission import Emission
from swarmsim.world.failsafes import FailsafeRules


@pytree
class Timing:
    """Periods as whole numbers; all of it is static."""

    time_step_s: float = static()  # of the physics
    substeps: int = static()  # physics steps in a control period
    judge_ticks: int = static()  # control periods between two looks at ground, traffic, wind and events
    log_ticks: int = static()  # control periods between two logged poses, a multiple of judge_ticks
    decision_ticks: int = static()  # control periods between two decisions of the mission, a multiple of log_ticks

    @property
    def control_period_s(self) -> float:
        """Control period [s]: one tick."""
        return self.time_step_s * self.substeps

    @property
    def judge_period_s(self) -> float:
        """Time between two looks at a vehicle [s]."""
        return self.control_period_s * self.judge_ticks

    @property
    def decision_period_s(self) -> float:
        """Time between two decisions of the mission [s]."""
        return self.control_period_s * self.decision_ticks


@pytree
class Air:
    """Wind of the mission."""

    speed_m_s: jax.Array  # [] at 20 ft above ground
    from_rad: jax.Array  # [] bearing that it blows from, clockwise from north
    gusts: jax.Array  # [] 1 with Dryden gusts, 0 without


@pytree
class TrafficRules:
    """Distances that active vehicles keep from each other."""

    separation_m: jax.Array  # [] between multirotors
    ground_separation_m: jax.Array  # [] between rovers


@pytree
class Radio:
    """How broadcasts of vehicles reach their team mates."""

    range_m: jax.Array  # [] inf: unlimited
    loss: jax.Array  # [] probability that a message is lost
    delay: int = static()  # judging periods between sending and hearing
    mates: int = static()  # nearest team mates that are heard


@pytree
class Limits:
    """What ends a vehicle's part; axis U."""

    radius_m: jax.Array  # [U] of the upright cylinder around it
    half_height_m: jax.Array  # [U] of that cylinder, the origin in its middle
    deck_m: jax.Array  # [U, 3] half length, half width and height over the origin of a rover's upper side; else zero
    impact_speed_m_s: jax.Array  # [U] largest speed at which it may meet the ground or a wall
    battery_j: jax.Array  # [U] capacity
    home_m: jax.Array  # [U, 2] where it started, world


@pytree
class Group:
    """Vehicles of one kind, size and sensor suite; leading axis U."""

    params: Any  # parameters of the kind
    limits: Limits
    counter: Counter | None  # radiation detector
    start_m: jax.Array  # [U, 2] where each starts, world
    yaw_rad: jax.Array  # [U] heading at the start, counter-clockwise from east
    member: jax.Array  # [U] int32: number of each in the mission
    kind: str = static()  # a key of `swarmsim.world.kinds.KINDS`

    @property
    def size(self) -> int:
        """Number of vehicles."""
        return int(self.member.shape[-1])


@pytree
class World:
    """The truth: a site with its sources and air, and the team."""

    site: Site
    walls: Walls  # of the site, for what flies
    sources: Source  # points of all sources at the start, leading axis P >= 1; one of no activity stands in for none
    emission: Emission  # of these points: which source, decay, carriers (whose points are in their body frames)
    air: Air
    background: BackgroundField
    departures: Departures
    traffic: TrafficRules
    failsafes: FailsafeRules
    radio: Radio
    groups: tuple[Group, ...]
    timing: Timing
    engine: str = static()  # mjx | analytic
    layout: Layout = static(default="vmap")  # of vehicles; "scalars" is faster to step on a GPU, slower to compile

    @property
    def vehicles(self) -> int:
        """Number of vehicles in the mission."""
        return sum(group.size for group in self.groups)
