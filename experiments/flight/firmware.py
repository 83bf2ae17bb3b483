"""Hover and steps of a vehicle flown by real firmware in our physics, against our own controller in the same."""

import json
import os
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import swarmsim  # isort: skip - before jax, whose log it quiets
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from cyclopts import App, Parameter

from swarmsim.autopilot.control import Control, State
from swarmsim.autopilot.frames import Geodetic
from swarmsim.autopilot.guard import Guard, outline_of
from swarmsim.autopilot.link import Setpoint
from swarmsim.autopilot.mavlink import MavlinkVehicle
from swarmsim.config.autopilot import Autopilot, SetpointLimits
from swarmsim.config.bare import bare_scenario
from swarmsim.config.errors import InputError
from swarmsim.config.scenario import Scenario
from swarmsim.config.sensors import Place
from swarmsim.control.commands import PositionCommand
from swarmsim.sitl.firmware import STARTS, Firmware
from swarmsim.sitl.link import seat_of
from swarmsim.sitl.lockstep import Lockstep
from swarmsim.sitl.opening import open_link
from swarmsim.sitl.plant import Plant
from swarmsim.sitl.settings import SitlSettings, load_sitl_settings
from swarmsim.world.step import step

mpl.use("Agg")
from matplotlib import pyplot as plt

SCENARIO = Path(__file__).with_name("responses.yaml")
SENSORS = ("bmi088", "zed_f9p_rtk", "ms5611", "ist8310")
HEIGHT_M = 6.0
BAND_M = 0.25  # within which a step has settled: a receiver's noise moves a vehicle by as much
# what is asked for, for how long: displacement from the place of the hover, m
HOVER_S, STEP_S = 60.0, 20.0
PARTS = (
    ("hover", (0.0, 0.0, 0.0), HOVER_S),
    ("step east 5 m", (5.0, 0.0, 0.0), STEP_S),
    ("step back", (0.0, 0.0, 0.0), STEP_S),
    ("step up 3 m", (0.0, 0.0, 3.0), STEP_S),
)

app = App(name="firmware", help=__doc__, help_format="plaintext")


@dataclass(frozen=True)
class Part:
    """One part of a flight: times [T] s from its begin, true displacements [T, 3] m from the place of the hover."""

    name: str
    time_s: np.ndarray
    offset_m: np.ndarray
    asked_m: tuple[float, float, float]


def figures_of(part: Part, before_m: Sequence[float]) -> dict[str, float]:
    """A hover's drift about its mean and its fastest tenth of a minute, or a step's rise, overshoot and settling.

    ``before_m`` is what was asked for before the step. The rise is that from 10 to 90 %.
    """
    if part.name == "hover":
        off = part.offset_m - part.offset_m.mean(axis=0)
        level = np.hypot(off[:, 0], off[:, 1])
        return {
            "drift_rms_m": float(np.sqrt(np.mean(level**2))),
            "drift_max_m": float(level.max()),
            "height_rms_m": float(np.sqrt(np.mean(off[:, 2] ** 2))),
        }
    change = np.asarray(part.asked_m) - np.asarray(before_m)
    axis = int(np.argmax(np.abs(change)))
    share = (part.offset_m[:, axis] - before_m[axis]) / change[axis]
    start = share[0]  # a receiver's drift has moved it already
    rises = [part.time_s[np.argmax(share - start >= part_of * (1.0 - start))] for part_of in (0.1, 0.9)]
    final = share[part.time_s > part.time_s[-1] - 5.0].mean()
    outside = np.flatnonzero(np.abs(share - final) * abs(change[axis]) > BAND_M)
    return {
        "rise_s": float(rises[1] - rises[0]),
        "overshoot": float(max(share.max() - final, 0.0)),
        "settles_s": float(part.time_s[outside[-1]]) if len(outside) else 0.0,
        "final_error_m": float((final - 1.0) * abs(change[axis])),
    }


