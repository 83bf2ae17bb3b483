"""Input errors: everything that is wrong with what a user gave, gathered and said at once."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

PROBLEMS_MAX = 100
"""Problems told at once: more help nobody, and looking for the nearest name of each takes time."""
_TEXT_MAX = 2000  # characters of one part of a message


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong, where it stands and how to mend it.

    ``file`` is the path of the file (or ``--set`` for an override), ``line`` counts from 1, ``path`` is the dotted
    place of the value inside the file, ``given`` is what stands there, ``allowed`` says what may stand there, and
    ``suggestion`` is the nearest valid name or a hint.
    """

    message: str
    file: str | None = None
    line: int | None = None
    path: str | None = None
    given: str | None = None
    allowed: str | None = None
    suggestion: str | None = None

    @property
    def where(self) -> str:
        """Place of the problem, ``file:line path``; empty when it has none."""
        place = "" if self.file is None else self.file if self.line is None else f"{self.file}:{self.line}"
        return " ".join(part for part in (place, self.path) if part)

    def __str__(self) -> str:
        """A readable block: place and message on the first line, the rest indented below it."""
        lines = [_readable(f"{self.where}: {self.message}" if self.where else self.message)]
        for label, value in (("given", self.given), ("allowed", self.allowed), ("hint", self.suggestion)):
            if value is not None:
                lines.append(f"    {label + ':':<9}{_readable(value)}")
        return "\n".join(lines)


def _readable(text: str) -> str:
    """``text`` shortened, without characters that a terminal would obey or cannot show."""
    text = text if len(text) <= _TEXT_MAX else text[: _TEXT_MAX - 1] + "…"
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


class InputError(Exception):
    """What a user gave cannot be used; ``problems`` holds every reason (the command line prints them, exit code 2)."""

    def __init__(self, problems: Iterable[Problem]):
        """Hold ``problems`` (at least one), the first `PROBLEMS_MAX` of them."""
        found = first_problems(problems)
        if not found:
            raise ValueError("an InputError needs at least one problem")
        if len(found) > PROBLEMS_MAX:
            found[PROBLEMS_MAX:] = [Problem("there are more problems than these")]
        self.problems: tuple[Problem, ...] = tuple(found)
        super().__init__("\n".join(map(str, self.problems)))

    @classmethod
    def of(cls, sentence: str, **where: Any) -> "InputError":
        """An error with a single problem; ``where`` are the other fields of `Problem`."""
        if isinstance(where.get("file"), Path):
            where["file"] = str(where["file"])
        return cls([Problem(message=sentence, **where)])


def first_problems(problems: Iterable[Problem]) -> list[Problem]:
    """As many problems as are told, and one more where there are more; none is looked for beyond that."""
    return list(islice(problems, PROBLEMS_MAX + 1))


@contextmanager
def file_errors_told(sentence: str, **where: Any) -> Iterator[None]:
    """Turn an error of the file system, such as a full disk, into an `InputError`; ``where`` as in `InputError.of`."""
    try:
        yield
    except ValueError as error:
        if "null byte" not in str(error):
            raise
        raise InputError.of(f"{sentence} (its name holds a null character)", **where) from error
    except OSError as error:
        raise InputError.of(f"{sentence} ({error.strerror or error})", **where) from error


def stop_of(error: BaseException) -> KeyboardInterrupt | None:
    """The Ctrl-C that an error stands for: Python 3.11 wraps one that meets a class being made."""
    stop = error if isinstance(error, KeyboardInterrupt) else error.__cause__
    return stop if isinstance(stop, KeyboardInterrupt) else None


def raise_if_any(problems: Sequence[Problem]) -> None:
    """Raise one `InputError` with all ``problems``, or nothing when there are none."""
    if problems:
        raise InputError(problems)
