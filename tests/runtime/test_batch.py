"""The mission axis: what is shared, how missions run side by side or in turn, and on how many devices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.device import each
from swarmsim.runtime import batch
from swarmsim.runtime.batch import SMALL, Batch, filled, shards_of
from swarmsim.runtime.clock import Clock

LARGE = np.arange(SMALL + 1, dtype=np.float32)


def grown(inputs, carried, factor):
    """Until it is small: missions take different numbers of rounds."""
    start = inputs["scale"] * carried + 0.0 * inputs["large"][0]
    return jax.lax.while_loop(lambda v: v > 0.7, lambda v: factor * v, start)


def of_mission(scale, large=LARGE):
    return {"scale": np.float32(scale), "large": large}


def alone(scale, value, factor=0.5):
    value = np.float32(scale * value)
    while value > 0.7:
        value *= factor
    return value


def test_a_batch_is_spread_only_where_every_device_gets_two():
    devices = len(jax.devices())
    assert devices == 2
    assert [shards_of(n) for n in (1, 2, 3, 4, 5, 1000)] == [1, 1, 1, 2, 2, devices]
    np.testing.assert_array_equal(filled(np.array([3, 4, 5, 6, 7])), [3, 4, 5, 6, 7, 7])
    np.testing.assert_array_equal(filled(np.array([3, 4, 5])), [3, 4, 5])


def test_small_arrays_carry_the_mission_axis_and_large_ones_only_where_they_differ():
    missions = Batch(3, Clock())
    alike = missions.spread([of_mission(2.0)])
    assert (len(alike.own), len(alike.shared)) == (1, 1)
    np.testing.assert_array_equal(alike.own[0], [2.0, 2.0, 2.0])
    other = missions.spread([of_mission(1.0), of_mission(2.0, LARGE + 1.0), of_mission(3.0)])
    assert (len(other.own), len(other.shared)) == (2, 0)
    for number, (scale, first) in enumerate([(1.0, 0.0), (2.0, 1.0), (3.0, 0.0)]):
        own = other.of(number)
        assert (own["scale"], own["large"][0]) == (scale, first)
    np.testing.assert_array_equal(alike.of(1)["large"], LARGE)


@pytest.mark.parametrize("together", [1, 2])
@pytest.mark.parametrize("in_turn", [False, True])
@pytest.mark.parametrize("count", [1, 3, 4])
def test_missions_side_by_side_or_in_turn_or_on_two_devices_are_each_its_own(count, in_turn, together, monkeypatch):
    monkeypatch.setattr(batch, "_together", lambda: together)
    scales, values = np.arange(1.0, count + 1.0), 10.0 ** np.arange(count, dtype=np.float32)
    missions = Batch(count, Clock())
    inputs = missions.spread([of_mission(scale) for scale in scales])
    name = f"grown {in_turn} {together}"
    result = missions.run(name, grown, [inputs], missions.put(values), (np.float32(0.5),), in_turn=in_turn)
    np.testing.assert_array_equal(result, [alone(s, v) for s, v in zip(scales, values, strict=True)])
    assert len(result.sharding.device_set) == (2 if count == 4 else 1)


def tried(inputs, carried, numbers):
    """Of every number: a float, a bool, an integer, what has no size, and bits that are no number as a float."""

    def one(n):
        value = jnp.sin(inputs["scale"] * n + carried)
        return value, value > 0.0, jnp.int32(-n), jnp.zeros((2, 0)), jax.lax.bitcast_convert_type(value, jnp.uint32)

    start = jax.tree.map(jnp.zeros_like, each(one, numbers, 1))
    return jax.lax.fori_loop(0, 3, lambda k, found: each(one, numbers + k + found[0], 1), start)


@pytest.mark.parametrize("count", [1, 2, 5, 8])
@pytest.mark.parametrize("missions", [1, 3])
def test_cores_that_missions_leave_idle_share_what_each_computes(missions, count):
    batch = Batch(missions, Clock())
    inputs = batch.spread([of_mission(scale) for scale in range(1, missions + 1)])
    numbers = np.arange(count, dtype=np.float32)
    given = batch.put(np.arange(missions, dtype=np.float32))
    call = {"inputs": [inputs], "carried": given, "common": (numbers,), "in_turn": True}
    together = batch.run("together", tried, shared=True, **call)
    by_itself = batch.run("by itself", tried, **call)
    for a, b in zip(together, by_itself, strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_array_equal(a, b)
        assert len(a.sharding.device_set) == 1


@pytest.mark.parametrize("how", ["in turn", "shared", "some"])
def test_what_is_done_mission_by_mission_is_one_program_for_a_few_of_them(how):
    for count in (1, 2, 3):
        clock = Clock()
        missions = Batch(count, clock)
        inputs = missions.spread([of_mission(scale) for scale in range(1, count + 1)])
        call = {"name": f"any number {how}", "function": grown, "inputs": [inputs], "common": (np.float32(0.5),)}
        call |= {"carried": missions.put(10.0 ** np.arange(count, dtype=np.float32)), "shared": how == "shared"}
        asked = missions.put(np.ones(count, bool))
        call |= {"only": asked, "donate": True} if how == "some" else {"in_turn": True}
        missions.prepare([call])
        result = missions.run(**call)
        np.testing.assert_array_equal(result, [alone(1.0 + k, 10.0**k) for k in range(count)])
        assert count == 1 or not clock.compiled


def test_shared_work_is_compiled_once_for_preparation_and_calls():
    clock = Clock()
    batch = Batch(1, clock)
    inputs, given = batch.spread([of_mission(1.0)]), batch.put(np.zeros(1, np.float32))
    call = {"name": "once", "function": tried, "inputs": [inputs], "carried": given, "shared": True}
    call["common"] = (np.arange(7, dtype=np.float32),)
    batch.prepare([call])
    batch.run(**call)
    program = next(iter(batch._programs.values()))
    assert len(program._executables) == 1
    assert not program._coming


@pytest.mark.parametrize("together", [1, 2])
def test_results_without_a_size_are_kept(together, monkeypatch):
    """As the thickness of walls that a mission knows."""
    monkeypatch.setattr(batch, "_together", lambda: together)
    missions = Batch(3, Clock())
    empty = missions.spread([{"walls": np.zeros((2, 0), np.float32)}])
    given = missions.put(np.arange(3, dtype=np.float32))
    walls, values = missions.run(
        f"empty {together}", lambda own, value: (own["walls"], value), [empty], given, in_turn=True
    )
    assert walls.shape == (3, 2, 0)
    np.testing.assert_array_equal(values, [0.0, 1.0, 2.0])


@pytest.mark.parametrize("together", [1, 2, 3, 8])
@pytest.mark.parametrize("asked", ["100100", "000000", "111111", "011101", "101", "000", "010"])
def test_only_the_missions_that_are_asked_for_change(asked, together, monkeypatch):
    """Whatever group they fall into; groups are filled with those that are asked for."""
    monkeypatch.setattr(batch, "_together", lambda: together)
    missions = Batch(len(asked), Clock())
    inputs = missions.spread([of_mission(1.0)])
    values = 10.0 * np.arange(1.0, len(asked) + 1.0, dtype=np.float32)
    chosen = np.array([c == "1" for c in asked])
    name = f"some {together}"
    result = missions.run(name, grown, [inputs], missions.put(values), (np.float32(0.5),), only=missions.put(chosen))
    expected = [alone(1.0, v) if c else v for v, c in zip(values, chosen, strict=True)]
    np.testing.assert_array_equal(result, expected)


def test_other_values_need_no_other_program():
    clock = Clock()
    missions = Batch(2, clock)
    values = missions.put(jnp.array([3.0, 5.0]))
    missions.run("again", grown, [missions.spread([of_mission(1.0)])], values, (np.float32(0.5),))
    clock.reset()
    inputs = missions.spread([of_mission(2.0), of_mission(7.0)])
    result = missions.run("again", grown, [inputs], values, (np.float32(0.25),))
    np.testing.assert_array_equal(result, [alone(2.0, 3.0, 0.25), alone(7.0, 5.0, 0.25)])
    assert not clock.compiled
    assert not clock.loaded
    assert clock.run_s > 0.0


@pytest.mark.parametrize("only", [False, True])
def test_a_result_takes_over_what_it_was_made_from_only_if_told_to(only):
    missions = Batch(3, Clock())
    inputs = missions.spread([of_mission(2.0)])
    kept, given = (missions.put(np.arange(3, dtype=np.float32)) for _ in range(2))
    asked = missions.put(np.array([True, False, True])) if only else None
    call = {"function": grown, "inputs": [inputs], "common": (np.float32(0.5),), "only": asked}
    results = [missions.run(f"taken {only}", carried=x, donate=x is given, **call) for x in (kept, given)]
    np.testing.assert_array_equal(*results)
    assert (kept.is_deleted(), given.is_deleted()) == (False, True)
    assert not any(s.is_deleted() for s in inputs.own)


def _counted(inputs, state, step):
    """A mission that counts up by ``step``; its record is the count, its verdict whether it wants to stop."""
    state = state + step
    return state, {"count": state}, state >= inputs["scale"]


def _until_any_wants_to_stop(verdicts, common):
    return ~jnp.any(verdicts), (common[0] + 1.0,)


@pytest.mark.parametrize("most", [1, 3, 8])
@pytest.mark.parametrize("count", [1, 3, 4])
def test_a_function_is_evaluated_again_until_a_mission_wants_the_host(count, most):
    """Steps of 1, 2, 3, …: the counts are 1, 3, 6, 10, 15; 10 is the first mission's limit."""
    missions = Batch(count, Clock())
    inputs = missions.spread([of_mission(10.0 + 90.0 * (k > 0)) for k in range(count)])
    state, again = missions.put(np.zeros(count, np.float32)), batch.Again(most, _until_any_wants_to_stop)
    state, records, stop, times = missions.run(
        "counted", _counted, [inputs], state, (np.float32(1.0),), donate=True, again=again
    )
    made = min(most, 4) if count < 4 else 1  # on two devices one evaluation a call
    np.testing.assert_array_equal(times, np.full(count, made))
    rows = np.zeros(most if count < 4 else 1)
    rows[:made] = [1.0, 3.0, 6.0, 10.0][:made]
    np.testing.assert_array_equal(records["count"], np.tile(rows, (count, 1)))
    np.testing.assert_array_equal(state, np.full(count, rows[made - 1]))
    np.testing.assert_array_equal(stop, [made == 4] + [False] * (count - 1))
