"""Where configuration files are: the working folder's ``configs`` first, then those that the package carries."""

import os
from collections.abc import Iterable
from pathlib import Path

from swarmsim.config.errors import InputError
from swarmsim.config.names import did_you_mean, one_of

KINDS = ("vehicles", "sites", "missions", "detectors", "sensors", "nuclides", "materials")
SHOWN = 60  # characters of what is no name
_SUFFIXES = (".yaml", ".yml")


def packaged_dir() -> Path:
    """The configurations that the package carries: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "_configs"
    return installed if installed.is_dir() else package.parent / "configs"


def config_dirs(near: Path | None = None) -> list[Path]:
    """Folders that are searched, first come first served.

    They are the ``configs`` folder that the file ``near`` lies in (the parent of its ``missions``, ``vehicles`` …)
    unless it is the packaged one, the ``configs`` of the working folder, and the packaged ones.
    """
    found: list[Path] = []
    if near is not None:
        parents = near.absolute().parents
        found += [parents[i + 1] for i in range(min(2, len(parents) - 1)) if parents[i].name in KINDS]
        found = [folder for folder in found if resolved(folder) != packaged_dir()]
    found += [folder for folder in (Path.cwd() / "configs", packaged_dir()) if folder.is_dir()]
    unique: dict[Path, Path] = {}
    for folder in found:
        unique.setdefault(resolved(folder), folder)
    return list(unique.values())


def available(kind: str, near: Path | None = None) -> dict[str, Path]:
    """Names of a kind (one of `KINDS`) and their files, sorted by name; an earlier folder hides a later one."""
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {KINDS}, not {kind!r}")
    found: dict[str, Path] = {}
    for folder in config_dirs(near):
        if kind == "sites":
            named = [(path.parent.name, path) for path in (folder / kind).glob("*/site.yaml")]
        else:
            named = [(path.stem, path) for path in (folder / kind).glob("*") if path.suffix in _SUFFIXES]
        for name, path in named:
            found.setdefault(name, path)
    return dict(sorted(found.items()))


def resolved(path: Path) -> Path:
    """``path`` absolute and without links; as far as it goes where links lead in a circle."""
    return Path(os.path.realpath(path))


def exists(path: Path) -> bool:
    """Whether ``path`` exists; not where no file could have that name (too long, a character that is not allowed)."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _is_link(path: Path) -> bool:
    """Whether ``path`` is a symbolic link, to whatever."""
    try:
        return path.is_symlink()
    except OSError:
        return False


def is_file(path: Path) -> bool:
    """Whether ``path`` is a regular file; not where no file could have that name."""
    return exists(path) and path.is_file()


def listing(folder: Path, pattern: str) -> list[Path]:
    """What matches ``pattern`` in a folder; nothing where there is no such folder or it cannot be read."""
    try:
        return list(folder.glob(pattern))
    except (OSError, ValueError):
        return []


def looks_like_path(name: str) -> bool:
    """Whether ``name`` is meant as a path (it has a folder or a YAML suffix) rather than as a configuration's name."""
    return "/" in name or "\\" in name or Path(name).suffix in _SUFFIXES


def find(kind: str, name: str | Path, near: Path | None = None) -> Path:
    """The file of configuration ``name`` of a kind; a path to a file works too (a folder with ``site.yaml`` for sites).

    Raises `InputError` with the nearest names when there is none.
    """
    if not isinstance(name, str | os.PathLike):
        what, allowed = kind.removesuffix("s"), "a text or a pathlib.Path"
        raise InputError.of(f"a {what} is named by a text or a path", given=repr(name)[:SHOWN], allowed=allowed)
    path = Path(name)
    if not isinstance(name, str) or looks_like_path(name):
        if kind == "sites" and is_file(path / "site.yaml"):
            return path / "site.yaml"
        if exists(path):
            return path
    known = available(kind, near)
    if str(name) in known:
        return known[str(name)]
    if kind != "sites" and exists(path) and not is_file(path):
        return path  # a folder, a pipe: whoever reads it says what it is
    if _is_link(path):
        raise InputError.of(
            f"'{name}' is a link to nothing", given=str(name), suggestion="mend the link, or name a file"
        )
    raise InputError.of(
        f"there is no {'file' if looks_like_path(str(name)) else kind.removesuffix('s')} '{name}'",
        given=str(name),
        allowed=f"{one_of(known)}; or the path of a file",
        suggestion=_meant(str(name), path, known),
    )


def _meant(name: str, path: Path, known: Iterable[str]) -> str | None:
    """A hint to what is meant by a ``name`` that names nothing: a file beside its ``path``, or one of the ``known``."""
    if looks_like_path(name):
        beside = [p for p in listing(path.parent, "*") if p.suffix in _SUFFIXES and is_file(p)]
        return did_you_mean(name, sorted(str(path.parent / p.name) for p in beside))
    return f"if the file is meant, write './{name}'" if is_file(path) else did_you_mean(name, known)
