"""The names of the package: there, documented, and loaded when they are first used."""

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
