"""Reading YAML: scalars of the YAML 1.2 core schema, the lines of values, and writing back."""

import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.config import documents
from swarmsim.config.documents import Document, Mark, dump_yaml, parse_value, read_file, read_text
from swarmsim.config.errors import InputError
from tests.config.mutations import make_mutant


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e3", 1000.0),
        ("-2.5E-3", -0.0025),
        (".5", 0.5),
        ("3.", 3.0),
        ("010", 10),
        ("0x1f", 31),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("yes", "yes"),
        ("off", "off"),
        ("true", True),
        ("False", False),
        ("2024-01-31", "2024-01-31"),
        ("~", None),
        ("", None),
        ("'12'", "12"),
        ("!!str 12", "12"),
        ("!!float 12", 12.0),
        ("[1, [2.0, x]]", [1, [2.0, "x"]]),
        ("{a: {b: 1}}", {"a": {"b": 1}}),
        ("-.inf", float("-inf")),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: Any) -> None:
    read = parse_value(text)
    assert read == value
    assert type(read) is type(value)


def test_each_value_knows_its_line() -> None:
    document = read_text("a: 1\nb:\n  - x: 2\n    y: 3\n  - [4,\n     5]\n", "f.yaml")
    assert document.data == {"a": 1, "b": [{"x": 2, "y": 3}, [4, 5]]}
    lines = {("a",): 1, ("b",): 2, ("b", 0): 3, ("b", 0, "x"): 3, ("b", 0, "y"): 4, ("b", 1): 5, ("b", 1, 1): 6}
    assert {place: document.mark(place) for place in lines} == {p: Mark("f.yaml", n) for p, n in lines.items()}
    assert document.mark(("b", 0, "missing")) == Mark("f.yaml", 3)


def test_an_alias_stands_for_what_it_names() -> None:
    assert read_text("a: &p [1, 2]\nb: *p\n", "f").data == {"a": [1, 2], "b": [1, 2]}


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "bom.yaml"
    path.write_bytes(b"\xef\xbb\xbfname: a\n")
    assert read_file(path).data == {"name": "a"}


words = st.text(st.characters(categories=("L", "N", "P", "S", "Zs")), min_size=1, max_size=8)
numbers = st.integers(-(10**9), 10**9) | st.floats(allow_nan=False)
values = st.recursive(
    st.none() | st.booleans() | numbers | words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=8,
)
tricky = st.sampled_from(["1e3", "010", "yes", "~", "null", "0x1", "1:30", ".5", "+1", "-", "# x", "a: b", "\t", "<<"])


@given(st.dictionaries(st.text("abc", min_size=1), values | tricky, min_size=1, max_size=4))
def test_what_is_written_is_read_back(data: dict[str, Any]) -> None:
    assert read_text(dump_yaml(data), "f").data == data


def test_a_large_document_is_read_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "vehicles:\n" + "".join(f"- {{name: u{i}, type: x500, position_m: [{i}.5, 0]}}\n" for i in range(2500))

    def read() -> tuple[Document, float]:
        started = time.process_time()
        return read_text(text, "f"), time.process_time() - started

    quick, quick_s = read()
    monkeypatch.setattr(documents, "_FastLoader", documents._Loader)
    slow, slow_s = read()
    assert quick == slow
    assert quick_s < 0.5 * slow_s


@pytest.mark.parametrize("seed", range(60))
def test_both_parsers_say_the_same(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """The quick one decides what is right, the other one what is wrong; tabs between words only the quick one takes."""
    text = make_mutant(seed).content.decode("utf-8", "replace").replace("\t", " ")

    def read() -> Document | str:
        try:
            return read_text(text, "f")
        except InputError as error:
            return str(error)

    quick = read()
    monkeypatch.setattr(documents, "_FastLoader", documents._Loader)
    assert quick == read()
