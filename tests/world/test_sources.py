"""True sources in the world: decay, lines and areas on uneven ground, and sources on vehicles."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.load import load_named
from swarmsim.estimation import Measurements
from swarmsim.missions.knowledge import accumulate_spectrum
from swarmsim.missions.trail import followed, poses_at, trail_start
from swarmsim.physics.rotations import rotate
from swarmsim.radiation.rate import observed_rois
from swarmsim.sensors.radiation import source_rate
from swarmsim.world.emission import Poses, between, poses_of, sources_at
from swarmsim.world.step import hold, step
from tests.world.worlds import airborne, at_tick, begin, row, world

HALF_LIFE_S = load_named("nuclides", "F-18").half_life_s
SPRING = {"nuclide": "F-18", "position_m": (2.0, 6.0), "height_m": 0.5, "activity_mbq": 300.0}
OFFSET = (0.4, 0.1, -0.2)


def quiet(made):
    """The world without a background and with detectors as sensitive as they are presumed."""
    background = replace(made.background, scale=jnp.float32(0.0))
    return replace(made, background=background, departures=replace(made.departures, sensitivity_std=jnp.float32(0.0)))


def test_activity_halves_with_the_half_life():
    made = world(row("uav", "tarot_t650", 1, (-5.0, 0.0)), sources=[SPRING, SPRING | {"nuclide": "Cs-137"}])
    for halvings in (0.0, 0.1, 1.0, 3.0):
        now = sources_at(made.sources, made.emission, jnp.float32(halvings * HALF_LIFE_S), None)
        np.testing.assert_allclose(now.activity_bq, [3e8 * np.exp(-np.log(2.0) * halvings), 3e8], rtol=1e-4)
        np.testing.assert_array_equal(now.position_m, made.sources.position_m)


def test_counts_fall_with_the_activity():
    made = quiet(
        world(row("uav", "tarot_t650", 1, (-5.0, 0.0)), sources=[SPRING], sample_period_s={"nai_1p5x1p5": 0.1})
    )
    go = jax.jit(lambda state: step(made, state, hold(made, state), 5)[0])
    state = begin(made, jax.random.key(0))
    mean = []
    for first in (0, round(HALF_LIFE_S / 0.01 / 10) * 10):
        mean.append(float(go(go(at_tick(state, first))).groups[0].counter.expected_counts[0]))
    lost = 2e-6 * mean[0] / 0.1  # to the dead time
    assert mean[1] / mean[0] == pytest.approx(0.5 * (1.0 + 0.5 * lost), rel=1e-3)


def test_lines_and_areas_follow_the_ground_and_keep_their_activity():
    line = {"nuclide": "Co-60", "line_m": ((-20.0, 12.0), (0.0, 12.0)), "height_m": 0.5, "activity_mbq": 100.0}
    area = {"nuclide": "Cs-137", "area_m": ((0.0, -20.0), (10.0, -20.0), (10.0, -14.0)), "height_m": 0.0} | {
        "activity_mbq": 40.0
    }
    made = world(row("uav", "tarot_t650", 1, (-5.0, 0.0)), sources=[SPRING, line, area])
    number, activity = np.asarray(made.emission.number), np.asarray(made.sources.activity_bq)
    np.testing.assert_allclose([activity[number == k].sum() for k in range(3)], [3e8, 1e8, 4e7], rtol=1e-5)
    assert len(set(np.asarray(made.sources.nuclide)[number == 1])) == 1
    np.testing.assert_allclose(made.sources.position_m[number == 1, 2], 0.5)
    np.testing.assert_array_equal(made.emission.corner_of, [1, 1, 2, 2, 2])
    h, below = 3.0, made.sources.position_m[number == 1]
    seen = np.sum(activity[number == 1] / (4 * np.pi * np.sum((below - np.array([-10.0, 12.0, 0.5 + h])) ** 2, axis=1)))
    angle = 2.0 * np.arctan(10.0 / h)
    assert seen == pytest.approx(1e8 * angle / (4 * np.pi * h * 20.0), rel=2e-3)  # photons per m2 and decay


@pytest.mark.slow
def test_a_line_gives_the_rate_of_the_integral_over_its_length():
    line = {"nuclide": "Co-60", "line_m": ((-20.0, 12.0), (0.0, 12.0)), "height_m": 0.5, "activity_mbq": 100.0}
    made = world(row("uav", "tarot_t650", 1, (-5.0, 0.0)), sources=[line])
    detector, axis = made.groups[0].counter.detector, jnp.array([1.0, 0.0, 0.0])
    place = jnp.array([[-12.0, 12.0, 2.5], [-2.0, 14.0, 4.0], [10.0, 5.0, 8.0]])
    rate = jax.jit(
        jax.vmap(lambda sources, at: jnp.sum(source_rate(made.site, detector, sources, at, axis)), (None, 0))
    )
    x = np.linspace(-20.0, 0.0, 1001)
    x = 0.5 * (x[1:] + x[:-1])
    fine = replace(
        made.sources,
        position_m=jnp.asarray(np.stack([x, 0 * x + 12.0, 0 * x + 0.5], axis=1), jnp.float32),
        activity_bq=jnp.full(1000, 1e5),
        nuclide=jnp.full(1000, made.sources.nuclide[0]),
    )
    np.testing.assert_allclose(rate(made.sources, place), rate(fine, place), rtol=5e-3)


def carried(on, **team):
    """A rover that drives with a source on ``on``, beside a UAV that measures it from where it hovers."""
    source = {"nuclide": "Co-60", "on": on, "offset_m": OFFSET, "activity_mbq": 200.0}
    members = row("uav", "tarot_t650", 1, (0.0, -10.0)) + row("rover", "orpheus", 2, (-5.0, 0.0))
    return world(members, sources=[SPRING, source], sample_period_s={"nai_1p5x1p5": 0.1}, **team)


@pytest.mark.slow
def test_a_source_goes_with_its_vehicle_and_is_counted_where_it_is():
    made = quiet(carried("rover1"))
    assert made.sources.position_m.shape == (2, 3)
    state = airborne(made, begin(made, jax.random.key(0)), [[1.0, -3.0, 4.0]])
    body = state.groups[1].vehicle.body
    turned = jnp.array([[1.0, 0.0, 0.0, 0.0], [np.cos(0.6), 0.0, 0.0, np.sin(0.6)]])
    body = replace(body, quaternion=turned, velocity_m_s=jnp.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0]]))
    rover = replace(state.groups[1], vehicle=replace(state.groups[1].vehicle, body=body))
    state = replace(state, groups=(state.groups[0], rover))
    go = jax.jit(lambda state: step(made, state, hold(made, state), 5)[0])
    after = go(go(state))
    poses = poses_of(made.emission, [g.vehicle.body for g in after.groups])
    moved = after.groups[1].vehicle.body
    np.testing.assert_array_equal(poses.position_m[0], moved.position_m[1])
    now = sources_at(made.sources, made.emission, jnp.float32(0.1), poses)
    np.testing.assert_allclose(now.position_m[0], [2.0, 6.0, 0.5])
    expected = moved.position_m[1] + rotate(moved.quaternion[1], jnp.array(OFFSET))
    np.testing.assert_allclose(now.position_m[1], expected, atol=1e-5)
    # the exposure ended now: its mean is the rate here and now
    counter, uav = made.groups[0].counter, after.groups[0].vehicle.body
    assert counter.ticks * counter.evaluations == 10
    crystal = uav.position_m[0] + rotate(uav.quaternion[0], counter.mount_position_m[0])
    axis = rotate(uav.quaternion[0], counter.mount_axis[0])
    net = source_rate(made.site, counter.detector, now, crystal, axis)
    rate = jnp.sum(observed_rois(counter.detector, net, jnp.float32(0.0)))
    mean = after.groups[0].counter.expected_counts[0]
    assert float(mean) == pytest.approx(0.1 * float(rate), rel=2e-3)


def test_who_carries_a_source_is_a_value():
    first, other = carried("rover0"), carried("uav0")
    assert jax.tree.structure(first) == jax.tree.structure(other)
    assert [np.asarray(one.emission.carrier).tolist() for one in (first, other)] == [[1], [0]]
    with pytest.raises(ValueError, match="sources on vehicles"):
        sources_at(first.sources, first.emission, jnp.float32(0.0), None)


def test_worlds_without_lines_or_carriers_have_nothing_more_to_compute():
    made = world(row("uav", "tarot_t650", 1, (-5.0, 0.0)), sources=[SPRING])
    assert (made.emission.carrier, made.emission.corners_m) == (None, None)
    assert world(row("uav", "tarot_t650", 1, (-5.0, 0.0)), sources=[]).sources.activity_bq.tolist() == [0.0]


def test_poses_between_two_are_on_the_way():
    half = jnp.sqrt(0.5)
    before = Poses(position_m=jnp.zeros((1, 3)), quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]))
    after = Poses(position_m=jnp.array([[2.0, 4.0, 0.0]]), quaternion=-jnp.array([[half, 0.0, 0.0, half]]))
    middle = between(before, after, jnp.float32(0.5))
    np.testing.assert_allclose(middle.position_m, [[1.0, 2.0, 0.0]])
    np.testing.assert_allclose(middle.quaternion, [[np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8)]], atol=1e-6)
    np.testing.assert_allclose(between(before, after, jnp.float32(1.0)).quaternion, -after.quaternion, atol=1e-6)


def test_the_trail_of_a_carrier_is_read_by_time():
    made = carried("uav0")
    state = begin(made, jax.random.key(0))
    trail = trail_start(made, state, 4)
    for second in range(1, 6):  # the third one has no phase under way, and there is no room for the fifth
        moved = airborne(made, at_tick(state, 100 * second), [[float(second), 0.0, 9.0]])
        trail = followed(made, trail, moved, jnp.array(second != 3))
    np.testing.assert_allclose(trail.time_s, [0.0, 1.0, 2.0, 4.0])
    for time_s, east in ((0.0, 0.0), (1.5, 1.5), (3.0, 3.0), (4.0, 4.0), (9.0, 4.0)):
        assert float(poses_at(trail, jnp.float32(time_s)).position_m[0, 0]) == pytest.approx(east, abs=1e-5)
    short = followed(made, trail_start(made, state, 4), state, jnp.array(False))
    np.testing.assert_allclose(poses_at(short, jnp.float32(3.0)).position_m[0, :2], [0.0, -10.0], atol=1e-5)
    assert poses_at(None, jnp.float32(0.0)) is None


@pytest.mark.slow
def test_the_spectrum_of_a_carried_source_is_drawn_where_it_was():
    made = carried("rover0")
    state = begin(made, jax.random.key(0))
    start = state.groups[1].vehicle.body.position_m[0]
    trail = trail_start(made, state, 3)
    rover = state.groups[1]
    gone = replace(rover.vehicle.body, position_m=rover.vehicle.body.position_m + jnp.array([8.0, 0.0, 0.0]))
    later = at_tick(
        replace(state, groups=(state.groups[0], replace(rover, vehicle=replace(rover.vehicle, body=gone)))), 800
    )
    trail = followed(made, trail, later, jnp.array(True))
    x, y, z = (float(v) for v in start + jnp.array(OFFSET) + jnp.array([4.0, 0.0, 0.0]))
    standing = {"nuclide": "Co-60", "position_m": (x, y), "height_m": z, "activity_mbq": 200.0}
    members = row("uav", "tarot_t650", 1, (0.0, -10.0)) + row("rover", "orpheus", 2, (-5.0, 0.0))
    same = world(members, sources=[SPRING, standing], sample_period_s={"nai_1p5x1p5": 0.1})
    place = jnp.array([[0.0, -3.0, 2.0]])
    samples = Measurements(
        time_s=jnp.array([5.0]),
        position_m=place,
        travel_m=jnp.zeros((1, 3)),
        axis=jnp.array([[0.0, 1.0, 0.0]]),
        counts=jnp.zeros(1),
        exposure_s=jnp.array([2.0]),
        valid=jnp.array([True]),
        detector=jnp.zeros(1, jnp.int32),
    )
    key, used = jax.random.key(3), jnp.array([True])
    rolling = accumulate_spectrum(key, made, 0, samples, used, trail)
    still = accumulate_spectrum(key, same, 0, samples, used)
    assert float(jnp.sum(still.counts)) > 1000.0
    np.testing.assert_allclose(jnp.sum(rolling.counts), jnp.sum(still.counts), rtol=2e-3)
    with pytest.raises(ValueError, match="sources on vehicles"):
        accumulate_spectrum(key, made, 0, samples, used)
