"""Rovers and sites for the tests of the skid-steer physics, and the same rover in MuJoCo C."""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import yaml

from swarmsim.config.vehicles import SkidSteer
from swarmsim.physics.skid_steer import make_skid_steer_step, rest_state
from swarmsim.physics.wheels import ROLLING_ONSET_RAD_S
from swarmsim.site import Obstacles, Site, Steps
from swarmsim.vehicles.skid_steer import skid_steer_mjcf, skid_steer_params, tyre_sinkage

FILE = Path(__file__).parents[2] / "configs" / "vehicles" / "orpheus.yaml"
SPEC = SkidSteer(**yaml.safe_load(FILE.read_text()))
PARAMS = skid_steer_params(SPEC)
DT = 0.005
CHUNK = 10  # steps
STEP = {engine: make_skid_steer_step(engine, DT) for engine in ("mjx", "analytic")}
ENGINES = tuple(STEP)


def plane_site(slope=(0.0, 0.0), wall_east_m=None, cells=80, cell=1.0) -> Site:
    """Plane ground of ``slope`` (rise per metre), with a wall that fills all that is east of ``wall_east_m``."""
    axis = (np.arange(cells) - cells // 2) * cell
    x, y = np.meshgrid(axis, axis)
    terrain = jnp.asarray(slope[0] * x + slope[1] * y, jnp.float32)
    clearance = np.full_like(x, 30.0) if wall_east_m is None else wall_east_m - x
    return Site(
        origin_m=jnp.full(2, axis[0], jnp.float32),
        cell_m=jnp.float32(cell),
        terrain_m=terrain,
        surface_m=terrain,
        clearance_m=jnp.asarray(clearance, jnp.float32),
        cost=jnp.ones_like(terrain),
        obstacles=Obstacles(
            centre_m=jnp.zeros((1, 3)),
            half_extent_m=jnp.zeros((1, 3)),
            axis=jnp.array([[1.0, 0.0]]),
            wall_m=jnp.zeros(1),
            material=jnp.zeros(1, jnp.int32),
        ),
        survey_area_m=jnp.zeros((4, 2)),
        ground_material=jnp.int32(0),
        material_names=("soil",),
    )


def step_site(rise_m, distance_m=1.0, angle=0.0, cells=81, cell=0.5) -> Site:
    """Level ground that is higher by ``rise_m`` beyond a straight edge, ``distance_m`` from the origin at ``angle``."""
    site = plane_site(cells=cells, cell=cell)
    axis = (np.arange(cells) - cells // 2) * cell
    x, y = np.meshgrid(axis, axis)
    beyond = np.cos(angle) * x + np.sin(angle) * y - distance_m
    edge = np.stack(np.broadcast_arrays(np.cos(angle), np.sin(angle), -beyond, rise_m), axis=-1)
    steps = Steps(floor_m=jnp.asarray(rise_m * (beyond > 0.0), jnp.float32), edge=jnp.asarray(edge, jnp.float32))
    return dataclasses.replace(site, terrain_m=steps.floor_m, steps=steps)


@partial(jax.jit, static_argnums=0)
def _chunk(engine, params, state, command, site):
    def one(state, _):
        state = STEP[engine](params, state, command, site)
        return state, state

    return jax.lax.scan(one, state, None, length=CHUNK)[1]


def drive(engine, command, seconds, site=None, params=PARAMS, state=None, yaw=0.0):
    """States [n, ...] after each step of driving ``command`` [4] from rest at the origin, or from ``state``.

    ``seconds`` is a multiple of 0.05: chunks of that length share one compilation.
    """
    site = plane_site() if site is None else site
    state = rest_state(params, site, jnp.zeros(2), yaw) if state is None else state
    chunks = []
    for _ in range(round(seconds / DT) // CHUNK):
        chunks.append(_chunk(engine, params, state, jnp.asarray(command, jnp.float32), site))
        state = last(chunks[-1])
    return jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *chunks)


def last(states):
    """The last of ``states``."""
    return jax.tree.map(lambda x: x[-1], states)


def mujoco_drive(command, seconds, dt, gravity=(0.0, 0.0, -9.81)):
    """MuJoCo C's data after driving ``command`` [4] from rest on level ground, all in float64."""
    model = mujoco.MjModel.from_xml_string(skid_steer_mjcf(SPEC, time_step_s=dt))
    model.opt.gravity[:] = gravity
    data = mujoco.MjData(model)
    data.qpos[2] -= float(tyre_sinkage(PARAMS))
    p = jax.tree.map(lambda x: np.asarray(x, float), PARAMS)
    resistance = p.rolling_resistance * 0.25 * p.mass_kg * p.gravity_m_s2 * p.wheel_radius_m
    torque, command = np.zeros(4), np.asarray(command, float)
    for _ in range(round(seconds / dt)):
        speed = data.qvel[6:10]
        wanted = np.clip(p.speed_gain_nm_s * (command - speed), -p.torque_max_nm, p.torque_max_nm)
        torque = wanted + (torque - wanted) * np.exp(-dt / p.motor_time_constant_s)
        data.ctrl[:] = torque - resistance * np.tanh(speed / ROLLING_ONSET_RAD_S)
        mujoco.mj_step(model, data)
    return data
