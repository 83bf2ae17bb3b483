"""A program as one kernel of a GPU, interpreted here: what it reads and writes, and what is left to XLA."""

from functools import partial

import jax
import jax.numpy as jnp
import pytest
from jax import lax

from swarmsim.scalars import over_vehicles
from tests.control.test_multirotor import params_of
from tests.scalars.mapped import MISSIONS, RASTER, N, assert_alike, numbers, x3
from tests.scalars.test_composed import controlled, fleet

in_kernel = partial(over_vehicles, platform="gpu, interpreted")
LONG = numbers(30, 2, seed=9)  # of every vehicle, too long to be taken apart


def kernels_in(function, *args):
    """How many kernels a function calls."""
    return str(jax.make_jaxpr(function)(*args)).count("pallas_call[")


def looked_up(x, long, shared, raster):
    """Reads at places that are known, and at places that depend on the vehicle."""
    at = jnp.clip(jnp.int32(4.0 * x[0]), 0, 27)
    part = lax.dynamic_slice(long, (at, 0), (2, 2))
    corner = raster[jnp.int32(x[1]) % 20, jnp.int32(x[2]) % 30]
    beyond = raster[jnp.int32(100.0 * x[2]), 3]  # jnp fills what is outside
    return {"part": part, "last": long[-1], "sum": shared @ x, "corner": corner, "beyond": jnp.nan_to_num(beyond)}


def repeated(x, length):
    """A loop within a loop, and a branch that all vehicles share."""

    def inner(carry, _):
        return carry * 0.9 + jnp.sin(x), None

    def outer(carry, _):
        number, value = carry
        value = lax.cond(number % 2 == 0, lambda v: lax.scan(inner, v, None, length)[0], lambda v: v - 1.0, value)
        return (number + 1, value), None

    return lax.scan(outer, (jnp.int32(0), x), None, 20)[0][1]


@pytest.mark.parametrize("function", [partial(repeated, length=3), partial(repeated, length=40)])
def test_loops_and_branches_run_inside(function):
    mapped = in_kernel(function, unroll=1)
    assert kernels_in(mapped, x3) == 1
    assert_alike(jax.jit(mapped)(x3), jax.vmap(function)(x3))


def halved(x):
    """A loop that ends for each vehicle by itself, at once for some; and one within it."""

    def step(carry):
        value, number = carry
        part = lax.while_loop(lambda v: jnp.abs(v[1]) > 0.2, lambda v: 0.7 * v, value)
        return jnp.array([0.5 * value[0], value[1], part[1]]), number + 1

    return lax.while_loop(lambda carry: carry[0][0] > 0.1, step, (x, jnp.int32(0)))


def counted(x):
    """A loop of so many passes for each vehicle, which carries what is alike for all."""
    last = jnp.int32(10.0 * jnp.abs(x[0]))
    return lax.while_loop(lambda c: c[0] < last, lambda c: (c[0] + 1, 2.0 * c[1]), (jnp.int32(0), jnp.float32(1.0)))


@pytest.mark.parametrize("function", [halved, counted])
@pytest.mark.parametrize("times", [1, 30], ids=["a block", "blocks"])
def test_loops_end_for_each_vehicle_by_itself(function, times):
    mapped, many = in_kernel(function), jnp.abs(jnp.tile(x3, (times, 1))) * jnp.linspace(0.1, 3.0, times * N)[:, None]
    assert kernels_in(mapped, many) == 1
    found = jax.jit(mapped)(many)
    assert_alike(found, jax.vmap(function)(many))
    passes = found[1] if function is halved else found[0]
    assert len(set(passes.tolist())) > 2
    assert_alike(jax.jit(jax.vmap(mapped))(MISSIONS), jax.vmap(jax.vmap(function))(MISSIONS))


def test_a_loop_ends_though_what_it_no_longer_needs_is_no_number():
    """The body is evaluated for vehicles that are through: what comes out of it must not reach them."""

    def root(x):
        return lax.while_loop(lambda v: v > 1.0, lambda v: jnp.sqrt(v - 1.0), x)

    values = jnp.array([0.5, 1.5, 100.0, -3.0])
    assert_alike(jax.jit(in_kernel(root))(values), jax.vmap(root)(values))


def in_step(x):
    """Loops that `jax.vmap` makes one, whose test is an array."""
    return jax.vmap(lambda y: lax.while_loop(lambda v: v > 0.2, lambda v: 0.6 * v, y))(x)


def random_walk(x):
    """A loop that carries a key, and uses it."""

    def step(carry):
        key, value = carry
        return jax.random.split(key)[0], 0.5 * value + jax.random.uniform(key)

    return lax.while_loop(lambda carry: carry[1] < x[0], step, (jax.random.key(3), jnp.float32(0.0)))[1]


@pytest.mark.parametrize("function", [in_step, random_walk])
def test_loops_that_no_kernel_has_are_left_to_xla(function):
    assert kernels_in(in_kernel(function), x3) == 0
    for found in (jax.jit(in_kernel(function))(x3), jax.jit(over_vehicles(function))(x3)):
        assert_alike(found, jax.vmap(function)(x3))


def row_of(x, rows):
    """A row too long to be taken apart, at a place of the vehicle's own: read within loops and a branch, and after."""
    row = lax.dynamic_index_in_dim(rows, jnp.int32(3.0 * jnp.abs(x[0])), 0, False)

    def inner(i, value):
        return value + row[i + 2]

    def step(carry):
        return carry[0] + 1, lax.cond(carry[0] % 2 == 0, lambda: 0.5, lambda: row[5]) * lax.fori_loop(
            0, 20, inner, carry[1]
        )

    last = lax.while_loop(lambda c: (c[0] < 4) & (c[1] < 2.0 + row[1]), step, (jnp.int32(0), x[1]))
    return last, row[0], row[jnp.int32(jnp.abs(x[2]))]


