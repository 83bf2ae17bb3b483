"""A user's policy as missions call it: what fails, or answers what cannot be, is told with the file and the line."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.config.errors import InputError
from swarmsim.control.commands import multirotor_command, skid_steer_command
from swarmsim.policies.answers import ask
from swarmsim.policies.path import Path
from swarmsim.vehicles.multirotor import MultirotorParams

METHODS = ("task", "start", "done", "plan")
SHOWN = 40  # characters of what is no array


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
        return partial(self._call, name, found) if name in METHODS and callable(found) else found

    def _call(self, name: str, method: Callable[..., Any], *arguments: Any) -> Any:
        answer = ask(self._reference, f"{name}()", lambda: method(*arguments))
        if name in ("task", "start"):
            self._kinds(name, answer)
        elif name == "done" and self._kinds(name, answer)[1] != [("bool", ())]:
            raise self._wrong(name, "must give whether it is done", _words(answer), "true or false, or bool[]")
        elif name == "plan" and not (isinstance(answer, Path) and jnp.ndim(answer.points_m) == 3):
            allowed = "a swarmsim.policies.path.Path whose points_m are [M, P, 3], of its M vehicles"
            raise self._wrong(name, "must give the paths of its vehicles", type(answer).__name__, allowed)
        return answer

    def _act(self, task: Any, memory: Any, view: Any, key: jax.Array) -> tuple[Any, Any]:
        given = self._call("act", self._policy.act, task, memory, view, key)
        if not (isinstance(given, tuple) and len(given) == 2):
            raise self._wrong("act", "must give two values", _words(given), "the memory and a command")
        after, command = given
        if self._kinds("act", after) != self._kinds("act", memory):
            what = "must give a memory of the shape and type that it was given"
            raise self._wrong("act", what, _words(after), _words(memory))
        try:
            if isinstance(task.params, MultirotorParams):
                multirotor_command(command, task.params.rotor_spin.shape[-1])
            else:
                skid_steer_command(command)
        except (TypeError, ValueError) as error:
            words, kind = str(error).partition("\n")[0], type(command).__name__
            raise self._wrong("act", f"gives no command: {words}", kind, "see swarmsim.control") from error
        return after, command

    def _kinds(self, name: str, tree: Any) -> tuple[Any, list[tuple[str, tuple[int, ...]]]]:
        """Structure of a pytree, and type and shape of its arrays; a number of Python's has the type that it becomes.

        Raises `InputError` where a leaf is no array.
        """
        leaves, structure = jax.tree.flatten(tree)
        try:
            return structure, [(jnp.result_type(leaf).name, jnp.shape(leaf)) for leaf in leaves]
        except (TypeError, ValueError):
            raise self._wrong(
                name, "must give arrays, or a pytree of them", _words(tree), "numbers and arrays"
            ) from None

    def _wrong(self, name: str, what: str, given: str, allowed: str) -> InputError:
        return InputError.of(f"{name}() of the policy '{self._reference}' {what}", given=given, allowed=allowed)


def _words(tree: Any) -> str:
    """The leaves of a pytree in words, with the ways to them: their types and shapes where they are arrays."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree)
    told = [f"{jax.tree_util.keystr(path)} {_word(leaf)}".strip() for path, leaf in leaves]
    return ", ".join(told) or str(structure)


def _word(leaf: Any) -> str:
    try:
        return f"{jnp.result_type(leaf).name}{list(jnp.shape(leaf))}"
    except (TypeError, ValueError):
        return f"{type(leaf).__name__} {str(leaf)[:SHOWN]!r}"
