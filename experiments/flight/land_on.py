"""Land on a rover that drives, over many seeds in gusty wind: how often it succeeds, and how well it touches down."""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import swarmsim  # isort: skip - before jax, whose log it quiets
import matplotlib as mpl
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from cyclopts import App, Parameter
from cyclopts.validators import Number

from swarmsim.config.vehicles import Multirotor
from swarmsim.runtime.progress import RichProgress
from swarmsim.vehicles.skid_steer import skid_steer_params
from swarmsim.world import events
from swarmsim.world.build import deck_of

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import Rectangle

MIDDLE_M = (-192.0, 55.0)  # of the open field of the site `meadows`
LEG_M, LEGS = 12.0, 4  # of a route
BEND_DEG = (30.0, 75.0)  # turns between the legs, alternately to both sides
FAR_M = (6.0, 25.0)  # from the rover to where the UAV starts
STAYS_S = 5.0  # after the touchdown
CONTACT_M = 0.02  # feet lower than this above the deck touch it ...
BELOW_M = 0.05  # ... and no lower below it than this
BAR = 0.95  # share of the missions that is to succeed

app = App(name="land_on", help=__doc__, help_format="plaintext")


@dataclass(frozen=True)
class Deck:
    """The rover's deck and what stands on it: half length, half width, height over the rover's origin; feet, m."""

    half_m: np.ndarray  # [2]
    height_m: float
    feet_m: np.ndarray  # [F, 3] of the UAV, body


def draw(seeds: range) -> dict[str, list[Any]]:
    """Values of the missions: every second route bends, the others are straight; the wind comes from anywhere."""
    found: dict[str, list[Any]] = {}
    for seed in seeds:
        random = np.random.default_rng([seed, 1])
        heading = random.uniform(0.0, 2.0 * math.pi)
        bends = math.radians(random.uniform(*BEND_DEG)) * (seed % 2) * random.choice([-1.0, 1.0])
        turns = heading + bends * np.array([0.0, 1.0, 0.0, 1.0])
        steps = LEG_M * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        route = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        route = route - route.mean(axis=0) + MIDDLE_M + random.uniform(-5.0, 5.0, 2)
        away = random.uniform(0.0, 2.0 * math.pi)
        start = route[0] + random.uniform(*FAR_M) * np.array([math.cos(away), math.sin(away)])
        row = {
            "vehicles.uav.position_m": start.round(3).tolist(),
            "vehicles.uav.heading_deg": round(random.uniform(-180.0, 180.0), 1),
            "vehicles.rover.position_m": route[0].round(3).tolist(),
            "vehicles.rover.heading_deg": round(math.degrees(heading) % 360.0, 1),
            "phases.drive.settings.points": route[1:].round(3).tolist(),
            "wind.from_deg": round(random.uniform(0.0, 360.0), 1),
        }
        for path, value in row.items():
            found.setdefault(path, []).append(value)
    return found


