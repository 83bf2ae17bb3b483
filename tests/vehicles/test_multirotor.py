"""Multirotor parameters, rotors and aerodynamics against the reference figures and closed forms."""

import copy
import re
from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from swarmsim.config.errors import InputError
from swarmsim.config.vehicles import Multirotor
from swarmsim.vehicles.multirotor import (
    battery_power,
    effectiveness,
    multirotor_mjcf,
    multirotor_params,
    rotor_speeds,
    wrench,
)
from swarmsim.vehicles.rotors import ground_gain
from tests.flights import GRAVITY, hover_speed, params_of, spec_of

RPM = 2 * np.pi / 60
FAR = jnp.full(4, 1e3)
FULL_V = jnp.float32(100.0)
STILL = jnp.zeros(3)


def loads(params, speed, *, after=None, height=FAR, air=STILL, rate=STILL, dt=0.005):
    speed = jnp.broadcast_to(jnp.asarray(speed, jnp.float32), (4,))
    return wrench(
        params,
        speed_before_rad_s=speed,
        speed_after_rad_s=speed if after is None else after,
        rotor_height_m=height,
        air_velocity_m_s=air,
        angular_velocity_rad_s=rate,
        dt=dt,
    )


def test_t650_has_the_reference_figures():
    spec = spec_of("tarot_t650")
    assert spec.mass_kg == 3.5
    assert spec.rotor.thrust_coefficient_n_s2 * RPM**2 == pytest.approx(7.3385e-7, rel=1e-5)
    assert spec.rotor.moment_constant_m == pytest.approx(0.07 * 3 * 0.19)
    assert spec.rotor.speed_min_rad_s == pytest.approx(875 * RPM, rel=1e-5)
    assert spec.rotor.speed_max_rad_s == pytest.approx(5832 * RPM, rel=1e-5)
    assert (spec.rotor.time_constant_up_s, spec.rotor.time_constant_down_s) == (0.03, 0.03)
    assert spec.drag_quadratic_kg_m == pytest.approx(0.30 * np.pi * 0.325**2, rel=1e-5)
    cylinder = 3.5 * (3 * 0.325**2 + 0.15**2) / 12
    np.testing.assert_allclose(spec.inertia_kg_m2, [cylinder, cylinder, 3.5 * 0.325**2 / 2])
    np.testing.assert_allclose(np.abs([r.position_m for r in spec.rotors])[:, :2], 0.707 * 0.325)


def test_t650_hovers_at_3420_rpm():
    assert hover_speed(params_of("tarot_t650")) / RPM == pytest.approx(3420, abs=0.5)


def test_x500_has_the_figures_of_px4():
    rotor = spec_of("x500").rotor
    assert (rotor.thrust_coefficient_n_s2, rotor.moment_constant_m, rotor.speed_max_rad_s) == (
        8.54858e-6,
        0.016,
        1000.0,
    )
    assert (rotor.time_constant_up_s, rotor.time_constant_down_s) == (0.0125, 0.025)
    assert spec_of("x500").mass_kg == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
def test_every_number_needs_a_source(name):
    data = spec_of(name).model_dump()
    broken = copy.deepcopy(data)
    del broken["sources"]["rotor.radius_m"]
    with pytest.raises(ValidationError, match=re.escape("no source is given for: rotor.radius_m")):
        Multirotor.model_validate(broken)
    with pytest.raises(ValidationError, match=r"no number stands at the path of the source: rotor\.radius "):
        Multirotor.model_validate({**data, "sources": {**data["sources"], "rotor.radius": "nowhere"}})
    with pytest.raises(ValidationError, match="the source is empty for: mass_kg"):
        Multirotor.model_validate({**data, "sources": {**data["sources"], "mass_kg": " "}})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass_kg": 60.0}, "the rotors lift"),
        ({"rotor": {"speed_max_rad_s": 50.0}}, "speed_max_rad_s must be more than"),
        ({"spins": "cw"}, "turn both ways"),
    ],
)
def test_what_cannot_fly_is_refused(changes, message):
    data = spec_of().model_dump()
    data["rotor"].update(changes.pop("rotor", {}))
    for rotor in data["rotors"]:
        rotor["spin"] = changes.get("spins", rotor["spin"])
    changes.pop("spins", None)
    with pytest.raises(ValidationError, match=message):
        Multirotor.model_validate({**data, **changes})


