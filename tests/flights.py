"""Short flights of multirotors for the tests of vehicles, physics and control."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.flight import FlightEffects
from swarmsim.config.load import load_named
from swarmsim.config.vehicles import Multirotor
from swarmsim.control.multirotor import control, control_start
from swarmsim.physics.contact import Plane
from swarmsim.physics.multirotor import make_multirotor_step, rest_state
from swarmsim.physics.wind import GUST_NOISE, gust_start, gust_step, gust_velocity, steady_wind
from swarmsim.vehicles.battery import open_circuit_voltage
from swarmsim.vehicles.multirotor import MultirotorParams, multirotor_params
from swarmsim.vehicles.state import MultirotorState, RigidState

DT = 0.005
GRAVITY = 9.81
ENGINES = ("analytic", "mjx")
BLOCK = 400
"""Steps that are compiled; longer flights repeat them."""
CALM = np.zeros(3, np.float32)


@cache
def spec_of(name: str = "tarot_t650") -> Multirotor:
    return load_named("vehicles", name)


PLAIN = FlightEffects(**dict.fromkeys(FlightEffects.model_fields, False))
"""Rotors as in still air, whatever the air does, and a battery of constant voltage: what closed forms describe."""


def params_of(name: str = "tarot_t650", effects: FlightEffects | None = None) -> MultirotorParams:
    return multirotor_params(spec_of(name), effects)


def plane(slope_deg: float = 0.0) -> Plane:
    """Plane through the origin that falls towards the east."""
    slope = np.radians(slope_deg)
    return Plane(point_m=jnp.zeros(3), normal=jnp.array([np.sin(slope), 0.0, np.cos(slope)], jnp.float32))


def airborne(params: MultirotorParams, *, height=100.0, speed=0.0, rate=(0.0, 0.0, 0.0), q=(1.0, 0, 0, 0)):
    """Vehicle at rest high above the origin, its rotors at ``speed`` rad/s."""
    rotors = params.rotor_spin.shape[0]
    return MultirotorState(
        body=RigidState(
            position_m=jnp.array([0.0, 0.0, height]),
            quaternion=jnp.array(q, jnp.float32),
            velocity_m_s=jnp.zeros(3),
            angular_velocity_rad_s=jnp.array(rate, jnp.float32),
        ),
        rotor_speed_rad_s=jnp.broadcast_to(jnp.asarray(speed, jnp.float32), (rotors,)),
        contact_slip_m=jnp.zeros_like(params.contact_position_m),
        ground_force_n=jnp.zeros(()),
        energy_j=jnp.zeros(()),
        voltage_v=open_circuit_voltage(params.battery, jnp.ones(())),
    )


def hover_speed(params: MultirotorParams) -> float:
    rotors = params.rotor_spin.shape[0]
    return float(np.sqrt(params.mass_kg * GRAVITY / rotors / params.thrust_coefficient_n_s2))


@partial(jax.jit, static_argnames=("name", "engine"))
def _fly(params, state, commands, wind, ground, name, engine):
    step = make_multirotor_step(engine, DT)

    def body(state, command):
        state = step(params, state, command, wind, ground)
        return state, state

    return jax.lax.scan(body, state, commands)[1]


def fly(params, state, commands, *, steps=None, wind=CALM, ground=None, name="tarot_t650", engine="analytic"):
    """States after each step (numpy) of the rotor commands [steps, R], or of one command held for ``steps``."""
    commands = jnp.asarray(commands, jnp.float32)
    if steps is not None:
        commands = jnp.broadcast_to(commands, (steps, params.rotor_spin.shape[0]))
    parts = []
    for part in np.split(np.asarray(commands), range(BLOCK, len(commands), BLOCK)):
        parts.append(_fly(params, state, part, jnp.asarray(wind), ground or plane(), name=name, engine=engine))
        state = jax.tree.map(lambda x: x[-1], parts[-1])
    return jax.tree.map(lambda *blocks: np.concatenate(blocks), *parts)


@partial(jax.jit, static_argnames=("name", "engine", "gusts"))
def _controlled(params, state, ground, wind_m_s, seed, setpoints, name, engine, gusts):
    step = make_multirotor_step(engine, DT)

    def tick(carry, now):
        state, memory, gust = carry
        k, setpoint = now
        command, memory = control(params, memory, state, setpoint, 2 * DT)
        height = state.body.position_m[2]
        wind = steady_wind(wind_m_s, 4.2, height)
        if gusts:
            key = jax.random.fold_in(jax.random.key(seed), k)
            airspeed = jnp.linalg.norm(wind - state.body.velocity_m_s)
            gust = gust_step(
                jax.random.normal(key, (GUST_NOISE,)),
                gust,
                speed_m_s=wind_m_s,
                height_m=height,
                airspeed_m_s=airspeed,
                dt=2 * DT,
            )
            wind = wind + gust_velocity(gust, wind_m_s, 4.2, height)
        state = step(params, step(params, state, command, wind, ground), command, wind, ground)
        return (state, memory, gust), (state, memory, command)

    start = (state, control_start(), gust_start(jax.random.normal(jax.random.key(seed + 1000), (GUST_NOISE,))))
    ticks = jax.tree.leaves(setpoints)[0].shape[0]
    return jax.lax.scan(tick, start, (jnp.arange(ticks), setpoints))[1]


def fly_controlled(
    params,
    setpoint_at,
    seconds,
    *,
    state=None,
    wind=0.0,
    seed=0,
    gusts=False,
    ground=None,
    name="tarot_t650",
    engine=None,
):
    """States, controller memories and commands every 10 ms (numpy) of a flight along ``setpoint_at(time_s)``."""
    ground = ground or plane()
    state = rest_state(params, ground, 0.0) if state is None else state
    # values, so that flights along other ways are flown by the same program
    setpoints = jax.jit(jax.vmap(setpoint_at))(2 * DT * jnp.arange(round(seconds / (2 * DT))))
    flown = _controlled(
        params, state, ground, jnp.float32(wind), seed, setpoints, name=name, engine=engine or "analytic", gusts=gusts
    )
    return jax.tree.map(np.asarray, flown)


def attitude(q):
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] in float64."""
    w, x, y, z = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def angle_deg(a, b):
    """Angle between attitudes of quaternions [..., 4]; well conditioned near zero."""
    relative = np.swapaxes(attitude(a), -1, -2) @ attitude(b)
    skew = 0.5 * np.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        -1,
    )
    cosine = 0.5 * (np.trace(relative, axis1=-2, axis2=-1) - 1.0)
    return np.degrees(np.arctan2(np.linalg.norm(skew, axis=-1), cosine))
