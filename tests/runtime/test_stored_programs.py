"""Programs in the cache folder: what is stored, what later processes load, and what they do not."""

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.runtime.clock import Clock
from swarmsim.runtime.programs import Program
from tests.runtime.walking import State, bits, forget, start, walk

pytestmark = pytest.mark.usefixtures("folder", "no_cache_of_jax")


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


def test_results_that_cannot_be_pickled_are_not_stored(folder: Path) -> None:
    def make(x: jax.Array) -> State:
        return State(position=x, key=x, act=lambda y: y)

    program = Program("make", make, clock=Clock())
    with pytest.warns(UserWarning, match="program 'make' is compiled anew in every process"):
        made = program(jnp.ones(2))
    assert made.act(5) == 5
    assert list(folder.iterdir()) == []


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
