"""A folder is complete or absent."""

from pathlib import Path

import pytest

from swarmsim.atomic_folder import atomic_folder, folder_above


def anything(target: Path) -> None:
    """Whatever is there may be replaced."""


def only_new(target: Path) -> None:
    """Refuse an existing target."""
    if target.exists():
        raise FileExistsError(target)


def interrupted_write(target: Path, file: Path | None = None, error: type[BaseException] = InterruptedError) -> None:
    """Write the target, and ``file`` besides, and raise ``error`` before the end of the block."""
    with atomic_folder(target, anything) as folder:
        (folder / "new").write_text("new")
        if file is not None:
            file.write_text("theirs")
        raise error


def write_beside_another(target: Path) -> None:
    """Write the target while another process does the same."""
    with atomic_folder(target, only_new):
        target.mkdir()
        (target / "theirs").write_text("theirs")


def content(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_a_new_folder_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b" / "run"
    with atomic_folder(target, only_new) as folder:
        (folder / "one").write_text("1")
        assert not target.exists()
    assert content(tmp_path) == {"a/b/run/one": "1"}
    assert [path.name for path in target.parent.iterdir()] == ["run"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_exception_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error):
        interrupted_write(tmp_path / "a" / "b" / "run", error=error)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_replaced_as_a_whole_or_kept(tmp_path: Path) -> None:
    target = tmp_path / "run"
    target.mkdir()
    (target / "old").write_text("old")
    with pytest.raises(InterruptedError):
        interrupted_write(target)
    assert content(tmp_path) == {"run/old": "old"}
    with atomic_folder(target, anything) as folder:
        (folder / "new").write_text("new")
    assert content(tmp_path) == {"run/new": "new"}
    assert list(tmp_path.iterdir()) == [target]


def test_a_target_is_checked_before_and_after(tmp_path: Path) -> None:
    target = tmp_path / "run"
    with pytest.raises(FileExistsError):
        write_beside_another(target)
    assert content(tmp_path) == {"run/theirs": "theirs"}
    with pytest.raises(FileExistsError), atomic_folder(target, only_new):
        pytest.fail("the block ran")


def test_a_replacement_that_fails_brings_the_old_folder_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "run"
    target.mkdir()
    (target / "old").write_text("old")
    rename = Path.rename

    def fails_for_new(path: Path, to: Path) -> Path:
        if path.name == "new":
            raise OSError("no room")
        return rename(path, to)

    with pytest.raises(OSError, match="no room"), atomic_folder(target, anything):
        monkeypatch.setattr(Path, "rename", fails_for_new)
    assert content(tmp_path) == {"run/old": "old"}
    assert list(tmp_path.iterdir()) == [target]


def test_a_parent_that_others_wrote_into_stays(tmp_path: Path) -> None:
    with pytest.raises(InterruptedError):
        interrupted_write(tmp_path / "a" / "run", tmp_path / "a" / "theirs")
    assert content(tmp_path) == {"a/theirs": "theirs"}


def test_a_file_where_a_folder_above_is_to_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    assert folder_above(tmp_path / "a" / "b" / "c") == tmp_path
    with (
        pytest.raises(NotADirectoryError, match="file' is no folder"),
        atomic_folder(tmp_path / "file" / "a", anything),
    ):
        raise AssertionError
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "kept"
