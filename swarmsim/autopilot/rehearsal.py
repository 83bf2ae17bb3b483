"""A rehearsal: the setpoints that a flight would send, from the mission with its own simulated vehicle."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from swarmsim.autopilot.convert import setpoint_of
from swarmsim.autopilot.frames import ned_of_enu, yaw_ned_of_enu
from swarmsim.autopilot.guard import Guard, RefusedError
from swarmsim.autopilot.link import Setpoint
from swarmsim.runtime.live import LiveMission, LiveStep
from swarmsim.vehicles.state import RigidState


@dataclass(frozen=True)
class Sent:
    """A setpoint that would be sent, and where the vehicle would be."""

    time_s: float  # of the mission
    setpoint: Setpoint
    place_m: tuple[float, float, float]  # world
    refused: str = ""  # why it would not be sent


def rehearse(
    live: LiveMission,
    guard: Guard | None,
    limit_s: float,
    observer: Callable[[LiveStep, RigidState], None] | None = None,
) -> list[Sent]:
    """Fly the prepared mission as fast as it goes, and collect what would be sent to its vehicle; ``limit_s`` at most.

    Without a ``guard`` nothing is refused. ``observer`` is called after each step in which the vehicle is commanded,
    with its body at the step's beginning. Raises `LinkError` where a policy commands what cannot be sent.
    """
    live.start()
    live.begin_phases()
    if guard is not None:
        guard.forget()
    rows: list[Sent] = []
    while live.time_s < limit_s:
        body = live.body()
        place = tuple(float(v) for v in body.position_m)
        step = live.step(body, 1.0)
        if step.in_phase:
            setpoint, refused = setpoint_of(step.command), ""
            try:
                if guard is not None:
                    guard.check(setpoint, step.time_s)
            except RefusedError as error:
                refused = str(error)
            rows.append(Sent(time_s=step.time_s, setpoint=setpoint, place_m=place, refused=refused))  # type: ignore[arg-type]
            if observer is not None:
                observer(step, body)
        if step.begins:
            live.begin_phases()
        if step.over or not (step.in_phase or step.begins or live.has_phase_to_come()):
            break
    return rows


def picked(rows: Sequence[Sent], count: int) -> list[Sent]:
    """About ``count`` of the rows, evenly in time, and every one at which refusals begin."""
    step = max(1, len(rows) // max(1, count))
    chosen = set(range(0, len(rows), step)) | ({len(rows) - 1} if rows else set())
    chosen |= {k for k, row in enumerate(rows) if row.refused and (k == 0 or row.refused != rows[k - 1].refused)}
    return [rows[k] for k in sorted(chosen)]


def cells(row: Sent) -> tuple[str, ...]:
    """A row of the table: time, position and velocity in ENU, position in NED, heading from north."""
    s = row.setpoint
    position = "" if s.position_m is None else " ".join(f"{v:.1f}" for v in s.position_m)
    ned = "" if s.position_m is None else " ".join(f"{v:.1f}" for v in ned_of_enu(s.position_m))
    velocity = "" if s.velocity_m_s is None else " ".join(f"{v:.2f}" for v in s.velocity_m_s)
    yaw = "" if s.yaw_rad is None else f"{np.degrees(yaw_ned_of_enu(s.yaw_rad)) % 360.0:.0f}"
    return f"{row.time_s:.1f}", position, velocity, ned, yaw, row.refused


def drawn(rows: Sequence[Sent], outline_m: np.ndarray, columns: int = 72) -> str:
    """A map in characters: outline (``.``), way (``*``), its begin (``S``), where setpoints are refused (``x``).

    North is up; a character is twice as high as it is wide.
    """
    places = np.array([row.setpoint.position_m or row.place_m for row in rows], float).reshape(-1, 3)[:, :2]
    every = np.concatenate([places, outline_m]) if len(places) else np.asarray(outline_m)
    low, high = every.min(axis=0), every.max(axis=0)
    cell = max(float(np.max(high - low)) / columns, 1e-3)
    size = np.ceil((high - low) / [cell, 2.0 * cell]).astype(int) + 1
    grid = np.full((size[1], size[0]), " ")

    def mark(points: np.ndarray, sign: str) -> None:
        index = np.floor((points - low) / [cell, 2.0 * cell]).astype(int)
        grid[index[:, 1], index[:, 0]] = sign

    corners = np.asarray(outline_m, float)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        mark(a + (b - a) * np.linspace(0.0, 1.0, 4 * columns)[:, None], ".")
    if len(places):
        mark(places, "*")
        refused = np.array([bool(row.refused) for row in rows])
        if refused.any():
            mark(places[refused], "x")
        mark(places[:1], "S")
    return (
        "\n".join("".join(line).rstrip() for line in grid[::-1]) + f"\none character is {cell:.1f} m wide, north is up"
    )
