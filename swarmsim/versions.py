"""Versions of what a result depends on: Python, swarmsim and other distributions."""

import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version

DISTRIBUTION = "swarmsim-jax"  # name on PyPI, where `swarmsim` belongs to another simulator
NOT_INSTALLED = "not installed"


def package_versions(packages: Iterable[str]) -> dict[str, str]:
    """Version of Python, of swarmsim and of each distribution of ``packages``, by name.

    A distribution that is absent (swarmsim itself when it runs from its source folder) reads "not installed".
    """
    found = {"python": platform.python_version(), "swarmsim": _version(DISTRIBUTION)}
    return found | {name: _version(name) for name in packages if name not in found}


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return NOT_INSTALLED
