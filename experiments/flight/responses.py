"""How each multirotor follows its commands: steps, a turn, a Lissajous figure at speed, and hovering in gusts."""

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import swarmsim  # isort: skip - before jax, whose log it quiets
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from cyclopts import App, Parameter

from swarmsim.control.commands import PositionCommand
from swarmsim.world.step import step

mpl.use("Agg")
from matplotlib import pyplot as plt

SCENARIO = Path(__file__).with_suffix(".yaml")
VEHICLES = ("tarot_t650", "x500", "dji_f550", "asctec_pelican", "ar_drone_2", "crazyflie_2_1")
TICK_S = 0.01
HEIGHT_M, BEGIN_S, END_S = 6.0, 18.0, 48.0  # of the flights: the manoeuvre begins after the climb
STEPS_M = (2.0, 5.0, 10.0)
BAND = 0.02  # of a step, within which it has settled
LISSAJOUS_SHARE = 0.6  # of the largest speed and acceleration are the figure's
TURN_RAD = math.pi / 2.0
WINDS_M_S = (5.0, 8.0)  # at 20 ft, with gusts

app = App(name="responses", help=__doc__, help_format="plaintext")


@dataclass(frozen=True)
class Flight:
    """A commanded flight: position, velocity and acceleration [T, 3] over the pad (m, ENU), heading [T], wind."""

    name: str
    position_m: np.ndarray
    velocity_m_s: np.ndarray
    acceleration_m_s2: np.ndarray
    yaw_rad: np.ndarray
    wind_m_s: float = 0.0


def times() -> np.ndarray:
    """Times of the ticks of a flight [T], s."""
    return TICK_S * np.arange(round(END_S / TICK_S))


def flights(speed_max_m_s: float, climb_rate_m_s: float, acceleration_max_m_s2: float) -> list[Flight]:
    """The flights of a vehicle with these limits: each climbs at half its rate, waits, and does its manoeuvre."""
    time = times()
    rate = min(0.5 * climb_rate_m_s, 2.0)
    climb = np.zeros((len(time), 3))
    climb[:, 2] = np.minimum(rate * time, HEIGHT_M)
    rising = np.zeros_like(climb)
    rising[:, 2] = np.where(rate * time < HEIGHT_M, rate, 0.0)
    zero, heading, later = np.zeros_like(climb), np.zeros(len(time)), time >= BEGIN_S

    def stepped(axis: int, metres: float) -> Flight:
        position = climb + np.where(later, metres, 0.0)[:, None] * np.eye(3)[axis]
        return Flight(f"step {'x' if axis == 0 else 'up'} {metres:g} m", position, rising, zero, heading)

    found = [stepped(0, metres) for metres in STEPS_M] + [stepped(2, 5.0)]
    found.append(Flight("turn 90 deg", climb, rising, zero, np.where(later, TURN_RAD, 0.0)))
    fast = LISSAJOUS_SHARE * speed_max_m_s
    found.append(_lissajous(climb, rising, heading, fast, fast**2 / (LISSAJOUS_SHARE * acceleration_max_m_s2)))
    found += [Flight(f"hover, W20 {wind:g} m/s", climb, rising, zero, heading, wind) for wind in WINDS_M_S]
    return found


def _lissajous(climb: np.ndarray, rising: np.ndarray, heading: np.ndarray, speed_m_s: float, size: float) -> Flight:
    """An eight x = a sin wt, y = a / 2 sin 2 wt, entered gently.

    Its largest speed, in the middle, is v = a w sqrt(2), its largest acceleration, at the ends, v^2 / a; ``size`` is a.
    """
    time = np.maximum(times() - BEGIN_S, 0.0)
    rate = speed_m_s / (math.sqrt(2.0) * size)
    entry = 4.0  # the phase speeds up over this time
    phase = rate * np.where(time < entry, 0.5 * time**2 / entry, time - 0.5 * entry)
    pace = rate * np.minimum(time / entry, 1.0)
    change = np.where((time > 0.0) & (time < entry), rate / entry, 0.0)
    place = np.stack([size * np.sin(phase), 0.5 * size * np.sin(2.0 * phase), 0.0 * phase], -1)
    slope = np.stack([size * np.cos(phase), size * np.cos(2.0 * phase), 0.0 * phase], -1)
    bend = np.stack([-size * np.sin(phase), -2.0 * size * np.sin(2.0 * phase), 0.0 * phase], -1)
    velocity = pace[:, None] * slope
    acceleration = pace[:, None] ** 2 * bend + change[:, None] * slope
    return Flight(f"Lissajous, {speed_m_s:.1f} m/s", climb + place, rising + velocity, acceleration, heading)


