"""`jit`, `vmap` and `scan` of the step against steps one by one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim import device
from swarmsim.control.commands import go_to
from swarmsim.world import step as stepping
from swarmsim.world.state import mission_axes
from swarmsim.world.step import step
from tests.world.worlds import at_tick, begin, row, world

TICKS = 25
STARTS = (0, 7, 103)
"""Ticks at which the missions of a batch begin: their judging and sampling fall on different steps."""
MASSES = (1.0, 0.9, 1.1)


@pytest.fixture(scope="module")
def fields():
    """One world for each mission: masses and activities differ."""
    field = world(row("uav", "tarot_t650", 2, (-20.0, 0.0)), mates=1)
    return [scaled(field, factor) for factor in MASSES]


def scaled(field, factor):
    (group,) = field.groups
    params = replace(group.params, mass_kg=factor * group.params.mass_kg)
    sources = replace(field.sources, activity_bq=100.0 * factor * field.sources.activity_bq)
    return replace(field, groups=(replace(group, params=params),), sources=sources)


@pytest.fixture(scope="module")
def begun(fields):
    states = [begin(field, jax.random.key(seed)) for seed, field in enumerate(fields)]
    return [at_tick(state, tick) for state, tick in zip(states, STARTS, strict=True)]


@pytest.fixture(scope="module")
def commands(begun):
    place = begun[0].groups[0].vehicle.body.position_m
    return (jax.vmap(go_to)(place + jnp.array([1.0, 2.0, 3.0])),)


one_step = jax.jit(step)


def one_by_one(field, state, commands):
    readings = []
    for _ in range(TICKS):
        state, seen = one_step(field, state, commands)
        readings.append(seen)
    return state, jax.tree.map(lambda *x: np.stack(x), *readings)


def scanned(field, state, commands):
    return jax.lax.scan(lambda s, _: step(field, s, commands), state, None, length=TICKS)


@pytest.fixture(scope="module")
def flown(fields, begun, commands):
    """End and readings of each mission, stepped one by one."""
    return [one_by_one(field, state, commands) for field, state in zip(fields, begun, strict=True)]


def values(tree):
    def value(x):
        return np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)

    return [value(x) for x in jax.tree.leaves(tree)]


def assert_close(one, other):
    for a, b in zip(values(one), values(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5)


def stacked(trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def mission(batch, number):
    return jax.tree.map(lambda x: x[number], batch)


def test_a_scan_equals_the_steps_one_by_one(fields, begun, commands, flown):
    assert_close(jax.jit(scanned)(fields[1], begun[1], commands), flown[1])


@pytest.mark.slow
@pytest.mark.parametrize("in_kernels", [False, True], ids=["between branches", "inside them"])
def test_commands_held_for_a_judging_period_are_those_of_each_period(
    fields, begun, commands, flown, in_kernels, monkeypatch
):
    monkeypatch.setattr(stepping, "_in_kernels", lambda: in_kernels)
    monkeypatch.setattr(device, "on_processor", lambda: not in_kernels)
    held = jax.jit(lambda field, state: step(field, state, commands, 5))
    state, fresh = begun[0], []
    for _ in range(TICKS // 5):
        state, (reading,) = held(fields[0], state)
        fresh.append(np.asarray(reading.fresh)[0])
    expected, (each,) = flown[0]
    assert_close(state, expected)
    np.testing.assert_array_equal(fresh, np.reshape(np.asarray(each.fresh)[:, 0], (5, 5)).any(axis=1))
    heights = []  # of a mission whose judging falls within the calls: each call judges once
    state = begun[1]
    for _ in range(3):
        state, _ = held(fields[0], state)
        heights.append(float(state.groups[0].around.height_m[0]))
    assert heights[0] < heights[1] < heights[2]
    assert int(state.clock.tick) == STARTS[1] + 15


def test_commands_are_held_for_a_judging_period_at_most(fields, begun, commands):
    for periods in (0, 6):
        with pytest.raises(ValueError, match=f"periods is {periods}: .* 1 to 5"):
            step(fields[0], begun[0], commands, periods)


@pytest.mark.slow
def test_a_batch_of_missions_at_different_ticks_equals_its_missions(fields, begun, commands, flown):
    batch = jax.jit(jax.vmap(scanned, in_axes=(0, 0, None)))(stacked(fields), stacked(begun), commands)
    for number, expected in enumerate(flown):
        assert_close(mission(batch, number), expected)
    _, (reading,) = batch
    # exposures of nine ticks end at 9 and 18, at 9, 18 and 27, and at 108, 117 and 126
    np.testing.assert_array_equal(np.asarray(reading.fresh).sum(axis=1)[:, 0], [2, 3, 3])
    height = batch[0].groups[0].vehicle.body.position_m[:, 0, 2]
    assert height[1] > height[0] > height[2]  # the lighter ones climb faster


@pytest.mark.slow
def test_a_batch_of_missions_that_share_their_clock_equals_its_missions(fields, begun, commands):
    shared = begun[1].clock
    begun = [replace(state, clock=shared) for state in begun]
    axes = mission_axes()
    together = jax.vmap(scanned, in_axes=(0, axes, None), out_axes=(axes, 0))
    state, (reading,) = jax.jit(together)(stacked(fields), replace(stacked(begun), clock=shared), commands)
    assert int(state.clock.tick) == STARTS[1] + TICKS
    for number, (field, first) in enumerate(zip(fields, begun, strict=True)):
        expected, (read,) = one_by_one(field, first, commands)
        assert_close(mission(state.groups, number), expected.groups)
        assert_close(mission(reading, number), read)
        assert_close(mission(state.radio, number), expected.radio)


def largest(jaxpr, count):
    """Number of elements, for each of ``count`` missions, of the largest array that a program computes for all."""
    sizes = [0]
    for equation in jaxpr.eqns:
        shapes = [out.aval.shape for out in equation.outvars]
        sizes += [int(np.prod(shape[1:])) for shape in shapes if shape[:1] == (count,)]
        for value in equation.params.values():
            parts = value if isinstance(value, tuple | list) else [value]
            programs = [getattr(part, "jaxpr", part) for part in parts]
            sizes += [largest(part, count) for part in programs if hasattr(part, "eqns")]
    return max(sizes)


@pytest.mark.slow
@pytest.mark.parametrize("in_kernels", [True, False])
def test_a_batch_of_missions_copies_no_raster(monkeypatch, fields, begun, commands, in_kernels):
    """On a GPU. On a CPU the conditions stay, which copy what they read: the test would see it."""
    monkeypatch.setattr(stepping, "_in_kernels", lambda: in_kernels)
    monkeypatch.setattr(device, "on_processor", lambda: not in_kernels)
    field = replace(fields[0], layout="scalars")
    every = jax.vmap(lambda state: step(field, state, commands)[0])
    program = jax.make_jaxpr(every)(stacked(begun)).jaxpr
    assert (largest(program, len(begun)) < field.site.terrain_m.size) == in_kernels
