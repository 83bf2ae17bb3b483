"""Where a run may be written, and where its results are kept when that fails."""

import fnmatch
import shutil
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from swarmsim.atomic_folder import folder_above
from swarmsim.config.errors import InputError, file_errors_told
from swarmsim.results import names

SPACE_BYTES = 100_000_000  # several times the largest of the shipped missions' runs


@dataclass(frozen=True)
class Content:
    """What a folder holds that a command has written, and may replace."""

    what: str  # with its article
    files: tuple[str, ...] = ()  # which together tell it
    nothing_but: tuple[str, ...] = ()  # patterns of names: a folder in which all match one is told by that

    def fills(self, folder: Path) -> bool:
        """Whether a folder is one of these."""
        if self.files and all((folder / name).is_file() for name in self.files):
            return True
        return all(path.is_file() and self._matches(path.name) for path in folder.iterdir())

    def _matches(self, name: str) -> bool:
        return any(fnmatch.fnmatchcase(name, pattern) for pattern in self.nothing_but)


# A flight that gave up before it had measured anything leaves no run, only what was flown.
RUN = Content(
    "a run",
    (names.SUMMARY, names.SCENARIO),
    (names.FLOWN, names.FLIGHT, *(names.FLIGHT_LOG + suffix for suffix in names.FLIGHT_LOGS)),
)
READ_LOG = Content("a log's results", (names.LOG,))
EXPORT = Content("an export", nothing_but=(f"*{names.N42}",))


def check_folder(out: Path, force: bool, content: Content) -> None:
    """Raise `InputError` unless ``out`` can be made, or is empty, or with ``force`` holds what may be replaced.

    The one rule for the folders of all results: what a folder holds that no command of ours has written stays.
    """
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise InputError.of(
            "there is something else than a folder where the results should go", path="--out", given=str(out)
        )
    if not out.is_dir() or not any(out.iterdir()):
        return
    if not content.fills(out):
        lacks = f" (no {' and '.join(content.files)} in it)" if content.files else ""
        raise InputError.of(
            f"the folder holds something else than {content.what}, and is not replaced{lacks}",
            path="--out",
            given=str(out),
            suggestion="choose another folder with --out",
        )
    if not force:
        raise InputError.of(
            f"there are results already, {content.what}",
            path="--out",
            given=str(out),
            suggestion="choose another folder with --out, or replace them with --force",
        )


def check_out(out: Path, force: bool) -> None:
    """Raise `InputError` unless a run can be written to ``out``.

    It can where there is nothing yet or an empty folder and, with ``force``, in place of an earlier run. A folder that
    holds anything else is never replaced.
    """
    with told_of(out):
        _check(out, force)


def check_space(out: Path) -> None:
    """Raise `InputError` unless there is room for the files of a run at ``out``."""
    with told_of(out):
        parent = next(p for p in out.absolute().parents if p.exists())
        free = shutil.disk_usage(parent).free
    if free < SPACE_BYTES:
        raise InputError.of(
            "there is too little room on the disk for the results",
            path="--out",
            given=f"{free / 1e6:.0f} MB free at {out}",
            allowed=f"at least {SPACE_BYTES / 1e6:.0f} MB",
            suggestion="make room, or choose another folder with --out",
        )


def keep_elsewhere(write: Callable[[Path], int], whole: int, name: str) -> Path | None:
    """A new folder in a temporary place with what ``write(folder)`` saves; None where nothing can be kept.

    ``write`` says how many parts of ``whole`` it saved. The folder for temporary files, the user's own folder and the
    memory are tried, those with room first, until one takes everything; the folder with most is kept.
    """
    places = [Path(tempfile.gettempdir()), Path("~").expanduser(), Path("/dev/shm")]
    room = {place: shutil.disk_usage(place).free for place in places if place.is_dir()}
    saved: dict[Path, int] = {}
    for place in sorted(room, key=lambda place: room[place] < SPACE_BYTES):
        try:
            folder = Path(tempfile.mkdtemp(prefix=f"swarmsim-{name[:100]}-", dir=place))
        except OSError:
            continue
        saved[folder] = write(folder)
        if saved[folder] == whole:
            break
    best = max(saved, key=lambda folder: saved[folder], default=None)
    for folder, count in saved.items():
        if folder != best or count == 0:
            shutil.rmtree(folder, ignore_errors=True)
    return best if best is not None and saved[best] > 0 else None


def told_of(out: Path) -> AbstractContextManager[None]:
    """Turn errors of the file system, such as a full disk, into an `InputError` about ``out``."""
    hint = "choose another folder with --out"
    return file_errors_told("the results cannot be written there", path="--out", given=str(out), suggestion=hint)


def _check(out: Path, force: bool) -> None:
    check_folder(out, force, RUN)
    with tempfile.TemporaryDirectory(prefix=".", dir=folder_above(out)):
        pass  # permissions do not tell everything: a folder may lie in a file system that takes no files
