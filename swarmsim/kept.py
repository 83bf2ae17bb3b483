"""Results that take long to compute, kept for the next call with the same arguments."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def kept(most: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Keep the last ``most`` results of a function; its arguments are compared, not hashed.

    Configuration models hold mappings, so that `functools.lru_cache` cannot take them. Results are shared and must not
    be changed.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        found: list[tuple[object, R]] = []

        @wraps(function)
        def keeping(*args: P.args, **kwargs: P.kwargs) -> R:
            given = (args, kwargs)
            for known, result in found:
                if known == given:
                    return result
            result = function(*args, **kwargs)
            found.append((given, result))
            del found[:-most]
            return result

        return keeping

    return decorate
