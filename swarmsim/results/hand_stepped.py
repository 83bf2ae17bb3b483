"""A mission that was stepped by hand, as a record like any other.

def tick(state, _):
    state, readings = swarmsim.step(world, state, commands(state))
    return state, swarmsim.observe(world, state)

state, frames = jax.lax.scan(tick, simulation.reset(seed=0), None, length=1000)
record = swarmsim.record_steps(simulation, frames, seed=0)
"""

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.missions.state import Track
from swarmsim.pytree import pytree
from swarmsim.results.departures import departures_of
from swarmsim.results.extract import CROWDED
from swarmsim.results.record import Event, MissionRecord, Phase, VehicleRecord
from swarmsim.results.samples import READ, measured_rows, samples_of, windows_of
from swarmsim.results.sources import gamma_constants, true_sources
from swarmsim.results.tracks import TRACK, losses, place_of, vehicle_record
from swarmsim.runtime.simulation import Simulation
from swarmsim.sensors.radiation import Reading
from swarmsim.world.model import World
from swarmsim.world.state import WorldState

BY_HAND = "by hand"
"""Name of the only phase, and of its policy."""


@pytree
class GroupFrame:
    """One group at one time; leading axis U."""

    track: Track  # without the axis T
    event_time_s: jax.Array  # [U, kinds] first time of each kind of event, inf where there was none
    reading: Reading | None  # of its detectors; None without


@pytree
class Frame:
    """What one tick leaves."""

    time_s: jax.Array  # [] since the start
    groups: tuple[GroupFrame, ...]
    crowded: jax.Array  # [] bool: as in `WorldState`


def observe(world: World, state: WorldState) -> Frame:
    """What `record_steps` needs of a state: pure, so it can be an output of `jax.lax.scan`."""
    groups = tuple(
        GroupFrame(
            track=Track(
                position_m=g.vehicle.body.position_m,
                quaternion=g.vehicle.body.quaternion,
                velocity_m_s=g.vehicle.body.velocity_m_s,
                energy_j=g.vehicle.energy_j,
                active=g.active,
            ),
            event_time_s=g.event_time_s,
            reading=None if g.counter is None else g.counter.reading,
        )
        for g in state.groups
    )
    time_s = state.clock.tick * jnp.float32(world.timing.control_period_s)
    return Frame(time_s=time_s, groups=groups, crowded=state.crowded)


def record_steps(simulation: Simulation, frames: Frame, seed: int, world: World | None = None) -> MissionRecord:
    """The record of one mission that was stepped by hand: a single phase, in which all vehicles have a part.

    Args:
        simulation: whose world was stepped.
        frames: from `observe`, stacked over T times on the leading axis, as `jax.lax.scan` does. Not every tick has to
            be observed; of the exposures that end between two frames only the last one is recorded.
        seed: of the mission.
        world: if others than ``simulation.world``, whose values are recorded as the truth.

    Raises:
        ValueError: frames are not those of one mission at one time or more.
    """
    frames = jax.tree.map(np.asarray, frames)
    if frames.time_s.ndim != 1 or not len(frames.time_s):
        raise ValueError(
            f"frames must be stacked over time on their leading axis, for one mission: time_s has the shape "
            f"{frames.time_s.shape}, it must be (T,) with T at least 1"
        )
    times = frames.time_s
    vehicles = tuple(_vehicle(simulation, frames, number) for number in range(len(simulation.scenario.members)))
    phase = Phase(
        name=BY_HAND,
        policy=BY_HAND,
        vehicles=tuple(range(len(vehicles))),
        start_s=float(times[0]),
        end_s=float(times[-1]),
        in_time=True,
    )
    sources = true_sources(simulation, simulation.world if world is None else world, vehicles)
    return MissionRecord(
        name=simulation.scenario.mission.name,
        site=simulation.site_model.name,
        seed=seed,
        phases=(phase,),
        vehicles=vehicles,
        samples=samples_of(_readings(simulation, frames), [phase]),
        sought="nothing",
        map=None,
        survey_estimate=None,
        surveyed_s=phase.end_s,
        estimate=None,
        spectrum=None,
        sources=sources,
        paths_m={},
        events=tuple(_events(simulation, frames)),
        finding="stepped by hand, so nothing was estimated",
        warnings=(CROWDED,) if frames.crowded.any() else (),
        drawn=simulation.draws.told(0) if world is None else {},
        windows_kev=windows_of(simulation),
        at_1_m=gamma_constants(simulation, sources),
        departures=departures_of(simulation, simulation.world if world is None else world, None, seed),
    )


def _vehicle(simulation: Simulation, frames: Frame, number: int) -> VehicleRecord:
    group, local = place_of(simulation, number)
    frame = frames.groups[group]
    track = {name: getattr(frame.track, name)[:, local] for name in TRACK}
    return vehicle_record(simulation, number, track | {"time_s": frames.time_s}, frame.event_time_s[-1, local])


def _events(simulation: Simulation, frames: Frame) -> list[Event]:
    found = []
    for number, member in enumerate(simulation.scenario.members):
        group, local = place_of(simulation, number)
        found += losses(member.name, frames.groups[group].event_time_s[-1, local])
    return sorted(found, key=lambda event: event.time_s)


def _readings(simulation: Simulation, frames: Frame) -> list[dict[str, np.ndarray]]:
    """Valid readings of each group that were new in their frame."""
    found = []
    for group, frame in zip(simulation.world.groups, frames.groups, strict=True):
        reading = frame.reading
        if reading is None:
            continue
        new = np.concatenate([reading.fresh[:1], np.diff(reading.time_s, axis=0) > 0.0]) & reading.valid
        rows = {name: getattr(reading, name)[new] for name in READ}
        rows["vehicle"] = np.broadcast_to(np.asarray(group.member, np.int32), new.shape)[new]
        found.append(measured_rows(simulation, group, rows))
    return found
