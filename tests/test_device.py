"""Both ways of mapping and branching give the same, on a processor and as an accelerator would do it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

from swarmsim import device


@pytest.fixture(params=[True, False], ids=["processor", "accelerator"])
def processor(request, monkeypatch):
    monkeypatch.setattr(device, "on_processor", lambda: request.param)


@pytest.mark.parametrize("count", [1, 7, 12])
def test_each_is_the_function_of_every_element(processor, count):
    values = {"a": jnp.arange(float(count)), "b": jnp.arange(2.0 * count).reshape(count, 2)}
    found = jax.jit(lambda v: device.each(lambda x: x["a"] * x["b"].sum(), v, 5))(values)
    np.testing.assert_array_equal(found, values["a"] * values["b"].sum(axis=1))
    empty = jax.jit(lambda v: device.each(lambda x: jnp.zeros((3, 0)), v, 4))(values)
    assert empty.shape == (count, 3, 0)


def test_in_turn_what_comes_later_knows_what_came_before():
    """Of its own device's part alone."""

    def step(known, x):
        return known + x, known

    values = jnp.arange(1.0, 6.0)
    before = jax.jit(lambda v: device.in_turn(step, jnp.zeros(()), v))(values)
    np.testing.assert_array_equal(before, [0.0, 1.0, 3.0, 6.0, 10.0])
    mesh = jax.make_mesh((2,), ("cores",))

    def shared(v):
        with device.among_cores("cores"):
            return device.in_turn(step, jnp.zeros(()), v)

    spread = jax.shard_map(shared, mesh=mesh, in_specs=P(), out_specs=P(), check_vma=False)
    np.testing.assert_array_equal(jax.jit(spread)(values), [0.0, 1.0, 3.0, 0.0, 4.0])


def test_branches_are_chosen_by_each_mission(processor):
    branches = [lambda: (jnp.float32(1.0), jnp.zeros(2)), lambda: (jnp.float32(2.0), jnp.ones(2))]
    numbers = jnp.array([1, 0, 1])
    first, second = jax.jit(jax.vmap(lambda n: device.switch(n, branches)))(numbers)
    np.testing.assert_array_equal(first, [2.0, 1.0, 2.0])
    np.testing.assert_array_equal(second[:, 0], [1.0, 0.0, 1.0])
    first, second = jax.jit(jax.vmap(lambda n: device.either(n == 0, *branches)))(numbers)
    np.testing.assert_array_equal(first, [2.0, 1.0, 2.0])
    np.testing.assert_array_equal(second[:, 1], [1.0, 0.0, 1.0])


@pytest.mark.parametrize("few", [1, 2, 32])
def test_those_that_need_it_are_computed_in_groups(processor, monkeypatch, few):
    monkeypatch.setattr(device, "AT_A_TIME", few)
    shared, own = jnp.arange(3.0), jnp.arange(7.0)

    def one(x, wanted):
        many = device.for_those(wanted, lambda: {"a": x * shared, "b": jnp.int32(1)}, lambda: {"a": -shared, "b": 0})
        # decided for a mission, computed for several places of it
        places = jax.vmap(lambda y: device.for_those(wanted, lambda: y + x, lambda: y))(shared)
        alike = jax.vmap(lambda y: device.for_those(wanted, lambda: x, lambda: y))(shared)
        return many, places, alike

    wanted = jnp.array([True, False, True, True, False, False, True])
    many, places, alike = jax.jit(jax.vmap(one))(own, wanted)
    chosen = np.asarray(wanted)[:, None]
    np.testing.assert_array_equal(many["a"], np.where(chosen, np.outer(own, shared), -np.asarray(shared)))
    np.testing.assert_array_equal(many["b"], wanted)
    np.testing.assert_array_equal(places, np.asarray(shared) + np.where(chosen, np.asarray(own)[:, None], 0.0))
    np.testing.assert_array_equal(alike, np.where(chosen, np.asarray(own)[:, None], np.asarray(shared)))


def test_groups_are_filled_up_with_none_that_would_take_longer(monkeypatch):
    """The second of two missions would take 10^7 passes, and does not ask for any."""
    monkeypatch.setattr(device, "on_processor", lambda: False)
    counted: list[int] = []

    def one(wanted, passes):
        def long():
            count = jax.lax.while_loop(lambda k: k < passes, lambda k: k + 1, 0)
            jax.debug.callback(lambda most: counted.append(int(most)), passes)
            return count

        return device.for_those(wanted, long, lambda: -1)

    found = jax.jit(jax.vmap(one))(jnp.array([True, False]), jnp.array([3, 10**7]))
    jax.effects_barrier()
    np.testing.assert_array_equal(found, [3, -1])
    assert counted == [3, 3]


