"""Followers of paths, with vehicles that go where they are told."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.control.commands import DriveToCommand, PositionCommand
from swarmsim.policies.follow import LAG_M, PACE_M_S2, START_SPEED_M_S, FollowByAir, FollowByGround
from swarmsim.policies.path import Path
from tests.policies.views import LOOKAHEAD_M, task, view

PERIOD_S = 0.1
KEY = jax.random.key(0)
by_air, by_ground = FollowByAir(control_period_s=PERIOD_S), FollowByGround(control_period_s=PERIOD_S)


def straight(height=5.0, end_height=None, length=10.0, speed=2.0):
    """A path to the east."""
    points = jnp.stack(
        [
            jnp.linspace(0.0, length, 21),
            jnp.zeros(21),
            jnp.linspace(height, height if end_height is None else end_height, 21),
        ],
        axis=1,
    )
    total = float(np.linalg.norm(np.asarray(points[-1] - points[0])))
    return Path(
        points_m=points,
        speed_m_s=jnp.full(21, speed).at[jnp.array([0, 20])].set(0.0),
        spacing_m=jnp.float32(total / 20),
        length_m=jnp.float32(total),
    )


def at(follower, path, progress, pace=1.0):
    memory = follower.start(task(path), KEY)
    return replace(memory, progress_m=jnp.float32(progress), pace=jnp.float32(pace))


def settled(path, progress, seen):
    """Pace and command of a reference that is kept in one place until its pace no longer changes."""
    memory = at(by_air, path, progress)
    for _ in range(20):
        memory = replace(memory, progress_m=jnp.float32(progress))
        memory, command = by_air.act(task(path), memory, seen, KEY)
    return memory, command


def test_the_reference_moves_at_the_paths_speed():
    path = straight()
    memory, command = by_air.act(task(path), at(by_air, path, 4.0), view((4.0, 0.0, 5.0)), KEY)
    assert isinstance(command, PositionCommand)
    np.testing.assert_allclose(command.position_m, [4.0, 0.0, 5.0], atol=1e-5)
    np.testing.assert_allclose(command.velocity_m_s, [2.0, 0.0, 0.0], atol=1e-5)
    assert float(command.yaw_rad) == pytest.approx(0.3)
    assert float(memory.progress_m) == pytest.approx(4.2)
    first, command = by_air.act(task(path), by_air.start(task(path), KEY), view((0.0, 0.0, 5.0)), KEY)
    assert 0.0 < float(first.progress_m) <= START_SPEED_M_S * PERIOD_S  # it does not stay where speed is zero


@pytest.mark.parametrize(("behind", "pace"), [(0.5, 1.0), (1.0, 1.0), (1.5, 0.5), (2.0, 0.0), (3.0, 0.0)])
def test_the_reference_waits_for_a_vehicle_that_lags_behind(behind, pace):
    path = straight()
    seen = view((4.0 - behind * LAG_M, 0.0, 5.0))
    memory, command = settled(path, 4.0, seen)
    assert float(memory.progress_m) == pytest.approx(4.0 + 0.2 * pace, abs=1e-5)
    np.testing.assert_allclose(command.velocity_m_s, [2.0 * pace, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(command.position_m, [4.0, 0.0, 5.0], atol=1e-5)


def test_the_reference_waits_and_steps_aside_for_traffic():
    path = straight()
    seen = view((4.0, 0.0, 5.0), hold=True, push_m=[0.0, -2.0, 1.0])
    memory, command = settled(path, 4.0, seen)
    assert float(memory.progress_m) == 4.0
    np.testing.assert_allclose(command.velocity_m_s, 0.0, atol=1e-6)
    np.testing.assert_allclose(command.position_m, [4.0, -2.0, 6.0], atol=1e-5)


def test_the_reference_brakes_and_sets_out_with_a_limit():
    path = straight()  # at 2 m/s
    _, command = by_air.act(task(path), at(by_air, path, 4.0), view((4.0, 0.0, 5.0), hold=True), KEY)
    assert float(command.velocity_m_s[0]) == pytest.approx(2.0 - PACE_M_S2 * PERIOD_S)
    _, command = by_air.act(task(path), at(by_air, path, 4.0, pace=0.0), view((4.0, 0.0, 5.0)), KEY)
    assert float(command.velocity_m_s[0]) == pytest.approx(PACE_M_S2 * PERIOD_S)


def flown(path, ticks):
    """Memory and position of a vehicle that is always where it was told to be."""
    job = task(path)

    def tick(carry, _):
        memory, position = carry
        memory, command = by_air.act(job, memory, view(position), KEY)
        done = by_air.done(job, memory, view(command.position_m))
        return (memory, command.position_m), (command.position_m, done)

    start = (by_air.start(job, KEY), path.points_m[0])
    return jax.jit(lambda: jax.lax.scan(tick, start, None, length=ticks))()


def test_a_path_is_flown_to_its_end_and_no_further():
    (memory, position), (track, done) = flown(straight(), 120)
    np.testing.assert_allclose(position, [10.0, 0.0, 5.0], atol=1e-4)
    assert float(memory.progress_m) == 10.0
    assert np.all(np.diff(track[:, 0]) >= 0.0)
    assert not done[:40].any()
    assert done[-1]


def test_a_flight_that_ends_in_the_air_is_done_when_it_stands_there():
    path = straight()
    here = (10.0, 0.0, 5.0)
    assert bool(by_air.done(task(path), at(by_air, path, 9.5), view(here)))
    assert not bool(by_air.done(task(path), at(by_air, path, 8.5), view(here)))
    assert not bool(by_air.done(task(path), at(by_air, path, 10.0), view(here, velocity_m_s=(0.3, 0.0, 0.0))))


def test_a_flight_that_ends_on_the_ground_is_done_when_it_has_landed():
    path = straight(end_height=-0.4)
    end = float(path.length_m)
    memory = at(by_air, path, end)
    assert bool(memory.lands)
    assert not bool(by_air.start(task(straight()), KEY).lands)
    assert not bool(by_air.done(task(path), memory, view((10.0, 0.0, 0.5))))
    assert bool(by_air.done(task(path), memory, view((10.0, 0.0, 0.02))))
    assert not bool(by_air.done(task(path), memory, view((10.0, 0.0, 0.02), velocity_m_s=(0.0, 0.0, -0.5))))
    assert not bool(by_air.done(task(path), at(by_air, path, end - 1.5), view((10.0, 0.0, 0.02))))


def drive(path, progress, position, **seen):
    return by_ground.act(task(path), at(by_ground, path, progress), view(position, **seen), KEY)


def test_a_rovers_point_keeps_a_lookahead_ahead():
    path = straight(height=0.0, speed=0.8)
    memory, command = drive(path, 4.5, (4.0, 0.0, 0.2))
    assert isinstance(command, DriveToCommand)
    np.testing.assert_allclose(command.position_m, [4.5, 0.0], atol=1e-5)
    assert float(command.speed_m_s) == pytest.approx(0.8)
    assert float(memory.progress_m) == pytest.approx(4.5 + 3.0 * 0.8 * PERIOD_S)  # it catches up, at thrice the speed
    near, _ = drive(path, 4.9, (4.0, 0.0, 0.2))
    assert float(near.progress_m) == pytest.approx(4.0 + LOOKAHEAD_M)
    far, _ = drive(path, 5.5, (4.0, 0.0, 0.2))
    assert float(far.progress_m) == 5.5  # it waits


def test_a_rover_that_is_told_to_hold_stands():
    memory, command = drive(straight(height=0.0), 4.5, (4.0, 0.0, 0.2), hold=True)
    assert float(memory.progress_m) == 4.5
    assert float(command.speed_m_s) == 0.0


def test_a_rover_sets_out_from_rest_and_slows_down_with_the_path():
    path = straight(height=0.0, speed=0.8)
    _, first = drive(path, 0.0, (0.0, 0.0, 0.2))
    assert 0.0 < float(first.speed_m_s) < 0.8
    _, last = drive(path, 10.0, (9.8, 0.0, 0.2))
    assert float(last.speed_m_s) < 0.5


def test_a_drive_is_done_where_it_stands_at_its_end():
    path = straight(height=0.0)
    job, memory = task(path), at(by_ground, path, 10.0)
    assert bool(by_ground.done(job, memory, view((9.9, 0.1, 0.2))))
    assert not bool(by_ground.done(job, memory, view((9.7, 0.1, 0.2))))
    assert not bool(by_ground.done(job, memory, view((9.9, 0.1, 0.2), velocity_m_s=(0.2, 0.0, 0.0))))
    assert not bool(by_ground.done(job, at(by_ground, path, 9.0), view((9.9, 0.1, 0.2))))


def test_a_path_of_no_length_is_done_at_once():
    still = straight(height=0.0, length=0.0)
    job = task(still)
    memory = by_ground.start(job, KEY)
    after, command = by_ground.act(job, memory, view(), KEY)
    assert bool(by_ground.done(job, after, view()))
    np.testing.assert_array_equal(command.position_m, 0.0)
