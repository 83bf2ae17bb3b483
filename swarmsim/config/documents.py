"""YAML read into plain data that remembers the file and line of each value.

Scalars follow the YAML 1.2 core schema: only ``true`` and ``false`` are booleans (``yes``, ``on`` are words), ``1e3``
is a number, ``010`` is ten and ``1:30`` is a word, so that no number changes behind a user's back.
"""

import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, cast

import yaml

from swarmsim.config.errors import InputError, Problem

Place = tuple[str | int, ...]

SIZE_MAX_BYTES = 1_000_000
VALUES_MAX = 30_000  # names of fields included; more than a team of 2000 vehicles, read in a tenth of a second
DEPTH_MAX = 32
FIELD_NAME_MAX = 200
DIGITS_MAX = 18  # of a whole number: fits 64 bits
_TAG = "tag:yaml.org,2002:"
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_INT = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_CORE: tuple[tuple[str, re.Pattern[str], list[str]], ...] = (  # kind, what it looks like, how it may begin
    ("null", re.compile(r"~|null|Null|NULL|"), [*"~nN", ""]),
    ("bool", re.compile(r"true|True|TRUE|false|False|FALSE"), [*"tTfF"]),
    ("int", re.compile(rf"(?:{_INT.pattern})$"), [*"-+0123456789"]),
    ("float", re.compile(rf"(?:{_FLOAT.pattern})$"), [*"-+.0123456789"]),
)


class Mark(NamedTuple):
    """Where a value stands: the file, and the line counted from 1 (None for an override)."""

    file: str
    line: int | None


@dataclass
class Document:
    """Plain data of a YAML file and the `Mark` of each value by its place, e.g. ``("sources", 0, "nuclide")``."""

    data: dict[str, Any]
    marks: dict[Place, Mark] = field(default_factory=dict)
    files: tuple[Path, ...] = ()

    def mark(self, place: Place) -> Mark | None:
        """Mark of the value at ``place``, or of the nearest thing around it."""
        for length in range(len(place), -1, -1):
            if place[:length] in self.marks:
                return self.marks[place[:length]]
        return None

    def problem(self, place: Place, message: str, **details: str | None) -> Problem:
        """A `Problem` about the value at ``place``."""
        mark = self.mark(place)
        file, line = mark if mark is not None else (None, None)
        return Problem(message=message, file=file, line=line, path=dotted(place) or None, **details)

    def replace(self, place: Place, marks: dict[Place, Mark]) -> None:
        """Forget the marks at and below ``place`` and take ``marks`` in their stead."""
        depth = len(place)
        self.marks = {p: m for p, m in self.marks.items() if p[:depth] != place} | marks


def dotted(place: Place) -> str:
    """``sources.0.nuclide``."""
    return ".".join(map(str, place))


def other_key(value: Any, place: tuple[Any, ...] = ()) -> tuple[Any, ...] | None:
    """Place of a field in ``value`` whose name is no text, with that name at its end; None where all are."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list | tuple) else ()
    for key, inner in items:
        if isinstance(value, dict) and not isinstance(key, str):
            return (*place, key)
        if (found := other_key(inner, (*place, key))) is not None:
            return found
    return None


class _Loader(yaml.SafeLoader):
    """Composes nodes with the scalars of the YAML 1.2 core schema; its errors are the ones that users are told."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


class _LimitError(Exception):
    """A document exceeds a limit: the message, what is allowed, and the line."""


_TOO_MANY = ("holds too many values", f"at most {VALUES_MAX}")
_TOO_DEEP = ("is nested too deeply", f"at most {DEPTH_MAX} levels of fields and lists")


class _FastLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Composes the same nodes nine times as fast where PyYAML was built with libyaml, as its wheels are."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers


class _Dumper(yaml.SafeDumper):
    """Quotes whatever either version of YAML would take for something else than a string."""


for _kind, _pattern, _first in _CORE:
    _anchored = re.compile(rf"^(?:{_pattern.pattern})$")
    _Loader.add_implicit_resolver(_TAG + _kind, _anchored, _first)
_Dumper.add_implicit_resolver(_TAG + "float", re.compile(rf"^(?:{_FLOAT.pattern})$"), list("-+.0123456789"))
_Dumper.add_implicit_resolver(_TAG + "int", re.compile(rf"^(?:{_INT.pattern})$"), list("-+0123456789"))