def flown(simulation: swarmsim.Simulation, made: list[Flight]) -> tuple[np.ndarray, np.ndarray]:
    """Positions [F, T, 3] over the pad (m) and headings [F, T] (rad) of the flights, all at once."""
    world, start = simulation.world, simulation.reset(0)
    pad = np.asarray(start.groups[0].vehicle.body.position_m[0])
    commands = PositionCommand(
        position_m=_stacked([flight.position_m + pad for flight in made]),
        velocity_m_s=_stacked([flight.velocity_m_s for flight in made]),
        acceleration_m_s2=_stacked([flight.acceleration_m_s2 for flight in made]),
        yaw_rad=_stacked([flight.yaw_rad for flight in made]),
        hold_position=jnp.ones((len(made), len(times()), 1)),
    )

    def fly(command: PositionCommand, wind_m_s: jax.Array) -> Any:
        windy = replace(world, air=replace(world.air, speed_m_s=wind_m_s))

        def tick(state: Any, now: PositionCommand) -> Any:
            state, _ = step(windy, state, (now,))
            body = state.groups[0].vehicle.body
            return state, (body.position_m[0], body.quaternion[0])

        return jax.lax.scan(tick, start, command)[1]

    winds = jnp.array([flight.wind_m_s for flight in made], jnp.float32)
    position, q = (np.asarray(x, float) for x in jax.jit(jax.vmap(fly))(commands, winds))
    yaw = np.arctan2(
        2.0 * (q[..., 0] * q[..., 3] + q[..., 1] * q[..., 2]), 1.0 - 2.0 * (q[..., 2] ** 2 + q[..., 3] ** 2)
    )
    return position - pad, yaw


def _stacked(arrays: list[np.ndarray]) -> jax.Array:
    """Commands [F, T, 1, …] of one vehicle."""
    return jnp.asarray(np.stack(arrays)[:, :, None], jnp.float32)


def figures_of(flight: Flight, position_m: np.ndarray, yaw_rad: np.ndarray) -> dict[str, float]:
    """What a flight comes to in numbers, after the manoeuvre has begun."""
    begin = round(BEGIN_S / TICK_S)
    off = np.linalg.norm(position_m - flight.position_m, axis=1)[begin:]
    if flight.name.startswith("step"):
        axis = 0 if " x " in flight.name else 2
        metres = flight.position_m[-1, axis] - flight.position_m[begin - 1, axis]
        return step_figures((position_m[begin:, axis] - flight.position_m[begin - 1, axis]) / metres)
    if flight.name.startswith("turn"):
        return step_figures(yaw_rad[begin:] / TURN_RAD) | {"off_max_m": float(off.max())}
    return {"off_rms_m": float(np.sqrt(np.mean(off**2))), "off_max_m": float(off.max())}


def step_figures(share: np.ndarray) -> dict[str, float]:
    """Overshoot and settling time of a response to a step, as shares of it [T]."""
    outside = np.flatnonzero(np.abs(share - 1.0) > BAND)
    settles = TICK_S * (outside[-1] + 1) if len(outside) else 0.0
    return {"overshoot": float(max(share.max() - 1.0, 0.0)), "settles_s": float(settles)}


def table(rows: list[dict[str, Any]]) -> str:
    """The flights in one table; what is not asked of a flight is left empty."""
    columns = {"overshoot": "overshoot [%]", "settles_s": "settles [s]", "off_rms_m": "off, rms [m]",
               "off_max_m": "off, largest [m]"}  # fmt: skip
    lines = ["| vehicle | flight | " + " | ".join(columns.values()) + " |", "|---" * (2 + len(columns)) + "|"]
    for row in rows:
        cells = [row.get(key) for key in columns]
        cells = [
            None if x is None else 100.0 * x if key == "overshoot" else x for key, x in zip(columns, cells, strict=True)
        ]
        texts = ["" if cell is None else f"{cell:.2f}" for cell in cells]
        lines.append(f"| {row['vehicle']} | {row['flight']} | " + " | ".join(texts) + " |")
    return "\n".join([*lines, ""])