def ours(scenario: Scenario) -> list[Part]:
    """The same parts flown by our own controller, which knows the state as it is."""
    simulation = swarmsim.build(scenario)
    world, state = simulation.world, simulation.reset(0)
    pad = np.asarray(state.groups[0].vehicle.body.position_m[0], np.float64)
    stepped = jax.jit(lambda state, command: step(world, state, (command,))[0])
    period = world.timing.control_period_s

    def fly(state: Any, target_m: np.ndarray, seconds: float, climb: float = 0.0) -> tuple[Any, np.ndarray]:
        command = PositionCommand(
            position_m=jnp.asarray(target_m, jnp.float32)[None],
            velocity_m_s=jnp.array([[0.0, 0.0, climb]], jnp.float32),
            acceleration_m_s2=jnp.zeros((1, 3)),
            yaw_rad=jnp.zeros(1),
            hold_position=jnp.ones(1),
        )
        places = []
        for _ in range(round(seconds / period)):
            state = stepped(state, command)
            places.append(np.asarray(state.groups[0].vehicle.body.position_m[0], np.float64))
        return state, np.array(places)

    above = pad + np.array([0.0, 0.0, HEIGHT_M])
    state, _ = fly(state, above, 2.0, climb=1.0)
    state, _ = fly(state, above, 15.0)
    parts = []
    for name, offset, seconds in PARTS:
        state, places = fly(state, above + offset, seconds)
        parts.append(Part(name, period * np.arange(1, len(places) + 1), places - above, offset))
    return parts


