"""The nearest valid name to a misspelt one, and lists of names as text."""

import difflib
from collections.abc import Iterable


def nearest(given: str, valid: Iterable[str]) -> str | None:
    """The valid name that looks most like ``given`` (case does not count), or None when none is near."""
    by_folded = {name.casefold(): name for name in valid}
    found = difflib.get_close_matches(given.casefold(), by_folded, n=1, cutoff=0.55)
    return by_folded[found[0]] if found else None


def did_you_mean(given: str, valid: Iterable[str]) -> str | None:
    """A hint such as ``did you mean 'Co-60'?``, or None."""
    name = nearest(given, valid)
    return None if name is None else f"did you mean '{name}'?"


def one_of(valid: Iterable[str]) -> str:
    """``one of a, b, c``; says so when there is nothing to choose from."""
    names = list(valid)
    return "one of " + ", ".join(names) if names else "nothing: there are none"
