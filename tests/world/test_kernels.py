"""On a GPU a world's step consists of kernels: nothing in it may keep a group's motion or judging out of one."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from swarmsim.scalars import kernel
from swarmsim.world.step import hold, step
from tests.world.worlds import begin, row, world


def _turned(made):
    """The world with UAVs whose principal axes are not those of their bodies."""
    group, *others = made.groups
    axes = np.tile(np.float32([0.8, 0.6, 0.0, 0.0]), (group.size, 1))
    params = replace(group.params, principal_axes=axes, control=replace(group.params.control, principal_axes=axes))
    return replace(made, groups=(replace(group, params=params), *others))


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "turned"), [("analytic", False), ("analytic", True), ("mjx", False), ("mjx", True)])
def test_every_function_over_vehicles_is_a_kernel(engine, turned, monkeypatch):
    team = row("uav", "tarot_t650", 3, (-30.0, -20.0)) + row("rover", "orpheus", 2, (-30.0, 0.0))
    made = replace(world(team, engine=engine), layout="scalars")
    made = _turned(made) if turned else made
    state = begin(made, jax.random.key(0))
    launch, made_kernels, refused = kernel._launch, [], []

    def watched(program, size, *others):
        try:
            results = launch(program, size, *others)
        except kernel.NotInKernelError as error:
            refused.append(str(error))
            raise
        made_kernels.append(size)
        return results

    monkeypatch.setattr(kernel, "_launch", watched)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    jax.make_jaxpr(lambda s: step(made, s, hold(made, s)))(state)
    assert refused == []
    assert set(made_kernels) == {2, 3}
    assert len(made_kernels) >= 4  # of each group what it sees, and how it moves
