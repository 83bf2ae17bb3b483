import os
from collections.abc import Callable
from pathlib import Path

import pytest

from swarmsim import store

VERSION, KEY, CONTENT = "0123", "abcd", os.urandom(1000)


@pytest.fixture(autouse=True)
def parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWARMSIM_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("SWARMSIM_CACHE", raising=False)
    return tmp_path / "cache"


def entry(parent: Path) -> Path:
    (path,) = (parent / "programs").iterdir()
    return path


def test_entries_are_read_as_written() -> None:
    assert store.read_entry(VERSION, KEY) is None
    assert store.write_entry(VERSION, KEY, CONTENT)
    assert store.read_entry(VERSION, KEY) == CONTENT
    assert store.read_entry("4567", KEY) is None


def test_the_folder_is_the_users_alone(parent: Path) -> None:
    store.write_entry(VERSION, KEY, CONTENT)
    assert (parent / "programs").stat().st_mode & 0o777 == 0o700
    assert entry(parent).stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(
    "damage", [lambda d: d[:-1], lambda d: b"", lambda d: b"x" + d, lambda d: d[:-9] + d[-8:] + b"x"]
)
def test_damaged_entries_count_as_absent(parent: Path, damage: Callable[[bytes], bytes]) -> None:
    store.write_entry(VERSION, KEY, CONTENT)
    path = entry(parent)
    path.write_bytes(damage(path.read_bytes()))
    assert store.read_entry(VERSION, KEY) is None


@pytest.mark.parametrize("mode", [0o770, 0o702])
def test_a_folder_that_others_can_write_is_not_used(parent: Path, mode: int) -> None:
    store.write_entry(VERSION, KEY, CONTENT)
    (parent / "programs").chmod(mode)
    assert store.read_entry(VERSION, KEY) is None
    assert not store.write_entry(VERSION, KEY, CONTENT)


def test_another_users_folder_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    store.write_entry(VERSION, KEY, CONTENT)
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert store.read_entry(VERSION, KEY) is None


def test_the_store_can_be_switched_off(parent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SWARMSIM_CACHE", "0")
    assert store.program_folder() is None
    assert not store.write_entry(VERSION, KEY, CONTENT)
    assert not parent.exists()


def test_a_failed_write_leaves_nothing(parent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    assert not store.write_entry(VERSION, KEY, CONTENT)
    assert list((parent / "programs").iterdir()) == []


def test_a_path_that_is_no_folder_keeps_nothing(parent: Path) -> None:
    parent.write_text("a file")
    assert not store.write_entry(VERSION, KEY, CONTENT)
    assert store.read_entry(VERSION, KEY) is None


def test_the_least_recently_used_go_first(parent: Path) -> None:
    folder = parent / "programs"
    for age, key in enumerate("cba"):
        store.write_entry(VERSION, key, CONTENT)
        os.utime(folder / f"{VERSION}-{key}.program", (1e9 - age, 1e9 - age))
    size = (folder / f"{VERSION}-a.program").stat().st_size
    assert store.read_entry(VERSION, "a") == CONTENT  # now the last used
    store.prune(folder, VERSION, max_bytes=2.5 * size)
    assert sorted(path.name for path in folder.iterdir()) == [f"{VERSION}-a.program", f"{VERSION}-c.program"]


def test_old_entries_of_other_versions_go(parent: Path) -> None:
    folder = parent / "programs"
    for version in (VERSION, "4567", "89ab"):
        store.write_entry(version, KEY, CONTENT)
    for version in (VERSION, "4567"):
        os.utime(folder / f"{version}-{KEY}.program", (1e9, 1e9))
    (folder / "left.tmp").write_bytes(b"of a process that was stopped")
    os.utime(folder / "left.tmp", (1e9, 1e9))
    store.prune(folder, VERSION)
    assert sorted(path.name for path in folder.iterdir()) == [f"{VERSION}-{KEY}.program", f"89ab-{KEY}.program"]
