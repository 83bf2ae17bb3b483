"""The project folder that the tests of configuration work in."""

from pathlib import Path

import pytest

from tests.config.project import make_project


@pytest.fixture
def mission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """recon.yaml in a project of its own, which is the working folder."""
    path = make_project(tmp_path)
    monkeypatch.chdir(tmp_path)
    return path