def judge(record: swarmsim.MissionRecord, deck: Deck) -> dict[str, Any]:
    """What became of one landing."""
    uav, rover = record.vehicles
    time = uav.time_s
    middle, axes, velocity = _carried(rover, time, deck.height_m)
    apart = np.einsum("tij,ti->tj", axes, uav.position_m - middle)  # along, across and above the deck
    feet = apart[:, 2] + deck.feet_m[:, 2].min()
    on = (feet < CONTACT_M) & (feet > -BELOW_M) & (np.abs(apart[:, :2]) < deck.half_m).all(axis=1)
    done = [e.time_s for e in record.events if e.vehicle == uav.name and e.kind == "finished"]
    bad = sorted({f"{e.vehicle}: {e.kind}" for e in record.events if e.kind in events.KINDS})
    row: dict[str, Any] = {"seed": record.seed, "bends": bool(record.seed % 2), "events": ", ".join(bad)}
    row |= {"landed": False, "stays": False, "success": False}
    if not done:
        return row | {"closest_m": float(np.linalg.norm(apart[:, :2], axis=1).min())}
    end = int(np.searchsorted(time, done[0] - 1e-3))
    away = np.flatnonzero(~on[: end + 1])
    touch = int(away[-1]) + 1 if len(away) else 0
    later = int(np.searchsorted(time, time[min(touch, len(time) - 1)] + STAYS_S))
    row["landed"] = touch <= end
    if not row["landed"]:
        return row
    slip = uav.velocity_m_s[touch - 1] - velocity[touch - 1]
    turned = np.einsum("tij,ti->tj", axes[[touch]], _axes(uav.quaternion[[touch]])[:, :, 0])[0]
    high = np.flatnonzero(feet[:touch] > 1.5)
    low = feet[high[0] : touch] < 1.0 if len(high) else np.zeros(0, bool)
    descents = int(np.sum(np.diff(low.astype(int)) > 0))
    row |= {
        "stays": later < len(time) and bool(on[touch : later + 1].all()),
        "touchdown_s": float(time[touch]),
        "along_m": float(apart[touch, 0]),
        "across_m": float(apart[touch, 1]),
        "offset_m": float(np.linalg.norm(apart[touch, :2])),
        "later_offset_m": float(np.linalg.norm(apart[min(later, len(time) - 1), :2])),
        "feet_margin_m": _margin(deck, apart[touch, :2], math.atan2(turned[1], turned[0])),
        "slip_m_s": float(np.linalg.norm(slip[:2])),
        "sink_m_s": float(-slip[2]),
        "rover_m_s": float(np.linalg.norm(velocity[touch - 1, :2])),
        "contacts": int(np.sum(np.diff(on[: touch + 1].astype(int)) > 0)),
        "go_arounds": max(descents - 1, 0),
    }
    row["success"] = row["landed"] and row["stays"] and not bad
    return row


