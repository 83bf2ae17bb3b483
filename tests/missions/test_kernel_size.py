"""How long the kernels of the shipped missions take to compile, by what Triton does for each access to memory."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest
from jax.extend import core

import swarmsim
from swarmsim.missions.begin import begin_mission
from swarmsim.missions.frame import frame
from swarmsim.site import rays

# Triton's CoalescePass took 200 s of one core for kernels of 1.2e10 (an older layout of the UAVs of `recon`, in which
# accesses stood among all else): the limit stands for half a minute.
COST_MAX = 2e9


def jaxprs_in(equation):
    """The bodies of an equation's loops, branches and calls."""
    for value in equation.params.values():
        for part in value if isinstance(value, (list, tuple)) else [value]:
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield part


def size_of(jaxpr):
    """Its operations, those of its loops and branches among them."""
    return sum(1 + sum(map(size_of, jaxprs_in(equation))) for equation in jaxpr.eqns)


def kernels_of(jaxpr):
    for equation in jaxpr.eqns:
        if equation.primitive.name == "pallas_call":
            yield equation.params["jaxpr"]
        else:
            for inner in jaxprs_in(equation):
                yield from kernels_of(inner)


def set_apart(equation):
    """Whether what is outside a loop is out of Triton's sight: it is in that of one that counts (`access.apart`)."""
    if equation.primitive.name != "while":
        return False
    test, *more = equation.params["cond_jaxpr"].jaxpr.eqns
    return not more and any(isinstance(v, core.Literal) and v.val == 2 for v in test.invars)


def cost_of(jaxpr, seen):
    """Sum over all accesses of the square of the operations that Triton may find tied to it, ``seen`` of them here."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("get", "swap", "masked_load", "masked_swap"):
            total += seen**2
        for inner in jaxprs_in(equation):
            total += cost_of(inner, size_of(inner) if set_apart(equation) else seen)
    return total


@pytest.mark.slow
@pytest.mark.parametrize("name", ["recon", "mixed", "landing", "swarm"])
def test_kernels_of_a_mission_are_compiled_in_seconds(name, monkeypatch):
    simulation = swarmsim.build(swarmsim.load(name))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    world, plan = replace(simulation.world, layout="scalars"), simulation.plan
    mission, _ = jax.eval_shape(lambda key: begin_mission(key, world, plan), jax.random.key(0))
    kernels = list(kernels_of(jax.make_jaxpr(lambda mission: frame(world, plan, mission))(mission).jaxpr))
    assert len(kernels) >= 2  # of each group what it sees, and how it moves
    costs = [cost_of(kernel, size_of(kernel)) for kernel in kernels]
    assert all(0 < cost < COST_MAX for cost in costs)


@pytest.mark.parametrize("name", ["recon", "mixed"])
def test_what_rays_to_a_source_cross_is_one_kernel(name, monkeypatch):
    """Of a site that is an argument, as in the estimate: no loop over boxes or tiles of the terrain is left to XLA.

    One is: that over groups of pairs of a segment and a box that it meets, all of which are computed at a time.
    """
    site = swarmsim.build(swarmsim.load(name)).site_model.site
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    starts, ends = jnp.zeros((2, 5, 3)), jnp.zeros((40, 3))

    def every(site, starts):
        return jax.vmap(jax.vmap(lambda a: rays.crossed_from(site, a, ends)))(starts)

    program = jax.jit(every).trace(site, starts)
    traced = program.jaxpr.jaxpr
    (kernel,) = kernels_of(traced)
    assert loops_outside(traced) == 1
    monkeypatch.setattr(rays, "shaped", lambda boxes, metre, starts, ends, ways, size: ways)
    assert loops_outside(jax.jit(lambda site, starts: every(site, starts)).trace(site, starts).jaxpr.jaxpr) == 0
    assert 0 < cost_of(kernel, size_of(kernel)) < COST_MAX
    assert "triton" in program.lower(lowering_platforms=("cuda",)).as_text()


def loops_outside(jaxpr):
    """Loops that no kernel contains."""
    found = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name != "pallas_call":
            found += equation.primitive.name in ("while", "scan")
            found += sum(map(loops_outside, jaxprs_in(equation)))
    return found


def test_accesses_among_all_else_would_be_noticed():
    """What the cost is for: the same work with its reads where their values are used costs a hundred times as much."""
    from jax.experimental import pallas as pl

    def among(ref, out):
        total = ref[0]
        for place in range(1, 100):
            total = total * ref[place % 10] + ref[place // 10]
        out[0] = total

    shape = jax.ShapeDtypeStruct((10,), "float32")
    call = pl.pallas_call(among, out_shape=shape)
    (kernel,) = kernels_of(jax.make_jaxpr(call)(shape).jaxpr)
    assert cost_of(kernel, size_of(kernel)) == 200 * size_of(kernel) ** 2
