"""The user's folder of compiled programs, and of tables that take long to compute.

Entries are written whole, read with a checksum, bounded in size. They are unpickled, so they are read from a folder
that only the user can write. Whatever cannot be read or written is treated as absent: the program is then compiled, or
the table computed, with the same result.
"""

import contextlib
import hashlib
import os
import tempfile
import time
import zlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import platformdirs

from swarmsim.config.files import packaged_dir

MAX_BYTES = 2 * 10**9
MAX_AGE_S = 30 * 86400.0  # of entries of other versions of swarmsim
_SUFFIX = ".program"
_MAGIC = b"swarmsim program 1\n"
_CHECKSUM_BYTES = hashlib.sha256().digest_size


@lru_cache
def package_digest() -> str:
    """The digest of swarmsim's sources, and of the tables that programs hold: the version of all that is stored."""
    root, tables = Path(__file__).parent, packaged_dir() / "elements"
    digest = hashlib.sha256()
    for folder, pattern in ((root, "*.py"), (tables, "*.csv")):
        for path in sorted(folder.rglob(pattern)):
            name = f"{path.relative_to(folder).as_posix()}\n{path.stat().st_size}\n"
            digest.update(name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def program_folder() -> Path | None:
    """The folder of compiled programs, made if missing; None where nothing is kept.

    It lies in ``SWARMSIM_CACHE_DIR``, else in the user's cache folder. ``SWARMSIM_CACHE=0`` keeps nothing. A folder
    that belongs to another user, or that others can write, is not used: its entries could run anybody's code.
    """
    if os.environ.get("SWARMSIM_CACHE") == "0":
        return None
    parent = os.environ.get("SWARMSIM_CACHE_DIR") or platformdirs.user_cache_dir("swarmsim")
    folder = Path(parent) / "programs"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder if _is_private(folder) else None
    except OSError:
        return None


def read_entry(version: str, key: str) -> bytes | None:
    """The content stored under a key by a version of swarmsim, None if there is none or it is damaged."""
    folder = program_folder()
    if folder is None:
        return None
    path = folder / _file_name(version, key)
    try:
        data = path.read_bytes()
    except OSError:
        return None
    checksum, packed = data[len(_MAGIC) :][:_CHECKSUM_BYTES], data[len(_MAGIC) + _CHECKSUM_BYTES :]
    if not data.startswith(_MAGIC) or hashlib.sha256(packed).digest() != checksum:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # the time of last use, for `prune`
    return zlib.decompress(packed)


def write_entry(version: str, key: str, content: bytes) -> bool:
    """Store a content under a key, whole or not at all, then `prune`; False where nothing can be stored."""
    folder = program_folder()
    if folder is None:
        return False
    packed = zlib.compress(content, level=1)  # machine code shrinks five times at 150 MB/s
    try:
        handle, temporary = tempfile.mkstemp(dir=folder, suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_MAGIC + hashlib.sha256(packed).digest() + packed)
            os.replace(temporary, folder / _file_name(version, key))
        except BaseException:
            os.unlink(temporary)
            raise
        prune(folder, version)
    except OSError:
        return False
    return True


def prune(folder: Path, version: str, max_bytes: float = MAX_BYTES, max_age_s: float = MAX_AGE_S) -> None:
    """Remove entries of other versions not used for ``max_age_s``, then the least recently used above ``max_bytes``."""
    now, kept = time.time(), []
    for path, status in _files(folder):
        own = path.name.startswith(f"{version}-")
        if not own and now - status.st_mtime > max_age_s:
            path.unlink(missing_ok=True)
        else:
            kept.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in kept)
    for _, size, path in sorted(kept):
        if total <= max_bytes:
            return
        path.unlink(missing_ok=True)
        total -= size


def _file_name(version: str, key: str) -> str:
    return f"{version}-{key}{_SUFFIX}"


def _files(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Entries, and temporary files left behind by processes that were stopped; another process may remove any."""
    for path in folder.iterdir():
        if path.suffix in (_SUFFIX, ".tmp"):
            with contextlib.suppress(FileNotFoundError):
                yield path, path.stat()


def _is_private(folder: Path) -> bool:
    """Whether only this user can write the folder; on Windows the user's profile is private by its access list."""
    if not hasattr(os, "getuid"):
        return True
    status = folder.stat()
    return status.st_uid == os.getuid() and not status.st_mode & 0o022
