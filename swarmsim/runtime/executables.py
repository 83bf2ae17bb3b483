"""Compiled executables that threads share and later processes read back."""

import io
import pickle
import threading
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.monitoring
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from swarmsim.store import package_digest, read_entry, write_entry


class UnstorableError(ValueError):
    """A program that no other process can run: it calls back into Python, or its results cannot be pickled."""


@dataclass(frozen=True)
class Executable:
    """A compiled function of arrays, and the tree of what they stand for in its result."""

    call: Any  # a `jax.stages.Compiled` of arrays to a list of arrays
    tree: bytes  # see `results_tree`

    @staticmethod
    def of(call: Any, results: Any, arguments: Any) -> "Executable":
        """An executable with the tree structures of its results and of its arguments.

        Raises `UnstorableError` where a static field of the results is neither picklable nor one of the arguments'.
        """
        with io.BytesIO() as file:
            try:
                _Pickler(file, arguments).dump(results)
            except Exception as error:  # pickle promises no type
                raise UnstorableError(str(error)) from error
            return Executable(call, file.getvalue())

    def results_tree(self, arguments: Any) -> Any:
        """The tree structure of the results for arguments of a tree structure, with their static values."""
        return _Unpickler(self.tree, arguments).load()

    def save(self, key: str) -> None:
        """Store for later processes; raises `UnstorableError` where one could not run it."""
        try:
            serialized, _, results = serialize(self.call)
            device_ids = [device.id for device in self.call.runtime_executable().local_devices()]
            content = pickle.dumps((serialized, results, device_ids, self.tree))
        except Exception as error:  # XLA and pickle promise no type
            raise UnstorableError(str(error)) from error
        write_entry(package_digest(), key, content)


def load(key: str, leaves: int) -> Executable | None:
    """The executable of a key for a number of arrays; None if it is not stored or cannot be used here."""
    content = read_entry(package_digest(), key)
    if content is None:
        return None
    try:
        serialized, results, device_ids, tree = pickle.loads(content)
        by_id = {device.id: device for device in jax.devices()}
        devices = [by_id[number] for number in device_ids]
        if b"lapack_" in serialized:
            _initialize_lapack()
        arguments = jax.tree.structure((tuple(range(leaves)), {}))
        return Executable(deserialize_and_load(serialized, arguments, results, execution_devices=devices), tree)
    except Exception:  # as above; compiling instead gives the same program
        return None


class Executables:
    """The executables of this process that were made last, by key."""

    def __init__(self, most: int):
        self._most = most
        self._by_key: dict[str, Executable] = {}
        self._locks: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()

    def lock_of(self, key: str) -> threading.Lock:
        """One lock for each key, so that two threads do not compile the same program."""
        return self._locks.setdefault(key, threading.Lock())

    def get(self, key: str) -> Executable | None:
        """The executable of a key, if kept."""
        return self._by_key.get(key)

    def put(self, key: str, executable: Executable) -> None:
        """Keep an executable, and drop the oldest above the number to keep."""
        with self._lock:
            self._by_key.pop(key, None)
            self._by_key[key] = executable
            while len(self._by_key) > self._most:
                del self._by_key[next(iter(self._by_key))]

    def clear(self) -> None:
        """Drop all."""
        with self._lock:
            self._by_key.clear()


def cache_reads() -> int:
    """How many programs this thread has compiled by reading JAX's persistent cache, where a user has switched that on.

    XLA's CPU client serialises such a program without its machine code, so it must not be stored again.
    """
    return _READS.count


class _CacheReads(threading.local):
    count = 0

    def listen(self, event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            self.count += 1


_READS = _CacheReads()
jax.monitoring.register_event_listener(_READS.listen)


@lru_cache
def _initialize_lapack() -> None:
    """Connect JAX's calls of LAPACK, which it does when it lowers the first of them; before, they are null pointers."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), "float32"))


class _Pickler(pickle.Pickler):
    """Pickles a results' tree; static values that came in with the arguments are named by their place there.

    Those may be functions, many of which cannot be pickled; and a key promises that the arguments have the like.
    """

    def __init__(self, file: io.BytesIO, arguments: Any):
        super().__init__(file)
        self._places = {id(value): place for place, value in enumerate(_statics(arguments))}

    def persistent_id(self, value: Any) -> int | None:
        return self._places.get(id(value))


class _Unpickler(pickle.Unpickler):
    """The inverse of `_Pickler`."""

    def __init__(self, content: bytes, arguments: Any):
        super().__init__(io.BytesIO(content))
        self._values = _statics(arguments)

    def persistent_load(self, place: Any) -> Any:
        return self._values[place]


_PLAIN = (bool, int, float, str, bytes, type(None), type)


def _statics(structure: Any) -> list[Any]:
    """The static fields of a tree's dataclasses, in order, but for plain values."""
    own: Any = (structure.node_data() or (None, None))[1]
    found = [value for value in own if not isinstance(value, _PLAIN)] if isinstance(own, tuple) else []
    return found + [value for child in structure.children() for value in _statics(child)]
