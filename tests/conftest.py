"""Settings of the whole suite: CPU, a folder of its own for compiled programs, deterministic hypothesis."""

import contextlib
import ctypes
import gc
import os
import signal
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")  # so that the spreading of batches is tested
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # see swarmsim/__init__.py
# Workers share the cores: threads of NumPy's that wait for work by spinning tripled the time of building a mission.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Of the workers and of the programs that tests start: a compiler's millions of small objects are taken from and put
# back on lists of each thread, and not merged with their neighbours at once.
os.environ.setdefault("GLIBC_TUNABLES", "glibc.malloc.tcache_count=65535")
# Most of the suite's time is compilation. Without LLVM's second level, and with the older emitter of loops where there
# is the choice, it takes half as long, and what is tested runs as fast.
# What a loop does not change, and what it carries for nothing, is not looked for either: in loops of many thousand
# operations each of the two took a tenth. Without the second, nor may the number of passes be looked for: XLA 0.10 ends
# the process where it meets a limit that a loop carries along.
_SKIPPED = ("while-loop-invariant-code-motion", "simplify-while-loops", "while-loop-trip-count-annotator")
_FLAGS = ["--xla_backend_optimization_level=1", f"--xla_disable_hlo_passes={','.join(_SKIPPED)}"]
if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):
    _FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(_FLAGS))
_CACHE = Path(os.environ.get("SWARMSIM_TEST_CACHE", Path(tempfile.gettempdir()) / "swarmsim-test-cache"))
os.environ.setdefault("SWARMSIM_CACHE_DIR", str(_CACHE))

# Background jobs of a shell without job control ignore Ctrl-C, those of nohup a closed terminal; and so would the
# programs that tests start.
for _number, _default in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _default)

# the environment is set first
import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from swarmsim.runtime import programs  # noqa: E402

# Files that take long come first, so that no worker is left with one of them at the end. Two workers that meet the same
# programs at once both compile them: files that share theirs (those of `recon` of the first, of one UAV of `recon` of
# the autopilot's) come far apart.
_FIRST = (
    "missions/test_rollout.py",
    "autopilot/test_flight.py",
    "missions/test_program.py",
    "world/test_gradients.py",
    "runtime/test_live.py",
    "autopilot/test_fly.py",
    "autopilot/test_manual_flight.py",
    "estimation/test_localise.py",
    "estimation/test_posterior.py",
    "missions/test_aerial_bound.py",
    "families/test_families.py",
    "autopilot/test_stick_flight.py",
    "experiments/test_enclosures.py",
    "physics/test_skid_steer_gradients.py",
    "autopilot/test_pelican_vehicle.py",
    "world/test_sources.py",
    "radiation/test_identify.py",
    "world/test_collisions.py",
    "world/test_transforms.py",
    "test_readme.py",
)

# Flights in real time, which wait most of the time: one worker more than there are cores does so beside the others.
_WAITING = "tests/autopilot/"

# Files that share what takes long to make stay with one worker.
_SHARING = {
    "tests/estimation/test_pairs.py": "tests/estimation/test_localise.py",
    "tests/estimation/test_further_sources.py": "tests/estimation/test_localise.py",
    "tests/estimation/test_focus.py": "tests/estimation/test_posterior.py",
}

_MAPS = 15_000  # the largest files take as many again
_BYTES = 4e9  # that other processes leave: what JAX keeps within those maps is a gigabyte at most
# Tracing makes millions of objects that live on: collections among them, at the usual 700, took a tenth of the time.
gc.set_threshold(200_000, 50, 50)

settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("deterministic")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Choose between those that are done in minutes and all."""
    parser.addoption("--slow", action="store_true", help="run the tests that take long as well")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave slow tests out, unless they or tests by name are asked for; order the files, the rest as they are."""
    asked = config.getoption("--slow") or config.getoption("-m") or config.getoption("-k")
    if not asked and not any("::" in name for name in config.args):
        slow = [item for item in items if item.get_closest_marker("slow")]
        config.hook.pytest_deselected(items=slow)
        left_out = set(slow)
        items[:] = [item for item in items if item not in left_out]
    folder = Path(__file__).parent
    place = {folder / name: number for number, name in enumerate(_FIRST)}
    missing = [str(path) for path in place if not path.is_file()]
    assert not missing, missing
    items.sort(key=lambda item: place.get(item.path, len(place)))


def pytest_configure() -> None:
    """Workers that compute make way for the one whose flights keep time."""
    worker, count = os.environ.get("PYTEST_XDIST_WORKER", ""), int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if worker and worker != f"gw{count - 1}":
        os.nice(5)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Files go to workers as a whole, those of `_SHARING` together; the last worker has those of `_WAITING` first."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _assign_work_unit(self, node: Any) -> None:
            last = len(self.nodes) > 1 and node.gateway.id == f"gw{len(self.nodes) - 1}"
            preferred = next((file for file in self.workqueue if file.startswith(_WAITING) == last), None)
            if preferred is not None:
                self.workqueue.move_to_end(preferred, last=False)
            super()._assign_work_unit(node)

        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return _SHARING.get(file, file)

    return Scheduling(config, log) if config.getvalue("dist") == "loadfile" else None


@pytest.fixture(autouse=True, scope="module")
def programs_of_a_file(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compile quickly, but for files that compute for long (marked ``optimised``); free the programs afterwards.

    Small ones that JAX keeps, which most files have in common, stay until there is little room for more, or until
    they would be of the other kind.
    """
    quickly = request.node.get_closest_marker("optimised") is None
    if jax.config.values["jax_disable_most_optimizations"] != quickly:
        jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", quickly)
    yield
    programs.forget()
    _return_memory()
    if not _has_room():
        jax.clear_caches()
        gc.unfreeze()
    gc.collect()
    gc.freeze()  # what is left lives on, and is passed over by the next collection
    _return_memory()


def _return_memory() -> None:
    """Give the system what compilers have freed: glibc keeps gigabytes of it, in pieces, and no room would be left."""
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def _has_room() -> bool:
    """Whether another file's programs find room: in memory, and in the 65,530 maps that Linux allows a process.

    Each program takes some maps. What this process holds of the memory says little: most of it is what the allocator
    has on its lists.
    """
    try:
        free = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        maps = Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return False
    return maps < _MAPS and 1024 * int(free["MemAvailable"].split()[0]) > _BYTES