class Session:
    """Firmware and our physics in a thread of their own, in real time."""

    def __init__(self, scenario: Scenario, settings: SitlSettings, command: str, folder: Path, stack: ExitStack):
        """Start both, and wait until they have met."""
        origin = Geodetic(**settings.origin.model_dump())
        seat = seat_of(scenario.members[0].name, 0, scenario.vehicles[0], settings, origin)
        link = open_link(seat, settings)
        stack.callback(link.close)
        plant = Plant(scenario, Place(altitude_m=origin.altitude_m), settings.sensors)
        self.lockstep = Lockstep(plant, [link], settings, 1.0)
        firmware = Firmware(command, settings.autopilot, seat, scenario.vehicles[0], folder.absolute())
        stack.callback(firmware.stop)
        self.lockstep.connect(firmware.check)
        self.error: BaseException | None = None
        self._end = False
        thread = threading.Thread(target=self._run, daemon=True)
        thread.start()
        stack.callback(thread.join, 5.0)
        stack.callback(self.stop)

    def stop(self) -> None:
        """End the physics."""
        self._end = True

    def _run(self) -> None:
        try:
            while not self._end:
                self.lockstep.run(self.lockstep.time_s + 1.0, lambda: None)
        except BaseException as error:
            self.error = error

    def track(self, since_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Times [T] and true positions [T, 3] since a simulated time."""
        times = np.array(self.lockstep.tracks.time_s)
        rows = np.array([row[0, :3] for row in self.lockstep.tracks.rows[: len(times)]])
        shown = times >= since_s
        return times[shown] - since_s, rows[shown]


def theirs(scenario: Scenario, settings: SitlSettings, command: str, folder: Path) -> list[Part]:
    """The parts flown by firmware."""
    with ExitStack() as stack:
        session = Session(scenario, settings, command, folder, stack)
        time.sleep(5.0)
        vehicle = MavlinkVehicle(settings.link_of(0), autopilot=settings.autopilot)
        stack.callback(vehicle.close)
        truth = session.lockstep.plant.truth
        rest = tuple(float(x) for x in truth.position_m[0])
        limits = SetpointLimits(jump_m=10.0)
        guard = Guard(limits=limits, outline_m=outline_of_site(scenario), ground_m=rest[2], flies=True)
        flight = Autopilot(take_off_m=HEIGHT_M, limits=limits)
        control = Control(vehicle, flight, guard, True, print)
        stack.callback(control.stream.close)
        vehicle.on_mode(control.on_telemetry)
        vehicle.preflight(print, 120.0)
        vehicle.align(rest)  # type: ignore[arg-type]
        control.stream.start()
        above = np.array(rest) + np.array([0.0, 0.0, HEIGHT_M])
        if not control.start(tuple(above), 0.0):  # type: ignore[arg-type]
            raise RuntimeError(f"it does not follow: {control.alarm}")
        parts = []
        _hold(control, above, 15.0)
        for name, offset, seconds in PARTS:
            begin = session.lockstep.time_s
            _hold(control, above + offset, seconds)
            times, places = session.track(begin)
            parts.append(Part(name, times, places - above, offset))
        control.end("land")
        while not control.stands():
            time.sleep(0.1)
        if session.error is not None:
            raise session.error
        return parts


def _hold(control: Control, place_m: np.ndarray, seconds: float) -> None:
    end = time.monotonic() + seconds
    place = tuple(float(x) for x in place_m)
    while time.monotonic() < end:
        control.offer(Setpoint(position_m=place, velocity_m_s=(0.0, 0.0, 0.0), yaw_rad=0.0))  # type: ignore[arg-type]
        if not control.watch() or control.state is not State.FOLLOWS:
            raise RuntimeError(f"it does not follow any more: {control.alarm}")
        time.sleep(0.05)


def outline_of_site(scenario: Scenario) -> np.ndarray:
    """Corners [4, 2] of the scenario's site."""
    return outline_of(swarmsim.build(scenario).site_model.site)


def figure(flown: dict[str, list[Part]], path: Path) -> None:
    """Steps of all controllers, and their hovers from above."""
    fig, axes = plt.subplots(1, 3, figsize=(7.6, 2.8), layout="constrained")
    for colour, (name, parts) in zip(("C0", "C1", "C2"), flown.items(), strict=False):
        for part in parts:
            if part.name == "hover":
                off = part.offset_m - part.offset_m.mean(axis=0)
                axes[0].plot(off[:, 0], off[:, 1], lw=0.8, color=colour, label=name)
            elif part.name in ("step east 5 m", "step up 3 m"):
                panel, axis = (1, 0) if "east" in part.name else (2, 2)
                axes[panel].plot(part.time_s, part.offset_m[:, axis], lw=1.0, color=colour, label=name)
                axes[panel].axhline(part.asked_m[axis], color="0.8", lw=0.6, zorder=0)
    axes[0].set(xlabel="east [m]", ylabel="north [m]", aspect="equal", title=f"hover, {HOVER_S:g} s")
    axes[1].set(xlabel="time [s]", ylabel="east [m]", xlim=(0.0, 12.0), title="step of 5 m")
    axes[2].set(xlabel="time [s]", ylabel="up [m]", xlim=(0.0, 12.0), title="step of 3 m")
    axes[1].legend(frameon=False, fontsize="small")
    for suffix in ("png", "pdf"):
        fig.savefig(path / f"firmware.{suffix}", dpi=200)
    plt.close(fig)


@app.default
def main(
    *,
    out: Path = Path("runs/firmware"),
    autopilot: Annotated[tuple[Literal["px4", "ardupilot"], ...], Parameter(negative="")] = ("px4", "ardupilot"),
    vehicle: str = "x500",
    sensor: Annotated[tuple[str, ...], Parameter(negative="")] = SENSORS,
) -> int:
    """Fly the parts by firmware and by our own controller, and write figures and a table.

    Parameters
    ----------
    out
        Folder for the results.
    autopilot
        Which firmware; started by the commands in SWARMSIM_PX4_SITL and SWARMSIM_ARDUPILOT_SITL.
    vehicle
        Type of the vehicle.
    sensor
        Sensors that it carries instead of its own; with an RTK receiver by default, so that the controller is seen and
        not the receiver's drift.
    """
    whole = swarmsim.load(str(SCENARIO), [f"vehicles.uav.type={vehicle}"])
    whole = replace(whole, vehicles=tuple(v.model_copy(update={"sensors": sensor}) for v in whole.vehicles))
    flown = {"swarmsim": ours(whole)}
    for kind in autopilot:
        command = os.environ.get(STARTS[kind])
        if not command:
            raise InputError.of(f"{STARTS[kind]} does not say how {kind} is started", path="--autopilot", given=kind)
        settings = load_sitl_settings(kind)
        flown[kind] = theirs(bare_scenario(whole, [0], "sitl", settings.timing), settings, command, out / kind)
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, parts in flown.items():
        before: Sequence[float] = (0.0, 0.0, 0.0)
        for part in parts:
            rows.append({"controller": name, "part": part.name} | figures_of(part, before))
            before = part.asked_m
    figure(flown, out)
    (out / "firmware.json").write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    for row in rows:
        print(", ".join(f"{k} {v:.3f}" if isinstance(v, float) else str(v) for k, v in row.items()))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(app())
    except InputError as error:
        sys.exit("\n".join(str(problem) for problem in error.problems))