def figure(name: str, made: list[Flight], position_m: np.ndarray, yaw_rad: np.ndarray, path: Path) -> None:
    """Steps, turn, Lissajous and gusts of one vehicle in four panels."""
    fig, ((steps, turn), (eight, gusts)) = plt.subplots(2, 2, figsize=(7.2, 5.2), layout="constrained")
    time = times() - BEGIN_S
    for k, flight in enumerate(made):
        if flight.name.startswith("step"):
            axis = 0 if " x " in flight.name else 2
            first = flight.position_m[round(BEGIN_S / TICK_S) - 1, axis]
            steps.plot(time, position_m[k, :, axis] - first, label=flight.name, lw=1.0)
        elif flight.name.startswith("turn"):
            turn.plot(time, np.degrees(yaw_rad[k]), lw=1.0, label="heading")
            turn.plot(time, np.degrees(flight.yaw_rad), "k:", lw=0.8, label="commanded")
        elif flight.name.startswith("Lissajous"):
            shown = time >= 0.0
            eight.plot(*flight.position_m[shown, :2].T, "k:", lw=0.8, label="commanded")
            eight.plot(*position_m[k, shown, :2].T, lw=1.0, label=flight.name.split(", ")[1])
        else:
            off = np.linalg.norm(position_m[k] - flight.position_m, axis=1)
            gusts.plot(time, off, lw=1.0, label=flight.name.split(", ")[1])
    for metres in STEPS_M:
        steps.axhline(metres, color="0.8", lw=0.6, zorder=0)
    steps.set(xlabel="time [s]", ylabel="displacement [m]", xlim=(-0.5, 8.0), ylim=(-0.5, 1.1 * max(STEPS_M)))
    turn.set(xlabel="time [s]", ylabel="heading [deg]", xlim=(-0.5, 8.0))
    eight.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
    gusts.set(xlabel="time [s]", ylabel="off its place [m]", xlim=(0.0, END_S - BEGIN_S), ylim=(0.0, None))
    for axes in (steps, turn, eight, gusts):
        axes.legend(frameon=False, fontsize="small")
    fig.suptitle(name)
    for suffix in ("png", "pdf"):
        fig.savefig(path / f"{name}.{suffix}", dpi=200)
    plt.close(fig)


@app.default
def main(
    *,
    out: Path = Path("runs/responses"),
    vehicle: Annotated[list[str] | None, Parameter(negative="")] = None,
    set_: Annotated[list[str] | None, Parameter(name="--set", negative="")] = None,
) -> int:
    """Fly the manoeuvres and write a table, and a figure for each vehicle.

    Parameters
    ----------
    out
        Folder for the results.
    vehicle
        Type of multirotor; may be given again and again. All that the package carries by default.
    set_
        Overrides of the scenario, as PATH=VALUE, such as engine=mjx.
    """
    rows: list[dict[str, Any]] = []
    out.mkdir(parents=True, exist_ok=True)
    for name in vehicle or VEHICLES:
        simulation = swarmsim.build(swarmsim.load(str(SCENARIO), [f"vehicles.uav.type={name}", *(set_ or [])]))
        autopilot = simulation.world.groups[0].params.control
        limits = (autopilot.speed_max_m_s, autopilot.climb_rate_max_m_s, autopilot.acceleration_max_m_s2)
        made = flights(*(float(limit[0]) for limit in limits))
        position, yaw = flown(simulation, made)
        for k, flight in enumerate(made):
            rows.append({"vehicle": name, "flight": flight.name} | figures_of(flight, position[k], yaw[k]))
        figure(name, made, position, yaw, out)
    text = table(rows)
    (out / "table.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(app())
    except swarmsim.InputError as error:
        sys.exit("\n".join(str(problem) for problem in error.problems))
