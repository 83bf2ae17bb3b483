"""Digests that tell, across processes, whether two values stand for the same computation.

JAX finds a compiled program by the text of the traced program. Here it is found before tracing, by a digest of what the
trace depends on: the function's code and all that it closes over, and the static parts of its arguments.
"""

import dis
import enum
import functools
import hashlib
import pickle
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding

# Packages whose code is identified by a version, or for swarmsim by the digest of its files; see `programs`.
_VERSIONED = {"swarmsim", "jax", "jaxlib", "jax_plugins", "numpy", "scipy", "optax", "mujoco"} | sys.stdlib_module_names
_ATOMS = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), type(NotImplemented))


class UnidentifiableError(TypeError):
    """A value of which no process can tell whether it is the one that another process had."""


def fingerprint(value: Any) -> str:
    """A hexadecimal sha256 digest of a value, equal in two processes only if the values compute the same.

    Plain values, arrays, containers, dataclasses and other objects count by their content, functions by their code,
    defaults, closure and the globals that they read, modules by their source, classes by their members. Code of
    swarmsim, JAX and the other packages of `_VERSIONED` counts by its name alone. Equal values may differ in their
    digest (by the order of a mapping, say), which costs a compilation and nothing else.

    Raises `UnidentifiableError` for a value without content that can be read, such as a lock or an open file.
    """
    return _Digests().of(value).hex()