def dump_yaml(data: Any) -> str:
    """``data`` as YAML that `read_text` reads back to the same values; short lists stand on one line."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=118, default_flow_style=None)


def beginning(value: Any, items: int = 50, characters: int = 200) -> Any:
    """The first ``items`` of ``value`` and of what is in it, and ``characters`` of each text: quick to write out."""
    if isinstance(value, dict):
        return {key: beginning(inner, items, characters) for key, inner in islice(value.items(), items)}
    if isinstance(value, list):
        return [beginning(inner, items, characters) for inner in value[:items]]
    return value[:characters] if isinstance(value, str) else value


def read_file(path: Path) -> Document:
    """The mapping that a YAML file holds. Raises `InputError` when it cannot be read as one."""
    shown = shown_path(path)
    if path.is_dir():
        raise InputError.of("is a folder, not a file", file=shown, suggestion="name the YAML file in it")
    allowed = f"a YAML file of at most {SIZE_MAX_BYTES / 1e6:g} MB"
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):  # reading a pipe or a device may never end
            raise InputError.of("is not a regular file (a pipe, a device or a socket)", file=shown, allowed=allowed)
        with path.open("rb") as stream:
            raw = stream.read(SIZE_MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        raise InputError.of(f"cannot be read: {getattr(error, 'strerror', None) or error}", file=shown) from error
    if len(raw) > SIZE_MAX_BYTES:
        size = f"{max(about.st_size, len(raw)) / 1e6:.1f} MB"
        raise InputError.of("is too large for a configuration file", file=shown, given=size, allowed=allowed)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise InputError.of(
            "is not UTF-8 text", file=shown, line=line, given=f"byte 0x{raw[error.start]:02x}", allowed="text in UTF-8"
        ) from error
    document = read_text(text, shown)
    document.files = (path,)
    return document


def shown_path(path: Path) -> str:
    """``path`` as a user would write it: relative to the working folder where it lies below it."""
    absolute, here = path.absolute(), Path.cwd()
    return str(absolute.relative_to(here)) if absolute.is_relative_to(here) else str(absolute)


def read_text(text: str, file: str) -> Document:
    """The mapping written in ``text``; ``file`` is the name used in messages."""
    node = _compose(text, file)
    if node is None:
        raise InputError.of("is empty", file=file, allowed="a mapping of fields to values (name: value)")
    if not isinstance(node, yaml.MappingNode):
        kind = "a list" if isinstance(node, yaml.SequenceNode) else "a single value"
        raise InputError.of(
            "is not a mapping", file=file, line=_line(node), given=kind, allowed="fields and values (name: value)"
        )
    builder = _Builder(file)
    data = builder.build(node, (), ())
    if builder.problems:
        raise InputError(builder.problems)
    return Document(data=data, marks=builder.marks)


def parse_value(text: str) -> Any:
    """The value that ``text`` stands for in YAML. Raises `InputError` when it is no YAML."""
    node = _compose(text, "--set")
    if node is None:
        return None
    builder = _Builder("--set")
    value = builder.build(node, (), ())
    if builder.problems:
        raise InputError([Problem(message=p.message, file="--set", given=p.given) for p in builder.problems])
    return value


def _compose(text: str, file: str) -> yaml.Node | None:
    try:
        try:
            return _composed(text, _FastLoader)
        except (yaml.YAMLError, UnicodeEncodeError):  # libyaml says less of what is wrong, and takes no surrogates
            return _composed(text, _Loader)
    except _LimitError as error:
        message, allowed, line = error.args
        raise InputError.of(message, file=file, line=line, allowed=allowed) from None
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n") + 1
        raise InputError.of(
            "holds a character that YAML does not allow", file=file, line=line, given=f"character {error.character!r}"
        ) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = error.problem or error.context or "cannot be understood"
        hint = None
        if "'\\t'" in what:
            hint = "indent with spaces: YAML does not allow tabs"
        elif "mapping values are not allowed" in what:
            hint = "a second ':' stands on this line, or the line is indented too far; quote a text that holds ': '"
        elif "expected a single document" in (error.context or ""):
            what, hint = "holds more than one document", "remove what follows the line '---'"
        elif what.startswith(("expected", "could not find expected")):
            hint = "look for an unclosed bracket or quote, a missing ':' or wrong indentation on this line or above it"
        at = None if mark is None else mark.line + 1
        raise InputError.of(f"is not valid YAML: {what}", file=file, line=at, suggestion=hint) from error


def _composed(text: str, loader: type) -> yaml.Node | None:
    """The node of ``text``; raises `_LimitError` before a large document takes its time."""
    count = depth = 0
    for event in yaml.parse(text, Loader=loader):
        if isinstance(event, yaml.NodeEvent):
            count += 1
            if count > VALUES_MAX or depth >= DEPTH_MAX:
                what = _TOO_DEEP if depth >= DEPTH_MAX else _TOO_MANY
                raise _LimitError(*what, _line(event))
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
    return cast("yaml.Node | None", yaml.compose(text, Loader=loader))


def _line(at: yaml.Node | yaml.Event) -> int:
    return int(at.start_mark.line) + 1 if at.start_mark else 1


def _is_unicode(text: str) -> bool:
    """Whether all of ``text`` are characters; YAML's escapes can write halves of surrogate pairs."""
    return not any("\ud800" <= c <= "\udfff" for c in text) if not text.isascii() else True


