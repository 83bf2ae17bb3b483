"""Functions compiled once: for the process, and for every later process of this user on this kind of machine.

A program is found by a digest of what decides its machine code, computed without tracing (see `Program`). Its
executable is looked up in this process, then in the user's cache folder (see `swarmsim.store`); only then is
the function traced and compiled. JAX's own compilation cache is not needed and not touched.
"""

import contextlib
import gc
import hashlib
import itertools
import operator
import os
import time
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax

from swarmsim.device import on_processor
from swarmsim.runtime.clock import Clock, Source
from swarmsim.runtime.compilations import COMPILATIONS
from swarmsim.runtime.environment import environment, settings
from swarmsim.runtime.executables import Executable, Executables, UnstorableError, cache_reads, load
from swarmsim.runtime.fingerprint import UnidentifiableError, fingerprint, sharding_text
from swarmsim.runtime.waiting import waited_for

# Settings that may change between two calls of a program; the others are set once, before JAX starts.
_CHANGEABLE: dict[str, Callable[[Any], contextlib.AbstractContextManager[Any]]] = {
    "jax_enable_x64": jax.enable_x64,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_debug_nans": jax.debug_nans,
    "jax_default_device": jax.default_device,
}

_PATIENCE = (
    "xla_cpu_collective_call_warn_stuck_seconds",
    "xla_cpu_collective_call_terminate_timeout_seconds",
    "xla_cpu_collective_timeout_seconds",
)
_FOREVER_S = 100_000_000

_Ready = tuple[Callable[..., Any], Any]  # a compiled function of arrays to arrays, and the tree of its results
_COMPILED: Source = "compiled"
T = TypeVar("T")