class _Digests:
    """Digests of the values met so far, which also stay alive so that their ids are not used again."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Any, bytes]] = {}

    def of(self, value: Any) -> bytes:
        if isinstance(value, _ATOMS) and not isinstance(value, enum.Enum):
            return _hash(type(value).__name__, repr(value))
        if id(value) in self._known:
            return self._known[id(value)][1]
        self._known[id(value)] = value, b"cycle"  # what a value that contains itself finds
        digest = self._compound(value)
        self._known[id(value)] = value, digest
        return digest

    def _all(self, kind: str, values: Iterable[Any]) -> bytes:
        return _hash(kind, *(self.of(value) for value in values))

    def _compound(self, value: Any) -> bytes:
        for kind, digest in self._table:
            if isinstance(value, kind):
                return digest(value)
        if callable(value) and hasattr(value, "__wrapped__"):  # a function compiled or transformed by JAX
            return _hash("wrapped", _name(type(value)), self.of(value.__wrapped__))
        return self._instance(value)

    @functools.cached_property
    def _table(self) -> tuple[tuple[Any, Callable[[Any], bytes]], ...]:
        return (
            (enum.Enum, lambda value: _hash("enum", _name(type(value)), repr(value.value))),
            ((jax.Array, np.ndarray, np.generic), self._array),
            (types.FunctionType, self._function),
            (types.MethodType, lambda value: self._all("method", (value.__func__, value.__self__))),
            (functools.partial, lambda value: self._all("partial", (value.func, value.args, value.keywords))),
            ((types.BuiltinFunctionType, np.ufunc), self._built_in),
            (types.CodeType, self._code),
            (types.ModuleType, self._module),
            (type, self._class),
            ((dict, types.MappingProxyType), self._mapping),
            ((list, tuple), lambda value: _hash(_name(type(value)), *map(self.of, value))),
            ((set, frozenset), lambda value: _hash("set", *sorted(map(self.of, value)))),
            (jax.tree_util.PyTreeDef, self._structure),
            (Sharding, lambda value: _hash("sharding", sharding_text(value))),
            (Mesh, lambda value: _hash("mesh", _mesh_text(value))),
            ((np.dtype, jax.Device, PartitionSpec), _text),
        )

    def _array(self, value: Any) -> bytes:
        if isinstance(value, jax.core.Tracer):
            raise UnidentifiableError("a traced array has no value yet")
        if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
            return _hash("key", str(value.dtype), self._array(jax.random.key_data(value)))
        array = np.asarray(value)
        if array.dtype == object:
            return _hash("array", repr(array.shape), *map(self.of, array.ravel()))
        return _hash("array", array.dtype.str, repr(array.shape), array.tobytes())

    def _mapping(self, value: Mapping[Any, Any]) -> bytes:
        return self._all("mapping", (part for item in value.items() for part in item))

    def _function(self, value: types.FunctionType) -> bytes:
        closure = [_content(cell) for cell in value.__closure__ or ()]
        parts: list[Any] = [value.__defaults__, value.__kwdefaults__, closure]
        if not _is_versioned(value.__module__):
            parts += [value.__code__, _globals_read(value.__code__, value.__globals__)]
        return _hash("function", f"{value.__module__}.{value.__qualname__}", *map(self.of, parts))

    def _built_in(self, value: Any) -> bytes:
        owner = getattr(value, "__self__", None)
        bound = b"" if owner is None or isinstance(owner, types.ModuleType) else self.of(owner)
        return _hash("built-in", str(getattr(value, "__module__", "")), value.__name__, bound)

    def _code(self, value: types.CodeType) -> bytes:
        names = value.co_names, value.co_varnames, value.co_freevars, value.co_cellvars
        counts = value.co_argcount, value.co_posonlyargcount, value.co_kwonlyargcount, value.co_flags
        return self._all("code", (value.co_code, value.co_consts, names, counts, value.co_exceptiontable))

    def _module(self, value: types.ModuleType) -> bytes:
        """A module by its source and that of the modules it uses; one without a source by its name."""
        source = getattr(value, "__file__", None)
        if _is_versioned(value.__name__) or source is None:
            return _hash("module", value.__name__)
        with open(source, "rb") as file:
            content = file.read()
        modules = {getattr(part, "__module__", None) for part in vars(value).values()}
        modules |= {part.__name__ for part in vars(value).values() if isinstance(part, types.ModuleType)}
        names = sorted(name for name in modules if isinstance(name, str) and not _is_versioned(name))
        return _hash("module", value.__name__, content, *(self.of(sys.modules.get(name)) for name in names))

    def _class(self, value: type) -> bytes:
        if _is_versioned(value.__module__):
            return _hash("class", _name(value))
        kinds = (types.FunctionType, staticmethod, classmethod, property, *_ATOMS)
        members = {name: part for name, part in vars(value).items() if isinstance(part, kinds) and name != "__doc__"}
        return _hash("class", _name(value), self.of(value.__bases__), self.of(members))

    def _instance(self, value: Any) -> bytes:
        """Any other object by its class and attributes, or else by its pickled form."""
        if isinstance(value, staticmethod | classmethod):
            return self.of(value.__func__)
        if isinstance(value, property):
            return self._all("property", (value.fget, value.fset, value.fdel))
        cls = type(value)
        slots = [name for base in cls.__mro__ for name in _slots(base) if hasattr(value, name)]
        attributes = {name: getattr(value, name) for name in slots}
        for name, part in getattr(value, "__dict__", {}).items():
            if not isinstance(getattr(cls, name, None), functools.cached_property):
                attributes[name] = part
        if attributes or hasattr(value, "__dict__"):
            return _hash("object", self.of(cls), self.of(attributes))
        try:
            return _hash("pickle", self.of(cls), pickle.dumps(value))
        except Exception as error:
            raise UnidentifiableError(f"a {_name(cls)} has no content that can be compared") from error

    def _structure(self, value: Any) -> bytes:
        """A tree structure by its node types and their static data; its text would show functions by address."""
        return _hash("tree", str(value.num_leaves), self.of(value.node_data()), self.of(value.children()))


def sharding_text(sharding: Sharding) -> str:
    """A sharding as text, with its devices in order."""
    mesh = _mesh_text(sharding.mesh) if isinstance(sharding, NamedSharding) and isinstance(sharding.mesh, Mesh) else ""
    devices: Any = sharding.device_set
    ids = sorted(device.id for device in devices)
    return f"{sharding!r} {mesh} {ids}"


def _mesh_text(mesh: Mesh) -> str:
    ids = [device.id for device in mesh.devices.flat]
    return f"{mesh.axis_names} {mesh.devices.shape} {ids}"


def _hash(*parts: str | bytes) -> bytes:
    """The digest of parts, each with its length so that their borders count."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.digest()


def _text(value: Any) -> bytes:
    return _hash(_name(type(value)), str(value))


def _name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def _is_versioned(module: str | None) -> bool:
    return module is not None and module != "__main__" and module.partition(".")[0] in _VERSIONED


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not yet assigned
        return "empty"


def _slots(cls: type) -> tuple[str, ...]:
    """Names of a class's slots that hold content."""
    slots = cls.__dict__.get("__slots__", ())
    names = (slots,) if isinstance(slots, str) else tuple(slots)
    return tuple(name for name in names if name not in ("__dict__", "__weakref__"))


def _globals_read(code: types.CodeType, available: dict[str, Any]) -> dict[str, Any]:
    """The globals that a function's code and the functions defined in it read, by name."""
    names = {step.argval for step in dis.get_instructions(code) if step.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    found = {name: available[name] for name in sorted(names) if name in available}
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            found |= _globals_read(part, available)
    return found