class _Builder:
    """Turns nodes into plain data, gathering marks and problems on the way."""

    def __init__(self, file: str):
        self.file = file
        self.marks: dict[Place, Mark] = {}
        self.problems: list[Problem] = []
        self.values = 0

    def build(self, node: yaml.Node, place: Place, within: tuple[int, ...], line: int | None = None) -> Any:
        """Plain data of ``node`` at ``place``; ``within`` are the ids of the nodes around it."""
        self.marks[place] = Mark(self.file, line or _line(node))
        self.values += 1
        if id(node) in within:
            self._problem(node, place, "an alias refers to the thing that it stands in")
            return None
        if self.values > VALUES_MAX or len(within) >= DEPTH_MAX:  # aliases multiply and nest what they stand for
            message, allowed = _TOO_MANY if self.values > VALUES_MAX else _TOO_DEEP
            raise InputError.of(message, file=self.file, line=_line(node), allowed=allowed)
        inner = (*within, id(node))
        if isinstance(node, yaml.MappingNode):
            return {key: self.build(v, (*place, key), inner, at) for key, v, at in self._entries(node, place)}
        if isinstance(node, yaml.SequenceNode):
            return [self.build(item, (*place, i), inner) for i, item in enumerate(node.value)]
        return self._scalar(node, place)

    def _entries(self, node: yaml.MappingNode, place: Place) -> Iterator[tuple[str, yaml.Node, int]]:
        first: dict[str, int] = {}
        for key_node, value_node in node.value:
            key: str = key_node.value
            line = _line(key_node)
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag == _TAG + "null":
                self._problem(key_node, place, "a field's name must be a word")
            elif not _is_unicode(key):
                self._problem(key_node, place, "holds a field's name with half of a pair of surrogates")
            elif len(key) > FIELD_NAME_MAX:
                self._problem(key_node, place, f"a field's name has at most {FIELD_NAME_MAX} characters")
            elif key in first:
                self._problem(
                    key_node, (*place, key), f"is given twice, on lines {first[key]} and {line}", hint="remove one"
                )
            else:
                first[key] = line
                yield key, value_node, line

    def _scalar(self, node: yaml.Node, place: Place) -> Any:
        text: str = node.value
        match node.tag.removeprefix(_TAG):
            case "str" if _is_unicode(text):
                return text
            case "str":
                self._problem(node, place, "holds half of a pair of surrogates, which is no character")
                return None
            case "null":
                return None
            case "bool" if text.lower() in ("true", "false"):
                return text.lower() == "true"
            case "int" if _INT.fullmatch(text) and len(text) > DIGITS_MAX + 1:
                self._problem(node, place, f"is a whole number of more than {DIGITS_MAX} digits")
                return None
            case "int" if _INT.fullmatch(text):
                return int(text, 0) if text.startswith(("0x", "0o")) else int(text)
            case "float" if _FLOAT.fullmatch(text) or _INT.fullmatch(text):
                return float(text.replace(".inf", "inf").replace(".nan", "nan")) if "." in text else float(text)
        self._problem(node, place, f"has a tag that is not understood: {node.tag}", hint="leave the tag out")
        return None

    def _problem(self, node: yaml.Node, place: Place, message: str, hint: str | None = None) -> None:
        path = dotted(place) or None
        self.problems.append(Problem(message=message, file=self.file, line=_line(node), path=path, suggestion=hint))
