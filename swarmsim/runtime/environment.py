"""What decides the machine code of every program, apart from the function and its arguments, as text.

Sources and versions, devices and processor, settings of JAX and XLA.
"""

import importlib.metadata
import os
import platform
import re
from functools import lru_cache
from pathlib import Path

import jax

from swarmsim.store import package_digest

# Packages whose version decides how a function is traced or compiled.
_PACKAGES = (
    "jax", "jaxlib", "jax-cuda12-plugin", "jax-cuda13-plugin", "mujoco", "mujoco-mjx", "numpy", "scipy", "optax"
)  # fmt: skip
# Settings of JAX that do not decide a program: caches, logs, limits and checks of transfers.
_INDIFFERENT = re.compile(
    "cache|log|dump|traceback|pprint|tracer_error|transfer|timeout|thread_guard|garbage|platform|explain|proxy"
)


def settings() -> str:
    """Settings of JAX and XLA that decide programs, as text."""
    ours = sorted((name, value) for name, value in jax.config.values.items() if not _INDIFFERENT.search(name))
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    return f"{ours} {flags}"


@lru_cache
def environment() -> str:
    """Sources, versions, devices and processor, as text."""
    devices = jax.devices()
    backend = devices[0].client
    places = [(device.id, device.device_kind, device.process_index) for device in devices]
    versions = {name: _version(name) for name in _PACKAGES}
    machine = platform.machine(), platform.python_version(), _processor(), _cores()
    return f"{package_digest()} {versions} {backend.platform} {backend.platform_version} {places} {machine}"


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """The processor's model and instruction sets, so that a home folder shared by machines is safe."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    first: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        first.setdefault(name.strip(), value.strip())
    return " ".join(first.get(name, "") for name in ("model name", "flags", "Features", "CPU part"))


def _cores() -> int:
    """Cores open to this process: XLA divides large operations among them when it compiles."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
