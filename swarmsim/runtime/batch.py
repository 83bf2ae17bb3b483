"""The mission axis: from a function of one mission to a compiled one of B missions, spread over the devices.

Nothing outside this package knows that missions are batched. Arrays of the world and the plan that are small always
carry the mission axis, so that sweeping them never compiles anew; large ones (rasters, detector tables) are shared by
all missions unless they differ.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from swarmsim.device import IN_STEP, among_cores, on_processor
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.programs import Program, prepare
from swarmsim.scalars import Layout

SMALL = 4096  # elements up to which an array carries the mission axis whether or not missions differ in it
FEW = 3  # missions that are computed by the program of one: too few to be spread over devices
MANY_VEHICLES = 1024  # of all missions on a device
TOGETHER = IN_STEP  # missions that an accelerator estimates in step; a processor core takes one, which fits its cache


def layout_for(vehicles: int) -> Layout:
    """How ``vehicles`` of all missions are laid out: as scalars on an accelerator, and on a CPU where they are many.

    As scalars a step is fused into few kernels, but where vehicles are few a CPU spends its time on calling them: one
    rover steps 40 times as fast by `jax.vmap`, a thousand multirotors 1.5 to 3.5 times as fast as scalars.
    """
    return "vmap" if jax.default_backend() == "cpu" and vehicles < MANY_VEHICLES else "scalars"


def shards_of(missions: int) -> int:
    """On how many devices a batch is spread: all, as long as each gets at least two missions."""
    return max(1, min(len(jax.devices()), missions // 2))


def filled(seeds: np.ndarray) -> np.ndarray:
    """Seeds padded with the last one, so that every device gets as many missions; the copies are discarded."""
    return np.append(seeds, np.repeat(seeds[-1], -len(seeds) % shards_of(len(seeds))))


class Batch:
    """B missions side by side on the devices, and the programs that run them."""

    def __init__(self, missions: int, clock: Clock):
        """``missions`` is a multiple of `shards_of` it. Compile nothing yet."""
        self.missions = missions
        shards = shards_of(missions)
        self.shards = shards if missions % shards == 0 else 1
        self._clock = clock
        self._mesh = Mesh(np.array(jax.devices()[: self.shards]), ("mission",)) if self.shards > 1 else None
        # devices that a batch leaves idle
        idle = on_processor() and self._mesh is None and len(jax.devices()) > 1
        self._cores = Mesh(np.array(jax.devices()), ("core",)) if idle else None
        self._programs: dict[Any, Program] = {}
        # What a processor computes mission by mission is one program for one or a few of them.
        few = self._mesh is None and 1 < missions <= FEW
        self._one = Batch(1, clock) if few and _together() == 1 else None

    def spread(self, trees: Sequence[Any]) -> "Spread":
        """Arguments of B missions on the devices, from one tree for each mission, or one tree for all.

        Trees of several missions must agree in structure and shapes.
        """
        leaves, structure = jax.tree.flatten(trees[0])
        others = [jax.tree.flatten(tree)[0] for tree in trees[1:]]
        own, shared, carries = [], [], []
        for number, leaf in enumerate(leaves):
            values = [np.asarray(leaf), *(np.asarray(other[number]) for other in others)]
            differ = any(value is not values[0] and not np.array_equal(value, values[0]) for value in values)
            carries.append(differ or values[0].size <= SMALL)
            if carries[-1]:
                rows = np.stack([values[i] for i in np.minimum(np.arange(self.missions), len(values) - 1)])
                own.append(self.put(rows))
            else:
                shared.append(self.put(values[0], shared=True))
        return Spread(structure, tuple(carries), own, shared)

    def put(self, array: Any, *, shared: bool = False) -> Any:
        """An array [B, …] spread over the devices, or a shared one copied to each."""
        if self._cores is not None:  # what these have shared comes back to the first one for good
            return jax.device_put(array, jax.devices()[0])
        if self._mesh is None:
            return jax.device_put(array)
        return jax.device_put(array, NamedSharding(self._mesh, PartitionSpec() if shared else PartitionSpec("mission")))

    def run(
        self,
        name: str,
        function: Callable[..., Any],
        inputs: Sequence["Spread"],
        carried: Any,
        common: Sequence[Any] = (),
        *,
        only: Any = None,
        in_turn: bool = False,
        donate: bool = False,
        again: "Again | None" = None,
        shared: bool = False,
    ) -> Any:
        """``function(*inputs, carried, *common)`` of one mission, for all B at once.

        Args:
            name: of the program.
            function: of one mission; everything static about it is fingerprinted, so name no values in its closure.
            inputs: what differs by mission or not, as made by `spread`.
            carried: pytree with the mission axis on every leaf.
            common: arrays that all missions share.
            only: [B] bool. With it the function maps ``carried`` to the like, and is evaluated for those missions
                alone, in turn; the others keep theirs.
            in_turn: one mission after the other, on an accelerator in groups of `TOGETHER`: for what fills a device.
            donate: the result takes over the buffers of ``carried``, which is not used again: nothing that merely
                passes through is copied.
            again: evaluate the function, which then returns (carried, record, verdict), several times in one call.
            shared: where missions are too few for all processor cores, these share what the function computes with
                `swarmsim.device.each`.

        Returns:
            Its result with the mission axis on every leaf. With ``again`` (carried, records, verdict, times): records
            have an axis of evaluations after that of the missions, and were made ``times`` [B] times, as often for
            each mission; the rest of their rows are zero.
        """
        if self._one is not None and (in_turn or only is not None):
            made = self._one_by_one(name, function, inputs, carried, common, only, donate, shared)
            if donate:
                jax.tree.map(lambda leaf: leaf.delete(), carried)
            return made
        whole = self._call(name, function, inputs, carried, common, only, in_turn, donate, again, shared)
        program, arguments = whole
        if not shared or self._cores is None:
            return program(*arguments)
        results = program(*jax.device_put(arguments, NamedSharding(self._cores, PartitionSpec())))
        return jax.tree.map(lambda x: x.addressable_shards[0].data, results)

    def _one_by_one(
        self,
        name: str,
        function: Callable[..., Any],
        inputs: Sequence["Spread"],
        carried: Any,
        common: Sequence[Any],
        only: Any,
        donate: bool,
        shared: bool,
    ) -> Any:
        """`run` by the program of one mission; a mission that is not asked for keeps what it carries."""
        one = self._one
        assert one is not None
        leaves, structure = jax.tree.flatten(carried)
        leaves = [np.asarray(leaf) for leaf in leaves]
        asked = np.arange(self.missions) if only is None else np.flatnonzero(np.asarray(only))
        made: list[np.ndarray] = [] if only is None else [leaf.copy() for leaf in leaves]
        for mission in asked:
            rows = slice(mission, mission + 1)
            own = jax.tree.unflatten(structure, [one.put(leaf[rows].copy()) for leaf in leaves])
            chosen = None if only is None else one.put(np.ones(1, bool))
            result = one.run(
                name, function, [spread.rows(one, rows) for spread in inputs], own, common,
                only=chosen, in_turn=only is None, donate=donate, shared=shared,
            )  # fmt: skip
            found, structure_ = jax.tree.flatten(result)
            made = made or [np.zeros((self.missions, *leaf.shape[1:]), leaf.dtype) for leaf in found]
            for whole, leaf in zip(made, found, strict=True):
                whole[rows] = leaf
        return jax.tree.unflatten(structure if only is not None else structure_, [self.put(leaf) for leaf in made])

    def prepare(self, calls: Sequence[dict[str, Any]]) -> None:
        """Begin to load or compile the programs of future calls of `run` (its arguments by name), side by side."""
        prepare([self._prepared(call) for call in calls])

    def _prepared(self, call: dict[str, Any]) -> tuple[Program, Any]:
        """The program of a call, and what its arguments will be like."""
        one = self._one
        if one is not None and (call.get("in_turn") or call.get("only") is not None):
            first = slice(0, 1)
            carried = jax.tree.map(lambda leaf: one.put(np.asarray(leaf)[first]), call["carried"])
            chosen = None if call.get("only") is None else one.put(np.ones(1, bool))
            spreads = [spread.rows(one, first) for spread in call["inputs"]]
            alone = {"carried": carried, "inputs": spreads, "only": chosen}
            return one._prepared(call | alone)
        defaults = {"common": (), "only": None, "in_turn": False, "donate": False, "again": None, "shared": False}
        program, arguments = self._call(**(defaults | call))
        if call.get("shared") and self._cores is not None:
            everywhere = NamedSharding(self._cores, PartitionSpec())
            arguments = jax.tree.map(partial(_placed, everywhere), arguments)
        return program, arguments

    def _call(
        self,
        name: str,
        function: Callable[..., Any],
        inputs: Any,
        carried: Any,
        common: Any,
        only: Any,
        in_turn: bool,
        donate: bool,
        again: "Again | None",
        shared: bool,
    ) -> tuple[Program, tuple[Any, Any, Any]]:
        """The program and its arguments."""
        shape = (name, tuple((s.structure, s.carries) for s in inputs), only is not None, in_turn, donate, again)
        program = self._programs.get(shape)
        if program is None:
            apply = partial(_apply, function, tuple((s.structure, s.carries) for s in inputs))
            batched = partial(_in_turn, _together()) if in_turn or only is not None else _every
            if again is not None:  # parts of the batch would have to wait for one another after each
                batched = partial(_again, again if self._mesh is None else replace(again, most=1))
            whole = self._sharded(partial(batched, apply), shared)
            taken = (0,) if donate else ()
            program = self._programs[shape] = Program(name, whole, clock=self._clock, donate=taken)
        return program, (carried, ([s.own for s in inputs], only), ([s.shared for s in inputs], tuple(common)))

    def _sharded(self, function: Callable[..., Any], shared: bool) -> Callable[..., Any]:
        """The function of equal parts of the missions, on the devices side by side; parts do not wait for another."""
        if shared and self._cores is not None:
            everywhere = PartitionSpec()
            split = partial(_among_cores, function)
            return jax.shard_map(
                split, mesh=self._cores, in_specs=everywhere, out_specs=everywhere, check_vma=False
            )  # fmt: skip
        if self._mesh is None:
            return function
        each, all_ = PartitionSpec("mission"), PartitionSpec()
        return jax.shard_map(function, mesh=self._mesh, in_specs=(each, each, all_), out_specs=each, check_vma=False)


@dataclass(frozen=True)
class Again:
    """How often a function of all missions is evaluated in one call, which costs the host some milliseconds."""

    most: int
    onward: Callable[..., tuple[jax.Array, Any]]
    """From the verdicts of all missions and the common arguments: whether [] to go on, and with which ones."""


class Spread:
    """A pytree whose leaves either carry the mission axis (``own``) or are ``shared``."""

    def __init__(self, structure: Any, carries: tuple[bool, ...], own: list[Any], shared: list[Any]):
        self.structure, self.carries, self.own, self.shared = structure, carries, own, shared

    def rows(self, batch: Batch, rows: slice) -> "Spread":
        """That of some missions, on the devices of a ``batch`` of as many."""
        own = [batch.put(np.asarray(leaf)[rows]) for leaf in self.own]
        return Spread(self.structure, self.carries, own, self.shared)

    def of(self, mission: int) -> Any:
        """The pytree of one mission, on the host."""
        return self.part(mission, lambda whole: whole)

    def part(self, mission: int, chosen: Callable[[Any], Any]) -> Any:
        """What ``chosen`` takes of the pytree of one mission, on the host; nothing else is fetched from the devices."""
        arrays = self._arrays()

        def fetched(number: int) -> np.ndarray:
            return np.asarray(arrays[number][mission] if self.carries[number] else arrays[number])

        return jax.tree.map(fetched, chosen(jax.tree.unflatten(self.structure, range(len(arrays)))))

    def chosen(self, chosen: Callable[[Any], Any]) -> "Spread":
        """What ``chosen`` takes of the pytree, as one of its own: a program of it is the same whatever else differs."""
        arrays = self._arrays()
        numbers, structure = jax.tree.flatten(chosen(jax.tree.unflatten(self.structure, range(len(arrays)))))
        carries = tuple(self.carries[number] for number in numbers)
        own = [arrays[number] for number in numbers if self.carries[number]]
        return Spread(structure, carries, own, [arrays[number] for number in numbers if not self.carries[number]])

    def _arrays(self) -> list[Any]:
        """All leaves in their order."""
        own, shared = iter(self.own), iter(self.shared)
        return [next(own) if carries else next(shared) for carries in self.carries]


def _among_cores(function: Callable[..., Any], *arguments: Any) -> Any:
    with among_cores("core"):
        return function(*arguments)


def _placed(sharding: NamedSharding, array: Any) -> jax.ShapeDtypeStruct:
    """What an array will be like once it is there."""
    return jax.ShapeDtypeStruct(array.shape, array.dtype, sharding=sharding)


def _together() -> int:
    return 1 if on_processor() else TOGETHER


def _apply(function: Callable[..., Any], shapes: Any, carried: Any, own: Any, common: Any) -> Any:
    """The function of one mission on its unpacked arguments."""
    (own_leaves, _), (shared_leaves, arrays) = own, common
    inputs = []
    for (structure, carries), mine, shared in zip(shapes, own_leaves, shared_leaves, strict=True):
        own_part, shared_part = iter(mine), iter(shared)
        leaves = [next(own_part) if carry else next(shared_part) for carry in carries]
        inputs.append(jax.tree.unflatten(structure, leaves))
    return function(*inputs, carried, *arrays)


def _every(apply: Callable[..., Any], carried: Any, own: Any, common: Any) -> Any:
    """All missions in step; a processor computes a single one without vmap, which is traced and compiled faster."""
    if on_processor() and jax.tree.leaves(carried)[0].shape[0] == 1:  # a GPU would wait for the host at conditions
        return _alone(apply, carried, own, common)
    return jax.vmap(apply, in_axes=(0, 0, None))(carried, own, common)


def _again(again: Again, apply: Callable[..., Any], carried: Any, own: Any, common: Any) -> Any:
    """All missions in step, time after time."""
    shared, first = common
    # traced once, for its shapes and for the loop
    once = jax.jit(lambda carried, own, shared, arrays: _every(apply, carried, own, (shared, arrays)), inline=True)
    _, record, verdict = jax.eval_shape(once, carried, own, shared, first)
    records = jax.tree.map(lambda x: jnp.zeros((x.shape[0], again.most, *x.shape[1:]), x.dtype), record)
    verdict = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), verdict)

    def go_on(state: Any) -> jax.Array:
        times, wanted, *_ = state
        return (times < again.most) & wanted

    def body(state: Any) -> Any:
        times, _, carried, arrays, records, _ = state
        carried, record, verdict = once(carried, own, shared, arrays)
        records = jax.tree.map(lambda whole, row: whole.at[:, times].set(row), records, record)
        wanted, arrays = again.onward(verdict, arrays)
        return times + 1, wanted, carried, arrays, records, verdict

    start = (jnp.int32(0), jnp.array(True), carried, jax.tree.map(jnp.asarray, first), records, verdict)
    times, _, carried, _, records, verdict = jax.lax.while_loop(go_on, body, start)
    return carried, records, verdict, jnp.full(jax.tree.leaves(record)[0].shape[0], times)


def _in_turn(together: int, apply: Callable[..., Any], carried: Any, own: Any, common: Any) -> Any:
    """Groups of missions after one another; where only some are asked for, the groups are made up of those."""
    only = own[1]
    missions = jax.tree.leaves(carried)[0].shape[0]
    size = min(together, missions)
    places = jnp.arange(-(-missions // size) * size)

    def evaluate(places: jax.Array, carried: Any = carried) -> Any:
        mine, theirs = jax.tree.map(lambda x: x[jnp.minimum(places, missions - 1)], (carried, own))
        return _every(apply, mine, theirs, common) if size > 1 else _alone(apply, mine, theirs, common)

    if only is None:
        made = jax.lax.map(evaluate, places.reshape(-1, size))
        # -1 would say nothing of what has no size, such as the thickness of walls that are known
        return jax.tree.map(lambda x: x.reshape(len(places), *x.shape[2:])[:missions], made)
    if missions == 1:
        return jax.lax.cond(only[0], lambda: _alone(apply, carried, own, common), lambda: carried)
    if size == missions:
        return jax.lax.cond(jnp.any(only), lambda: _chosen(only, evaluate(places), carried), lambda: carried)
    asked = jnp.sum(only)
    order = jnp.argsort(~only, stable=True)
    order = jnp.where(places < asked, order[jnp.minimum(places, missions - 1)], missions)  # the rest is dropped

    def take(number: jax.Array, carried: Any) -> Any:
        group = jax.lax.dynamic_slice(order, (number * size,), (size,))
        return jax.tree.map(lambda new, old: old.at[group].set(new, mode="drop"), evaluate(group, carried), carried)

    return jax.lax.fori_loop(0, -(-asked // size), take, carried)


def _alone(apply: Callable[..., Any], carried: Any, own: Any, common: Any) -> Any:
    """The function of a group of one mission, without vmap: conditions stay conditions."""
    result = apply(*jax.tree.map(lambda x: x[0], (carried, own)), common)
    return jax.tree.map(lambda x: jnp.asarray(x)[None], result)


def _chosen(only: jax.Array, new: Any, old: Any) -> Any:
    """``new`` for the missions ``only`` [B], ``old`` for the others."""
    return jax.tree.map(lambda x, y: jnp.where(only.reshape(-1, *(1,) * (x.ndim - 1)), x, y), new, old)
