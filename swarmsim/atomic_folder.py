"""A folder on disk that is complete or absent, whatever happens while it is written."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_folder(target: Path, check: Callable[[Path], None]) -> Iterator[Path]:
    """An empty folder to write into, which becomes ``target`` when the block ends without an exception.

    ``check(target)`` raises when ``target`` must not be written. It is called before the block, and once more after it,
    because another process may have written ``target`` meanwhile. An existing ``target`` that passes is replaced. On
    any exception, Ctrl-C included, an existing ``target`` stays as it was, and nothing else is left behind.

    The folder lies beside ``target``, so that on one file system the replacement is a rename. Missing parents of
    ``target`` are created.
    """
    target = target.absolute()
    check(target)
    parents = _create_parents(target)
    try:
        with tempfile.TemporaryDirectory(
            prefix=f".{target.name}-", dir=target.parent, ignore_cleanup_errors=True
        ) as work:
            new, old = Path(work) / "new", Path(work) / "old"
            new.mkdir()
            yield new
            check(target)
            _replace(target, new, old)
    except BaseException:
        with suppress(OSError):  # a parent into which another process has written meanwhile stays
            for parent in parents:
                parent.rmdir()
        raise


def _create_parents(target: Path) -> list[Path]:
    """Create the missing parents of ``target``; those created, innermost first."""
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
