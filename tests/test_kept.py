"""Results that are kept in this process, and stored for others."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import swarmsim
from swarmsim import kept as module
from swarmsim import store
from swarmsim.config.load import load_all
from swarmsim.kept import kept, stored
from swarmsim.pytree import on_device, pytree, static
from swarmsim.radiation.detector import KINDS
from swarmsim.world.build import library_of


@pytree
class Table:
    values: jax.Array
    numbers: jax.Array
    name: str = static()


@dataclass(frozen=True)
class Asked:
    name: str
    factors: tuple[float, ...]


@pytest.fixture(autouse=True)
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWARMSIM_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("SWARMSIM_CACHE", raising=False)
    return tmp_path / "programs"


def counting() -> tuple[list[Asked], Any]:
    """The calls of a function, and that function."""
    calls: list[Asked] = []

    def table(asked: Asked, *, scale: float = 1.0) -> Table:
        calls.append(asked)
        values = scale * np.array(asked.factors)
        return Table(values=on_device(values), numbers=on_device(len(values), np.int32), name=asked.name)

    return calls, table


def assert_same(one: Table, other: Table) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert isinstance(b, jax.Array)
        assert (a.dtype, a.weak_type, a.committed) == (b.dtype, b.weak_type, b.committed)
        np.testing.assert_array_equal(a, b)


def test_the_last_results_are_kept() -> None:
    calls, table = counting()
    keeping = kept(2)(table)
    first, second, third = (Asked(name, (1.0, 2.0)) for name in "abc")
    assert keeping(first) is keeping(first)
    for one in (second, third, first, first):
        keeping(one)
    assert calls == [first, second, third, first]


def test_a_later_process_reads_what_was_stored(programs: Path) -> None:
    calls, table = counting()
    asked = Asked("a", (1.0, 0.1))
    made = stored()(table)(asked, scale=3.0)
    assert len(list(programs.iterdir())) == 1
    assert_same(made, stored()(table)(asked, scale=3.0))
    assert len(calls) == 1


OTHERS = [(Asked("b", (1.0, 0.1)), 3.0), (Asked("a", (1.0, 0.10000000000000002)), 3.0), (Asked("a", (1.0, 0.1)), 1.0)]


@pytest.mark.parametrize("other", OTHERS)
def test_other_arguments_are_another_entry(other: tuple[Asked, float]) -> None:
    calls, table = counting()
    storing = stored()(table)
    storing(Asked("a", (1.0, 0.1)), scale=3.0)
    storing(other[0], scale=other[1])
    assert len(calls) == 2


def test_other_sources_and_other_files_are_another_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, table = counting()
    asked, data = Asked("a", (1.0,)), tmp_path / "data"
    (data / "elements").mkdir(parents=True)
    file = data / "elements" / "a.csv"
    file.write_text("1", encoding="utf-8")
    monkeypatch.setattr(module, "packaged_dir", lambda: data)

    def call() -> None:
        module._content.cache_clear()
        stored(reads=("elements",))(table)(asked)

    call()
    call()
    assert len(calls) == 1
    file.write_text("2", encoding="utf-8")
    call()
    assert len(calls) == 2
    monkeypatch.setattr(module, "package_digest", lambda: "another")
    call()
    assert len(calls) == 3
    module._content.cache_clear()


@pytest.mark.parametrize("content", [b"", b"no pickle"])
def test_what_cannot_be_read_is_computed(content: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, table = counting()
    monkeypatch.setattr(module, "read_entry", lambda version, key: content)
    stored()(table)(Asked("a", (1.0,)))
    assert len(calls) == 1


def test_nothing_is_stored_where_the_user_wants_none(programs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SWARMSIM_CACHE", "0")
    calls, table = counting()
    for _ in range(2):
        stored()(table)(Asked("a", (1.0,)))
    assert len(calls) == 2
    assert not programs.exists()


def test_a_result_that_depends_on_something_unknown_is_refused() -> None:
    with pytest.raises(TypeError, match="ndarray cannot be stored"):
        stored()(lambda values: values)(np.zeros(3))


def test_every_shipped_detector_has_a_text_of_its_own() -> None:
    scenario = swarmsim.load("recon")
    library = library_of(scenario)
    mounts = [spec.detector for spec in scenario.vehicles if spec.detector is not None]
    texts = [
        module._text((spec, mounts[0], library, kind)) for spec in load_all("detectors").values() for kind in KINDS
    ]
    assert len(set(texts)) == len(texts) >= 2 * len(load_all("detectors"))
    assert len({module._text(mount) for mount in mounts}) >= 2


def test_another_table_is_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs hold the tables of ``elements`` as constants."""
    monkeypatch.setattr(store, "packaged_dir", lambda: tmp_path)
    (tmp_path / "elements").mkdir()
    versions = []
    for text in ("name,1.0\n", "name,1.5\n", "name,1.0\n"):
        (tmp_path / "elements" / "walls.csv").write_text(text, encoding="utf-8")
        versions.append(store.package_digest.__wrapped__())
    assert versions[0] == versions[2] != versions[1]
