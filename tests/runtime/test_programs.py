import gc
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from swarmsim.pytree import pytree, static
from swarmsim.runtime import programs
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.executables import Executable, Executables
from swarmsim.runtime.programs import Program, prepare, uncollected


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, and a process that has compiled nothing yet."""
    monkeypatch.setenv("SWARMSIM_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("SWARMSIM_CACHE", raising=False)
    forget(monkeypatch)
    return tmp_path / "cache" / "programs"


@pytest.fixture(autouse=True)
def no_cache_of_jax() -> Iterator[None]:
    """Programs read from JAX's cache, which the suite has, would not be stored."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drop this process's executables, as a new process would have none."""
    monkeypatch.setattr(programs, "_EXECUTABLES", Executables(most=256))


@pytree
class State:
    position: Any
    key: Any
    act: Any = static(default=jnp.tanh)


def walk(state: State, empty: jax.Array) -> tuple[State, jax.Array, dict[str, Any]]:
    """A step with a random key, a static function, a zero-sized array, None and a dictionary."""
    key, use = jax.random.split(state.key)
    moved = state.act(state.position + jax.random.normal(use, state.position.shape))
    return State(position=moved, key=key, act=state.act), empty, {"none": None, "sum": moved.sum()}


def start() -> tuple[State, jax.Array]:
    return State(position=jnp.arange(4.0), key=jax.random.key(1)), jnp.zeros((0, 3))


def bits(tree: Any) -> list[bytes]:
    def data(leaf: Any) -> np.ndarray:
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    return [data(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def scaled(factor: float) -> Any:
    return lambda x: x * factor


def key_of(program: Program, argument: Any) -> str | None:
    return program._key(*jax.tree.flatten((argument,)))


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


def test_loads_what_an_earlier_process_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    expected = Program("walk", walk, clock=Clock())(*start())
    forget(monkeypatch)
    traced = Program("walk", walk, clock=clock)
    monkeypatch.setattr(jax, "jit", None)  # tracing would fail
    result = traced(*start())
    assert not clock.compiled
    assert bits(result) == bits(expected)
    assert jax.tree.all(jax.tree.map(np.array_equal, result[1:], expected[1:]))  # of the same structure
    assert result[0].act is expected[0].act


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


def test_results_that_cannot_be_pickled_are_not_stored(folder: Path) -> None:
    def make(x: jax.Array) -> State:
        return State(position=x, key=x, act=lambda y: y)

    program = Program("make", make, clock=Clock())
    with pytest.warns(UserWarning, match="program 'make' is compiled anew in every process"):
        made = program(jnp.ones(2))
    assert made.act(5) == 5
    assert list(folder.iterdir()) == []


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


@pytest.mark.parametrize("content", [b"", b"swarmsim program 1\n", None])
def test_a_damaged_entry_is_compiled_anew(content: bytes | None, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = Program("walk", walk, clock=Clock())(*start())
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:-100] if content is None else content)
    forget(monkeypatch)
    clock = Clock()
    assert bits(Program("walk", walk, clock=clock)(*start())) == bits(expected)
    assert list(clock.compiled) == ["walk"]
    forget(monkeypatch)
    Program("walk", walk, clock=clock)(*start())
    assert list(clock.loaded) == ["walk"]  # the damaged entry was replaced


def test_calls_back_into_python_are_not_stored(folder: Path) -> None:
    def call(x: jax.Array) -> jax.Array:
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    program = Program("call", call, clock=Clock())
    with pytest.warns(UserWarning, match="program 'call' is compiled anew in every process"):
        result = program(jnp.ones(2))
    np.testing.assert_allclose(result, np.sin(np.ones(2)), rtol=1e-6)
    assert list(folder.iterdir()) == []


def test_a_function_that_cannot_be_identified_runs_with_a_warning(folder: Path) -> None:
    lock, clock = threading.Lock(), Clock()

    def locked(x: jax.Array) -> jax.Array:
        with lock:
            return x + 1.0

    program = Program("locked", locked, clock=clock)
    with pytest.warns(UserWarning, match="program 'locked' is compiled anew in every process"):
        assert program(1.0) == 2.0
    assert program(2.0) == 3.0
    assert not folder.exists()


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


SEPARATE = """
import hashlib, sys
import swarmsim
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import PartitionSpec
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.executables import Executable, Executables
from swarmsim.runtime.programs import Program

clock, mesh = Clock(), jax.make_mesh((2,), ("m",), axis_types=(jax.sharding.AxisType.Auto,))

def noise(x, keys):
    def part(x, keys): return x + jax.random.normal(keys[0], x.shape), jax.lax.psum(x.sum(), "m")
    spec = PartitionSpec("m")
    return jax.shard_map(part, mesh=mesh, in_specs=(spec, spec), out_specs=(spec, PartitionSpec()))(x, keys)

def decompose(x):
    return jnp.linalg.cholesky(x @ x.T + jnp.eye(3)), jnp.linalg.solve(x + 9 * jnp.eye(3), x)

x, keys = jnp.arange(8.0), jax.random.split(jax.random.key(0), 2)
spread = Program("noise", noise, clock=clock)
first, total = spread(x, keys)
second, _ = spread(first, keys)
elsewhere = Program("elsewhere", lambda x: x + 1, clock=clock)(jax.device_put(x, jax.devices()[1]))
factors = Program("decompose", decompose, clock=clock)(x.repeat(2)[:9].reshape(3, 3))
assert len(first.sharding.device_set) == 2 and elsewhere.devices() == {jax.devices()[1]}
digest = hashlib.sha256()
for leaf in jax.tree.leaves((first, total, second, elsewhere, factors)):
    digest.update(np.asarray(leaf).tobytes())
print(digest.hexdigest())
print("compiled", *clock.compiled)
"""


def separate(**settings: str) -> list[str]:
    """The lines that a process of its own with two devices prints; it must print no errors."""
    done = subprocess.run(
        [sys.executable, "-c", SEPARATE],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "2"} | settings,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_processes_share_programs_of_several_devices_and_of_lapack(folder: Path) -> None:
    plain = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    digest, compiled = separate(**plain)
    assert compiled == "compiled noise elsewhere decompose"
    assert separate(**plain) == [digest, "compiled"]


def test_programs_read_from_jaxs_cache_are_not_stored(tmp_path: Path, folder: Path) -> None:
    cached = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    first = separate(**cached)
    assert len(list(folder.iterdir())) == 4
    shutil.rmtree(folder)
    assert separate(**cached) == first  # compiled from JAX's cache
    assert list(folder.iterdir()) == []


def test_a_state_that_goes_round_finds_its_program_whatever_it_was_made_of():
    clock = Clock()
    begin = Program("begin", lambda n: jnp.full(3, jnp.inf) if n.ndim == 0 else n, clock=clock)
    go_on = Program("go on", lambda x: x + 1.0, clock=clock)
    state = begin(jnp.zeros(()))
    assert not jax.typeof(state).weak_type
    go_on(go_on(state))
    assert len(go_on._executables) == 1
