"""What a program computes, and what decides which executable it finds."""

import gc
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.runtime import programs
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.executables import Executable, Executables
from swarmsim.runtime.programs import Program, prepare, uncollected
from tests.runtime.walking import State, bits, forget, key_of, scaled, start, walk

pytestmark = pytest.mark.usefixtures("folder", "no_cache_of_jax")


def test_computes_the_function() -> None:
    program = Program("scale", scaled(2.0), clock=Clock())
    np.testing.assert_array_equal(program(np.arange(3.0, dtype=np.float32)), [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(program(jnp.ones((2, 1))), [[2.0], [2.0]])
    assert not program(3.0).weak_type
    assert not program(jnp.float32(3.0)).weak_type


def test_compiles_once_for_a_process(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SWARMSIM_CACHE", "0")
    first, second = Clock(), Clock()
    one, other = Program("walk", walk, clock=first), Program("walk", walk, clock=second)
    expected = one(*start())
    one(*start())
    assert bits(other(*start())) == bits(expected)
    assert list(first.compiled) == ["walk"]
    assert not first.loaded
    assert not second.compiled
    assert list(second.loaded) == ["walk"]
    assert not folder.exists()


def test_programs_with_like_static_functions_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each gets its own static fields back, so that its results fit its other arguments."""

    def step(state: State) -> State:
        return State(position=state.act(state.position), key=state.key, act=state.act)

    clock, key = Clock(), jax.random.key(0)
    for fresh in (False, False, True):  # the last as in a later process
        if fresh:
            forget(monkeypatch)
        state = State(position=jnp.ones(3), key=key, act=scaled(2.0))
        moved = Program("step", step, clock=clock)(state)
        np.testing.assert_array_equal(moved.position, [2.0, 2.0, 2.0])
        assert moved.act is state.act
    assert clock.ran
    assert len(clock.compiled) == 1
    clock.reset()
    other = State(position=jnp.ones(3), key=key, act=scaled(3.0))
    np.testing.assert_array_equal(Program("step", step, clock=clock)(other).position, [3.0, 3.0, 3.0])
    assert not clock.loaded


def test_other_values_do_not_compile() -> None:
    clock = Clock()
    program = Program("walk", walk, clock=clock)
    state, empty = start()
    program(state, empty)
    clock.reset()
    program(State(position=state.position + 1.0, key=jax.random.key(7)), empty)
    assert not clock.compiled
    assert not clock.loaded
    assert clock.ran["walk"] == clock.run_s > 0.0


@pytest.mark.parametrize("stored", [False, True])
def test_what_decides_the_program_tells_programs_apart(stored: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SWARMSIM_CACHE", str(int(stored)))
    clock = Clock()
    made = [
        (Program("a", scaled(2.0), clock=clock), jnp.ones(3)),
        (Program("a", scaled(3.0), clock=clock), jnp.ones(3)),
        (Program("b", scaled(2.0), clock=clock), jnp.ones(3)),
        (Program("a", scaled(2.0), identity=("x",), clock=clock), jnp.ones(3)),
        (Program("a", scaled(2.0), donate=(0,), clock=clock), jnp.ones(3)),
        (Program("a", scaled(2.0), clock=clock), jnp.ones(4)),
        (Program("a", scaled(2.0), clock=clock), jnp.ones(3, jnp.int32)),
        (Program("a", scaled(2.0), clock=clock), jnp.ones((3, 1))),
        (Program("a", scaled(2.0), clock=clock), 1.0),
    ]
    keys = {key_of(program, argument) for program, argument in made}
    assert len(keys) == len(made)
    for program, argument in made:
        if stored:
            forget(monkeypatch)
        program(argument)
        assert not clock.loaded
    np.testing.assert_array_equal(made[1][0](jnp.ones(3)), [3.0, 3.0, 3.0])


def test_settings_of_jax_and_xla_tell_programs_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    def key() -> str | None:
        return key_of(Program("a", scaled(2.0), clock=Clock()), 1.0)

    plain = key()
    with jax.default_matmul_precision("bfloat16"):
        assert key() != plain
    with jax.debug_nans(True):
        assert key() != plain
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    assert key() != plain


@pytest.mark.parametrize(
    ("processor", "chosen", "products"), [(False, None, 1), (True, None, 0), (False, "bfloat16", 0)]
)
def test_an_accelerator_multiplies_float32_as_such(
    processor: bool, chosen: str | None, products: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless the user has set another precision; nothing of it stays behind."""
    monkeypatch.setattr(programs, "on_processor", lambda: processor)
    lowered, made = [], programs._machine_code

    def machine_code(program: Any) -> Any:
        lowered.append(program.as_text())
        return made(program)

    monkeypatch.setattr(programs, "_machine_code", machine_code)
    with jax.default_matmul_precision(chosen):
        Program("square", lambda x: x @ x, clock=Clock())(jnp.ones((3, 3)))
    assert lowered[0].count("HIGHEST") == 2 * products  # of either factor
    assert jax.config.values["jax_default_matmul_precision"] is None


@pytest.mark.parametrize("prepared", [False, True])
def test_settings_of_a_context_are_those_of_its_programs(prepared: bool) -> None:
    """Also of what is compiled in the background."""
    program = Program("tenth", lambda x: x + jnp.asarray(0.1), clock=Clock())
    with jax.enable_x64(True):
        x = jnp.ones(3)
        assert x.dtype == jnp.float64
        if prepared:
            prepare([(program, (x,))])
        found = program(x)
    assert found.dtype == jnp.float64
    np.testing.assert_array_equal(found, np.full(3, 1.1))


def test_donated_buffers_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    for _ in range(2):  # compiled, then loaded
        state, empty = start()
        Program("walk", walk, donate=(0,), clock=clock)(state, empty)
        assert state.position.is_deleted()
        assert not empty.is_deleted()
        forget(monkeypatch)
    assert list(clock.loaded) == ["walk"]


def test_prepared_programs_do_not_compile_when_called() -> None:
    clock, traced = Clock(), []

    def noted(factor: float) -> Any:
        def scale(x: jax.Array) -> jax.Array:
            traced.append(factor)
            return x * factor

        return scale

    made = [Program(f"scale {factor}", scaled(factor), clock=clock) for factor in (1.0, 2.0, 3.0)]
    walking = Program("walk", walk, clock=clock)
    once = Program("once", noted(4.0), clock=clock)
    shape = (jax.ShapeDtypeStruct((3,), "float32"),)
    prepare([*((program, shape) for program in made), (walking, jax.eval_shape(start)), (once, shape)])
    assert not clock.ran
    for factor, program in zip((1.0, 2.0, 3.0), made, strict=True):
        np.testing.assert_array_equal(program(jnp.ones(3)), np.full(3, factor))
    walking(*start())
    once(once(jnp.ones(3)))
    assert traced == [4.0]
    assert len(clock.compiled) == 5
    clock.reset()
    prepare([(walking, start()), (once, shape)])
    walking(*start())
    assert not clock.compiled
    assert not clock.loaded


def test_an_error_of_the_function_reaches_the_caller() -> None:
    def wrong(x: jax.Array) -> jax.Array:
        raise ValueError("no such thing")

    program = Program("wrong", wrong, clock=Clock())
    with pytest.raises(ValueError, match="no such thing"):
        program(1.0)
    prepare([(program, (1.0,))])
    with pytest.raises(ValueError, match="no such thing"):
        program(1.0)


def test_the_least_recently_made_executables_are_dropped() -> None:
    kept, made = Executables(most=2), Executable(None, b"")
    for key in ("a", "b", "a", "c"):
        kept.put(key, made)
    assert [kept.get(key) for key in "abc"] == [made, None, made]


def test_a_clock_adds_up_and_copies() -> None:
    clock = Clock()
    clock.add("compiled", "fly", 1.0)
    clock.add("compiled", "fly", 2.0)
    clock.add("loaded", "drive", 0.5)
    clock.add("ran", "fly", 4.0)
    taken = clock.copy()
    clock.reset()
    assert (taken.compile_s, taken.run_s) == (3.5, 4.0)
    assert (clock.compile_s, clock.run_s) == (0.0, 0.0)


def test_the_garbage_collector_is_paused_and_resumed() -> None:
    with uncollected():
        assert not gc.isenabled()
        with uncollected():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()


def test_no_setting_of_jax_is_changed() -> None:
    before = dict(jax.config.values)
    Program("walk", walk, clock=Clock())(*start())
    assert dict(jax.config.values) == before


def test_a_state_that_goes_round_finds_its_program_whatever_it_was_made_of():
    clock = Clock()
    begin = Program("begin", lambda n: jnp.full(3, jnp.inf) if n.ndim == 0 else n, clock=clock)
    go_on = Program("go on", lambda x: x + 1.0, clock=clock)
    state = begin(jnp.zeros(()))
    assert not jax.typeof(state).weak_type
    go_on(go_on(state))
    assert len(go_on._executables) == 1