def test_any_predicate_tells_true_from_false(processor):
    def one(number, x):
        return device.for_those(number != 0, lambda: x + 1.0, lambda: x)

    many = jax.jit(jax.vmap(one))(jnp.array([0, 1, 2, 0, 5]), jnp.zeros(5))
    np.testing.assert_array_equal(many, [0.0, 1.0, 1.0, 0.0, 1.0])


def test_results_of_another_structure_are_refused(processor):
    with pytest.raises(TypeError, match="structure"):
        jax.vmap(lambda wanted: device.for_those(wanted, lambda: {"a": 1.0}, lambda: {"b": 1.0}))(jnp.array([True]))


def test_derivatives_along_a_direction(processor):
    def one(wanted, x):
        return device.for_those(wanted, lambda: jnp.sin(x), lambda: x)

    wanted, x = jnp.array([True, False, True]), jnp.array([0.3, 0.5, 0.7])
    slope = jax.jit(jax.vmap(lambda p, x: jax.jvp(lambda x: one(p, x), (x,), (1.0,))[1]))(wanted, x)
    np.testing.assert_allclose(slope, np.where(wanted, np.cos(x), 1.0), rtol=1e-6)


def test_missions_repeat_as_often_as_each_of_them_goes_on(processor, monkeypatch):
    monkeypatch.setattr(device, "AT_A_TIME", 2)

    def one(most, factor):
        def step(carry):
            k, x = carry
            inner = device.repeat_while(lambda y: y < k, lambda y: y + 1, jnp.int32(0))
            return k + 1, x * factor + inner.astype(jnp.float32)

        return device.repeat_while(lambda carry: carry[0] < most, step, (jnp.int32(0), jnp.float32(1.0)))

    most, factor = jnp.array([0, 3, 5, 1, 4]), jnp.linspace(0.5, 1.5, 5)
    times, values = jax.jit(jax.vmap(one))(most, factor)
    np.testing.assert_array_equal(times, most)
    for n, f, value in zip(most.tolist(), factor.tolist(), values, strict=True):
        x = 1.0
        for k in range(n):
            x = x * f + k
        assert float(value) == pytest.approx(x, rel=1e-6)


def test_groups_inside_are_full_whoever_went_on_before(monkeypatch):
    """Seven missions in step, three at a time where it takes long: as many groups as those that still go on need."""
    monkeypatch.setattr(device, "on_processor", lambda: False)
    monkeypatch.setattr(device, "AT_A_TIME", 3)
    groups: list[int] = []
    wanted = jnp.array([True, True, False, True, True, True, True])
    passes = jnp.array([4, 1, 10**7, 2, 4, 4, 1])

    def one(wanted, passes, x):
        def long(carry):
            k, x = carry
            jax.debug.callback(lambda k: groups.append(int(k)), k)
            return k + 1, x + device.some_at_a_time(lambda: 1.0 * x)

        def all_():
            return device.repeat_while(lambda carry: carry[0] < passes, long, (jnp.int32(0), x))[1]

        return device.for_those(wanted, all_, lambda: -x, 7)

    x = jnp.arange(1.0, 8.0)
    found = jax.jit(jax.vmap(one))(wanted, passes, x)
    jax.effects_barrier()
    np.testing.assert_array_equal(found, np.where(wanted, x * 2.0 ** np.minimum(passes, 9), -x))
    # six, four, three and three missions: 2 + 2 + 1 + 1 groups of three, each of which tells three times
    assert len(groups) == 18
    with_one = jax.jit(jax.vmap(lambda w, p, x: device.for_those(w, lambda: one(w, p, x), lambda: -x, 4)))
    np.testing.assert_array_equal(with_one(wanted, passes, x), found)


def test_most_of_all_missions_is_one_number():
    def one(x):
        count = device.at_most(x)
        return jax.lax.fori_loop(0, count, lambda _, total: total + 1, 0)

    np.testing.assert_array_equal(jax.jit(jax.vmap(one))(jnp.array([2, 5, 3])), [5, 5, 5])
    nested = jax.jit(jax.vmap(jax.vmap(one)))(jnp.array([[2, 1], [7, 3]]))
    np.testing.assert_array_equal(nested, np.full((2, 2), 7))
    assert int(jax.jit(one)(4)) == 4
