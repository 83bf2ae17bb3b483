"""Both ways of mapping and branching give the same, on a processor and as an accelerator would do it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim import device


@pytest.fixture(params=[True, False], ids=["processor", "accelerator"])
def processor(request, monkeypatch):
    monkeypatch.setattr(device, "on_processor", lambda: request.param)


@pytest.mark.parametrize("count", [1, 7, 12])
def test_each_is_the_function_of_every_element(processor, count):
    values = {"a": jnp.arange(float(count)), "b": jnp.arange(2.0 * count).reshape(count, 2)}
    found = jax.jit(lambda v: device.each(lambda x: x["a"] * x["b"].sum(), v, 5))(values)
    np.testing.assert_array_equal(found, values["a"] * values["b"].sum(axis=1))


def test_branches_are_chosen_by_each_mission(processor):
    branches = [lambda: (jnp.float32(1.0), jnp.zeros(2)), lambda: (jnp.float32(2.0), jnp.ones(2))]
    numbers = jnp.array([1, 0, 1])
    first, second = jax.jit(jax.vmap(lambda n: device.switch(n, branches)))(numbers)
    np.testing.assert_array_equal(first, [2.0, 1.0, 2.0])
    np.testing.assert_array_equal(second[:, 0], [1.0, 0.0, 1.0])
    first, second = jax.jit(jax.vmap(lambda n: device.either(n == 0, *branches)))(numbers)
    np.testing.assert_array_equal(first, [2.0, 1.0, 2.0])
    np.testing.assert_array_equal(second[:, 1], [1.0, 0.0, 1.0])
