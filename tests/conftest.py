"""Settings of the whole suite: CPU, a folder of its own for compiled programs, deterministic hypothesis."""

import gc
import os
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")  # so that the spreading of batches is tested
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # see swarmsim/__init__.py
# Most of the suite's time is compilation. Without LLVM's second level, and with the older emitter of loops where there
# is the choice, it takes half as long, and what is tested runs as fast.
_FLAGS = ["--xla_backend_optimization_level=1"]
if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):
    _FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(_FLAGS))
_CACHE = Path(os.environ.get("SWARMSIM_TEST_CACHE", Path(tempfile.gettempdir()) / "swarmsim-test-cache"))
os.environ.setdefault("SWARMSIM_CACHE_DIR", str(_CACHE))

# the environment is set first
import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from swarmsim.runtime import programs  # noqa: E402

settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("deterministic")


@pytest.fixture(autouse=True, scope="module")
def programs_of_a_file(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compile quickly, but for files that compute for long (marked ``optimised``); free the programs afterwards.

    Some hundred of them would use up a process's memory maps.
    """
    jax.config.update("jax_disable_most_optimizations", request.node.get_closest_marker("optimised") is None)
    yield
    programs.forget()
    jax.clear_caches()
    gc.collect()