def _carried(rover: Any, time: np.ndarray, height_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle [T, 3] of the deck, its axes [T, 3, 3] as columns, and its velocity [T, 3] at times [T]."""
    near = np.clip(np.searchsorted(rover.time_s, time - 1e-3), 0, len(rover.time_s) - 1)
    axes = _axes(rover.quaternion[near])
    return rover.position_m[near] + height_m * axes[:, :, 2], axes, rover.velocity_m_s[near]


def _axes(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices [T, 3, 3] of quaternions [T, 4]."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def _margin(deck: Deck, offset_m: np.ndarray, turn_rad: float) -> float:
    """Distance [m] of the outermost foot from the edge of the deck; negative: it is over it."""
    turn = np.array([[math.cos(turn_rad), -math.sin(turn_rad)], [math.sin(turn_rad), math.cos(turn_rad)]])
    feet = offset_m + deck.feet_m[:, :2] @ turn.T
    return float((deck.half_m - np.abs(feet)).min())


def table(rows: list[dict[str, Any]], title: str) -> str:
    """The campaign in one table."""
    good = [row for row in rows if row["landed"]]
    lines = [f"## {title}, {len(rows)} seeds", "", "| figure | mean | median | 95 % | worst |", "|---|---|---|---|---|"]
    figures = (
        ("offset at touchdown [m]", "offset_m", 1.0),
        ("offset 5 s later [m]", "later_offset_m", 1.0),
        ("horizontal speed over the deck at touchdown [m/s]", "slip_m_s", 1.0),
        ("sink rate over the deck at touchdown [m/s]", "sink_m_s", 1.0),
        ("time from the start to touchdown [s]", "touchdown_s", 1.0),
        ("outermost foot within the edge [m] (95 %: of all more)", "feet_margin_m", -1.0),
        ("go-arounds", "go_arounds", 1.0),
    )
    for name, key, sign in figures:
        values = sign * np.array([row[key] for row in good], float)
        if len(values):
            four = sign * np.array([values.mean(), np.median(values), np.percentile(values, 95), values.max()])
            lines.append(f"| {name} | " + " | ".join(f"{value:.3f}" for value in four) + " |")
    counted = {key: sum(bool(row[key]) for row in rows) for key in ("landed", "stays", "success")}
    over = sum(row["feet_margin_m"] < 0.0 for row in good)
    share = counted["success"] / len(rows)
    lines += [
        "",
        f"Landed {counted['landed']}, still on the deck {STAYS_S:g} s later {counted['stays']}, with no crash and no "
        f"collision {counted['success']} of {len(rows)}: {100.0 * share:.1f} % (bar: {100.0 * BAR:g} %, "
        f"{'met' if share >= BAR else 'not met'}). A foot was over the edge in {over}.",
        "",
    ]
    lines += [f"- seed {row['seed']}: {row['events'] or 'not landed'}" for row in rows if not row["success"]]
    return "\n".join([*lines, ""])


def figure(rows: list[dict[str, Any]], deck: Deck, path: Path) -> None:
    """Where on the deck they touched down, and how fast."""
    good = [row for row in rows if row["landed"]]
    fig, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.8), layout="constrained")
    left.add_patch(Rectangle(tuple(-deck.half_m), *(2.0 * deck.half_m), fill=False, color="0.3"))
    for bends, colour, label in ((False, "tab:blue", "straight"), (True, "tab:orange", "with bends")):
        part = [row for row in good if row["bends"] is bends]
        left.plot(*([row[k] for row in part] for k in ("along_m", "across_m")), ".", color=colour, label=label)
        right.plot(*([row[k] for row in part] for k in ("slip_m_s", "sink_m_s")), ".", color=colour, label=label)
    left.set(xlabel="along the deck [m]", ylabel="across [m]", aspect="equal")
    right.set(xlabel="horizontal speed over the deck [m/s]", ylabel="sink rate [m/s]", xlim=(0, None), ylim=(0, None))
    right.legend(frameon=False)
    for suffix in ("png", "pdf"):
        fig.savefig(path / f"touchdown.{suffix}", dpi=200)
    plt.close(fig)


def _deck(scenario: Any) -> Deck:
    """The deck of the scenario's rover, and the feet of its UAV."""
    uav, rover = scenario.vehicles
    assert isinstance(uav, Multirotor)
    length, width, height = deck_of(rover, skid_steer_params(rover))
    return Deck(half_m=np.array([length, width]), height_m=height, feet_m=np.array(uav.feet.positions_m))


@app.default
def main(
    *,
    out: Path = Path("runs/land_on"),
    seeds: Annotated[int, Parameter(validator=Number(gte=1))] = 64,
    uav: str = "x500",
    rover: str = "orpheus",
    set_: Annotated[list[str] | None, Parameter(name="--set", negative="")] = None,
) -> int:
    """Fly the campaign and write its table, its figure and one row for each mission.

    Parameters
    ----------
    out
        Folder for the results.
    seeds
        How many missions.
    uav
        Type of the UAV.
    rover
        Type of the rover.
    set_
        Overrides of the mission `landing`, as PATH=VALUE.
    """
    swarmsim.use_all_cores()
    overrides = [
        "engine=analytic", f"vehicles.uav.type={uav}", f"vehicles.rover.type={rover}",
        f"phases.drive.settings.points={draw(range(1))['phases.drive.settings.points'][0]}",
        "phases.drive.settings.laps=2", f"phases.drive.end={{after: land, delay_s: {STAYS_S + 1.0}}}",
        "phases.drive.time_limit_s=120", "phases.land.time_limit_s=110", *(set_ or []),
    ]  # fmt: skip
    scenario = swarmsim.load("landing", overrides)
    simulation = swarmsim.build(scenario)
    numbers = range(scenario.mission.seed, scenario.mission.seed + seeds)
    with RichProgress(missions=seeds) as progress:
        batch = simulation.rollout(numbers, values=draw(numbers), progress=progress)
    deck = _deck(scenario)
    rows = [judge(swarmsim.mission_record(simulation, batch, index), deck) for index in range(seeds)]
    out.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), out / "landings.parquet")
    text = table(rows, f"{uav} on {rover}")
    (out / "table.md").write_text(text, encoding="utf-8")
    figure(rows, deck, out)
    print(text)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(app())
    except swarmsim.InputError as error:
        sys.exit("\n".join(str(problem) for problem in error.problems))
