"""`over_vehicles` against `jax.vmap`: every class of rule, transformations round it, and a controlled multirotor."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import lax
from jax.sharding import AxisType, PartitionSpec

from swarmsim.control.commands import PositionCommand
from swarmsim.control.multirotor import control, control_start
from swarmsim.physics.multirotor import make_multirotor_step
from swarmsim.runtime.scalars import over_vehicles
from tests.flights import ENGINES, airborne, hover_speed, params_of, plane

N = 5
RASTER = np.random.default_rng(7).normal(size=(20, 30)).astype(np.float32)


def numbers(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(N, *shape)), jnp.float32)


def indices(high, *shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).integers(0, high, size=(N, *shape)), jnp.int32)


def assert_alike(found, expected, rtol=1e-5, atol=1e-5):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)


PLATFORMS = ("cpu", "gpu")  # how the program is arranged; both are run here
on_gpu = partial(over_vehicles, platform="gpu")


def check(function, *args, in_axes=0, **options):
    """Compare with `jax.vmap`; returns the results."""
    kinds = [over_vehicles(function, in_axes, platform=platform, **options) for platform in PLATFORMS]
    *found, expected = jax.jit(lambda *args: [f(*args) for f in (*kinds, jax.vmap(function, in_axes))])(*args)
    for results in found:
        assert_alike(results, expected)
    return found[0]


def primitives_of(function, *args, in_axes=0):
    """Names of the primitives that are bound."""
    return [e.primitive.name for e in jax.make_jaxpr(on_gpu(function, in_axes))(*args).eqns]


x3, x4, x34, x33 = numbers(3), numbers(4, seed=1), numbers(3, 4, seed=2), numbers(3, 3, seed=3)
i3 = indices(9, 3)

FUNCTIONS = {
    "arithmetic": lambda x: (x + 2.0) * x - x / (1.0 + x * x) + x**3 + x**-2,
    "division of integers": lambda x: ((jnp.int32(7) * jnp.sign(x).astype(jnp.int32)) // 2, lax.rem(jnp.int32(-7), 3)),
    "folded integers": lambda x: x[0] + (lax.div(jnp.int32(-7), jnp.int32(2)) + jnp.floor_divide(-7, 2)),
    "transcendental": lambda x: jnp.sin(x) + jnp.arctan2(x, x[0]) + jnp.log1p(jnp.abs(x)) + jax.nn.sigmoid(x),
    "powers": lambda x: jnp.abs(x) ** 1.5 + jnp.exp2(x) + jnp.cbrt(x) + jnp.hypot(x, 2.0),
    "clip and round": lambda x: (jnp.clip(x, -0.5, 0.5), jnp.round(x), jnp.floor(x).astype(jnp.int32)),
    "booleans": lambda x: ((x > 0) & ~(x > 1) | (x[0] == x), jnp.any(x > 0), jnp.all(x > 0), x > jnp.nan),
    "select": lambda x: jnp.where(x > 0, x, jnp.where(x[0] > 0, 1.0, x[1])),
    "select among three": lambda x: lax.select_n(jnp.int32(1), x, x + 1, x + 2)
    + lax.select_n(jnp.clip(x.astype(jnp.int32), 0, 2), x, x + 1, x + 2),
    "reductions": lambda x: (jnp.sum(x), jnp.prod(x), jnp.max(x), jnp.min(x), jnp.mean(x), jnp.var(x)),
    "positions": lambda x: (jnp.argmax(x), jnp.argmin(x), jnp.argmax(jnp.array([1.0, 3.0, 2.0]))),
    "running": lambda x: (jnp.cumsum(x), jnp.cumprod(x), lax.cummax(x, reverse=True), lax.cummin(x)),
    "norms": lambda x: x / jnp.linalg.norm(x),
    "matrix": lambda x: jnp.outer(x, x) @ jnp.eye(3) @ x + jnp.cross(x, jnp.array([1.0, 2.0, 3.0])),
    "contractions": lambda x: jnp.einsum("i,jk,ki->j", x, jnp.outer(x, x + 1), jnp.ones((3, 3))),
    "stacks": lambda x: jnp.stack([jnp.concatenate([x, x[:1]]), jnp.append(x[::-1], 1.0)], axis=1),
    "shapes": lambda x: jnp.tile(x[:, None], (1, 2)).T.reshape(3, 2)[..., None].squeeze(-1),
    "pads": lambda x: (lax.pad(x, 0.5, [(1, -1, 1)]), jnp.pad(jnp.ones(2), 1), lax.pad(jnp.ones(2), x[0], [(1, 1, 0)])),
    "splits": lambda x: jnp.split(x, [1]),
    "rolls": lambda x: (jnp.roll(x, 1), jnp.flip(x), x[jnp.array([2, 0])], x[jnp.array([[2, -1]])]),
    "writes": lambda x: (x.at[1].set(0.0), x.at[jnp.array([0, 0])].add(x[1]), jnp.zeros(4).at[1:3].set(x[:2])),
    "write extremes": lambda x: (x.at[0].max(0.3), x.at[2].min(0.3), x.at[1].mul(2.0), x.at[9].set(1.0)),
    "out of bounds": lambda x: (
        x.at[jnp.array([1, 7])].get(mode="fill", fill_value=9.0),
        x.at[jnp.array([1, 7])].get(mode="clip"),
        jnp.take(jnp.arange(3), 5, mode="fill"),
    ),
    "sorting": lambda x: (jnp.sort(x), jnp.argsort(x), lax.top_k(x, 2)),
    "linear algebra": lambda x: jnp.linalg.solve(jnp.eye(3) * 3 + jnp.outer(x, x), x),
    "constants": lambda x: (jnp.ones((2, 2)), jnp.arange(3) + 1, jnp.float32(2.0), jnp.zeros((0, 3)), x[:0]),
    "many": lambda x: jnp.sum(jnp.arange(100.0) * x[0]) + jnp.linspace(0.0, 1.0, 70) @ (jnp.arange(70.0) + x[1]),
    "bits": lambda x: lax.bitcast_convert_type(x, jnp.uint32) >> 3,
    "half": lambda x: (x.astype(jnp.bfloat16) * 2 + jnp.bfloat16(1)).astype(jnp.float32),
    "complex": lambda x: jnp.abs(x + 1j * x[0]),
    "checkpoint": jax.checkpoint(lambda x: jnp.sin(x) * x),
    "softplus": lambda x: jax.nn.softplus(x) + jax.nn.relu(x) + jnp.sinc(x),
    "unused": lambda x: (jnp.sort(x), x)[1],
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_rules(name):
    check(FUNCTIONS[name], x3)


@pytest.mark.parametrize("name", ["arithmetic", "select", "norms", "matrix", "reductions", "softplus", "checkpoint"])
def test_derivatives(name):
    def total(mapped, x):
        return sum(
            jnp.sum(leaf * jnp.sin(jnp.arange(leaf.size)).reshape(leaf.shape)) for leaf in jax.tree.leaves(mapped(x))
        )

    def derivatives(mapped):
        return jax.grad(partial(total, mapped))(x3), jax.jvp(mapped, (x3,), (numbers(3, seed=9),))

    kinds = [over_vehicles(FUNCTIONS[name]), on_gpu(FUNCTIONS[name]), jax.vmap(FUNCTIONS[name])]
    *found, expected = jax.jit(lambda: [derivatives(f) for f in kinds])()
    for results in found:
        assert_alike(results, expected)


@given(st.data())
def test_random_programs(data):
    """Compositions of elementwise, rearranging and reducing operations on arrays of any small shape."""
    unary = [jnp.sin, jnp.abs, jnp.sqrt, jnp.square, jnp.cumsum, lambda x: -x, lambda x: x[::-1], lambda x: x.T]
    reducing = [jnp.sum, jnp.max, jnp.min, jnp.prod, lambda x: x[0], lambda x: x.reshape(-1)[-1:]]
    binary = [jnp.add, jnp.multiply, jnp.subtract, jnp.divide, jnp.maximum, jnp.arctan2]
    constants = [0.0, 1.0, -1.0, 2.5, np.float32(np.inf), np.array([0.0, 1.0, 3.0], np.float32)]
    steps = data.draw(
        st.lists(st.tuples(st.integers(0, 3), st.integers(0, 7), st.integers(0, 7)), min_size=1, max_size=8)
    )
    shape = data.draw(st.sampled_from([(), (3,), (1, 3), (3, 3), (2, 1, 3)]))

    def program(x):
        made = [x, x + 1.0]
        for kind, which, place in steps:
            a, b = made[place % len(made)], made[-1]
            if kind == 0 and jnp.ndim(a):
                made.append(unary[which](a))
            elif kind == 1 and jnp.ndim(a):
                made.append(reducing[which % len(reducing)](a))
            elif kind == 2:
                other = b if a.shape == b.shape else constants[which % len(constants)]
                made.append(binary[place % len(binary)](a, other))
            else:
                made.append(jnp.where(a > 0.1, a, b if a.shape == b.shape else 0.0))
        return made[-1], made[len(made) // 2]

    x = jnp.asarray(np.random.default_rng(len(steps)).uniform(0.5, 1.5, (N, *shape)), jnp.float32)
    found, expected = over_vehicles(program)(x), jax.vmap(program)(x)
    for a, b in zip(found, expected, strict=True):
        finite = np.isfinite(b)  # where infinity meets a constant zero, zero is the documented result
        np.testing.assert_allclose(np.asarray(a)[finite], np.asarray(b)[finite], rtol=2e-5, atol=2e-5)


def test_nan_passes_selections_only_where_chosen():
    x = x3.at[0, 0].set(jnp.nan).at[1, 2].set(jnp.inf)
    found = check(lambda x: (jnp.where(jnp.isnan(x), 0.0, x), jnp.max(x), jnp.argmax(x), jnp.maximum(x, 0.0)), x)
    assert np.isfinite(found[0][0]).all()
    assert np.isnan(found[1][0])
    assert found[2][0] == 0


def test_constants_are_folded():
    eye = np.eye(3, dtype=np.float32)
    assert set(primitives_of(lambda x: eye @ (x * 1.0 + 0.0) + jnp.zeros(3) * jnp.sin(x), x3)) <= {
        "split", "squeeze", "broadcast_in_dim", "concatenate", "reshape", "jit"
    }  # fmt: skip
    assert "sin" not in primitives_of(lambda x: x * jnp.sin(jnp.arange(3.0)), x3)
    assert "mul" not in primitives_of(lambda x: jnp.where(jnp.arange(3) > 5, x * x, x), x3)


def test_equal_operations_are_bound_once():
    assert primitives_of(lambda x: jnp.sin(x[0]) * x[1] + jnp.sin(x[0]) * x[2], x3).count("sin") == 1


@pytest.mark.parametrize("mode", ["clip", "fill", "promise_in_bounds"])
def test_small_arrays_at_traced_indices(mode):
    def function(x, i):
        at = x.at[i].get(mode=mode)
        pair = x.at[i[0]].get(mode=mode), x[i[0] - 20], lax.dynamic_slice(x, (i[1] - 2,), (2,))
        return at, pair, lax.dynamic_update_slice(x, jnp.zeros(2), (i[2],))

    found = check(function, x4, indices(4 if mode == "promise_in_bounds" else 7, 3))
    assert found[0].shape == (N, 3)
    written = [
        lambda x, i: x.at[i].set(0.0),
        lambda x, i: x.at[i].add(x[0]),
        lambda x, i: x.at[i].mul(x[1], mode="clip"),
    ]
    for function in written:
        check(function, x4, indices(7))
    check(lambda x, i: x.at[i[0], i[1]].set(7.0)[i[2]], x34, indices(4, 3))
    check(lambda x, i: jnp.take_along_axis(x, i[:, None], axis=1), x34, indices(4, 3))
    check(lambda x, i: x[:, i], x34, indices(4))


def test_shared_arguments_and_rasters():
    def height(place, raster, scale, spacing):
        column = jnp.clip(place[0].astype(jnp.int32), 0, 28)
        row = jnp.clip(place[1].astype(jnp.int32), 0, 18)
        corner = lax.dynamic_slice(raster, (row, column), (2, 2))
        return jnp.sum(corner) * scale[1] + raster[row, column] * spacing, scale * 2.0, jnp.max(raster)

    place = jnp.abs(numbers(2, seed=4)) * 12.0
    scale = jnp.array([1.0, 2.0, 3.0])
    for raster in (RASTER, jnp.asarray(RASTER)):
        check(height, place, raster, scale, 0.5, in_axes=(0, None, None, None))
    check(lambda x, r: r[indices(20)[0]] * x + x[0], numbers(30), jnp.asarray(RASTER), in_axes=(0, None))


def test_arguments_are_given_as_to_vmap():
    state = {"p": x3, "shared": jnp.arange(3.0)}
    check(lambda s, y: s["p"] * s["shared"] + y, state, x4.T[:3], in_axes=({"p": 0, "shared": None}, 1))
    check(lambda x, y: x + y, x3, jnp.moveaxis(x3, 0, -1), in_axes=(0, -1))
    assert over_vehicles(lambda x, n: x[:n], in_axes=(0, None))(x3, 2).shape == (N, 2)  # a Python number stays one
    found = over_vehicles(lambda x, *, y: x + y)(x3, y=x3)
    assert_alike(found, 2.0 * x3)
    assert_alike(over_vehicles(lambda x: x * 2.0, layout="vmap")(x3), 2.0 * x3)
    captured = jnp.float32(3.0)
    assert_alike(jax.jit(lambda c: over_vehicles(lambda x: x * c)(x3))(captured), 3.0 * x3)
    assert_alike(over_vehicles(lambda x: x * np.float64(2.0) + 1)(np.asarray(x3)), 2.0 * x3 + 1)


def test_arguments_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="no layout 'arrays'"):
        over_vehicles(lambda x: x, layout="arrays")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="one size"):
        over_vehicles(lambda x, y: x)(x3, jnp.zeros(N + 1))
    with pytest.raises(ValueError, match="one size"):
        over_vehicles(lambda x: x, in_axes=(None,))(x3)
    with pytest.raises(ValueError, match="no axis 0"):
        over_vehicles(lambda x: x)(1.0)
    with pytest.raises(ValueError, match="2 entries for 1"):
        over_vehicles(lambda x: x, in_axes=(0, None))(x3)


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
    shared = jax.jit(lambda on: on_gpu(lambda x, on: nested(x, on), (0, None))(x3, on))
    assert "cond" in str(jax.make_jaxpr(shared)(True))


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
    for mapped in (over_vehicles, on_gpu):
        gradient = jax.grad(lambda x, f=mapped: jnp.sum(f(lambda x: doubled(x, x[0])["y"])(x)))(x3)
        assert_alike(gradient, jnp.full((N, 3), 5.0))


def towards(x, target):
    """A few steps of a vehicle."""
    end, path = lax.scan(lambda c, _: (c - 0.1 * (c - target) * jnp.tanh(c), jnp.linalg.norm(c)), x, None, 4)
    return jnp.where(end[0] > 0, end, end[::-1]), path


MISSIONS = jnp.stack([x3, x3 + 0.3, x3 * 2.0])
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
    found, expected = (jax.jit(jax.grad(partial(loss, f), argnums=(0, 1)))(*args) for f in (on_gpu, jax.vmap))
    assert_alike(found, expected, rtol=1e-4, atol=1e-4)
