"""What tests of programs begin with."""

from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from tests.runtime.walking import forget


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, and a process that has compiled nothing yet."""
    monkeypatch.setenv("SWARMSIM_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("SWARMSIM_CACHE", raising=False)
    forget(monkeypatch)
    return tmp_path / "cache" / "programs"


@pytest.fixture
def no_cache_of_jax() -> Iterator[None]:
    """Programs read from JAX's cache, which the suite has, would not be stored."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()
