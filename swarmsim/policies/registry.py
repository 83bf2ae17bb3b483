"""The table of policies: a policy is a function registered under a kind and a name.

A policy of the kind ``aerial`` turns an :class:`~swarmsim.policies.tasks.AerialTask` into one path per UAV; one of the
kind ``ground`` turns a :class:`~swarmsim.policies.tasks.GroundTask` into the rover's path. Both are pure functions of
one mission, so that the mission layer can compile and batch them.
"""

import importlib
import pkgutil
from collections.abc import Callable
from typing import Any, TypeVar

Policy = TypeVar("Policy", bound=Callable[..., Any])
KINDS = ("aerial", "ground")
_policies: dict[str, dict[str, Callable[..., Any]]] = {kind: {} for kind in KINDS}


def register(kind: str, name: str) -> Callable[[Policy], Policy]:
    """Decorate a policy function so that a scenario can name it.

    Raises:
        ValueError: the kind is not one of `KINDS`, or another function already has the name.
    """
    if kind not in _policies:
        raise ValueError(f"no policy kind {kind!r}; the kinds are {', '.join(KINDS)}")

    def add(policy: Policy) -> Policy:
        known = _policies[kind].get(name)
        if known is not None and known.__qualname__ != policy.__qualname__:
            raise ValueError(f"the {kind} policy {name!r} is already {known.__module__}.{known.__qualname__}")
        _policies[kind][name] = policy
        return policy

    return add


def names(kind: str) -> list[str]:
    """Names of the registered policies of a kind, sorted."""
    _load()
    return sorted(_policies[kind])


def get(kind: str, name: str) -> Callable[..., Any]:
    """The policy of a name.

    Raises:
        KeyError: there is none; the message lists those that are.
    """
    _load()
    if name not in _policies[kind]:
        raise KeyError(f"no {kind} policy {name!r}; there are {', '.join(names(kind))}")
    return _policies[kind][name]


def _load() -> None:
    """Import every module of this package once, so that a new file there is enough to add a policy."""
    package = importlib.import_module("swarmsim.policies")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"swarmsim.policies.{module.name}")