class Program:
    """A pure function, compiled for each structure, shape and placement of its arguments that it meets.

    What decides the machine code, and so makes the key: the program's name; the function with all that it closes over
    (see `fingerprint`) and ``identity``; which arguments are donated; the arguments' tree, shapes, dtypes, weak types
    and shardings; the sources of swarmsim; the versions of the packages it stands on; the devices; the settings of JAX
    and XLA; the processor. Values that are arguments decide nothing: a program runs for other values as it is.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any],
        *,
        clock: Clock,
        identity: Hashable = (),
        donate: tuple[int, ...] = (),
    ):
        """Compile nothing yet.

        ``identity`` is static configuration that the function reads from elsewhere than its closure and arguments (a
        registry, a file), as plain values. ``donate`` numbers the arguments whose buffers the results may take over.
        """
        self.name = name
        self._function = function
        self._identity = identity
        self._donate = donate
        self._clock = clock
        self._executables: dict[Any, _Ready] = {}
        self._coming: dict[Any, Future[tuple[_Ready, Source]]] = {}  # what `prepare` has begun
        self._last: tuple[_Marks, _Ready] | None = None  # the last call's marks and executable

    def __call__(self, *arguments: Any) -> Any:
        """The function's value, computed to the end; waiting for the executable and running are timed on the clock."""
        leaves, structure = jax.tree.flatten(arguments)
        marks = _Marks(leaves, structure)
        if self._last is None or not marks.same(self._last[0]):
            self._last = marks, self._ready(arguments)
        call, tree = self._last[1]
        start = time.perf_counter()
        results = call(*leaves)
        waited_for(lambda: jax.block_until_ready(results[-1:]))  # an executable's results are ready together
        self._clock.add("ran", self.name, time.perf_counter() - start)
        return jax.tree.unflatten(tree, results)

    def executable(self, *arguments: Any) -> tuple[Callable[..., Sequence[jax.Array]], Any]:
        """The compiled function of the arguments' leaves to the results' leaves, and the tree of the results.

        For what is called a thousand times a second: a call of the program itself waits in a thread, so that Ctrl-C
        interrupts it, and compares its arguments with those before, which together take 0.7 ms. The arguments of the
        calls must be as those given here in structure, shape, type and placement.
        """
        return self._ready(arguments)

    def _ready(self, arguments: Sequence[Any]) -> _Ready:
        """The executable for these arguments; the seconds that it is waited for go to the clock."""
        situation = _situation(*jax.tree.flatten(tuple(arguments)))
        if situation not in self._executables:
            start = time.perf_counter()
            coming = self._coming.pop(situation, None)
            self._executables[situation], source = self._obtain(arguments) if coming is None else coming.result()
            self._clock.add(source, self.name, time.perf_counter() - start)
        return self._executables[situation]

    def _begin(self, threads: ThreadPoolExecutor, arguments: Sequence[Any]) -> None:
        """Obtain the executable for these arguments in the background, unless that is done or under way."""
        arguments = jax.tree.map(_described, tuple(arguments))  # a call may take the arrays over meanwhile
        situation = _situation(*jax.tree.flatten(arguments))
        if situation not in self._executables and situation not in self._coming:
            self._coming[situation] = threads.submit(self._obtain_with, _changeable(), arguments)

    def _obtain_with(self, settings: Sequence[Any], arguments: Sequence[Any]) -> tuple[_Ready, Source]:
        """`_obtain` with the settings of the thread that asked for it: those of a context are that thread's alone."""
        with contextlib.ExitStack() as stack:
            for manager, value in zip(_CHANGEABLE.values(), settings, strict=True):
                stack.enter_context(manager(value))
            return self._obtain(arguments)

    def _obtain(self, arguments: Sequence[Any]) -> tuple[_Ready, Source]:
        """The executable for these arguments, and how it was obtained."""
        leaves, structure = jax.tree.flatten(tuple(arguments))
        with uncollected():
            key = self._key(leaves, structure)
            return (self._compile(arguments)[0], _COMPILED) if key is None else self._shared(key, arguments)

    def _shared(self, key: str, arguments: Sequence[Any]) -> tuple[_Ready, Source]:
        """The executable of a key: of this process, or from the user's folder, or compiled and stored there."""
        leaves, structure = jax.tree.flatten(tuple(arguments))
        with _EXECUTABLES.lock_of(key):
            executable = _EXECUTABLES.get(key) or load(key, len(leaves))
            if executable is not None:
                _EXECUTABLES.put(key, executable)
                return (executable.call, executable.results_tree(structure)), "loaded"
            (call, results), read = self._compile(arguments)
            try:
                executable = Executable.of(call, results, structure)
                _EXECUTABLES.put(key, executable)
                if not read:
                    executable.save(key)
            except UnstorableError as error:
                _warn_not_kept(self.name, error)
            return (call, results), _COMPILED

    def _compile(self, arguments: Sequence[Any]) -> tuple[_Ready, bool]:
        """The function of flat arguments and results, compiled, with the tree of its results; whether JAX had it."""
        with COMPILATIONS.of(self.name):
            return self._traced_and_compiled(arguments)

    def _traced_and_compiled(self, arguments: Sequence[Any]) -> tuple[_Ready, bool]:
        leaves, structure = jax.tree.flatten(tuple(arguments))
        trees = []

        def flat(*leaves: Any) -> list[Any]:
            results, tree = jax.tree.flatten(self._function(*jax.tree.unflatten(structure, leaves)))
            trees.append(tree)
            return [_strongly_typed(result) for result in results]

        flat.__name__ = self.name.replace(" ", "_")  # what profilers show
        ends = [0, *itertools.accumulate(len(jax.tree.leaves(argument)) for argument in arguments)]
        donated = [leaf for number in self._donate for leaf in range(ends[number], ends[number + 1])]
        with _full_precision():
            lowered = jax.jit(flat, donate_argnums=donated).lower(*leaves)

        def compiled() -> tuple[Callable[..., Any], bool]:
            before = cache_reads()  # of this thread
            return _machine_code(lowered), cache_reads() > before

        code, read = waited_for(compiled)
        return (code, trees[0]), read

    def _key(self, leaves: Sequence[Any], structure: Any) -> str | None:
        """The key of the executable; None, with a warning, where the function cannot be identified."""
        try:
            function, tree = self._function_fingerprint(), fingerprint(structure)
        except UnidentifiableError as error:
            _warn_not_kept(self.name, error)
            return None
        parts = (self.name, function, str(self._donate), tree, *map(_leaf_text, leaves), settings(), environment())
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _function_fingerprint(self) -> str:
        if not hasattr(self, "_fingerprint"):
            self._fingerprint = fingerprint((self._function, self._identity))
        return self._fingerprint


def _full_precision() -> contextlib.AbstractContextManager[Any]:
    """Products of float32 matrices as such, while a program is traced.

    An accelerator would round their factors to 10 bits of mantissa (TF32 of Nvidia's). A precision that the user has
    set stays.
    """
    chosen = jax.config.values["jax_default_matmul_precision"] is not None
    return contextlib.nullcontext() if chosen or on_processor() else jax.default_matmul_precision("float32")


