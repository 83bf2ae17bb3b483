"""Counters on vehicles: exposures along a way, their mean and their draws, and whose counts are valid."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.errors import InputError
from swarmsim.physics.rotations import from_yaw
from swarmsim.radiation.rate import observed_rois
from swarmsim.sensors.radiation import Counter, count, counter_start, source_rate, unread
from swarmsim.vehicles.state import RigidState
from swarmsim.world.build import detector_models
from tests.world.worlds import ROVERS, TICK_S, UAVS, begin, fly, row, scenario, stay, team, world

EXPOSURE, EVERY = 96, 12  # ticks of an exposure, and between two evaluations of the rate in it
TICKS = 2 * EXPOSURE
SPEED_M_S = 2.0
SOURCE = {"nuclide": "Cs-137", "position_m": (2.0, 6.0), "height_m": 0.5, "activity_mbq": 300.0}
MOUNTS = np.array([[0.2, 0.0, -0.1], [0.0, 0.3, 0.1]], np.float32)
AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], np.float32)


@pytest.fixture(scope="module")
def field():
    """Two UAVs whose detectors of one model are mounted in different ways."""
    made = world(row("uav", "tarot_t650", 2, (-5.0, 0.0)), sources=[SOURCE], sample_period_s={"nai_1p5x1p5": 0.96})
    (group,) = made.groups
    counter = replace(group.counter, mount_position_m=MOUNTS, mount_axis=AXES)
    assert (counter.ticks, counter.evaluations) == (EVERY, EXPOSURE // EVERY)
    even = replace(made.background, ground_share=jnp.float32(0.0))
    departures = replace(made.departures, sensitivity_std=jnp.float32(0.0))
    return replace(made, background=even, departures=departures, groups=(replace(group, counter=counter),))


@pytest.fixture(scope="module")
def way():
    """Bodies [T, 2] after each tick: past the source, one to the east, one to the north, turned by 1 rad."""
    along = SPEED_M_S * TICK_S * np.arange(1, TICKS + 1)
    place = np.zeros((TICKS, 2, 3), np.float32)
    place[:, 0, 0], place[:, 1, 1] = along, along
    place[..., 2] = 5.0
    velocity = np.zeros((TICKS, 2, 3), np.float32)
    velocity[:, 0, 0], velocity[:, 1, 1] = SPEED_M_S, SPEED_M_S
    quaternion = np.broadcast_to(np.stack([from_yaw(0.0), from_yaw(1.0)]), (TICKS, 2, 4))
    return RigidState(
        position_m=jnp.asarray(place),
        quaternion=jnp.asarray(quaternion),
        velocity_m_s=jnp.asarray(velocity),
        angular_velocity_rad_s=jnp.zeros((TICKS, 2, 3)),
    )


@jax.jit
def sampled(field, way, active, key):
    """Readings and means of the counts after every tick of a way; vehicle 0 is number 4 of the mission, 1 number 7."""
    (group,) = field.groups
    member = jnp.array([4, 7])

    def tick(state, x):
        number, body, active = x
        state = count(
            group.counter, unread(state), body, active, member, field.site, field.sources, field.background,
            field.departures, key, number, jnp.float32(TICK_S), number % EVERY == 0,
        )  # fmt: skip
        return state, (state.reading, state.expected_counts)

    return jax.lax.scan(
        tick, counter_start(2, group.counter.detector.background_rois.shape[0]), (jnp.arange(1, TICKS + 1), way, active)
    )[1]


@jax.jit
def rates(field, way):
    """Observed count rate [T, 2] wherever the vehicles are."""
    counter: Counter = field.groups[0].counter
    rotate = jax.vmap(jax.vmap(_rotated, in_axes=(0, 0)), in_axes=(0, None))
    place = way.position_m + rotate(way.quaternion, counter.mount_position_m)
    axis = rotate(way.quaternion, counter.mount_axis)
    one = partial(source_rate, field.site, counter.detector, field.sources)
    rates = observed_rois(counter.detector, jax.vmap(jax.vmap(one))(place, axis))
    return jnp.sum(rates, axis=-1), place, axis


def _rotated(q, v):
    w, u = q[0], q[1:]
    return v + 2.0 * jnp.cross(u, jnp.cross(u, v) + w * v)


ALWAYS = jnp.ones((TICKS, 2), bool)


@pytest.fixture(scope="module")
def read(field, way):
    return jax.tree.map(np.asarray, sampled(field, way, ALWAYS, jax.random.key(0)))


@pytest.mark.slow
def test_an_exposure_has_its_time_its_way_and_its_mean_place(field, way, read):
    reading, _ = read
    (ends,) = np.nonzero(reading.fresh[:, 0])
    np.testing.assert_array_equal(ends, [EXPOSURE - 1, TICKS - 1])
    assert reading.valid[ends].all()
    assert not reading.valid[: ends[0]].any()
    np.testing.assert_allclose(reading.time_s[ends], [[0.96] * 2, [1.92] * 2], rtol=1e-5)
    np.testing.assert_allclose(reading.exposure_s[ends], 0.96, rtol=1e-5)
    _, place, axis = rates(field, way)
    evaluated = np.arange(EVERY - 1, TICKS, EVERY).reshape(2, -1)
    np.testing.assert_allclose(reading.position_m[ends], np.asarray(place)[evaluated].mean(axis=1), atol=1e-5)
    np.testing.assert_allclose(reading.axis[ends], np.asarray(axis)[[0, 0]], atol=1e-5)
    np.testing.assert_allclose(reading.travel_m[ends[0]], 0.96 * SPEED_M_S * np.eye(3)[:2], atol=1e-5)
    held = np.arange(ends[0], ends[1])  # between two ends the last reading is kept
    np.testing.assert_array_equal(reading.counts[held], np.broadcast_to(reading.counts[ends[0]], (len(held), 2)))


def test_the_mean_of_the_counts_is_the_integral_of_the_rate(field, way, read):
    rate = np.asarray(rates(field, way)[0], np.float64).reshape(2, EXPOSURE, 2)
    mean = read[1].reshape(2, EXPOSURE, 2)[:, -1]
    np.testing.assert_allclose(mean, 0.96 * rate[:, EVERY - 1 :: EVERY].mean(axis=1), rtol=1e-4)
    np.testing.assert_allclose(mean, TICK_S * rate.sum(axis=1), rtol=0.03)  # of each tick: the rate is sampled finely
    assert rate.max() > 1.3 * rate.min()  # it does change along the way


def test_counts_are_poisson_draws_of_that_mean(field, way, read):
    keys = jax.random.split(jax.random.key(1), 200)
    readings, expected = jax.vmap(partial(sampled, field, way, ALWAYS))(keys)
    ends = [EXPOSURE - 1, TICKS - 1]
    counts, mean = np.asarray(readings.counts)[:, ends].reshape(200, -1), read[1][ends].reshape(-1)
    np.testing.assert_allclose(np.asarray(expected)[0, ends].reshape(-1), mean, rtol=1e-5)
    assert np.all(np.abs(counts.mean(axis=0) - mean) < 4.0 * np.sqrt(mean / 200))
    assert np.all(np.abs(counts.var(axis=0, ddof=1) / mean - 1.0) < 4.0 * np.sqrt(2.0 / 199))
    correlation = np.corrcoef(counts.T)[np.triu_indices(4, 1)]
    assert np.all(np.abs(correlation) < 4.0 / np.sqrt(200))  # vehicles and exposures are drawn independently


def test_a_reading_is_valid_only_if_the_vehicle_had_a_part_throughout(field, way):
    active = np.ones((TICKS, 2), bool)
    active[:30, 0] = False  # begins during the first exposure
    active[EXPOSURE + 40 :, 1] = False  # ends during the second one
    reading, _ = sampled(field, way, jnp.asarray(active), jax.random.key(0))
    ends = [EXPOSURE - 1, TICKS - 1]
    np.testing.assert_array_equal(np.asarray(reading.valid)[ends], [[False, True], [True, False]])
    np.testing.assert_array_equal(np.asarray(reading.fresh)[ends], True)


def test_the_draw_depends_on_the_vehicles_number_and_not_on_its_company(field, way, read):
    (group,) = field.groups
    counter = replace(group.counter, mount_position_m=MOUNTS[1:], mount_axis=AXES[1:])

    @jax.jit
    def alone(field, way):
        def tick(state, x):
            state = count(
                counter, unread(state), x[1], jnp.ones(1, bool), jnp.array([7]), field.site, field.sources,
                field.background, field.departures, jax.random.key(0), x[0], jnp.float32(TICK_S), x[0] % EVERY == 0,
            )  # fmt: skip
            return state, state.reading

        return jax.lax.scan(
            tick, counter_start(1, counter.detector.background_rois.shape[0]), (jnp.arange(1, TICKS + 1), way)
        )[1]

    reading = alone(field, jax.tree.map(lambda x: x[:, 1:], way))
    np.testing.assert_array_equal(np.asarray(reading.counts)[:, 0], read[0].counts[:, 1])


def test_the_mean_is_differentiable_and_the_draw_is_not(field, way):
    def last(activity, index):
        changed = replace(field, sources=replace(field.sources, activity_bq=field.sources.activity_bq * activity))
        reading, expected = sampled(changed, way, ALWAYS, jax.random.key(0))
        return (expected[-1, 0], reading.counts[-1, 0])[index]

    mean, slope = jax.value_and_grad(last)(1.0, 0)
    background = 94.0 * 0.96
    assert float(slope) == pytest.approx(float(mean) - background, rel=0.02)  # dead time takes a little of it
    assert float(jax.grad(last)(1.0, 1)) == 0.0


@pytest.mark.parametrize("judge_s", [0.01, 0.05, 0.25])
def test_period_and_exposure_do_not_depend_on_the_judging_period(judge_s):
    made = world(
        row("uav", "tarot_t650", 1, (0.0, 0.0)) + row("rover", "orpheus", 1, (8.0, 0.0)),
        timing={"judge_period_s": judge_s},
        sample_period_s={"nai_1p5x1p5": 0.35, "nai_2x2": 1.05},
    )
    ticks = [g.counter.ticks * g.counter.evaluations for g in made.groups]
    assert ticks == [35, 105]
    assert made.timing.judge_ticks == round(judge_s / TICK_S)
    for group in made.groups:
        assert 0.05 <= group.counter.ticks * TICK_S <= 0.25  # near the 0.12 s at which rates are evaluated


def test_a_detector_faster_than_the_judging_is_refused():
    with pytest.raises(InputError, match=r"sample_period_s of 0.09 s .* is shorter than timing.judge_period_s"):
        world(row("uav", "tarot_t650", 1, (0.0, 0.0)), timing={"judge_period_s": 0.1})


@pytest.mark.slow
def test_each_group_counts_with_its_own_detector():
    made = team()
    silent = replace(made, sources=replace(made.sources, activity_bq=jnp.zeros_like(made.sources.activity_bq)))
    silent = replace(silent, background=replace(silent.background, ground_share=jnp.float32(0.0)))
    state = begin(silent, jax.random.key(2))
    after, _ = fly(silent, state, stay(silent, state), 1.0)
    uavs, rovers = (group.counter for group in after.groups)
    # backgrounds of 94 cps for 1 s and of 167 cps for 0.09 s, less the dead time of 2 us
    np.testing.assert_allclose(uavs.expected_counts, [94.0 * np.exp(-94.0 * 2e-6)] * UAVS, rtol=1e-4)
    np.testing.assert_allclose(rovers.expected_counts, [0.09 * 167.0 * np.exp(-167.0 * 2e-6)] * ROVERS, rtol=1e-4)
    np.testing.assert_allclose(uavs.reading.time_s, 1.0, rtol=1e-5)
    np.testing.assert_allclose(rovers.reading.time_s, 0.99, rtol=1e-5)
    np.testing.assert_allclose(uavs.reading.exposure_s, 1.0, rtol=1e-5)
    np.testing.assert_allclose(rovers.reading.exposure_s, 0.09, rtol=1e-5)
    assert [g.counter.index for g in made.groups] == [0, 1]
    members = row("uav", "x500", 1, (0.0, 0.0)) + row("rover", "orpheus", 1, (8.0, 0.0))
    assert detector_models(scenario(members)) == ("nai_1p5x1p5", "nai_2x2")
