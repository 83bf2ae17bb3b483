"""`over_vehicles` against `jax.vmap`: loops, branches, transformations round it, and a controlled multirotor."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.sharding import AxisType, PartitionSpec

from swarmsim.control.commands import PositionCommand
from swarmsim.control.multirotor import control, control_start
from swarmsim.physics.multirotor import make_multirotor_step
from swarmsim.scalars import over_vehicles
from tests.flights import ENGINES, airborne, hover_speed, params_of, plane
from tests.scalars.mapped import MISSIONS, PLATFORMS, RASTER, N, as_it_is, assert_alike, check, indices, numbers, x3


def test_keys():
    keys = jax.random.split(jax.random.key(3), N)

    def function(key, x):
        near, far = jax.random.split(key)
        drawn = jax.random.normal(near, (5,)), jax.random.poisson(far, jnp.exp(x[0])), jax.random.fold_in(key, 7)
        return *drawn, jnp.where(x[1] > 0, near, far)

    check(function, keys, x3)
    check(lambda key, x: x + jax.random.uniform(key), jax.random.key(1), x3, in_axes=(None, 0))
    check(lambda x: x + jax.random.uniform(jax.random.key(2)), x3)


def test_branches():
    def nested(x, on):
        inner = lambda x: lax.cond(x[1] > 0, lambda x: x * 2, lambda x: (x + 1).at[0].set(0.0), x)  # noqa: E731
        return lax.cond(on, inner, lambda x: -x, x)

    check(nested, x3, x3[:, 0] > 0)
    for on in (True, False):
        check(nested, x3, on, in_axes=(0, None))
        check(nested, x3, jnp.array(on), in_axes=(0, None))
    five = [lambda x, k=k: (x * k, jnp.float32(k), k * jnp.arange(2)) for k in range(5)]
    check(lambda x, i: lax.switch(i, five, x), x3, indices(9) - 2)
    check(lambda x, i: lax.switch(i, five, x), x3, jnp.int32(2), in_axes=(0, None))
    check(
        lambda x, on: lax.cond(on, lambda x: jnp.outer(x, jnp.ones(40)), lambda x: jnp.zeros((3, 40)), x),
        x3,
        x3[:, 0] > 0,
    )
    shared = jax.jit(lambda on: as_it_is(lambda x, on: nested(x, on), (0, None))(x3, on))
    assert "cond" in str(jax.make_jaxpr(shared)(True))


@pytest.mark.slow
@pytest.mark.parametrize("unroll", [0, 16])
@pytest.mark.parametrize("length", [0, 1, 4])
def test_scans(unroll, length):
    def function(x, table):
        def step(carry, row):
            total, count = carry
            total = total * 0.9 + row[0] * table[1] + count
            return (total, count + 1), (total, jnp.outer(total, total), count, row[1])

        rows = (jnp.cos(jnp.arange(length * 3.0)).reshape(length, 3) * x, jnp.arange(length))
        return lax.scan(step, (x, jnp.int32(2)), rows, reverse=length == 4)

    check(function, x3, numbers(3, seed=5), unroll=unroll)
    check(function, x3, np.arange(3, dtype=np.float32), in_axes=(0, None), unroll=unroll)
    big = lambda x: lax.scan(lambda c, _: (c + 1.0, jnp.sum(c)), jnp.outer(x, jnp.ones(30)), None, length)  # noqa: E731
    check(big, x3, unroll=unroll)
    rows = lambda x, r: lax.scan(lambda c, row: (c + row[:3] * row[3], c[0]), x, r)  # noqa: E731
    check(rows, x3, jnp.ones((N, length, 40)), unroll=unroll)
    check(rows, x3, jnp.ones((length, 40)), in_axes=(0, None), unroll=unroll)


def test_loops():
    def shared(x, turns):
        return lax.fori_loop(0, turns, lambda i, c: c + jnp.sin(c) * i, x)

    check(shared, x3, jnp.int32(3), in_axes=(0, None))
    check(shared, x3, indices(5))
    check(lambda x: lax.fori_loop(0, 40, lambda i, c: c.at[i % 3].add(0.1 * i), x), x3)
    check(lambda x: lax.while_loop(lambda c: jnp.sum(c) < 9.0, lambda c: c + 1.0, x), x3)


def test_derivatives_of_its_own():
    @jax.custom_vjp
    def doubled(x, scale):
        return {"y": 2.0 * x * scale}

    doubled.defvjp(lambda x, scale: (doubled(x, scale), scale), lambda scale, g: (5.0 * g["y"], jnp.zeros_like(scale)))
    check(lambda x: doubled(x, jnp.float32(1.0)), x3)
    for mapped in (over_vehicles, as_it_is):
        gradient = jax.grad(lambda x, f=mapped: jnp.sum(f(lambda x: doubled(x, x[0])["y"])(x)))(x3)
        assert_alike(gradient, jnp.full((N, 3), 5.0))


def towards(x, target):
    """A few steps of a vehicle."""
    end, path = lax.scan(lambda c, _: (c - 0.1 * (c - target) * jnp.tanh(c), jnp.linalg.norm(c)), x, None, 4)
    return jnp.where(end[0] > 0, end, end[::-1]), path


TARGET = jnp.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("of_mission", [(True, True), (True, False), (False, True)])
def test_missions_outside(platform, of_mission):
    args = [
        a if own else a[0] for a, own in zip((MISSIONS, jnp.stack([TARGET, -TARGET, TARGET])), of_mission, strict=True)
    ]
    axes = [0 if own else None for own in of_mission]
    several = [jax.vmap(f(towards, (0, None)), axes) for f in (partial(over_vehicles, platform=platform), jax.vmap)]
    assert_alike(*(jax.jit(f)(*args) for f in several))


def test_sweeps_of_missions_outside():
    sweep = jnp.stack([MISSIONS, -MISSIONS])
    each = [jax.vmap(jax.vmap(f(towards, (0, None)), (0, None)), (0, None)) for f in (over_vehicles, jax.vmap)]
    assert_alike(*(jax.jit(f)(sweep, TARGET) for f in each))


def test_missions_outside_with_large_arrays():
    def one(table, raster, x):
        return table[:3] * raster[jnp.clip(x.astype(jnp.int32)[0], 0, 9), 0] + x

    table, raster = numbers(100), jnp.asarray(RASTER)
    for axes in [(0, None, 0), (None, 0, 0), (None, None, 0), (0, 0, None)]:
        args = [jnp.stack([a, 2 * a]) if axis == 0 else a for a, axis in zip((table, raster, x3), axes, strict=True)]
        assert_alike(*(jax.vmap(f(one, (0, None, 0)), axes)(*args) for f in (over_vehicles, jax.vmap)))


@pytest.mark.slow
@pytest.mark.parametrize("platform", PLATFORMS)
def test_derivatives_outside(platform):
    mapped = partial(over_vehicles, platform=platform)

    def loss(mapped, target, x):
        one = mapped(towards, in_axes=(0, None))
        return jnp.sum(lax.scan(lambda c, _: (one(c, target)[0], None), x, None, 3)[0] ** 2)

    def every(f):
        gradient = jax.grad(partial(loss, f), argnums=(0, 1))
        curvature = jax.jacfwd(jax.grad(partial(loss, f)))(TARGET, x3)
        of_all = jax.grad(lambda x: jnp.sum(jax.vmap(partial(loss, f), (None, 0))(TARGET, x)))(MISSIONS)
        return gradient(TARGET, x3), curvature, jax.vmap(gradient, (None, 0))(TARGET, MISSIONS), of_all

    found, expected = jax.jit(lambda: [every(f) for f in (mapped, jax.vmap)])()
    assert_alike(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("checked", [True, False])
def test_shard_map(checked, platform):
    mesh = jax.make_mesh((2,), ("missions",), axis_types=(AxisType.Auto,))

    def one(x, target, on):
        x = lax.cond(on, lambda x: x + target[0], lambda x: x * 2.0, x)
        x = lax.fori_loop(0, 20, lambda i, c: c * 0.9 + 0.1 * target, x)
        return jax.nn.softplus(x) + jnp.sort(x), jnp.arange(2.0)

    def missions(x, target, on):
        return jax.vmap(lambda x: over_vehicles(one, (0, None, None), platform=platform)(x, target, on))(x)

    spread = PartitionSpec("missions")
    specs = (spread, PartitionSpec(), PartitionSpec())
    sharded = jax.shard_map(missions, mesh=mesh, in_specs=specs, out_specs=spread, check_vma=checked)
    args = jnp.stack([x3, x3 + 1.0, -x3, x3 * 0.1]), jnp.array([1.0, 2.0, 3.0]), jnp.array(True)
    expected = jax.vmap(lambda x: jax.vmap(one, in_axes=(0, None, None))(x, *args[1:]))(args[0])
    assert_alike(jax.jit(sharded)(*args), expected)


def test_effects_are_kept(capfd):
    def one(x):
        jax.debug.print("x {}", x)
        return x * 2.0

    assert_alike(jax.jit(over_vehicles(one))(x3[:, 0]), 2.0 * x3[:, 0])
    jax.effects_barrier()
    assert capfd.readouterr().out.count("x ") == N


def controlled(engine, substeps=2):
    step = make_multirotor_step(engine, 0.005)

    def tick(params, state, memory, setpoint, wind, ground):
        command, memory = control(params, memory, state, setpoint, 0.01)
        for _ in range(substeps):
            state = step(params, state, command, wind, ground)
        return state, memory

    return tick


def fleet():
    """Arguments of `controlled`: some in the air, some about to touch a slope."""
    rng = np.random.default_rng(1)
    params = params_of()
    state = airborne(params, height=30.0, speed=hover_speed(params))
    every = lambda tree: jax.tree.map(lambda x: jnp.broadcast_to(x, (N, *jnp.shape(x))), tree)  # noqa: E731
    params, state, memory, ground = every(params), every(state), every(control_start()), every(plane(5.0))
    position = state.body.position_m.at[:, 2].set(jnp.array([0.3, 0.5, 20.0, 30.0, 40.0]))
    state = replace(state, body=replace(state.body, position_m=position))
    draw = lambda spread: jnp.asarray(rng.normal(0.0, spread, (N, 3)), jnp.float32)  # noqa: E731
    setpoint = PositionCommand(
        position_m=position + draw(2.0) - jnp.array([0.0, 0.0, 2.0]),
        velocity_m_s=draw(0.5),
        acceleration_m_s2=jnp.zeros((N, 3)),
        yaw_rad=draw(1.0)[:, 0],
        hold_position=jnp.ones(N),
    )
    return params, state, memory, setpoint, draw(3.0), ground


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_controlled_multirotor(engine):
    params, state, memory, *rest = fleet()

    def fly(layout, state, ticks, params):
        tick = over_vehicles(controlled(engine), layout=layout)
        body = lambda c, _: (tick(params, *c, *rest), None)  # noqa: E731
        return lax.scan(body, (state, memory), None, ticks)[0][0]

    ends = [jax.jit(partial(fly, layout, ticks=100))(state, params=params) for layout in ("scalars", "vmap")]
    np.testing.assert_allclose(ends[0].body.position_m, ends[1].body.position_m, atol=5e-6, rtol=1e-7)
    np.testing.assert_allclose(ends[0].body.quaternion, ends[1].body.quaternion, atol=5e-6)
    np.testing.assert_allclose(ends[0].energy_j, ends[1].energy_j, rtol=1e-5)


def test_gradient_of_a_multirotor():
    params, state, _, _, wind, ground = fleet()
    step = make_multirotor_step("analytic", 0.005)
    speeds = jnp.full((N, 4), hover_speed(params_of()))

    def loss(mapped, position, mass):
        before = replace(state, body=replace(state.body, position_m=position))
        after = mapped(step)(replace(params, mass_kg=mass), before, speeds, wind, ground)
        return jnp.sum(after.body.position_m**2) + jnp.sum(after.body.velocity_m_s[:, 2]) + jnp.sum(after.energy_j)

    args = state.body.position_m, params.mass_kg
    found, expected = (jax.jit(jax.grad(partial(loss, f), argnums=(0, 1)))(*args) for f in (as_it_is, jax.vmap))
    assert_alike(found, expected, rtol=1e-4, atol=1e-4)


def test_derivatives_beside_keys_and_integers():
    keys = jax.random.split(jax.random.key(3), N)

    def loss(mapped, x):
        noisy = mapped(lambda x, i, key: x[i] * jax.random.normal(key) + x[0])(x, indices(3), keys)
        return jnp.sum(noisy**2)

    found = [jax.grad(partial(loss, f))(x3) for f in (over_vehicles, as_it_is, jax.vmap)]
    for result in found[:2]:
        assert_alike(result, found[2])
