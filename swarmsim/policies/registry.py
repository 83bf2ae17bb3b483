"""Policies by name: those of this package, those registered in Python, users' files, modules and entry points.

A policy is an object with ``start(task, key) -> memory`` and ``act(task, memory, view, key) -> (memory, command)``, or
a planner with ``plan``. Its attribute ``Settings``, a subclass of `swarmsim.config.policies.PolicySettings`, says what
may stand under ``settings`` of a phase (nothing without it); ``vehicles`` says which kinds of vehicle it can command.
"""

import hashlib
import importlib
import importlib.util
import inspect
import os
import pkgutil
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from swarmsim.config import files
from swarmsim.config.documents import shown_path
from swarmsim.config.errors import InputError, stop_of
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.policies import SETTINGS, PolicySettings
from swarmsim.config.sensors import SENSOR_KINDS
from swarmsim.config.vehicles import VEHICLE_KINDS
from swarmsim.policies.answers import ask, check_attributes, names_of

Policy = TypeVar("Policy")
ENTRY_POINTS = "swarmsim.policies"
_PACKAGE = "swarmsim.policies"
_HOW = "the name of a policy, 'file.py:object', or 'package.module:object'"

_registered: dict[str, Any] = {}


@dataclass
class _File:
    """A file of policies that was imported, and the objects that were asked of it."""

    sha256: str
    module: ModuleType
    objects: dict[str, Any] = field(default_factory=dict)


_files: dict[Path, _File] = {}
_instances: dict[type, Any] = {}


def register(name: str) -> Callable[[Policy], Policy]:
    """Decorate a policy (a class that is made without arguments, or an object) so that a scenario can name it.

    Raises:
        ValueError: the name holds a ':', or another policy has it already.
        TypeError: the object is no policy.
    """
    if ":" in name:
        raise ValueError(f"the name of a policy holds no ':', but {name!r} does")

    def add(policy: Policy) -> Policy:
        made = policy() if inspect.isclass(policy) else policy
        if fault := _fault(made):
            raise TypeError(f"the policy {name!r} {fault}")
        known = _registered.get(name)
        if known is not None and _title(known) != _title(made):
            raise ValueError(f"the policy {name!r} is already {_title(known)}")
        _registered[name] = made
        return policy

    return add


def names() -> list[str]:
    """Names of the policies of this package, of those registered, and of entry points, sorted."""
    _load_package()
    return sorted({*SETTINGS, *_registered, *(point.name for point in entry_points(group=ENTRY_POINTS))})


def find(reference: str, near: Path | None = None) -> Any:
    """The policy object of a reference.

    Args:
        reference: a name, ``file.py:object`` or ``package.module:object``.
        near: the mission's file; files are looked for in its folder, then in the working folder.

    Raises:
        InputError: there is no such policy, or it cannot be imported or used.
    """
    left, colon, name = reference.rpartition(":")
    if not colon:
        return _named(reference)
    if not left or not name.isidentifier():
        raise InputError.of("is not a reference to a policy", given=reference, allowed=_HOW)
    if left.endswith(".py") or "/" in left or "\\" in left:
        return _from_file(reference, _existing_file(reference, near), name)
    return _made(reference, _attribute(reference, _module(reference, left), name))


def settings_model(reference: str, near: Path | None = None) -> type[PolicySettings]:
    """The model of a policy's settings; `PolicySettings` itself for a policy that has none. Raises as `find` does."""
    if is_shipped(reference):
        return SETTINGS[reference]
    policy = find(reference, near)
    model = ask(reference, "Settings", lambda: getattr(policy, "Settings", None))
    if model is None:
        return PolicySettings
    if not (inspect.isclass(model) and issubclass(model, PolicySettings)):
        raise InputError.of(
            f"the policy '{reference}' has an attribute Settings that is no settings model",
            given=reference,
            allowed="a subclass of swarmsim.config.policies.PolicySettings",
        )
    return model


