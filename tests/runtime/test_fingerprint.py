import enum
import functools
import os
import subprocess
import sys
import threading
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.pytree import pytree, static
from swarmsim.runtime.fingerprint import UnidentifiableError, fingerprint

ACROSS_PROCESSES = """
import functools, jax, jax.numpy as jnp, numpy as np
from swarmsim.runtime.fingerprint import fingerprint
table = np.arange(3.0)
def helper(x): return x * table
def function(x, /, scale=2.0, *, kind=frozenset({"a", "b", "c"})): return jax.vmap(helper)(x) * scale
print(fingerprint((function, jax.vmap(functools.partial(function, scale=3.0)), jax.random.key(1), {"s": {"x", "y"}})))
"""


class Mode(enum.IntFlag):
    ONE = 1
    TWO = 2


@pytree
class Node:
    value: Any
    act: Any = static(default=jnp.tanh)


class Gain:
    def __init__(self, gain: float):
        self.gain = gain

    @functools.cached_property
    def double(self) -> float:
        return 2.0 * self.gain

    def apply(self, x: Any) -> Any:
        return x * self.gain


def defined(source: str) -> Any:
    """The function ``f`` of a source, as a notebook cell defines it: in a module without a file."""
    module = types.ModuleType("cell")
    exec(source, module.__dict__)
    return module.__dict__["f"]


def scaled(factor: Any) -> Any:
    return lambda x: x * factor


def test_values_of_other_content_or_type_differ() -> None:
    values = [
        None, True, 1, 1.0, "1", b"1", -0.0, 0.0, (1,), [1], {1}, {1: 2}, {2: 1}, Mode.ONE, Mode.ONE | Mode.TWO,
        np.zeros(2), np.zeros(2, np.float32), np.zeros((2, 1)), np.ones(2), jax.random.key(0), jax.random.key(1),
        int, float, jnp.sin, jnp.cos, Gain(1.0), Gain(2.0), Gain(1.0).apply, Gain(2.0).apply,
    ]  # fmt: skip
    assert len({fingerprint(value) for value in values}) == len(values)


def test_equal_values_agree() -> None:
    assert fingerprint({"a": np.arange(3), "b": (1, Gain(2.0))}) == fingerprint(
        {"a": np.arange(3), "b": (1, Gain(2.0))}
    )
    assert fingerprint(jnp.arange(3)) == fingerprint(np.arange(3, dtype=np.int32))
    used = Gain(2.0)
    assert used.double == 4.0
    assert fingerprint(used) == fingerprint(Gain(2.0))


def test_a_function_counts_by_what_it_closes_over() -> None:
    assert fingerprint(scaled(2.0)) == fingerprint(scaled(2.0))
    assert fingerprint(scaled(2.0)) != fingerprint(scaled(3.0))
    assert fingerprint(scaled(np.ones(2))) != fingerprint(scaled(np.zeros(2)))
    assert fingerprint(scaled(scaled(1.0))) != fingerprint(scaled(scaled(2.0)))


@pytest.mark.parametrize("wrap", [jax.vmap, jax.jit, jax.grad, lambda f: functools.partial(f, 1.0)])
def test_transformed_functions_count_by_the_function_below(wrap: Any) -> None:
    assert fingerprint(wrap(scaled(2.0))) == fingerprint(wrap(scaled(2.0)))
    assert fingerprint(wrap(scaled(2.0))) != fingerprint(wrap(scaled(3.0)))
    assert fingerprint(jax.vmap(scaled(2.0), in_axes=0)) != fingerprint(jax.vmap(scaled(2.0), in_axes=1))


def test_a_users_function_counts_by_its_code_defaults_and_globals() -> None:
    sources = [
        "def f(x): return x + 1",
        "def f(x): return x + 2",
        "def f(x, y=1): return x + y",
        "def f(x, y=2): return x + y",
        "g = 1\ndef f(x): return x + g",
        "g = 2\ndef f(x): return x + g",
        "def h(x): return x + 1\ndef f(x): return h(x)",
        "def h(x): return x + 2\ndef f(x): return h(x)",
        "class C:\n  def go(self, x): return x + 1\nc = C()\ndef f(x): return c.go(x)",
        "class C:\n  def go(self, x): return x + 2\nc = C()\ndef f(x): return c.go(x)",
        "def h(x): return x + 1\ndef f(x): return (lambda y: h(y))(x)",
        "def h(x): return x + 2\ndef f(x): return (lambda y: h(y))(x)",
    ]
    assert len({fingerprint(defined(source)) for source in sources}) == len(sources)
    assert fingerprint(defined(sources[0])) == fingerprint(defined("# a comment\n\n" + sources[0]))


def test_a_users_module_counts_by_its_source_and_its_imports(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)

    def digest(inner: str) -> str:
        (tmp_path / "inner_module.py").write_text(inner)
        (tmp_path / "outer_module.py").write_text("import inner_module\ndef go(x): return inner_module.go(x)\n")
        for name in ("inner_module", "outer_module"):
            sys.modules.pop(name, None)
        return fingerprint(defined("import outer_module\ndef f(x): return outer_module.go(x)"))

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    first, other = digest("def go(x): return x"), digest("def go(x): return x + 1")
    assert first != other
    assert digest("def go(x): return x") == first


def test_recursion_and_cycles_end() -> None:
    def factorial(n: int) -> int:
        return 1 if n == 0 else n * factorial(n - 1)

    ring: list[Any] = [1]
    ring.append(ring)
    assert fingerprint(factorial) == fingerprint(factorial)
    assert fingerprint(ring) != fingerprint([1, [1]])


def test_tree_structures_count_by_their_static_fields() -> None:
    def structure(act: Any) -> str:
        return fingerprint(jax.tree.structure(Node(value={"a": 1.0}, act=act)))

    assert structure(jnp.tanh) == structure(jnp.tanh)
    assert len({structure(jnp.tanh), structure(jnp.sin), structure(scaled(1.0)), structure(scaled(2.0))}) == 4
    assert fingerprint(jax.tree.structure((1, 2))) != fingerprint(jax.tree.structure([1, 2]))
    assert fingerprint(jax.tree.structure({"a": 1})) != fingerprint(jax.tree.structure({"b": 1}))


@pytest.mark.parametrize("value", [threading.Lock(), (i for i in range(3))])
def test_values_without_content_are_refused(value: Any) -> None:
    with pytest.raises(UnidentifiableError, match="no content that can be compared"):
        fingerprint(scaled(value))


def test_processes_agree() -> None:
    def digest(seed: str) -> str:
        command, settings = [sys.executable, "-c", ACROSS_PROCESSES], os.environ | {"PYTHONHASHSEED": seed}
        return subprocess.run(command, env=settings, capture_output=True, text=True, check=True).stdout

    assert digest("1") == digest("2")