def test_rotor_lag_is_exact_for_any_step():
    params = params_of("x500")
    up, down = jnp.full(4, 400.0), jnp.full(4, 900.0)
    command = jnp.full(4, 700.0)
    once = rotor_speeds(params, up, command, FULL_V, 0.02)
    np.testing.assert_allclose(once, 700 - 300 * np.exp(-0.02 / 0.0125), rtol=1e-6)
    np.testing.assert_allclose(
        rotor_speeds(params, down, command, FULL_V, 0.02), 700 + 200 * np.exp(-0.02 / 0.025), rtol=1e-6
    )
    many = up
    for _ in range(10):
        many = rotor_speeds(params, many, command, FULL_V, 0.002)
    np.testing.assert_allclose(many, once, rtol=1e-5)


def test_motors_saturate_idle_and_disarm():
    params = params_of()
    command = jnp.array([1e6, 1.0, 0.0, -5.0])
    settled = rotor_speeds(params, jnp.full(4, 300.0), command, FULL_V, 10.0)
    expected = [params.speed_max_rad_s, params.speed_min_rad_s, 0.0, 0.0]
    np.testing.assert_allclose(settled, expected, rtol=1e-6)
    assert np.isnan(rotor_speeds(params, jnp.full(4, 300.0), jnp.full(4, jnp.nan), FULL_V, 0.005)).all()


@pytest.mark.parametrize(("height_in_radii", "factor"), [(0.5, 4 / 3), (1.0, 16 / 15), (2.0, 64 / 63), (1e4, 1.0)])
def test_ground_effect_is_cheeseman_and_bennett(height_in_radii, factor):
    assert 1 + float(ground_gain(height_in_radii * 0.19, 0.19)) == pytest.approx(factor, rel=1e-6)


@given(st.floats(-5.0, 50.0), st.floats(0.05, 1.0))
def test_ground_effect_is_bounded(height, radius):
    assert 0.0 <= float(ground_gain(height, radius)) <= 1 / 3 + 1e-6


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
def test_hover_wrench_carries_the_weight(name):
    params = params_of(name)
    force, torque = loads(params, hover_speed(params))
    np.testing.assert_allclose(force, [0, 0, spec_of(name).mass_kg * GRAVITY], rtol=1e-5)
    np.testing.assert_allclose(torque, 0.0, atol=1e-5)


@given(st.lists(st.floats(100.0, 600.0), min_size=4, max_size=4))
def test_wrench_is_the_effectiveness_of_the_thrusts(speeds):
    params, spec = params_of(), spec_of()
    force, torque = loads(params, jnp.array(speeds))
    thrust = spec.rotor.thrust_coefficient_n_s2 * np.square(speeds)
    np.testing.assert_allclose([force[2], *torque], effectiveness(spec) @ thrust, rtol=1e-4, atol=1e-4)


def test_front_right_rotor_rolls_left_pitches_up_and_yaws_right():
    # Body FLU: more thrust front right lifts that corner: roll torque x < 0, pitch torque y < 0 (nose up); it turns
    # counter-clockwise, so the body is pushed clockwise: z < 0.
    params = params_of()
    _, torque = loads(params, jnp.array([400.0, 300.0, 300.0, 300.0]))
    assert (np.asarray(torque) < 0).all()


def test_accelerating_rotor_turns_the_body_back():
    params = params_of()
    before, after = jnp.full(4, 300.0), jnp.array([310.0, 310.0, 300.0, 300.0])
    _, torque = loads(params, before, after=after)
    _, steady = loads(params, 0.5 * (before + after))
    reaction = float(torque[2] - steady[2])
    assert reaction == pytest.approx(-2 * float(params.rotor_inertia_kg_m2) * 10 / 0.005, rel=1e-4)


