"""Roofs carry, walls stop: what multirotors do to a house, and it to them."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import RotorSpeedCommand, fly_velocity
from swarmsim.world.collisions import TOUCH_M
from tests.world.worlds import BUILDING, airborne, begin, fly, happened, row, with_group, world

WEST, SOUTH, EAST, NORTH = BUILDING
ROOF_M = 6.0
COUNT = 32
FOOT_M = 0.2289  # of the x500, below its centre of mass
RADIUS_M = 0.386


@pytest.fixture(scope="module", params=["analytic", "mjx"])
def place(request):
    made = world(row("uav", "x500", COUNT, (-36.0, -25.0), spacing_m=2.2), engine=request.param,
                 sample_period_s={"nai_1p5x1p5": 1.0})  # fmt: skip
    return made, begin(made, jax.random.key(5))


def off(count=COUNT):
    return RotorSpeedCommand(rotor_speed_rad_s=jnp.zeros((count, 4)))


def spread():
    """Places [COUNT, 2] over the roof, 2.2 m apart and a little random."""
    x, y = np.meshgrid(np.linspace(WEST + 1.5, EAST - 1.5, 4), np.linspace(SOUTH + 1.5, NORTH - 1.5, 8))
    return np.stack([x.ravel(), y.ravel()], -1) + np.random.default_rng(0).uniform(-0.4, 0.4, (COUNT, 2))


def inside(position):
    """How deep [m] each place is within the house; negative outside."""
    x, y, z = np.moveaxis(position, -1, 0)
    return np.minimum.reduce([x - WEST, EAST - x, y - SOUTH, NORTH - y, ROOF_M - z])


@pytest.mark.slow
def test_what_falls_on_a_roof_rests_on_it(place):
    made, start = place
    draw = np.random.default_rng(1)
    at = np.concatenate([spread(), draw.uniform(6.3, 9.0, (COUNT, 1))], -1)
    state, tracks = fly(made, airborne(made, start, at, (0.5, 0.0, 0.0)), (off(),), 6.0)
    end = tracks[0].position_m[-1]
    assert inside(tracks[0].position_m).max() < 0.05
    assert np.abs(tracks[0].velocity_m_s[-1]).max() < 0.02
    stands = np.abs(end[:, 2] - ROOF_M - FOOT_M) < 0.01
    assert stands.mean() > 0.8
    assert (end[:, 2] > ROOF_M).all()  # the others lie on their side
    speed = np.sqrt(2 * 9.81 * (at[:, 2] - ROOF_M - FOOT_M))
    found = np.array(["crash" in kinds for kinds in happened(state)])
    assert found[speed > 2.5].all()
    assert not found[(speed < 1.7) & stands].any()
    assert not any({"obstacle", "vehicle"} & kinds for kinds in happened(state))


@pytest.mark.slow
def test_a_roof_is_landed_on_and_left(place):
    made, start = place
    at = np.concatenate([spread(), np.full((COUNT, 1), 8.0)], -1)
    down = jnp.tile(jnp.array([0.0, 0.0, -0.8]), (COUNT, 1))
    state, tracks = fly(made, airborne(made, start, at), (every(down),), 5.0)
    np.testing.assert_allclose(tracks[0].position_m[-1, :, 2], ROOF_M + FOOT_M, atol=0.01)
    assert float(jnp.max(state.groups[0].vehicle.rotor_speed_rad_s)) < 20.0  # landed: motors off
    state, tracks = fly(made, state, (every(-down),), 3.0)
    assert tracks[0].position_m[-1, :, 2].min() > ROOF_M + 1.0
    assert happened(state) == [set()] * COUNT


def every(velocity):
    return jax.vmap(partial(fly_velocity, yaw_rad=0.0))(velocity)


@pytest.mark.slow
def test_walls_stop_whatever_flies_into_them(place):
    """Random headings, heights and speeds up to 12 m/s at the four sides of the house; the motors stop at the wall."""
    made, start = place
    draw = np.random.default_rng(2)
    target = np.stack([draw.uniform(WEST, EAST, COUNT), draw.uniform(SOUTH, NORTH, COUNT)], -1)
    angle = draw.uniform(0, 2 * np.pi, COUNT)
    centre = np.array([(WEST + EAST) / 2, (SOUTH + NORTH) / 2])
    first = centre + 17.0 * np.stack([np.cos(angle), np.sin(angle)], -1)
    first[:, 0] = np.clip(first[:, 0], -38, 38)
    first[:, 1] = np.clip(first[:, 1], -28, 28)
    out = (first[:, 0] < WEST - 2) | (first[:, 0] > EAST + 2) | (np.abs(first[:, 1]) > 12)
    first[~out] = [10.0, 0.0]
    way = target - first
    speed = draw.uniform(1.0, 12.0, COUNT)
    velocity = np.zeros((COUNT, 3))
    velocity[:, :2] = way / np.linalg.norm(way, axis=1, keepdims=True) * speed[:, None]
    at = np.concatenate([first, draw.uniform(1.0, 4.5, (COUNT, 1))], -1)
    hit = airborne(made, start, at, velocity)
    state, tracks = fly(made, hit, (every(jnp.asarray(velocity, jnp.float32)),), 12.0)
    deep = inside(tracks[0].position_m)
    assert deep.max() < 0.0, (deep.max(), speed[deep.max(0).argmax()])
    kinds = happened(state)
    assert sum("obstacle" in k for k in kinds) > 0.8 * COUNT
    end = tracks[0].position_m[-1]
    down = np.array(["obstacle" in k for k in kinds]) & (np.abs(tracks[0].velocity_m_s[-1]).max(-1) < 0.05)
    assert down.sum() > 0.7 * COUNT
    assert (end[down, 2] < 0.5).all()  # on the ground in front of the wall


def test_nothing_is_thrown_at_the_edge_of_a_roof(place):
    """What falls or drifts onto the edge gains no speed but that of its fall, wherever it touches."""
    made, start = place
    draw = np.random.default_rng(7)
    edge = draw.uniform(SOUTH + 1.0, NORTH - 1.0, COUNT)
    at = np.stack([EAST + draw.uniform(-0.6, 0.6, COUNT), edge, ROOF_M + draw.uniform(-0.6, 1.0, COUNT)], -1)
    velocity = np.stack([draw.uniform(-2.0, 2.0, COUNT), draw.uniform(-1.0, 1.0, COUNT), np.full(COUNT, -1.0)], -1)
    _, tracks = fly(made, airborne(made, start, at, velocity), (off(),), 2.0)
    speed = np.linalg.norm(tracks[0].velocity_m_s, axis=-1)
    fallen = at[:, 2] - tracks[0].position_m[..., 2]
    most = np.sqrt(np.sum(velocity**2, axis=-1) + 2.0 * 9.81 * np.maximum(fallen, 0.0))
    assert (speed - most).max() < 0.8


def test_two_that_lie_in_each_other_come_apart_and_rest(place):
    """Pairs on their backs, 0.55 to 0.75 m apart, motors off: overlapping cylinders of 0.386 m."""
    made, start = place
    draw = np.random.default_rng(3)
    pairs, x = COUNT // 2, -34.0 + 4.0 * np.arange(COUNT // 2) % 48.0
    first = np.stack([x, -26.0 + 5.0 * (np.arange(pairs) // 12), np.full(pairs, 0.07)], -1)
    angle, apart = draw.uniform(0, 2 * np.pi, pairs), draw.uniform(0.55, 0.75, pairs)
    second = first + np.stack([apart * np.cos(angle), apart * np.sin(angle), np.zeros(pairs)], -1)
    lying = airborne(made, start, np.concatenate([first, second]))
    vehicle = lying.groups[0].vehicle
    on_its_back = jnp.tile(jnp.array([0.0, 1.0, 0.0, 0.0]), (COUNT, 1))
    body = replace(vehicle.body, quaternion=on_its_back)
    lying = with_group(lying, 0, vehicle=replace(vehicle, body=body, rotor_speed_rad_s=jnp.zeros((COUNT, 4))))
    _, tracks = fly(made, lying, (off(),), 4.0)
    end = tracks[0].position_m[-1]
    gap = np.linalg.norm((end[:pairs] - end[pairs:])[:, :2], axis=-1)
    assert gap.min() > 2 * RADIUS_M - TOUCH_M - 1e-3
    assert gap.max() < 2 * RADIUS_M + 0.1  # parted, not thrown
    assert np.abs(tracks[0].velocity_m_s[-1]).max() < 0.02


@pytest.mark.slow
def test_between_two_walls_one_comes_to_rest():
    """In slots of 1.25 to 2.25 m, whose middle has no nearest wall."""
    slots = [(-20.0 + 12.0 * k, 1.25 + 0.25 * k) for k in range(5)]
    blocks = [(x - 3.0, -5.0, x, 5.0) for x, _ in slots] + [(x + gap, -5.0, x + gap + 3.0, 5.0) for x, gap in slots]
    made = world(row("uav", "x500", 5, (-30.0, -20.0)), blocks=tuple(blocks), sample_period_s={"nai_1p5x1p5": 1.0})
    over = np.array([[x + 0.5 * gap + 0.1, 0.0, 5.0] for x, gap in slots])
    state = airborne(made, begin(made, jax.random.key(1)), over)
    vehicle = state.groups[0].vehicle
    state = with_group(state, 0, vehicle=replace(vehicle, rotor_speed_rad_s=jnp.zeros((5, 4))))
    _, tracks = fly(made, state, (off(5),), 12.0)
    assert np.abs(tracks[0].velocity_m_s[-100:]).max() < 0.1
