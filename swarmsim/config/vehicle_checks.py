"""Whether the numbers of a vehicle make one that can fly, drive and stand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from swarmsim.config.vehicles import Multirotor, SkidSteer

GRAVITY_M_S2 = 9.81
"""Acceleration of gravity, along -z of the world; the value of the models that the vehicle files quote."""
CELL_FULL_V = 4.1  # without load (`swarmsim.vehicles.battery`)
SINGULAR = 1e-4  # of the largest: a smaller singular value of what rotors do is none
REACH_SHARE = 0.98  # of its rotors' reach a vehicle's cylinder has at least: files round both


def multirotor_fault(spec: Multirotor) -> str | None:
    """What keeps a multirotor from flying or from standing on its feet, in a sentence; None for a sound one."""
    for fault in (_lift, _spins, _rotors, _level, _idle, _voltage, _feet, _outline):
        if told := fault(spec):
            return told
    return None


def skid_steer_fault(spec: SkidSteer) -> str | None:
    """What keeps a rover from driving, in a sentence; None for a sound one."""
    wheels = spec.wheels
    if spec.mass_kg <= 4 * wheels.mass_kg:
        return "mass_kg is the whole rover: it must be more than four times wheels.mass_kg"
    if wheels.wheel_base_m < 2 * wheels.radius_m:
        return "the wheels of a side overlap: wheels.wheel_base_m must be at least twice wheels.radius_m"
    if wheels.track_m < wheels.width_m:
        return "the wheels of an axle overlap: wheels.track_m must be at least wheels.width_m"
    if spec.chassis_height_m <= 0.5 * spec.chassis_size_m[2]:
        return (
            "the chassis reaches into the ground: chassis_height_m, that of its middle, must be more than half of the "
            "third of chassis_size_m"
        )
    share = 1.0 if wheels.castors is None else 1.0 - wheels.castors.load_share
    weight = GRAVITY_M_S2 * spec.mass_kg
    motors = (4 if wheels.castors is None else 2) * spec.motor.torque_max_nm / wheels.radius_m
    push, resistance = min(motors, wheels.friction * share * weight), wheels.rolling_resistance * weight
    if push <= resistance:
        return (
            f"the wheels push with {push:.3g} N at most, and roll against {resistance:.3g} N: check "
            "motor.torque_max_nm, wheels.friction and wheels.rolling_resistance"
        )
    return None


def effectiveness(spec: Multirotor) -> NDArray[np.float64]:
    """Matrix [4, R] from rotor thrusts (N) to total thrust (N) and torque x, y, z (N m, body)."""
    arms = np.array([rotor.position_m for rotor in spec.rotors])
    yaw = [spec.rotor.moment_constant_m * (-1.0 if rotor.spin == "ccw" else 1.0) for rotor in spec.rotors]
    return np.stack([np.ones(len(arms)), arms[:, 1], -arms[:, 0], np.array(yaw)])


def _most(spec: Multirotor) -> float:
    """Largest thrust of one rotor, N."""
    return spec.rotor.thrust_coefficient_n_s2 * spec.rotor.speed_max_rad_s**2


def _lift(spec: Multirotor) -> str | None:
    rotor, weight = spec.rotor, GRAVITY_M_S2 * spec.mass_kg
    if rotor.speed_max_rad_s <= rotor.speed_min_rad_s:
        return "rotor.speed_max_rad_s must be more than rotor.speed_min_rad_s"
    thrust = len(spec.rotors) * _most(spec)
    if thrust <= weight:
        return (
            f"the rotors lift {thrust:.1f} N at most, the vehicle weighs {weight:.1f} N: check mass_kg, "
            "rotor.thrust_coefficient_n_s2 and rotor.speed_max_rad_s"
        )
    return None


def _spins(spec: Multirotor) -> str | None:
    if len({rotor.spin for rotor in spec.rotors}) < 2:
        return "rotors must turn both ways (spin ccw and cw), or nothing holds the yaw"
    return None


def _rotors(spec: Multirotor) -> str | None:
    """Rotors that do not move all of the vehicle."""
    level = np.array([rotor.position_m[:2] for rotor in spec.rotors])
    least, spread = SINGULAR * np.abs(level).max(), np.linalg.svd(level - level.mean(axis=0), compute_uv=False)
    if spread[1] <= least:
        line = "on one line" if spread[0] > least else "at one point"
        return f"the rotors stand {line} seen from above, so that they cannot tilt the vehicle to all sides"
    matrix = effectiveness(spec)
    strength = np.linalg.svd(matrix / np.abs(matrix).max(axis=1, keepdims=True), compute_uv=False)
    if len(spec.rotors) < 4 or strength[3] < SINGULAR * strength[0]:
        return (
            "the rotors cannot lift, roll, pitch and yaw the vehicle independently of each other: it takes four or "
            "more, and neighbours that turn opposite ways (spin)"
        )
    return None


def _level(spec: Multirotor) -> str | None:
    """Rotors that lift the vehicle beside its centre of mass."""
    weight, most = GRAVITY_M_S2 * spec.mass_kg, _most(spec)
    hover = np.linalg.pinv(effectiveness(spec)) @ [weight, 0.0, 0.0, 0.0]
    if hover.min() < -SINGULAR * weight or hover.max() > most:
        thrusts = ", ".join(f"{thrust:.3g}" for thrust in hover)
        return (
            f"the rotors cannot hold the vehicle level: it takes thrusts of {thrusts} N, and each gives 0 to "
            f"{most:.3g} N. Their places are from the centre of mass, which must lie among them"
        )
    return None


def _idle(spec: Multirotor) -> str | None:
    weight = GRAVITY_M_S2 * spec.mass_kg
    idle = len(spec.rotors) * spec.rotor.thrust_coefficient_n_s2 * spec.rotor.speed_min_rad_s**2
    if idle >= weight:
        return (
            f"the rotors lift {idle:.1f} N at least, the vehicle weighs {weight:.1f} N, so that it never comes down: "
            "check rotor.speed_min_rad_s"
        )
    return None


def _voltage(spec: Multirotor) -> str | None:
    """A battery at whose voltage the motors are too slow to lift the vehicle."""
    full, weight = CELL_FULL_V * spec.battery.cells, GRAVITY_M_S2 * spec.mass_kg
    thrust = len(spec.rotors) * _most(spec) * min(1.0, full / spec.rotor.speed_max_voltage_v) ** 2
    if thrust <= weight:
        return (
            f"at the {full:.1f} V of its full battery the rotors lift {thrust:.1f} N, the vehicle weighs "
            f"{weight:.1f} N: check battery.cells and rotor.speed_max_voltage_v"
        )
    return None


def _feet(spec: Multirotor) -> str | None:
    places = np.array(spec.feet.positions_m)
    if np.max(places[:, 2]) >= 0.0:
        return "the feet must lie below the centre of mass: the third of each of feet.positions_m is less than zero"
    bearing = np.sort(np.arctan2(places[:, 1], places[:, 0]))
    gap = np.max(np.diff(bearing, append=bearing[0] + 2.0 * np.pi))
    if gap >= np.pi - 1e-6:
        return (
            "the vehicle falls over: its centre of mass, from which feet.positions_m are, must lie above the area "
            "between its feet"
        )
    return None


def _outline(spec: Multirotor) -> str | None:
    rotors = np.array([rotor.position_m for rotor in spec.rotors])
    feet = np.array(spec.feet.positions_m)
    reach = max(np.hypot(*rotors.T[:2]).max() + spec.rotor.radius_m, np.hypot(*feet.T[:2]).max())
    if spec.collision_radius_m < REACH_SHARE * reach:
        return f"collision_radius_m must take in propellers and feet, which reach {reach:.3g} m from the middle"
    tall = max(rotors[:, 2].max(), 0.0) - feet[:, 2].min()
    if spec.collision_height_m < REACH_SHARE * tall:
        return f"collision_height_m must take in the feet and the rotors above them, {tall:.3g} m"
    return None