def vehicle_kinds(reference: str, near: Path | None = None) -> tuple[str, ...]:
    """Kinds of vehicle that a policy can command: its own ``vehicles``, or those of its settings."""
    model = settings_model(reference, near)
    if is_shipped(reference):
        return model.vehicles
    policy = find(reference, near)
    own = ask(reference, "vehicles", lambda: getattr(policy, "vehicles", None))
    kinds = names_of(reference, "vehicles", model.vehicles if own is None else own, VEHICLE_KINDS)
    if not kinds:
        raise InputError.of(f"'vehicles' of the policy '{reference}' is empty", allowed=one_of(VEHICLE_KINDS))
    return kinds


def senses(reference: str, near: Path | None = None) -> tuple[str, ...]:
    """Kinds of navigation sensors that a policy reads: its ``senses``; none of this package does.

    Raises as `find` does, and where it names what is no kind of sensor.
    """
    if is_shipped(reference):
        return ()
    policy = find(reference, near)
    given = ask(reference, "senses", lambda: getattr(policy, "senses", ()))
    return names_of(reference, "senses", given, SENSOR_KINDS)


def digest(reference: str, near: Path | None = None) -> str:
    """SHA-256 of the file that a user's policy stands in; empty for this package's, and where there is no file."""
    if is_shipped(reference):
        return ""
    policy = find(reference, near)
    path = policy_file(reference, near)
    if path is None:
        module = sys.modules.get(type(policy).__module__)
        if module is None or module.__name__.startswith(f"{_PACKAGE}.") or getattr(module, "__file__", None) is None:
            return ""
        path = Path(str(module.__file__))
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def policy_file(reference: str, near: Path | None = None) -> Path | None:
    """Absolute path of the file that a reference ``file.py:object`` names; None for every other reference."""
    left, colon, _ = reference.rpartition(":")
    if colon and (left.endswith(".py") or "/" in left or "\\" in left):
        return _existing_file(reference, near)
    return None


def is_shipped(reference: str) -> bool:
    """Whether a name is that of a policy of this package, told without importing JAX."""
    return reference in SETTINGS and (
        reference not in _registered or type(_registered[reference]).__module__.startswith(f"{_PACKAGE}.")
    )


def _load_package() -> None:
    """Import every module of this package once, so that a new file there is enough to add a policy."""
    package = importlib.import_module(_PACKAGE)
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{_PACKAGE}.{module.name}")


def _named(name: str) -> Any:
    if name not in _registered:
        _load_package()
    if name in _registered:
        return _registered[name]
    for point in entry_points(group=ENTRY_POINTS, name=name):
        return _made(name, _loaded_entry_point(name, point))
    known = names()
    raise InputError.of(
        f"there is no policy '{name}'",
        given=name,
        allowed=f"{one_of(known)}; or 'file.py:object' or 'package.module:object'",
        suggestion=did_you_mean(name, known),
    )


def _loaded_entry_point(name: str, point: EntryPoint) -> Any:
    try:
        return point.load()
    except BaseException as error:
        if stop := stop_of(error):
            raise stop from None
        raise InputError.of(
            f"the entry point '{point.value}' of the policy '{name}' cannot be loaded: {_words(error)}", given=name
        ) from error


def _existing_file(reference: str, near: Path | None) -> Path:
    """Absolute path of the file of a reference: in the folder of ``near``, else in the working folder."""
    path = Path(os.path.expanduser(reference.rpartition(":")[0]))  # leaves the name of an unknown user as it is
    folders = [Path.cwd()] if near is None else [near.absolute().parent, Path.cwd()]
    for folder in folders:
        if files.is_file(folder / path):
            return (folder / path).resolve()
    beside = sorted(
        str(path.parent / p.name)
        for folder in folders
        for p in files.listing((folder / path).parent, "*.py")
        if files.is_file(p)
    )
    raise InputError.of(
        f"there is no file '{path}' to take a policy from",
        given=reference,
        allowed=f"a file in {' or in '.join(str(shown_path(folder)) for folder in dict.fromkeys(folders))}",
        suggestion=did_you_mean(str(path), beside),
    )


