"""Settings of the whole suite: CPU, a folder of its own for compiled programs, deterministic hypothesis."""

import os
import tempfile
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")  # so that the spreading of batches is tested
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # see swarmsim/__init__.py
_CACHE = Path(os.environ.get("SWARMSIM_TEST_CACHE", Path(tempfile.gettempdir()) / "swarmsim-test-cache"))
os.environ.setdefault("SWARMSIM_CACHE_DIR", str(_CACHE))

from hypothesis import settings  # noqa: E402 - the environment is set first

settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("deterministic")
