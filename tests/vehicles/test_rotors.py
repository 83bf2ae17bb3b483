"""Rotors in moving air against blade element and momentum theory, solved numerically."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from swarmsim.config.flight import FlightEffects
from swarmsim.vehicles.multirotor import LIFT_SLOPE, multirotor_params
from swarmsim.vehicles.rotors import AIR_DENSITY_KG_M3, ground_gain, thrusts
from tests.flights import PLAIN, hover_speed, params_of, spec_of

FAR = jnp.full(1, 1e3)


def thrust(name, speed, hub, effects=None, height=FAR):
    params = params_of(name, effects)
    hub = jnp.asarray(hub, jnp.float32)[None]
    return float(
        thrusts(params.rotor_air, params.thrust_coefficient_n_s2, jnp.full(1, jnp.float32(speed)), hub, height)[0]
    )


def theory(name, speed, across, along):
    """Thrust [N] by blade element theory with the uniform inflow that momentum theory gives (Leishman, 3.2 and 2.14).

    The pitch is what makes the hover thrust k w^2.
    """
    rotor = spec_of(name).rotor
    area, tip = np.pi * rotor.radius_m**2, speed * rotor.radius_m
    scale = AIR_DENSITY_KG_M3 * area * tip**2
    hover = rotor.thrust_coefficient_n_s2 * speed**2 / scale
    lift = LIFT_SLOPE * rotor.solidity
    pitch = 3 * (2 * hover / lift + 0.5 * np.sqrt(hover / 2))
    mu, climb = across / tip, along / tip

    def coefficient(inflow):
        return 0.5 * lift * (pitch / 3 * (1 + 1.5 * mu**2) - 0.5 * inflow)

    def gap(inflow):
        return 2 * (inflow - climb) * np.hypot(mu, inflow) - coefficient(inflow)

    return scale * coefficient(brentq(gap, max(climb, 0.0) + 1e-9, 1.0))


@pytest.mark.parametrize("name", ["tarot_t650", "x500", "dji_f550", "crazyflie_2_1"])
def test_thrust_in_climb_and_in_forward_flight_is_that_of_theory(name):
    """Within 6 % of the hover thrust at the speeds that the vehicle flies."""
    hover, control = hover_speed(params_of(name)), spec_of(name).control
    weight = thrust(name, hover, [0, 0, 0])
    for across in np.linspace(0.0, control.speed_max_m_s, 7):
        for along in (-0.3, 0.0, 0.5, 1.0):
            climb = along * control.climb_rate_max_m_s
            found, wanted = thrust(name, hover, [across, 0, climb]), theory(name, hover, across, climb)
            assert found == pytest.approx(wanted, abs=0.06 * weight), (across, climb)


def test_a_climb_costs_thrust_and_forward_flight_spares_inflow():
    hover = hover_speed(params_of())
    weight = thrust("tarot_t650", hover, [0, 0, 0])
    assert weight == pytest.approx(3.5 * 9.81 / 4, rel=1e-4)
    assert thrust("tarot_t650", hover, [0, 0, 2.0]) < 0.95 * weight
    assert 1.03 * weight < thrust("tarot_t650", hover, [0, 5.0, 0]) < 1.3 * weight
    falling = [thrust("tarot_t650", hover, [0, 0, -v]) for v in (11.5, 20.0, 40.0)]
    assert max(falling) - min(falling) < 0.02 * weight  # below the theory's reach the thrust stays as it is


@pytest.mark.parametrize(
    ("left_out", "hub", "height"),
    [
        ("inflow", [0, 0, 2.0], 1e3),
        ("translational_lift", [4.0, 0, 0], 1e3),
        ("ground_effect", [0, 0, 0], 0.2),
    ],
)
def test_each_effect_can_be_left_out(left_out, hub, height):
    hover, height = hover_speed(params_of()), jnp.full(1, height)
    whole = thrust("tarot_t650", hover, hub, height=height)
    without = thrust("tarot_t650", hover, hub, FlightEffects(**{left_out: False}), height)
    plain = thrust("tarot_t650", hover, hub, PLAIN, height)
    assert without == pytest.approx(plain, rel=1e-5)
    assert abs(whole - plain) > 0.02 * plain


def test_the_ground_is_felt_less_in_forward_flight():
    """Cheeseman and Bennett: at the induced velocity half of the squared ratio."""
    ratio = (0.19 / (4 * 0.3)) ** 2
    assert 1 + float(ground_gain(0.3, 0.19)) == pytest.approx(1 / (1 - ratio), rel=1e-6)
    assert 1 + float(ground_gain(0.3, 0.19, 4.0, 4.0)) == pytest.approx(1 / (1 - 0.5 * ratio), rel=1e-6)
    low = jnp.full(1, 0.3)
    hover = hover_speed(params_of())
    gain = [thrust("tarot_t650", hover, [v, 0, 0], height=low) / thrust("tarot_t650", hover, [v, 0, 0]) for v in (0, 4)]
    assert 1.0 < gain[1] < gain[0]


def test_derivatives_are_finite_at_rest():
    params = multirotor_params(spec_of())

    def total(speed, hub):
        return jnp.sum(thrusts(params.rotor_air, params.thrust_coefficient_n_s2, speed, hub, jnp.ones(4)))

    for speed in (0.0, 300.0):
        gradient = jax.grad(total, argnums=(0, 1))(jnp.full(4, speed), jnp.zeros((4, 3)))
        assert all(np.isfinite(g).all() for g in gradient)
