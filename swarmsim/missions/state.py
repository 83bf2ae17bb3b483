"""What one mission carries while it runs: its world, its phases, its policies' memories, what it has measured."""

from typing import Any

import jax

from swarmsim.estimation import Estimated, Hotspots, RadiationMap
from swarmsim.estimation.recursive_map import Binned
from swarmsim.estimation.windows import Windows
from swarmsim.missions.trail import Trail
from swarmsim.policies.path import Path
from swarmsim.pytree import pytree
from swarmsim.sensors.suite import Readings
from swarmsim.world.sensing import Sensed
from swarmsim.world.state import WorldState

NO_PHASE = -1


@pytree
class Survey:
    """What the counts told: a map, its hotspots, and an estimate of the sources."""

    map: RadiationMap
    hotspots: Hotspots
    estimated: Estimated
    found: jax.Array  # [] bool: there is a source


@pytree
class PhaseState:
    """One phase; leading axis M: its vehicles."""

    began_s: jax.Array  # [] inf: not yet
    asked_s: jax.Array  # [] when its planner was last asked
    ended_s: jax.Array  # [] inf: not yet
    done_s: jax.Array  # [M] when each vehicle's part was done; inf: not yet
    in_time: jax.Array  # [] bool: it has not been ended by its time limit
    memory: Any  # [M] of the policy
    held: Any  # [M] last command of a policy that acts less often than the vehicles are controlled; else None
    path: Path | None  # [M] of a planner


@pytree
class Sensing:
    """Navigation sensors of the team, and what they read last."""

    sensed: Sensed
    readings: tuple[Readings | None, ...]  # for each group, leading axis U; None without sensors


@pytree
class MissionState:
    """All of one mission that changes."""

    world: WorldState
    phases: tuple[PhaseState, ...]
    phase_of: tuple[jax.Array, ...]  # for each group [U] int32: phase that each vehicle is in, or NO_PHASE
    belief: Binned | None
    windows: tuple[Windows | None, ...]  # for each group: what its detectors counted
    survey: Survey | None  # for the last phase that asked for the source; None if sources are not estimated
    over_s: jax.Array  # [] when the mission ended; inf: it has not
    sensing: Sensing | None  # None if no policy senses
    trail: Trail | None = None  # of the vehicles that carry sources, where spectra are drawn: truth, not known to it


@pytree
class Signals:
    """What the host wants to know at a decision."""

    begin: jax.Array  # [P] bool: phases whose policy or planner is to be started or asked again
    running: jax.Array  # [P] bool: phases under way
    active: jax.Array  # [G] bool: groups with a vehicle that has a part in the mission, or rides on a rover
    over: jax.Array  # [] bool


@pytree
class Track:
    """Poses of one group at the log's times; axes [T, U]."""

    position_m: jax.Array  # [T, U, 3] world
    quaternion: jax.Array  # [T, U, 4] w x y z, body to world
    velocity_m_s: jax.Array  # [T, U, 3] world
    energy_j: jax.Array  # [T, U] used since the start
    active: jax.Array  # [T, U] bool: it had a part in the mission, or was carried along


@pytree
class Sampled:
    """Exposures of one group that ended in each judging period; axes [F, U], in the log [E, U] with E <= F."""

    time_s: jax.Array  # [F, U] end of the exposure
    position_m: jax.Array  # [F, U, 3] of the crystal, world
    travel_m: jax.Array  # [F, U, 3]
    axis: jax.Array  # [F, U, 3]
    counts: jax.Array  # [F, U]
    exposure_s: jax.Array  # [F, U]
    rois: jax.Array  # [F, U, R] counts by region of interest
    new: jax.Array  # [F, U] bool: one ended in this period, and it is valid


@pytree
class Log:
    """What one segment of a mission leaves: for each group its track and its samples (None without a detector)."""

    time_s: jax.Array  # [T] of the track
    tracks: tuple[Track, ...]
    samples: tuple[Sampled | None, ...]
