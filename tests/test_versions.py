"""Versions of what a result depends on."""

import importlib.metadata
import platform
import tomllib
from pathlib import Path

from swarmsim.versions import DISTRIBUTION, NOT_INSTALLED, package_versions


def test_versions_of_installed_and_absent_distributions() -> None:
    found = package_versions(["numpy", "no-such-distribution"])
    assert found["numpy"] == importlib.metadata.version("numpy")
    assert found["python"] == platform.python_version()
    assert found["no-such-distribution"] == NOT_INSTALLED
    assert list(found) == ["python", "swarmsim", "numpy", "no-such-distribution"]


def test_the_distribution_has_the_projects_name_and_version() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert project["name"] == DISTRIBUTION
    assert package_versions([])["swarmsim"] == project["version"]
    assert project["scripts"] == {"swarmsim": "swarmsim.cli:main"}