def test_parts_of_long_arrays_go_into_loops():
    rows = jnp.asarray(RASTER.repeat(4, axis=1)[:, :100])
    mapped = in_kernel(row_of, (0, None))
    assert kernels_in(mapped, x3, rows) == 1
    assert_alike(jax.jit(mapped)(x3, rows), jax.vmap(row_of, (0, None))(x3, rows))


def of_boolean(x):
    """What Triton has no reduction of."""
    return jnp.max(x > 0.0), lax.reduce_precision(x, 8, 10)


def test_kernels_are_lowered_for_a_gpu():
    """As far as Triton's own language: no GPU is needed for that."""
    rows = jnp.asarray(RASTER.repeat(4, axis=1)[:, :100])
    on_gpu = partial(over_vehicles, platform="gpu")
    for function, *others in ((halved,), (counted,), (keyed,), (row_of, rows), (partial(repeated, length=40),)):
        mapped = on_gpu(function, (0, *(None for _ in others)))
        assert kernels_in(mapped, x3, *others) == 1
        lowered = jax.jit(mapped).trace(x3, *others).lower(lowering_platforms=("cuda",)).as_text()
        assert "triton" in lowered
    assert kernels_in(on_gpu(of_boolean), x3) == 0


def keyed(x):
    """A number and an index in one, by their bits."""
    bits = lax.bitcast_convert_type(jnp.abs(x), jnp.int32)
    return lax.bitcast_convert_type((bits & ~0xFF) | 7, jnp.float32), bits


def test_bits_of_numbers_are_seen_inside():
    assert kernels_in(in_kernel(keyed), x3) == 1
    for found in (jax.jit(in_kernel(keyed))(x3), jax.jit(over_vehicles(keyed))(x3)):
        assert_alike(found, jax.vmap(keyed)(x3), rtol=0.0, atol=0.0)


def test_reads_from_long_arrays_of_vehicles_and_of_all():
    axes = (0, 0, None, None)
    shared = numbers(3, seed=4)[0]
    mapped = in_kernel(looked_up, axes)
    assert kernels_in(mapped, x3, LONG, shared, RASTER) == 1
    assert_alike(
        jax.jit(mapped)(x3, LONG, shared, RASTER), jax.vmap(looked_up, axes)(x3, LONG, shared, jnp.asarray(RASTER))
    )


@pytest.mark.parametrize("own", [(0, 0, 0, None), (0, None, None, None), (0, None, 0, 0), (None, 0, None, None)])
def test_missions_have_arrays_of_their_own_or_share_them(own):
    """Of each mission and vehicle, of each mission, of each vehicle, or of all."""
    axes = (0, 0, None, None)
    arguments = [MISSIONS, jnp.stack([LONG, LONG + 1.0, 2.0 * LONG]), numbers(3, seed=4)[:3], jnp.stack([RASTER] * 3)]
    given = [a if axis == 0 else a[0] for a, axis in zip(arguments, own, strict=True)]
    found, expected = (jax.vmap(f(looked_up, axes), own) for f in (in_kernel, jax.vmap))
    assert kernels_in(found, *given) == 1
    assert_alike(jax.jit(found)(*given), expected(*given))


@pytest.mark.parametrize("size", [1, 31, 33])
def test_threads_beyond_the_last_vehicle_write_nothing(size):
    x = jnp.linspace(-1.0, 1.0, 3 * size).reshape(size, 3)
    assert_alike(jax.jit(in_kernel(jnp.sin))(x), jnp.sin(x))


def test_what_comes_back_is_written_in_place_and_the_argument_is_left_to_its_owner():
    def one(gain, state, step):
        return {"position": state["position"] + gain * step, "flag": ~state["flag"]}, state["position"][0]

    gain, step = numbers(seed=1), numbers(3, seed=2)
    state = {"position": x3, "flag": jnp.arange(N) % 2 == 0}

    def fly(f, state):
        def body(carry, _):
            after, first = f(gain, carry, step)
            return after, first

        return state, lax.scan(body, state, None, 7)

    found, expected = (jax.jit(partial(fly, f))(state) for f in (in_kernel(one, returned=(1,)), jax.vmap(one)))
    assert_alike(found, expected)
    assert "input_output_aliases=((1, 0), (2, 1))" in str(
        jax.make_jaxpr(in_kernel(lambda s: (s, 0.0), returned=(0,)))(state)
    )


def test_a_vehicle_with_its_controller_is_one_kernel():
    params, state, memory, *rest = fleet()
    tick = in_kernel(controlled("analytic"))
    assert kernels_in(tick, params, state, memory, *rest) == 1
    assert params.mass_kg.shape == (N,)
    assert params_of().mass_kg.shape == ()


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x + jax.random.normal(jax.random.key(0), (3,)),
        lambda x: jnp.sort(jnp.tile(x, 40))[:3],
        lambda x: jnp.tile(x, 40),  # a result that is not taken apart
        lambda x: jax.scipy.special.gammaln(jnp.abs(x) + 1.0),
        lambda x: (x.astype(jnp.float16) * jnp.float16(2.0)).astype(jnp.float32),
        lambda x: lax.scan(lambda c, row: (c + row, c), x[0], jnp.tile(x, 10))[0],
    ],
)
def test_what_has_no_form_in_a_kernel_is_left_to_xla(function):
    mapped = in_kernel(function)
    assert kernels_in(mapped, x3) == 0
    assert_alike(jax.jit(mapped)(x3), jax.vmap(function)(x3))
    assert_alike(jax.jit(jax.vmap(mapped))(MISSIONS), jax.vmap(jax.vmap(function))(MISSIONS))
