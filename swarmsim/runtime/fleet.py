"""How fast a fleet of one type flies: position-controlled multirotors, each with rotors, drag, feet and wind."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.vehicles import Multirotor
from swarmsim.control.commands import PositionCommand
from swarmsim.control.multirotor import control, control_start
from swarmsim.physics.contact import Plane
from swarmsim.physics.multirotor import make_multirotor_step, rest_state
from swarmsim.scalars import Layout, over_vehicles
from swarmsim.vehicles.multirotor import MultirotorParams, multirotor_params

TIME_STEP_S = 0.005
SUBSTEPS = 2  # physics steps in a control period
TICKS = 100  # control periods of a measurement: one second


@dataclass(frozen=True)
class FleetSpeed:
    """What was measured."""

    vehicles: int
    engine: str
    layout: str
    own_parameters: bool  # each vehicle has its own, or all share one set; both are traced
    steps_per_s: float  # physics steps of all vehicles per second, the control of every second step included
    compile_s: float
    apart_m: float  # largest difference of a position from the first vehicles' by `jax.vmap`, after the same time


def measure_fleet(
    spec: Multirotor, engine: Any, vehicles: int, layout: Layout, *, own_parameters: bool, ticks: int, repeats: int = 3
) -> FleetSpeed:
    """Fly ``vehicles`` from rest to places of their own for ``ticks`` control periods; the fastest of ``repeats``."""
    params = multirotor_params(spec)
    flight = _flight(params, vehicles, own_parameters)
    start = time.perf_counter()
    run = jax.jit(partial(_fly, engine, layout, own_parameters, ticks)).lower(*flight).compile()
    compile_s = time.perf_counter() - start
    result = jax.block_until_ready(run(*flight))
    seconds = min(_timed(run, flight) for _ in range(repeats))
    few = min(vehicles, 256)
    check = _flown(engine, "vmap", own_parameters, ticks, *_flight(params, few, own_parameters))
    apart = float(jnp.max(jnp.abs(result[:few] - check)))
    speed = vehicles * ticks * SUBSTEPS / seconds
    return FleetSpeed(vehicles, engine, layout, own_parameters, speed, compile_s, apart)


def _timed(run: Callable[..., Any], arguments: tuple[Any, ...]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(run(*arguments))
    return time.perf_counter() - start


def _flight(params: MultirotorParams, vehicles: int, own_parameters: bool) -> tuple[Any, ...]:
    """Parameters, targets [N, 3], the wind [3] and the ground."""
    number = np.arange(vehicles)
    spread = np.stack([number % 7 - 3.0, number % 5 - 2.0, 5.0 + number % 3], axis=-1).astype(np.float32)
    if own_parameters:
        params = jax.tree.map(lambda x: jnp.broadcast_to(x, (vehicles, *x.shape)), params)
    ground = Plane(point_m=jnp.zeros(3), normal=jnp.array([0.0, 0.0, 1.0]))
    return params, jnp.asarray(spread), jnp.array([2.0, 1.0, 0.0]), ground


def _fly(
    engine: Any, layout: Layout, own_parameters: bool, ticks: int, params: Any, target_m: Any, wind: Any, ground: Any
) -> jax.Array:
    """Positions [N, 3] after the flight.

    The loop over time stands inside the mapped function, so that its state stays apart in scalars from tick to tick.
    """
    step = make_multirotor_step(engine, TIME_STEP_S)

    def one(params: Any, target: jax.Array, wind: jax.Array, ground: Plane) -> jax.Array:
        zero = jnp.zeros(3)
        command = PositionCommand(position_m=target, velocity_m_s=zero, acceleration_m_s2=zero, yaw_rad=jnp.zeros(()))

        def tick(state: Any, _: None) -> tuple[Any, None]:
            vehicle, memory = state
            speeds, memory = control(params, memory, vehicle, command, SUBSTEPS * TIME_STEP_S)
            for _substep in range(SUBSTEPS):
                vehicle = step(params, vehicle, speeds, wind, ground)
            return (vehicle, memory), None

        start = rest_state(params, ground, jnp.zeros(())), control_start(landed=True)
        (vehicle, _), _ = jax.lax.scan(tick, start, None, length=ticks)
        position: jax.Array = vehicle.body.position_m
        return position

    axis = 0 if own_parameters else None
    every = over_vehicles(one, in_axes=(axis, 0, None, None), layout=layout)
    positions: jax.Array = every(params, target_m, wind, ground)
    return positions


_flown = jax.jit(_fly, static_argnums=(0, 1, 2, 3))  # compiled once for the layouts that are compared with it