def test_drag_is_quadratic_against_the_air():
    params = params_of()
    air = jnp.array([3.0, -4.0, 0.0])
    force, _ = loads(params, 0.0, air=air)
    np.testing.assert_allclose(force[:2], -0.0995494 * 5.0 * np.asarray(air)[:2], rtol=1e-5)
    tall = replace(params, drag_quadratic_kg_m=jnp.array([0.1, 0.2, 0.3]))
    force, _ = loads(tall, 0.0, air=jnp.array([3.0, -4.0, 12.0]))
    np.testing.assert_allclose(force, [-0.1 * 13 * 3, 0.2 * 13 * 4, -0.3 * 13 * 12], rtol=1e-5)


def test_rotor_drag_of_the_x500_is_that_of_its_model():
    """0.6 N at 2.4 m/s: models/x500/model.sdf, 8.06428e-5 times the rotor speed and the speed, of four rotors."""
    params = params_of("x500")
    speed, air = hover_speed(params), jnp.array([2.4, 0.0, 0.0])
    still = replace(params, drag_quadratic_kg_m=jnp.zeros(3))
    force, torque = loads(still, speed, air=air)
    assert float(force[0]) == pytest.approx(-4 * 8.06428e-5 * speed * 2.4, rel=1e-4)
    assert 0.55 < -float(force[0]) < 0.65
    # The drag acts 58 mm above the centre of mass and tips the nose up; the rolling moment is about the motion.
    assert float(torque[1]) == pytest.approx(0.0581 * float(force[0]), rel=1e-2)
    assert float(torque[0]) == pytest.approx(-4 * 1e-6 * speed * 2.4, rel=1e-2)


def hover_power(name):
    """Power of the motors in hover [W], avionics apart."""
    params = params_of(name)
    speed = jnp.full(len(spec_of(name).rotors), hover_speed(params))
    power = battery_power(params, speed_before_rad_s=speed, speed_after_rad_s=speed, dt=0.005)
    return float(power) - spec_of(name).battery.avionics_power_w


@pytest.mark.parametrize(
    ("name", "measured_w"),
    [
        ("tarot_t650", 4 * 105.4),  # MRS's bench of this drive at 875 g a rotor (ctu-mrs.github.io, motor_tests.md)
        ("dji_f550", 6 * 48.1),  # the same bench at 383 g: 51.5 W at 401 g by the power 3/2 of the thrust
        ("x500", 4 * 63.2),  # the same bench, another 10 inch drive at 516 g
        ("crazyflie_2_1", 7.61 - 0.96),  # Bitcraze's thrust investigation at 28 g
        ("ar_drone_2", 60.0 - 5.0),  # 11 min on 11.1 Wh
    ],
)
def test_hover_takes_the_measured_power(name, measured_w):
    assert hover_power(name) == pytest.approx(measured_w, rel=0.1)


def test_a_rotor_that_slows_down_gives_nothing_back():
    params = params_of()
    speed = jnp.full(4, hover_speed(params))
    braking = float(battery_power(params, speed_before_rad_s=speed, speed_after_rad_s=0.5 * speed, dt=0.005))
    assert braking == pytest.approx(25.0)


@pytest.mark.parametrize("visual", [True, False])
@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
def test_mjcf_is_the_body_of_the_spec(name, visual):
    spec = spec_of(name)
    model = mujoco.MjModel.from_xml_string(multirotor_mjcf(spec, 0.004, visual=visual))
    assert (model.nq, model.nv, model.opt.timestep) == (7, 6, 0.004)
    assert model.body_mass[1] == pytest.approx(spec.mass_kg)
    np.testing.assert_allclose(model.body_inertia[1], spec.inertia_kg_m2, rtol=1e-6)
    assert (model.ngeom > 0) == visual


def test_a_number_that_float32_cannot_hold_is_told():
    heavy = spec_of("x500").model_copy(update={"inertia_kg_m2": (1e300, 1e300, 1e300)})
    with pytest.raises(InputError, match="inertia_kg_m2 is too large"):
        multirotor_params(heavy)
