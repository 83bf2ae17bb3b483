"""The names of the package: there, documented, and loaded when they are first used."""

import os
import subprocess
import sys

import pytest

import swarmsim


def test_every_public_name_is_there_and_documented() -> None:
    assert sorted(swarmsim._PLACES) == swarmsim.__all__ == sorted(swarmsim.__all__)
    for name in swarmsim.__all__:
        assert (getattr(swarmsim, name).__doc__ or "").strip(), name


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Stepper'"):
        swarmsim.Stepper  # noqa: B018


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = "import sys, swarmsim; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not set(result.stdout.split()) & {"jax", "numpy", "mujoco", "pydantic"}


LOOP = """
import os
import swarmsim, jax
import jax.numpy as jnp
def turn(x, _): return jnp.sin(x) + jnp.sum(x * x) * x[::-1], None
loop = jax.jit(lambda x: jax.lax.scan(turn, x, None, length=1000)[0]).lower(jnp.ones(500)).compile()
print("xla_cpu_small_call" in loop.as_text(), os.environ["XLA_FLAGS"])
"""


@pytest.mark.parametrize(
    ("flags", "one_function"),
    [
        ("", True),
        ("--xla_cpu_enable_fast_math=false", True),
        ("--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1", False),
    ],
)
def test_a_cpu_runs_a_loop_as_one_function_unless_told_otherwise(flags: str, one_function: bool) -> None:
    variables = os.environ | {"XLA_FLAGS": flags}
    result = subprocess.run([sys.executable, "-c", LOOP], capture_output=True, text=True, check=True, env=variables)
    found, *kept = result.stdout.split()
    assert found == str(one_function)
    assert set(flags.split()) <= set(kept)


def test_the_public_names_are_offered_for_completion():
    assert set(swarmsim.__all__) <= set(dir(swarmsim))
