"""What all parts of the recording share: the timeline, names of entities, and how series and meshes are sent."""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmsim.playback.bodies import Mesh
from swarmsim.playback.colours import rgba, vehicle_colours
from swarmsim.results.record import MissionRecord, Phase

TIMELINE = "sim_time"
# Vehicles are drawn larger than life, or nobody would find them on a site of 150 m.
BODY_SCALE = {"multirotor": 5.0, "skid_steer": 3.0}
LARGE_TEAM = 12  # vehicles of a larger team share entities: names beside them and in legends would hide the picture
ALL = "all"
"""Name of the measurements of a large team's vehicles together."""


def path_of(parent: str, name: str) -> str:
    """Entity path of ``name`` below ``parent``, whatever characters it holds."""
    return f"{parent}/{rr.escape_entity_path_part(name)}"


def measurements_path(phase: str) -> str:
    """Entity path of the measurements of a phase."""
    return path_of("world/measurements", phase)


def is_large(record: MissionRecord) -> bool:
    """Whether vehicles share entities."""
    return len(record.vehicles) > LARGE_TEAM


def trails(record: MissionRecord) -> dict[str, tuple[int, ...]]:
    """Vehicles of each entity that draws vehicles: one each, or those of a large team with the same look."""
    if not is_large(record):
        return {vehicle.name: (number,) for number, vehicle in enumerate(record.vehicles)}
    alike: dict[tuple[str, str], list[int]] = {}
    for number, (vehicle, colour) in enumerate(zip(record.vehicles, vehicle_colours(record), strict=True)):
        alike.setdefault((vehicle.type, colour), []).append(number)
    return {f"{kind}_{k + 1}": tuple(numbers) for k, ((kind, _), numbers) in enumerate(alike.items())}


def measurers(record: MissionRecord, phase: Phase) -> dict[str, tuple[int, ...]]:
    """Vehicles of each entity that shows measurements of a phase: one each, or all of a large team."""
    if is_large(record):
        return {ALL: phase.vehicles}
    return {record.vehicles[number].name: (number,) for number in phase.vehicles}


def times(time_s: NDArray[np.floating]) -> list[rr.TimeColumn]:
    """The time column of rows at ``time_s`` [n]."""
    return [rr.TimeColumn(TIMELINE, duration=np.asarray(time_s, float))]


def mesh3d(mesh: Mesh) -> rr.Mesh3D:
    """A mesh as the viewer takes it."""
    return rr.Mesh3D(
        vertex_positions=mesh.vertices_m,
        triangle_indices=mesh.triangles,
        vertex_normals=mesh.normals,
        vertex_colors=mesh.colours,
    )


def send_series(
    stream: rr.RecordingStream,
    path: str,
    name: str,
    colour: str,
    time_s: NDArray[np.floating],
    values: NDArray[np.floating],
) -> None:
    """A line in a plot."""
    stream.log(path, rr.SeriesLines(names=[name], colors=[rgba(colour)], widths=[1.5]), static=True)
    stream.send_columns(path, times(time_s), rr.Scalars.columns(scalars=np.asarray(values, float)))


def send_points(
    stream: rr.RecordingStream,
    path: str,
    name: str,
    colour: str,
    time_s: NDArray[np.floating],
    values: NDArray[np.floating],
) -> None:
    """Points in a plot."""
    stream.log(path, rr.SeriesPoints(names=[name], colors=[rgba(colour)], marker_sizes=[1.5]), static=True)
    stream.send_columns(path, times(time_s), rr.Scalars.columns(scalars=np.asarray(values, float)))