def _machine_code(lowered: Any) -> Any:
    """A lowered program, compiled.

    Where XLA's CPU compiler still has a choice (until jaxlib 0.10), its older way of emitting loops compiles a mission
    in three quarters of the time, and the mission flies as fast. Devices that exchange data wait for one another as
    long as it takes: XLA would end the process after half a minute, and so one that was suspended.
    """
    options: dict[str, Any] = {}
    if jax.default_backend() == "cpu":
        options = {"xla_cpu_use_fusion_emitters": False} | dict.fromkeys(_PATIENCE, _FOREVER_S)
    while True:
        try:
            return lowered.compile(compiler_options=options)
        except jax.errors.JaxRuntimeError as error:
            unknown = [name for name in options if "No such compile option" in str(error) and name in str(error)]
            if not unknown:
                raise
            options = {name: value for name, value in options.items() if name not in unknown}


def prepare(work: Sequence[tuple[Program, Sequence[Any]]]) -> None:
    """Begin to load or compile programs for their arguments, which may be `jax.ShapeDtypeStruct` trees.

    Returns at once: a call waits for its own program only. XLA compiles and loads outside Python's global lock, so
    several programs are made side by side, in the order given, while the first of them run already. An error is
    raised by the call.
    """
    threads = ThreadPoolExecutor(os.cpu_count() or 1, "swarmsim-programs")
    for program, arguments in work:
        program._begin(threads, arguments)
    threads.shutdown(wait=False)


def forget() -> None:
    """Drop the executables that this process keeps for programs to come; those in use stay with their programs."""
    _EXECUTABLES.clear()


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Pause the cyclic garbage collector, which takes 25 % of the time of tracing."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


# A mission's larger programs take about 1,500 memory maps each, of the 65,530 that Linux allows a process, and some
# 100 MB: a process that meets ever new scenarios keeps those of the last few.
_EXECUTABLES = Executables(most=16)


def _warn_not_kept(name: str, reason: Exception) -> None:
    warnings.warn(f"program {name!r} is compiled anew in every process: {reason}", stacklevel=2)


def _changeable() -> tuple[Any, ...]:
    return tuple(getattr(jax.config, name) for name in _CHANGEABLE)


def _situation(leaves: Sequence[Any], structure: Any) -> Hashable:
    """What chooses among the executables of one program."""
    return structure, tuple(map(_leaf, leaves)), _changeable()


def _leaf(leaf: Any) -> tuple[Any, ...]:
    """Shape, dtype, weak type and placement of an argument; placement is None where JAX may choose it."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return leaf.shape, leaf.dtype, leaf.weak_type, leaf.sharding
    kind = jax.typeof(leaf)
    placement = leaf.sharding if getattr(leaf, "committed", False) else None
    return kind.shape, kind.dtype, kind.weak_type, placement


def _described(leaf: Any) -> jax.ShapeDtypeStruct:
    """All of an argument that chooses its executable."""
    shape, dtype, weak_type, placement = _leaf(leaf)
    return jax.ShapeDtypeStruct(shape, dtype, sharding=placement, weak_type=weak_type)


_PLACED = operator.attrgetter("aval", "committed", "sharding")


class _Marks:
    """What `_leaf` tells of the leaves of a call, in objects that results of one program share.

    Whether two calls are alike is then known from the objects' identity, in no time; if these differ, the calls may
    still be alike.
    """

    def __init__(self, leaves: Sequence[Any], structure: Any):
        """Take the marks of ``leaves``; whatever they refer to is kept alive, but none of the arrays."""
        self.structure, self.settings = structure, _changeable()
        self.objects: list[Any] = []
        self.others: list[Any] = []  # of what is no array of JAX
        for leaf in leaves:
            try:
                self.objects += _PLACED(leaf)
            except AttributeError:
                self.others.append(_leaf(leaf))

    def same(self, other: "_Marks") -> bool:
        """Whether both are certainly marks of calls of one executable."""
        return (
            len(self.objects) == len(other.objects)
            and all(map(operator.is_, self.objects, other.objects))
            and self.others == other.others
            and self.structure == other.structure
            and self.settings == other.settings
        )


def _strongly_typed(result: Any) -> Any:
    """The result with a fixed type: a state that goes round from program to program then always looks the same."""
    weak = jax.typeof(result).weak_type
    return jax.lax.convert_element_type(result, result.dtype) if weak else result


def _leaf_text(leaf: Any) -> str:
    shape, dtype, weak_type, sharding = _leaf(leaf)
    return f"{shape} {dtype} {weak_type} {sharding_text(sharding) if sharding is not None else 'anywhere'}"
