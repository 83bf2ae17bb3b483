"""The rover of `tests.physics.rovers` in scenes of MuJoCo C: slopes, kerbs, ledges and walls made of boxes and planes.

The wheels are spheres with the tyres' contact parameters, as in `skid_steer_mjcf`. The chassis is the specification's
box and the bumper a frictionless box of the rover's outline, at the height of the centre of mass. Gravity is tilted for
a slope, which is exact on a plane.
"""

import mujoco
import numpy as np

from swarmsim.physics.wheels import ROLLING_ONSET_RAD_S
from swarmsim.vehicles.rover_body import rover_body
from swarmsim.vehicles.skid_steer import WHEELS, skid_steer_mjcf, skid_steer_params, tyre_sinkage
from tests.physics.rovers import SPEC

DT_C = 0.001
BUMPER_HALF_HEIGHT_M = 0.02


class Rover:
    """MuJoCo C's rover on ``geoms`` (MJCF attributes of each, without contact), with the motors of swarmsim.

    ``start`` is x, y, height of the ground, yaw; ``walls`` are geoms that only the bumper meets.
    """

    def __init__(self, geoms, walls=(), start=(0.0, 0.0, 0.0, 0.0), slope_deg=(0.0, 0.0), spec=SPEC, dt=DT_C):
        self.spec, self.params, body = spec, skid_steer_params(spec), rover_body(spec)
        root = mujoco.MjSpec.from_string(skid_steer_mjcf(spec, time_step_s=dt))
        contacts = {}
        for tyre in root.pairs:
            said = {name: getattr(tyre, name) for name in ("condim", "friction", "solref", "solreffriction", "solimp")}
            contacts[tyre.geomname2] = {name: np.array(v) if np.ndim(v) else v for name, v in said.items()}
        for pair in list(root.pairs):
            root.delete(pair)
        chassis = root.body("chassis")
        off = {"contype": 0, "conaffinity": 0}
        centre = spec.chassis_height_m - (body.wheel_radius_m - body.wheel_position_m[0, 2])
        box = mujoco.mjtGeom.mjGEOM_BOX
        chassis.add_geom(
            name="hull", type=box, size=0.5 * np.array(spec.chassis_size_m), pos=[0, 0, centre], mass=0, **off
        )
        _, front, _, left = body.outline_m
        chassis.add_geom(name="bumper", type=box, size=[front, left, BUMPER_HALF_HEIGHT_M], mass=0, **off)
        for i, geom in enumerate([*geoms, *walls]):
            root.worldbody.add_geom(name=f"scene{i}", **geom, **off)
        for i in range(len(geoms)):
            for wheel in WHEELS:
                root.add_pair(geomname1=f"scene{i}", geomname2=wheel, **contacts[wheel])
            root.add_pair(geomname1=f"scene{i}", geomname2="hull", condim=3, friction=[0.4, 0.4, 0, 0, 0])
        for i in range(len(geoms), len(geoms) + len(walls)):
            root.add_pair(geomname1=f"scene{i}", geomname2="bumper", condim=1)
        self.model = root.compile()
        self.model.opt.iterations = 50
        tilt = np.radians(slope_deg)
        down = np.array([-np.tan(tilt[0]), -np.tan(tilt[1]), -1.0])
        self.model.opt.gravity[:] = 9.81 * down / np.linalg.norm(down)
        self.data = mujoco.MjData(self.model)
        x, y, ground, yaw = start
        height = body.wheel_radius_m - body.wheel_position_m[0, 2] - float(tyre_sinkage(self.params))
        self.data.qpos[:7] = [x, y, ground + height, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        self.torque = np.zeros(4)

    def drive(self, command, seconds):
        """Poses [n, 7] every 50 ms of driving with ``command`` [4] (rad/s)."""
        p, data, dt = self.params, self.data, self.model.opt.timestep
        wanted_speed = np.clip(
            np.asarray(command, float), -float(p.wheel_speed_max_rad_s), float(p.wheel_speed_max_rad_s)
        )
        gain, most = float(p.speed_gain_nm_s), float(p.torque_max_nm)
        keep = np.exp(-dt / float(p.motor_time_constant_s))
        resistance = float(p.rolling_resistance * 0.25 * p.mass_kg * p.gravity_m_s2 * p.wheel_radius_m)
        poses = []
        for i in range(round(seconds / dt)):
            speed = data.qvel[6:10]
            wanted = np.asarray(p.driven) * np.clip(gain * (wanted_speed - speed), -most, most)
            self.torque = wanted + (self.torque - wanted) * keep
            data.ctrl[:] = self.torque - resistance * np.tanh(speed / ROLLING_ONSET_RAD_S)
            mujoco.mj_step(self.model, data)
            if (i + 1) % round(0.05 / dt) == 0:
                poses.append(data.qpos[:7].copy())
        return np.array(poses)


def plane():
    """Level ground at height zero."""
    return {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [100, 100, 1]}


def block(low, high, yaw=0.0):
    """A box between the corners ``low`` and ``high`` (m), turned about the vertical through the origin."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    x, y, z = 0.5 * (low + high)
    c, s = np.cos(yaw), np.sin(yaw)
    return {
        "type": mujoco.mjtGeom.mjGEOM_BOX,
        "size": 0.5 * (high - low),
        "pos": [c * x - s * y, s * x + c * y, z],
        "quat": [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)],
    }
