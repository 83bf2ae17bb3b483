"""Where a run may be written."""

import tempfile
from contextlib import AbstractContextManager
from pathlib import Path

from swarmsim.config.errors import InputError, file_errors_told
from swarmsim.results.names import SCENARIO, SUMMARY


def check_out(out: Path, force: bool) -> None:
    """Raise `InputError` unless a run can be written to ``out``.

    It can where there is nothing yet or an empty folder and, with ``force``, in place of an earlier run. A folder that
    holds anything else is never replaced.
    """
    with told_of(out):
        _check(out, force)


def told_of(out: Path) -> AbstractContextManager[None]:
    """Turn errors of the file system, such as a full disk, into an `InputError` about ``out``."""
    return file_errors_told("the results cannot be written there", path="--out", given=str(out))


def _check(out: Path, force: bool) -> None:
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise InputError.of(
            "there is something else than a folder where the results should go", path="--out", given=str(out)
        )
    if out.is_dir() and any(out.iterdir()):
        if not ((out / SUMMARY).is_file() and (out / SCENARIO).is_file()):
            raise InputError.of(
                f"the folder holds something else than a run, and is not replaced (no {SUMMARY} and {SCENARIO} in it)",
                path="--out",
                given=str(out),
                suggestion="choose another folder with --out",
            )
        if not force:
            hint = "choose another folder with --out, or replace them with --force"
            raise InputError.of("there are results already", path="--out", given=str(out), suggestion=hint)
    parent = next(p for p in out.absolute().parents if p.exists())
    if not parent.is_dir():
        raise InputError.of("the results cannot be written there", path="--out", given=str(out))
    with tempfile.TemporaryDirectory(prefix=".", dir=parent):
        pass  # permissions do not tell everything: a folder may lie in a file system that takes no files
