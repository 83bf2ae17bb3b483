"""Tracks and losses of single vehicles, from the arrays of their groups."""

from collections.abc import Mapping

import jax
import numpy as np

from swarmsim.results.record import Event, VehicleRecord
from swarmsim.results.vehicle_shape import shape_of
from swarmsim.runtime.simulation import Simulation
from swarmsim.world import events

TRACK = ("position_m", "quaternion", "velocity_m_s", "energy_j")
"""Columns of a track, as in `swarmsim.missions.state.Track`."""


def place_of(simulation: Simulation, number: int) -> tuple[int, int]:
    """Group, and place in it, of a vehicle of the mission."""
    for g, group in enumerate(simulation.world.groups):
        found = np.flatnonzero(np.asarray(group.member) == number)
        if len(found):
            return g, int(found[0])
    raise IndexError(f"there is no vehicle {number}")


def vehicle_record(
    simulation: Simulation, number: int, track: Mapping[str, np.ndarray], event_time_s: jax.Array | np.ndarray
) -> VehicleRecord:
    """One vehicle, from its ``track`` (``time_s`` and `TRACK`, leading axis n) and its event times [kinds]."""
    member, spec = simulation.scenario.members[number], simulation.scenario.vehicles[number]
    energy_wh = track["energy_j"] / 3600.0
    return VehicleRecord(
        name=member.name,
        type=member.type,
        kind=spec.kind,
        time_s=track["time_s"],
        position_m=track["position_m"],
        quaternion=track["quaternion"],
        velocity_m_s=track["velocity_m_s"],
        energy_wh=energy_wh,
        battery_fraction=np.clip(1.0 - energy_wh / spec.battery.capacity_wh, 0.0, 1.0),
        crashed=bool(np.isfinite(event_time_s[: len(events.LOSSES)]).any()),
        shape=shape_of(spec),
    )


def still_vehicle(simulation: Simulation, number: int) -> VehicleRecord:
    """One vehicle without a track: its name, kind and shape, to draw it."""
    nothing = {"time_s": np.zeros(0), "position_m": np.zeros((0, 3)), "quaternion": np.zeros((0, 4))}
    nothing |= {"velocity_m_s": np.zeros((0, 3)), "energy_j": np.zeros(0)}
    return vehicle_record(simulation, number, nothing, np.full(len(events.KINDS), np.inf))


def losses(vehicle: str, event_time_s: jax.Array | np.ndarray) -> list[Event]:
    """What ended the part of a vehicle in the mission, from its event times [kinds]."""
    return [
        Event(float(time), vehicle, kind, events.DESCRIPTIONS[kind])
        for kind, time in zip(events.KINDS, event_time_s, strict=True)
        if np.isfinite(time)
    ]
