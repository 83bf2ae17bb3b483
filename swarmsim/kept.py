"""Results that take long to compute, kept for the next call with the same arguments."""

import dataclasses
import hashlib
import pickle
from collections.abc import Callable, Sequence
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np
import scipy
from pydantic import BaseModel

from swarmsim.config.files import packaged_dir
from swarmsim.store import package_digest, read_entry, write_entry

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


def stored(reads: Sequence[str] = ()) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Store a function's results in the user's cache folder, for later processes.

    The function depends on its arguments and on the sources of swarmsim, numpy and scipy, and on the files of the
    packaged folders that it ``reads``; all of them decide whether a result is found. The arguments are configuration
    models, dataclasses and tuples of such, and plain values; the result is a pytree of arrays.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def storing(*args: P.args, **kwargs: P.kwargs) -> R:
            parts = [
                f"{function.__module__}.{function.__qualname__}", np.__version__, scipy.__version__,
                *map(_content, reads), _text((args, tuple(sorted(kwargs.items())))),
            ]  # fmt: skip
            key = hashlib.sha256("\n".join(parts).encode()).hexdigest()
            content = read_entry(package_digest(), key)
            if content is not None:
                try:
                    result: R = jax.device_put(pickle.loads(content))
                    return result
                except Exception:  # pickle promises no type; what is computed instead is the same
                    pass
            result = function(*args, **kwargs)
            write_entry(package_digest(), key, pickle.dumps(jax.tree.map(np.asarray, result)))
            return result

        return storing

    return decorate


@lru_cache
def _content(folder: str) -> str:
    """The digest of the files of a packaged folder."""
    digest = hashlib.sha256()
    for path in sorted((packaged_dir() / folder).iterdir()):
        digest.update(f"{path.name}\n{path.stat().st_size}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _text(value: Any) -> str:
    """A value as text that tells it from every other one; raises `TypeError` for what it does not know."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return repr(value)
    if isinstance(value, BaseModel):
        fields = ", ".join(f"{name}={_text(getattr(value, name))}" for name in type(value).model_fields)
        return f"{type(value).__qualname__}({fields})"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = ", ".join(f"{f.name}={_text(getattr(value, f.name))}" for f in dataclasses.fields(value))
        return f"{type(value).__qualname__}({fields})"
    if isinstance(value, (tuple, list)):
        return f"({', '.join(map(_text, value))},)"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_text(k)}: {_text(v)}' for k, v in value.items())}}}"
    raise TypeError(f"a result that depends on a {type(value).__qualname__} cannot be stored")
