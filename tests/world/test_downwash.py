"""Downwash: a jet's momentum, a published loss of lift, the wind that carries it along, and flights below others."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import go_to
from swarmsim.vehicles.rotors import AIR_DENSITY_KG_M3, thrusts
from swarmsim.world.downwash import DECAY, DEPTH_MAX, ORIGIN, REACH_MAX, SPREAD, Rotorcraft, downwash
from swarmsim.world.neighbours import candidates
from swarmsim.world.traffic import in_traffic
from tests.flights import hover_speed, params_of
from tests.world.worlds import airborne, begin, fly, happened, row, world

SPAN, THRUST = 0.5, 20.0


def air_at(
    offset, *, span=(SPAN, SPAN), thrust=(THRUST, 0.0), wind=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), dense=256
):
    """Speeds [N] of the air downwards at offsets [N, 3] from one vehicle, in pairs that have nothing of each other."""
    offset = np.atleast_2d(np.asarray(offset, np.float32))

    def one(apart):
        place = jnp.stack([jnp.zeros(3), apart])
        craft = Rotorcraft(
            position_m=place,
            velocity_m_s=jnp.tile(jnp.asarray(velocity, jnp.float32), (2, 1)),
            wind_m_s=jnp.tile(jnp.asarray(wind, jnp.float32), (2, 1)),
            thrust_n=jnp.asarray(thrust, jnp.float32),
            span_m=jnp.asarray(span, jnp.float32),
        )
        every = jnp.ones(2, bool)
        return downwash(craft, candidates(place, every, every, jnp.float32(REACH_MAX * max(span)), 48, dense))

    return np.asarray(jax.vmap(one)(jnp.asarray(offset)))


@pytest.mark.parametrize("depth", [2.0, 5.0, 10.0])
def test_the_jet_carries_the_momentum_of_the_thrust(depth):
    radius = np.linspace(0.0, 0.74 * REACH_MAX * SPAN, 400)
    speed = air_at(np.stack([radius, 0 * radius, -depth + 0 * radius], -1), span=(SPAN, 0.0))[:, 1]
    flux = AIR_DENSITY_KG_M3 * np.trapezoid(speed.astype(float) ** 2 * 2 * np.pi * radius, radius)
    assert flux == pytest.approx(THRUST, rel=0.03)


def test_the_jet_spreads_and_slows_as_a_round_turbulent_jet():
    depth = np.array([1.0, 4.0, 8.0])
    length = depth + ORIGIN * SPAN
    axis = air_at(np.stack([0 * depth, 0 * depth, -depth], -1), span=(SPAN, 0.0))[:, 1]
    strength = np.sqrt(4 * THRUST / (np.pi * AIR_DENSITY_KG_M3))
    np.testing.assert_allclose(axis, DECAY * strength / length, rtol=1e-4)
    assert 5.8 <= DECAY <= 6.06
    half = air_at(np.stack([SPREAD * length, 0 * depth, -depth], -1), span=(SPAN, 0.0))[:, 1]
    np.testing.assert_allclose(half, 0.5 * axis, rtol=1e-4)


def test_nothing_is_felt_above_beside_or_far_away_and_it_fades_smoothly():
    offsets = [[0, 0, 1.0], [1.0, 0, 0.0], [1.01 * REACH_MAX * SPAN, 0, -1.0], [0, 0, -1.01 * DEPTH_MAX * SPAN]]
    assert not air_at(offsets).any()
    deep = np.linspace(0.5, 1.05 * DEPTH_MAX * SPAN, 300)
    speed = air_at(np.stack([0 * deep, 0 * deep, -deep], -1))[:, 1]
    assert (np.diff(speed) <= 1e-6).all()
    assert np.abs(np.diff(speed)).max() < 0.1


def test_two_crazyflies_lose_what_was_measured():
    """9 g at 0.3 m (Shi et al., "Neural-Swarm", ICRA 2020, introduction), of the 28 g that one weighs here."""
    params = params_of("crazyflie_2_1")
    rotors, weight = params.rotor_spin.shape[0], float(params.mass_kg) * 9.81
    span = 2.0 * float(np.linalg.norm(np.asarray(params.rotor_position_m)[:, :2], axis=1).max())
    air = air_at([0.0, 0.0, -0.3], span=(span, span), thrust=(weight, weight))[0, 1]

    def lift(through):
        hub = jnp.tile(jnp.array([0.0, 0.0, through]), (rotors, 1))
        speed, high = jnp.full(rotors, hover_speed(params)), jnp.full(rotors, 100.0)
        return float(jnp.sum(thrusts(params.rotor_air, params.thrust_coefficient_n_s2, speed, hub, high)))

    lost = lift(0.0) - lift(air) + float(params.drag_quadratic_kg_m[2]) * air**2
    assert 1000.0 * lost / 9.81 == pytest.approx(9.0, abs=1.5)


def test_the_wind_carries_the_jet_along_and_a_moving_vehicle_leaves_it_behind():
    aside = np.linspace(-4.0, 4.0, 321)
    below = np.stack([aside, 0 * aside, 0 * aside - 3.0], -1)
    for given, sign in (({"wind": (3.0, 0.0, 0.0)}, 1.0), ({"velocity": (3.0, 0.0, 0.0)}, -1.0)):
        speed = air_at(below, **given)[:, 1]
        origin, strength = ORIGIN * SPAN, np.sqrt(4 * THRUST / (np.pi * AIR_DENSITY_KG_M3))
        age = ((3.0 + origin) ** 2 - origin**2) / (2 * DECAY * strength)
        assert aside[speed.argmax()] == pytest.approx(sign * 3.0 * age, abs=0.03)


@pytest.mark.slow
def test_the_momenta_of_several_jets_add_and_both_searches_agree():
    draw = np.random.default_rng(2)
    place = jnp.asarray(draw.uniform([0, 0, 0], [12, 12, 12], (80, 3)), jnp.float32)
    craft = Rotorcraft(
        position_m=place,
        velocity_m_s=jnp.asarray(draw.normal(0, 1, (80, 3)), jnp.float32),
        wind_m_s=jnp.zeros((80, 3)),
        thrust_n=jnp.asarray(draw.uniform(5, 30, 80), jnp.float32),
        span_m=jnp.asarray(draw.uniform(0.1, 0.4, 80), jnp.float32),
    )
    every = jnp.ones(80, bool)
    dense, cells = (downwash(craft, candidates(place, every, every, jnp.float32(4.0), 48, n)) for n in (256, 0))
    np.testing.assert_allclose(dense, cells, rtol=1e-5, atol=1e-6)
    assert (np.asarray(dense) > 0.5).sum() > 20
    above = [[0, 0, 0.0], [0, 0, 2.0], [0, 0, 4.0]]
    three = air_at_all(above)
    one, two = air_at([0, 0, -4.0])[0, 1], air_at([0, 0, -2.0])[0, 1]
    assert three[0] == pytest.approx(np.hypot(one, two), rel=1e-5)


def air_at_all(places):
    count = len(places)
    place, every = jnp.asarray(places, jnp.float32), jnp.ones(count, bool)
    craft = Rotorcraft(
        position_m=place,
        velocity_m_s=jnp.zeros((count, 3)),
        wind_m_s=jnp.zeros((count, 3)),
        thrust_n=jnp.full(count, THRUST),
        span_m=jnp.full(count, SPAN),
    )
    return np.asarray(downwash(craft, candidates(place, every, every, jnp.float32(5.0), 48, 256)))


def test_a_vehicle_without_numbers_takes_the_downwash_from_nobody():
    place = jnp.array([[0, 0, 0.0], [0, 0, 2.0], [0, 1.0, 4.0]])
    every = jnp.array([True, True, False])
    still = {"position_m": place, "velocity_m_s": jnp.zeros((3, 3)), "span_m": jnp.full(3, SPAN)}
    craft = Rotorcraft(
        thrust_n=jnp.array([THRUST, THRUST, 0.0]), wind_m_s=jnp.zeros((3, 3)).at[2].set(jnp.nan), **still
    )
    felt = downwash(craft, candidates(place, every, every, jnp.float32(5.0), 48, 256))
    assert felt[0] == pytest.approx(air_at([0, 0, -2.0])[0, 1], rel=1e-5)


@pytest.mark.slow
def test_one_that_has_no_part_any_more_blows_at_nobody():
    team = row("uav", "x500", 2, (-20.0, -15.0), spacing_m=9.0)
    made = world(team, blocks=(), sample_period_s={"nai_1p5x1p5": 1.0}, wind={"speed_m_s": 0.0, "gusts": False})
    places = np.array([[-20.0, -15.0, 10.0], [-20.0, -15.0, 8.0]], np.float32)
    state = airborne(made, begin(made, jax.random.key(5)), places)
    running = jnp.ones(1, bool)
    for part, air in ((True, 4.4), (False, 0.0)):
        g = replace(state.groups[0], active=jnp.array([part, True]))
        groups, _, _ = in_traffic(made, (g,), running)
        assert -float(groups[0].around.wind_m_s[1, 2]) == pytest.approx(air, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("on", [True, False])
def test_one_that_hovers_below_another_sinks_and_comes_back(on):
    team = row("uav", "x500", 3, (-20.0, -15.0), spacing_m=9.0)
    made = world(team, blocks=(), sample_period_s={"nai_1p5x1p5": 1.0}, traffic={"separation_m": 0.9},
                 effects={"downwash": on}, wind={"speed_m_s": 0.0, "gusts": False})  # fmt: skip
    start = begin(made, jax.random.key(5))
    places = np.array([[-20.0, -15.0, 10.0], [-20.0, -15.0, 8.8], [0.0, 0.0, 10.0]], np.float32)
    hover = jax.vmap(go_to)(jnp.asarray(places))
    state, tracks = fly(made, airborne(made, start, places), (hover,), 8.0)
    assert happened(state) == [set()] * 3
    low = places[:, 2] - tracks[0].position_m[:, :, 2]
    wind = -np.asarray(state.groups[0].around.wind_m_s)[:, 2]
    if not on:
        assert np.abs(wind).max() == 0.0
        return
    assert 3.0 < wind[1] < 6.0
    assert np.abs(wind[[0, 2]]).max() == 0.0
    assert 0.1 < low[:, 1].max() < 0.9
    assert np.abs(low[-1]).max() < 0.03
    speeds = np.asarray(state.groups[0].vehicle.rotor_speed_rad_s).mean(1)
    assert speeds[1] > 1.1 * speeds[2]
