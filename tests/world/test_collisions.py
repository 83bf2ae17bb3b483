"""Vehicles that meet: momentum, parting, and that nobody passes through anybody."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import DriveCommand, RotorSpeedCommand, fly_velocity, go_to
from swarmsim.world.collisions import RESTITUTION, Bodies, collide
from swarmsim.world.neighbours import candidates
from tests.world.worlds import airborne, begin, fly, happened, row, stay, with_group, world

DT = 0.05
RADIUS_M = 0.386
HALF_M = 0.15


INERTIA = 0.02


def bodies(position, velocity, mass=None, flies=None, active=None, rate=None):
    count = len(position)
    return Bodies(
        position_m=jnp.asarray(position, jnp.float32),
        velocity_m_s=jnp.asarray(velocity, jnp.float32),
        rate_rad_s=jnp.asarray(np.zeros((count, 3)) if rate is None else rate, jnp.float32),
        radius_m=jnp.full(count, 0.4),
        half_height_m=jnp.full(count, HALF_M),
        inertia_kg_m2=jnp.full(count, INERTIA),
        mass_kg=jnp.asarray(np.ones(count) if mass is None else mass, jnp.float32),
        flies=jnp.asarray(np.ones(count, bool) if flies is None else flies),
        active=jnp.asarray(np.ones(count, bool) if active is None else active),
    )


def met(b, dense_max=256):
    every = jnp.ones(len(b.mass_kg), bool)
    return collide(b, candidates(b.position_m, every, every, jnp.float32(3.0), 48, dense_max), DT)


@pytest.mark.slow
@pytest.mark.parametrize("dense_max", [256, 0])
def test_momentum_is_conserved_and_nobody_gains_energy(dense_max):
    """Crowds of random vehicles, of which a third touch somebody."""
    draw = np.random.default_rng(4)
    touched = 0
    for _ in range(20):
        count = 60
        place = draw.uniform([-6, -6, 0], [6, 6, 2], (count, 3))
        speed, mass = draw.normal(0, 4, (count, 3)), draw.uniform(0.5, 5, count)
        result = met(bodies(place, speed, mass), dense_max)
        change = mass[:, None] * np.asarray(result.velocity_m_s, float)
        scale = np.abs(change).sum()
        assert np.abs(change.sum(0)).max() < 1e-5 * max(scale, 1.0)
        after = speed + np.asarray(result.velocity_m_s)
        gained = 0.5 * (mass * ((after**2).sum(1) - (speed**2).sum(1))).sum()
        gained += 0.5 * (np.asarray(result.spin_nms, float) ** 2).sum() / INERTIA
        pushed = 0.5 * (mass * 1.0**2).sum()  # those that overlap to begin with are moved apart
        assert gained < pushed
        touched += int(np.asarray(result.hit).sum())
    assert 200 < touched < 1000


@pytest.mark.slow
@pytest.mark.parametrize("spin", [1.0, 5.0, 15.0])
def test_spinning_pairs_that_touch_gain_no_energy(spin):
    draw = np.random.default_rng(6)
    touched = 0
    for _ in range(400):
        place = np.array([[0, 0, 5.0], [0.83, 0, 5.0]]) + draw.normal(0, 0.02, (2, 3)) * [0, 1, 3]
        speed, rate = draw.normal(0, 1, (2, 3)), draw.normal(0, spin, (2, 3))
        result = met(bodies(place, speed, rate=rate))
        after, spun = speed + np.asarray(result.velocity_m_s), rate + np.asarray(result.spin_nms) / INERTIA
        energy = lambda v, w: 0.5 * (v**2).sum() + 0.5 * INERTIA * (w**2).sum()  # noqa: E731
        assert energy(after, spun) - energy(speed, rate) < 1e-4 * energy(speed, rate)
        touched += int(np.any(result.velocity_m_s))
    assert touched > 50


def test_two_in_one_place_are_parted():
    for flies in (True, False):
        result = met(bodies([[1.0, 2, 5], [1.0, 2, 5]], np.zeros((2, 3)), flies=[flies, flies]))
        assert np.linalg.norm(result.velocity_m_s, axis=1).min() > 0.3
        np.testing.assert_allclose(np.asarray(result.velocity_m_s).sum(0), 0.0, atol=1e-6)
    rovers = met(bodies([[0, 0, 0.2], [0.2, 0, 0.2]], np.zeros((2, 3)), flies=[False, False]))
    assert rovers.hit.all()
    assert rovers.velocity_m_s[0, 0] < 0 < rovers.velocity_m_s[1, 0]


@pytest.mark.parametrize("speed", [0.5, 5.0, 25.0])
def test_two_that_meet_head_on_part_with_the_restitution(speed):
    gap = 0.8 + 0.5 * speed * DT
    result = met(bodies([[0, 0, 5], [gap, 0, 5]], [[speed, 0, 0], [0, 0, 0]], [1.0, 3.0]))
    after = np.array([speed, 0.0]) + np.asarray(result.velocity_m_s)[:, 0]
    assert after @ [1.0, 3.0] == pytest.approx(speed, rel=1e-5)
    assert after[1] - after[0] == pytest.approx(RESTITUTION * speed, rel=1e-4)


def test_those_that_pass_do_not_meet():
    aside = bodies([[0, 0, 5], [1.0, 0.9, 5]], [[20.0, 0, 0], [0, 0, 0]])
    above = bodies([[0, 0, 5], [1.0, 0, 5.4]], [[20.0, 0, 0], [0, 0, 0]])
    later = bodies([[0, 0, 5], [2.9, 0, 5]], [[20.0, 0, 0], [0, 0, 0]])
    parting = bodies([[0, 0, 5], [0.7, 0, 5]], [[-5.0, 0, 0], [5.0, 0, 0]])
    for b in (aside, above, later):
        assert not np.asarray(met(b).hit).any()
    np.testing.assert_allclose(met(parting).velocity_m_s, 0.0)


def test_one_that_has_no_part_any_more_does_not_give_way():
    b = bodies([[0, 0, 0.2], [0.85, 0, 0.2]], [[4.0, 0, 0], [0, 0, 0]], [1.0, np.inf], active=[True, False])
    change = np.asarray(met(b).velocity_m_s)
    assert change[0, 0] == pytest.approx(-4.0 * (1 + RESTITUTION), rel=1e-4)
    np.testing.assert_allclose(change[1], 0.0)


def test_one_that_is_not_stepped_is_not_turned_either():
    """It would keep the rate until it has a part in the mission again."""
    b = bodies([[0, 0, 0.2], [0.85, 0, 0.3]], [[4.0, 0.5, 0], [0, 0, 0]], [1.0, np.inf], active=[True, False])
    spin = np.asarray(met(b).spin_nms)
    assert np.abs(spin[0]).max() > 0.01
    np.testing.assert_allclose(spin[1], 0.0)


def test_derivatives_are_finite():
    def total(position):
        return jnp.sum(met(bodies(position, np.array([[3.0, 0, 0], [0, 0, 0], [0, 0, 0]]))).velocity_m_s ** 2)

    gradient = jax.grad(total)(jnp.array([[0, 0, 5.0], [0.85, 0.1, 5.0], [0.0, 0.0, 5.0]]))
    assert np.isfinite(gradient).all()


COUNT = 8
OFF = RotorSpeedCommand(rotor_speed_rad_s=jnp.zeros((COUNT, 4)))


@pytest.fixture(scope="module")
def place():
    uavs = row("uav", "x500", COUNT, (-36.0, -25.0), spacing_m=9.0)
    rovers = row("rover", "orpheus", 2, (-30.0, 0.0))
    made = world(uavs + rovers, sample_period_s={"nai_1p5x1p5": 1.0, "nai_2x2": 0.09}, blocks=())
    return made, begin(made, jax.random.key(5))


def gaps(position):
    """Least horizontal distance [T, pairs] of the pairs (0, 1), (2, 3) where they share heights."""
    one, other = position[:, 0::2], position[:, 1::2]
    level = np.linalg.norm((one - other)[..., :2], axis=-1)
    return np.where(np.abs((one - other)[..., 2]) < 2 * HALF_M, level, np.inf)


@pytest.mark.slow
def test_uavs_that_fly_into_each_other_fall_apart(place):
    """Head on, from behind, crossing and grazing: nobody passes through, and both are out of action."""
    made, start = place
    at = np.zeros((COUNT, 3))
    velocity = np.zeros((COUNT, 3))
    for pair, (angle, offset, speed) in enumerate(
        [(np.pi, 0.0, 12.0), (0.0, 0.1, 6.0), (2.0, 0.0, 8.0), (np.pi, 0.5, 9.0)]
    ):
        y = -21.0 + 14.0 * pair
        at[2 * pair], at[2 * pair + 1] = [-3.0, y, 9.0], [0.0, y + offset, 9.0]
        velocity[2 * pair] = [speed, 0, 0]
        velocity[2 * pair + 1] = 0.5 * speed * np.array([np.cos(angle), np.sin(angle), 0])
        at[2 * pair + 1] -= 0.2 * velocity[2 * pair + 1]
    commands = (jax.vmap(fly_velocity)(jnp.asarray(velocity, jnp.float32)), stay(made, start)[1])
    state, tracks = fly(made, airborne(made, start, at, velocity), commands, 6.0)
    closest = gaps(tracks[0].position_m).min(0)
    assert (closest > 2 * RADIUS_M - 0.1).all()
    assert all("vehicle" in kinds for kinds in happened(state)), happened(state)
    assert np.abs(tracks[0].velocity_m_s[-1]).max() < 0.05  # they lie on the ground
    assert tracks[0].position_m[-1, :, 2].max() < 0.5


@pytest.mark.slow
def test_one_that_lies_on_another_comes_to_rest(place):
    """Dropped on one another with motors off: they neither spin up nor gain energy, and end beside each other."""
    made, start = place
    at = np.array(start.groups[0].vehicle.body.position_m)
    at[1] = at[0] + [0.1, 0.0, 1.0]
    spin = start.groups[0].vehicle
    body = replace(spin.body, position_m=jnp.asarray(at))
    _, tracks = fly(made, with_group(start, 0, vehicle=replace(spin, body=body)), (OFF, stay(made, start)[1]), 8.0)
    rate = np.linalg.norm(tracks[0].angular_velocity_rad_s[-1], axis=-1)
    assert rate.max() < 0.5
    assert np.linalg.norm(tracks[0].velocity_m_s[-1], axis=-1).max() < 0.2


@pytest.mark.slow
def test_rovers_that_meet_stop_outside_each_other(place):
    made, start = place
    rover = start.groups[1].vehicle
    xy = jnp.array([[-10.0, 0.0], [-5.0, 0.2]])
    turned = jnp.array([[1.0, 0, 0, 0], [0.0, 0, 0, 1.0]])
    body = replace(rover.body, position_m=rover.body.position_m.at[:, :2].set(xy), quaternion=turned)
    near = with_group(start, 1, vehicle=replace(rover, body=body))
    drive = DriveCommand(speed_m_s=jnp.full(2, 1.8), yaw_rate_rad_s=jnp.zeros(2))
    state, tracks = fly(made, near, (stay(made, start)[0], drive), 5.0)
    apart = np.linalg.norm(tracks[1].position_m[:, 0] - tracks[1].position_m[:, 1], axis=-1)
    reach = 2 * float(made.groups[1].limits.radius_m[0])
    assert apart.min() > reach - 0.15
    assert all("vehicle" in kinds for kinds in happened(state, 1))
    assert np.abs(tracks[1].velocity_m_s[-1]).max() < 0.05


def test_a_uav_lands_on_a_rover_and_rides_on_it(place):
    """It descends beside its way onto the moving deck, and rests there with its motors off."""
    made, start = place
    rover = start.groups[1].vehicle.body.position_m[0]
    deck = float(rover[2] + made.groups[1].limits.deck_m[0, 2])
    at = np.array(start.groups[0].vehicle.body.position_m)
    at[:, 2] = 12.0
    at[0] = [float(rover[0]), float(rover[1]), deck + 0.6]
    hover = airborne(made, start, at)
    go = jnp.zeros((COUNT, 3)).at[0].set(jnp.array([0.5, 0.0, -0.5]))
    idle = jax.vmap(go_to)(jnp.asarray(at), made.groups[0].yaw_rad)
    down = jax.vmap(fly_velocity)(go)
    first = jax.tree.map(
        lambda a, b: jnp.where((jnp.arange(COUNT) == 0).reshape(-1, *(1,) * (a.ndim - 1)), a, b), down, idle
    )
    drive = DriveCommand(speed_m_s=jnp.array([0.5, 0.0]), yaw_rate_rad_s=jnp.zeros(2))
    moving = start.groups[1].vehicle
    body = replace(moving.body, velocity_m_s=moving.body.velocity_m_s.at[0, 0].set(0.5))
    wheels = moving.wheel_speed_rad_s.at[0].set(2.5)
    hover = with_group(hover, 1, vehicle=replace(moving, body=body, wheel_speed_rad_s=wheels))
    state = replace_velocity(hover)
    state, tracks = fly(made, state, (first, drive), 8.0)
    assert happened(state)[0] == set()
    assert happened(state, 1)[0] == set()
    uav, carrier = tracks[0].position_m[-1, 0], tracks[1].position_m[-1, 0]
    assert float(state.groups[0].vehicle.rotor_speed_rad_s[0].max()) < 20.0
    assert carrier[0] > float(rover[0]) + 2.5
    assert np.abs(uav[:2] - carrier[:2]).max() < 0.35
    assert uav[2] == pytest.approx(deck + 0.2289, abs=0.03)
    np.testing.assert_allclose(tracks[0].velocity_m_s[-1, 0], tracks[1].velocity_m_s[-1, 0], atol=0.05)


def replace_velocity(state):
    body = state.groups[0].vehicle.body
    body = replace(body, velocity_m_s=body.velocity_m_s.at[0, 0].set(0.5))
    return with_group(state, 0, vehicle=replace(state.groups[0].vehicle, body=body))
