"""A user's policy as missions call it: what fails, or answers what cannot be, is told with the file and the line."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.config.errors import InputError
from swarmsim.control.commands import multirotor_command, skid_steer_command
from swarmsim.policies.answers import ask
from swarmsim.vehicles.multirotor import MultirotorParams

METHODS = ("task", "start", "done", "plan")


class Asked:
    """A policy, or a planner; every attribute is the policy's own."""

    def __init__(self, reference: str, policy: Any):
        """Hold the ``policy`` of a ``reference``."""
        self._reference, self._policy = reference, policy

    def __getattr__(self, name: str) -> Any:
        """The policy's attribute; a method that says where it fails."""
        found = getattr(self._policy, name)
        if name == "act":
            return self._act
        return partial(self._call, f"{name}()", found) if name in METHODS and callable(found) else found

    def _call(self, what: str, method: Callable[..., Any], *arguments: Any) -> Any:
        return ask(self._reference, what, lambda: method(*arguments))

    def _act(self, task: Any, memory: Any, view: Any, key: jax.Array) -> tuple[Any, Any]:
        given = self._call("act()", self._policy.act, task, memory, view, key)
        if not (isinstance(given, tuple) and len(given) == 2):
            raise self._wrong("must give two values", type(given).__name__, "the memory and a command")
        after, command = given
        was, now = _shapes(memory), _shapes(after)
        if was != now:
            raise self._wrong("must give a memory of the shape and type that it was given", now, was)
        try:
            if isinstance(task.params, MultirotorParams):
                multirotor_command(command, task.params.rotor_spin.shape[-1])
            else:
                skid_steer_command(command)
        except TypeError as error:
            raise self._wrong(f"gives no command: {error}", type(command).__name__, "see swarmsim.control") from error
        return after, command

    def _wrong(self, what: str, given: str, allowed: str) -> InputError:
        return InputError.of(f"act() of the policy '{self._reference}' {what}", given=given, allowed=allowed)


def _shapes(tree: Any) -> str:
    """Structure, shapes and types of arrays in words; a number of Python's has the type that it becomes."""
    return str(jax.tree.map(lambda x: f"{jnp.result_type(x).name}{list(jnp.shape(x))}", tree)).replace("'", "")
