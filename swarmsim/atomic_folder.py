"""A folder on disk that is complete or absent, whatever happens while it is written, and written by one at a time."""

import errno
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from swarmsim.config.errors import InputError

_MARK = ".swarmsim-"  # in the names of work folders
_LOCK = "lock"  # in a work folder; locked as long as the process lives that made it
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # of a file system that has none
_held: dict[Path, tuple[int, Path]] = {}  # target -> thread, work folder


@contextmanager
def atomic_folder(target: Path, check: Callable[[Path], None]) -> Iterator[Path]:
    """An empty folder to write into, which becomes ``target`` when the block ends without an exception.

    ``check(target)`` raises when ``target`` must not be written. It is called before the block, and once more after it,
    because another process may have written ``target`` meanwhile. An existing ``target`` that passes is replaced. On
    any exception, Ctrl-C included, an existing ``target`` stays as it was, and nothing else is left behind.

    The folder lies beside ``target``, so that on one file system the replacement is a rename. Missing parents of
    ``target`` are created. Raises `InputError` as `claimed` does.
    """
    target = target.absolute()
    check(target)
    with claimed(target) as work:
        new, old = work / "new", work / "old"
        try:
            new.mkdir()
            yield new
            check(target)
            _replace(target, new, old)
        finally:
            for rest in (new, old):
                shutil.rmtree(rest, ignore_errors=True)


@contextmanager
def claimed(target: Path) -> Iterator[Path]:
    """Keep other processes from writing ``target`` during the block; yields a work folder beside it.

    The same thread may claim ``target`` again within the block. Work folders that lie beside it and whose process has
    died are removed. Raises `InputError` where another process, or another thread, has claimed ``target``. Missing
    parents of ``target`` are created, and removed again when the block ends with an exception.
    """
    if "\0" in str(target):
        raise InputError.of("no folder can have a name with a null character", given=str(target))
    target = target.absolute()
    thread, held = _held.get(target, (None, None))
    if held is not None and thread == threading.get_ident():
        yield held
        return
    parents = _create_parents(target)
    try:
        _refuse_another(target)
        prefix = f".{target.name[:100]}{_MARK}"
        with tempfile.TemporaryDirectory(prefix=prefix, dir=target.parent, ignore_cleanup_errors=True) as name:
            work = Path(name)
            with _locked(work, target):
                _refuse_another(target, work)
                _held[target] = (threading.get_ident(), work)
                try:
                    yield work
                finally:
                    del _held[target]
    except BaseException:
        with suppress(OSError):  # a parent into which another process has written meanwhile stays
            for parent in parents:
                parent.rmdir()
        raise


def _refuse_another(target: Path, own: Path | None = None) -> None:
    """Raise `InputError` when another one than ``own`` has claimed ``target``; remove folders of dead processes."""
    for lock in target.parent.glob(f".*{_MARK}*/{_LOCK}"):
        if lock.parent == own:
            continue
        with suppress(OSError), lock.open("rb") as file:
            if _lock(file):
                shutil.rmtree(lock.parent, ignore_errors=True)
                continue
            process, _, name = file.read().decode("utf-8", "replace").partition("\n")
            if name == target.name:
                raise InputError.of(
                    f"another run is being written there (process {process})",
                    given=str(target),
                    suggestion="wait for its end, or choose another folder",
                )


@contextmanager
def _locked(work: Path, target: Path) -> Iterator[None]:
    """A file in ``work`` that tells that its process lives. It appears under its name only when it is locked."""
    with (work / "unlocked").open("w+b") as file:
        file.write(f"{os.getpid()}\n{target.name}".encode("utf-8", "replace"))
        file.flush()
        _lock(file)
        (work / "unlocked").rename(work / _LOCK)
        yield


def _lock(file: BinaryIO) -> bool:
    """Lock an open file until it is closed; False where somebody else holds it, or the file system has no locks."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK, errno.EDEADLK, *_NO_LOCKS):
            return False
        raise
    return True


def folder_above(target: Path) -> Path:
    """The nearest folder above ``target`` that exists; raises `NotADirectoryError` where a file stands there."""
    parent = next(parent for parent in target.absolute().parents if parent.exists())
    if not parent.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, f"'{parent}' is no folder")
    return parent


def _create_parents(target: Path) -> list[Path]:
    """Create the missing parents of ``target``; those created, innermost first."""
    folder_above(target)
    missing = [parent for parent in target.parents if not parent.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    return missing


def _replace(target: Path, new: Path, old: Path) -> None:
    """Rename ``new`` to ``target``, with an existing ``target`` moved to ``old`` and restored when that fails."""
    try:
        if target.exists():
            target.rename(old)
        new.rename(target)
    except BaseException:
        if old.exists() and not target.exists():
            old.rename(target)
        raise