def _from_file(reference: str, path: Path, name: str) -> Any:
    """The policy of a file; the same object as before unless the file has changed."""
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    known = _files.get(path)
    if known is None or known.sha256 != sha256:
        known = _files[path] = _File(sha256, _executed(reference, path, sha256))
    if name not in known.objects:
        known.objects[name] = _made(reference, _attribute(reference, known.module, name))
    return known.objects[name]


def _executed(reference: str, path: Path, sha256: str) -> ModuleType:
    """The module of a file, under a name of its own; its folder can be imported from while it runs."""
    spec = importlib.util.spec_from_file_location(f"swarmsim_policy_{path.stem}_{sha256[:12]}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        sys.modules.pop(spec.name, None)
        if stop := stop_of(error):
            raise stop from None
        line = error.lineno if isinstance(error, SyntaxError) else None
        for frame in traceback.extract_tb(error.__traceback__):
            line = frame.lineno if frame.filename == str(path) else line
        where = f"{shown_path(path)}:{line}" if line is not None else shown_path(path)
        message = f"the file of the policy cannot be imported: {where}: {_words(error)}"
        raise InputError.of(message, given=reference, suggestion="mend the Python file") from error
    finally:
        with suppress(ValueError):  # the file may have changed it
            sys.path.remove(str(path.parent))
    return module


def _module(reference: str, name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except BaseException as error:
        if stop := stop_of(error):
            raise stop from None
        if isinstance(error, ModuleNotFoundError) and error.name and f"{name}.".startswith(f"{error.name}."):
            hint = f"install it, or name its file: '{name.rpartition('.')[2]}.py:{reference.rpartition(':')[2]}'"
            raise InputError.of(f"there is no module '{error.name}'", given=reference, suggestion=hint) from error
        raise InputError.of(f"the module '{name}' cannot be imported: {_words(error)}", given=reference) from error


def _attribute(reference: str, module: ModuleType, name: str) -> Any:
    nothing = object()
    found = ask(reference, f"the module of the object '{name}'", lambda: getattr(module, name, nothing))
    if found is not nothing:
        return found
    known = [n for n, value in vars(module).items() if not n.startswith("_") and _fault(value) is None]
    raise InputError.of(
        f"'{reference.rpartition(':')[0]}' holds no object '{name}'",
        given=reference,
        allowed=one_of(known) if known else "an object with start and act, or with plan",
        suggestion=did_you_mean(name, known),
    )


def _made(reference: str, policy: Any) -> Any:
    """The policy itself, made where a class was named; raises `InputError` for what is no policy."""
    if inspect.isclass(policy) and _fault(policy) is None:
        try:
            if policy not in _instances:
                _instances[policy] = policy()
            policy = _instances[policy]
        except (Exception, SystemExit) as error:
            if stop := stop_of(error):
                raise stop from None
            raise InputError.of(
                f"the policy '{reference}' cannot be made without arguments: {_words(error)}",
                given=reference,
                suggestion="give its arguments defaults, or name an object",
            ) from error
    if fault := _fault(policy):
        raise InputError.of(
            f"'{reference}' {fault}",
            given=reference,
            allowed="an object or class with start(task, key) and act(task, memory, view, key), or with plan",
        )
    check_attributes(policy, reference)
    return policy


def _fault(policy: Any) -> str | None:
    """Why an object is no policy, or None when it is one."""

    def has(name: str) -> bool:
        try:
            return callable(getattr(policy, name, None))
        except Exception:  # of a user's object, which is then no policy
            return False

    start, act, plan = map(has, ("start", "act", "plan"))
    if plan or (start and act):
        return None
    if act:
        return "has act and no start, which makes its memory"
    what = "function" if inspect.isfunction(policy) else type(policy).__name__
    return f"is no policy: it is a {what} without act and without plan"


def _title(policy: Any) -> str:
    return f"{type(policy).__module__}.{type(policy).__qualname__}"


def _words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
