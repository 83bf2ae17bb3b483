"""`over_vehicles` against `jax.vmap`: every class of rule, and how arguments are given."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import lax

from swarmsim.scalars import over_vehicles
from tests.scalars.mapped import (
    MISSIONS,
    PLATFORMS,
    RASTER,
    N,
    as_it_is,
    assert_alike,
    check,
    indices,
    numbers,
    primitives_of,
    x3,
    x4,
    x34,
)

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

    kinds = [over_vehicles(FUNCTIONS[name]), as_it_is(FUNCTIONS[name]), jax.vmap(FUNCTIONS[name])]
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


def test_on_a_cpu_nothing_is_computed_for_each_result_anew():
    def one(x):
        for _ in range(30):
            x = jnp.stack([x[0] * x[1] + x[2], x[1] * x[2] - x[0], x[2] * x[0] + x[1]])
        return x[0], x[1], x[2]

    def multiplications(platform):
        compiled = jax.jit(over_vehicles(one, platform=platform)).lower(x3).compile()
        return compiled.as_text().count("multiply(")

    assert 90 <= multiplications("cpu") < 2.5 * 90 < multiplications("as it is")


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


@pytest.mark.parametrize("platform", PLATFORMS)
def test_captured_values_are_shared(platform):
    def total(c, x):
        return jnp.sum(over_vehicles(lambda x: x * c + jnp.sin(c), platform=platform)(x))

    expected = jax.value_and_grad(lambda c, x: jnp.sum(x * c + jnp.sin(c)))
    assert_alike(jax.jit(jax.value_and_grad(total))(3.0, x3), expected(3.0, x3), rtol=1e-4)
    each = jax.vmap(jax.value_and_grad(total))(jnp.arange(3.0), MISSIONS)
    assert_alike(each, jax.vmap(expected)(jnp.arange(3.0), MISSIONS), rtol=1e-4)
    assert_alike(jax.vmap(total)(jnp.arange(3.0), MISSIONS), each[0], rtol=1e-4)


def test_numpy_arguments():
    assert_alike(over_vehicles(lambda x: x * np.float64(2.0) + 1)(np.asarray(x3)), 2.0 * x3 + 1)


@pytest.mark.parametrize("platform", PLATFORMS)
def test_what_is_known_and_alike_is_a_constant(platform):
    alike, uneven = jnp.full((N, 3), 2.0), jnp.full((N, 3), 2.0).at[1].set(jnp.nan)
    every = over_vehicles(lambda x, y: x * y, platform=platform)
    for known in (alike, uneven, np.asarray(alike)):
        assert_alike(jax.jit(lambda x, known=known: every(x, known))(x3), x3 * known)
        assert_alike(jax.jit(jax.vmap(lambda x, known=known: every(x, known)))(MISSIONS), MISSIONS * known)
    signed = np.zeros(N, np.float32)
    signed[1] = -0.0  # is equal to the others, and not the same
    inverse = over_vehicles(lambda x, y: x + 1.0 / y, platform=platform)
    assert_alike(jax.jit(lambda x: inverse(x, signed))(jnp.zeros(N)), 1.0 / jnp.asarray(signed))
    shapes = [v.aval.shape for v in jax.make_jaxpr(lambda x: every(x, alike))(x3).jaxpr.constvars]
    assert (N, 3) not in shapes


@pytest.mark.parametrize("platform", PLATFORMS)
def test_what_is_known_and_alike_is_traced_as_jax_does(platform):
    def assert_as_vmap(function, *known, x=x3):
        mapped = over_vehicles(function, platform=platform)
        found, expected = (jax.jit(lambda x, of=of: of(*known, x))(x) for of in (mapped, jax.vmap(function)))
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(np.asarray(found, np.float32), np.asarray(expected, np.float32))

    def added(p, x):
        p += 1.0
        return p * x

    row, number = np.ones((N, 3), np.float32), jnp.arange(N) % 3
    assert_as_vmap(added, row)
    np.testing.assert_array_equal(row, 1.0)  # the caller's array is the caller's
    assert_as_vmap(lambda p, x: p.at[0].set(x[1]), row)
    assert_as_vmap(lambda p, i: p[i], row, x=number)
    assert_as_vmap(lambda p, x: p[5] + x, row)
    assert_as_vmap(lambda a, x: a * x, jnp.full(N, 2.0), x=number.astype(jnp.float16))
    assert_as_vmap(lambda n, x: n * x, np.full(N, 16777217), x=jnp.full(N, 0.1))
    assert_as_vmap(lambda a, x: 1.0 / a + x[0], jnp.zeros(N))


@pytest.mark.parametrize("platform", PLATFORMS)
def test_operations_on_constants_are_done_while_tracing(platform):
    """Triton has no form of some of them on a constant, and a kernel would repeat them."""

    def one(known, x):
        part = jnp.stack([known[0], x[0]]) ** 3  # the first entry is known, and the other is not
        return lax.fori_loop(0, 20, lambda _, c: c + jnp.cbrt(known) + part[0], x)

    every = over_vehicles(one, platform=platform)
    known = np.full((N, 3), 1.5, np.float32)
    assert_alike(jax.jit(lambda x: every(known, x))(x3), jax.vmap(one)(known, x3))
    text = str(jax.make_jaxpr(lambda x: every(known, x))(x3))
    assert text.count("integer_pow") <= 1  # of the entry that is not known
    assert "cbrt" not in text


def test_constants_in_a_shard_map():
    mesh = jax.make_mesh((2,), ("missions",), axis_types=(jax.sharding.AxisType.Auto,))
    known, spread = np.full((N, 3), 1.5, np.float32), jax.sharding.PartitionSpec("missions")
    every = jax.vmap(lambda x: over_vehicles(lambda p, x: p**3 * x)(known, x))
    args = jnp.stack([x3, -x3])
    sharded = jax.shard_map(every, mesh=mesh, in_specs=spread, out_specs=spread)
    assert_alike(jax.jit(sharded)(args), 3.375 * args)


def test_known_arguments_may_be_none_or_laid_out_on_a_mesh():
    times = over_vehicles(lambda a, x: a * x)
    assert jax.jit(lambda x: times(jnp.zeros(0), x))(jnp.zeros(0)).shape == (0,)
    mesh = jax.make_mesh((1,), ("vehicles",), axis_types=(jax.sharding.AxisType.Explicit,))
    with jax.set_mesh(mesh):
        place = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("vehicles"))
        known, x = (jax.device_put(v, place) for v in (np.arange(4, dtype=np.float32), np.full(4, 2.0, np.float32)))
        assert_alike(jax.jit(lambda x: times(known, x))(x), jnp.arange(4.0) * 2.0)


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
