"""What a policy and its settings answer when asked: they may be a user's code, which can fail or answer anything."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from swarmsim.config.documents import shown_path
from swarmsim.config.errors import InputError, stop_of
from swarmsim.config.names import did_you_mean, one_of

if TYPE_CHECKING:
    from swarmsim.config.policies import PolicySettings

Answer = TypeVar("Answer")
FOUND = ("source", "hotspot")
"""What a policy can need the mission to find."""
_SHOWN = 60
_PACKAGE = Path(__file__).parents[1]
_LIBRARIES = {"jax", "jaxlib", "numpy", "mujoco", "optax"}  # beside which a user's policy may be installed
_WORDS = {
    "needs": ("needs", "thing that a mission finds"),
    "senses": ("senses", "kind of sensor"),
    "vehicles": ("commands", "kind of vehicle"),
}


def ask(reference: str, what: str, question: Callable[[], Answer]) -> Answer:
    """The answer of a user's code; raises `InputError` with the file and line where it fails. Ctrl-C stays Ctrl-C."""
    try:
        return question()
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        if stop := stop_of(error):
            raise stop from None
        frames = traceback.extract_tb(error.__traceback__)[1:]  # the first is here
        # of a call that does not fit the method's arguments there is no line but this package's
        outside = [frame for frame in frames if not Path(frame.filename).is_relative_to(_PACKAGE)]
        own = [frame for frame in frames if _is_users(Path(frame.filename))] or outside
        where = f"{shown_path(Path(own[-1].filename))}:{own[-1].lineno}: " if own else ""
        words = str(error).strip().partition("\n")[0]  # JAX adds paragraphs
        raise InputError.of(
            f"{what} of the policy '{reference}' fails: {where}{type(error).__name__}: {words}",
            given=reference,
            suggestion="mend the policy's code",
        ) from error


def _is_users(file: Path) -> bool:
    """Whether a line of a traceback is of a user's code: where a mistake was made, not where it comes to light."""
    _, found, inside = file.as_posix().rpartition("/site-packages/")
    library = found and inside.partition("/")[0] in _LIBRARIES
    return not library and not file.is_relative_to(_PACKAGE)


def names_of(reference: str, what: str, given: Any, known: Sequence[str]) -> tuple[str, ...]:
    """The names in an answer, one or several of the ``known``; raises `InputError` for anything else."""
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, (tuple, list, set, frozenset)) or not all(isinstance(name, str) for name in names):
        message = f"'{what}' of the policy '{reference}' must be a name or a tuple of names"
        raise InputError.of(message, given=repr(given)[:_SHOWN], allowed=one_of(known))
    for name in names:
        if name not in known:
            verb, noun = _WORDS[what]
            message = f"the policy '{reference}' {verb} '{name}', which is no {noun}"
            raise InputError.of(message, given=name, allowed=one_of(known), suggestion=did_you_mean(name, known))
    return tuple(names)


@dataclass(frozen=True)
class Answers:
    """What the settings of a phase say of it."""

    needs: tuple[str, ...]
    partners: Mapping[str, str]
    faults: tuple[tuple[str, str], ...]


def answers_of(settings: PolicySettings, reference: str, kinds: frozenset[str], known: Sequence[str]) -> Answers:
    """What settings need, whom they name, and what is wrong with them for ``kinds`` of the ``known`` vehicles.

    Raises `InputError` where one of these fails or is none.
    """
    needs = ask(reference, "needed()", settings.needed)
    return Answers(
        needs=names_of(reference, "needs", needs, FOUND),
        partners=_partners(settings, reference, known),
        faults=_faults(settings, reference, kinds),
    )


def _partners(settings: PolicySettings, reference: str, known: Sequence[str]) -> Mapping[str, str]:
    partners, fields = ask(reference, "partners", lambda: settings.partners), type(settings).model_fields
    if not isinstance(partners, Mapping):
        message = f"'partners' of the policy '{reference}' must be a mapping of settings to kinds of vehicle"
        raise InputError.of(message, given=repr(partners)[:_SHOWN])
    for field, kind in partners.items():
        if field not in fields or not isinstance(getattr(settings, field), str):
            message = f"'partners' of the policy '{reference}' must name settings that are names"
            raise InputError.of(message, given=repr(field)[:_SHOWN], allowed=one_of(fields))
        if not isinstance(kind, str) or kind not in known:
            message = f"'partners' of the policy '{reference}' names no kind of vehicle"
            raise InputError.of(message, given=repr(kind)[:_SHOWN], allowed=one_of(known))
    return partners


def _faults(settings: PolicySettings, reference: str, kinds: frozenset[str]) -> tuple[tuple[str, str], ...]:
    def listed() -> list[Any]:
        found = settings.faults(kinds)
        return [found] if isinstance(found, str) or not isinstance(found, Iterable) else list(found)

    faults = ask(reference, "faults()", listed)
    for fault in faults:
        pair = isinstance(fault, (tuple, list)) and len(fault) == 2
        if not pair or not all(isinstance(part, str) for part in fault):
            message = f"faults() of the policy '{reference}' must give pairs of a field and a message"
            raise InputError.of(message, given=repr(fault)[:_SHOWN])
    return tuple((field, message) for field, message in faults)


def check_attributes(policy: Any, reference: str) -> None:
    """Raise `InputError` for a period that is none, and for methods that cannot be called."""
    period = ask(reference, "period_s", lambda: getattr(policy, "period_s", None))
    number = isinstance(period, int | float) and not isinstance(period, bool)
    if period is not None and not (number and math.isfinite(period) and period >= 0):
        message = f"'period_s' of the policy '{reference}' must be a number of seconds, or None"
        raise InputError.of(message, given=repr(period)[:_SHOWN], allowed="a number at least 0")
    for name in ("task", "done"):
        method = ask(reference, name, lambda name=name: getattr(policy, name, len))  # type: ignore[misc]
        if not callable(method):
            message = f"'{name}' of the policy '{reference}' must be a method"
            raise InputError.of(message, given=repr(method)[:_SHOWN])
