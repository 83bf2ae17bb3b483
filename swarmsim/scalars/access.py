"""How a kernel of a GPU reads and writes memory: many entries at once, apart from all that is computed.

For every access to memory Triton (`CoalescePass`) collects the operations that are tied to it: those that it depends
on, those that depend on it, and again all of theirs. In a kernel whose operations are all tied to one another that is
the whole kernel, for each access, in a time that grows with the square of its size: minutes for a mission. It stops at
what the body of a loop is given and at what the body hands on. Entries are therefore read and written in the bodies of
loops of one pass, whose operations are the accesses and the sums that make their places. Not even a constant comes from
outside, because operations that have a constant in common are tied by it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from swarmsim.scalars.graph import Graph, Node, Scalar, is_constant, unbound


@dataclass(frozen=True)
class Rows:
    """How the entries of the vehicles follow one another in an array."""

    of_vehicle: bool
    of_mission: bool
    entries: int  # of one vehicle

    @property
    def shared(self) -> bool:
        """Whether all vehicles have the same entries."""
        return not (self.of_vehicle or self.of_mission)

    def first(self, size: int, vehicle: jax.Array) -> jax.Array | None:
        """Index of each vehicle's first entry, None where they share all; ``vehicle`` counts through all missions.

        A mission has ``size`` vehicles.
        """
        entries = np.int32(self.entries)
        if self.of_vehicle and self.of_mission:
            return vehicle * entries
        if self.of_vehicle:
            return lax.rem(vehicle, np.int32(size)) * entries
        return lax.div(vehicle, np.int32(size)) * entries if self.of_mission else None


class Read(Node):
    """An entry in memory, ``offset`` and ``place`` after the vehicle's first one."""

    __slots__ = ("offset", "place", "ref", "rows")

    def __init__(self, ref: Any, rows: Rows, offset: Scalar, place: int):
        known = is_constant(offset)
        mapped = not rows.shared or (not known and offset.mapped)
        super().__init__(_read_with_others, () if known else (offset,), mapped)
        self.ref, self.rows = ref, rows
        self.offset: Node | None = None if known else offset
        self.place = place + int(offset) if known else place


def _read_with_others(*_: Any) -> None:
    raise AssertionError("entries are read together")


@dataclass(frozen=True)
class Memory:
    """What a kernel's thread has to know to find its vehicle's entries."""

    size: int  # vehicles of a mission
    vehicle: jax.Array  # [threads] int32: number of each thread's vehicle, counted through all missions


@dataclass
class MemoryGraph(Graph):
    """A graph in which entries are read from memory, as many as possible together."""

    memory: Memory = field(kw_only=True)
    _reads: dict[Any, Read] = field(default_factory=dict)

    def inner(self) -> "MemoryGraph":
        """Empty graph for the trace of a loop's or a branch's body."""
        return MemoryGraph(self.size, self.varying, self.stores, memory=self.memory)

    def read(self, ref: Any, rows: Rows, offset: Scalar, place: int) -> Read:
        """The entry at ``offset + place``."""
        made = Read(ref, rows, offset, place)
        return self._reads.setdefault((id(ref), made.place, id(made.offset)), made)

    def values(self, scalars: Any) -> list[Any]:
        """Value of each scalar; binds what has not been bound yet."""
        scalars = list(scalars)
        for reads in _rounds(unbound(x for x in scalars if isinstance(x, Node) and x.value is None)):
            super().values(read.offset for read in reads if read.offset is not None)
            for read, value in zip(reads, self._read(reads), strict=True):
                read.value = value
        return super().values(scalars)

    def _read(self, reads: Sequence[Read]) -> list[Any]:
        memory = self.memory
        firsts = {read.rows: read.rows.first(memory.size, memory.vehicle) for read in reads}
        firsts = {rows: first for rows, first in firsts.items() if first is not None}
        offsets = {read.offset: read.offset.value for read in reads if read.offset is not None}

        def work(number: "Numbers", given: Sequence[Any]) -> list[Any]:
            known: dict[Any, Any] = dict(zip([*firsts, *offsets], given, strict=True))
            return [r.ref[number.after(r.place, known.get(r.rows), known.get(r.offset))] for r in reads]

        blank = [jnp.zeros((self.size,) if read.mapped else (), read.ref.dtype) for read in reads]
        return apart(work, [*firsts.values(), *offsets.values()], blank)


def _rounds(order: Sequence[Node]) -> Iterator[list[Read]]:
    """The reads among nodes, each of which comes after its operands: first those that depend on no other read."""
    rounds: dict[Node, int] = {}  # reads that come before, one after another
    found: list[list[Read]] = []
    for node in order:
        before = [x for x in node.operands if isinstance(x, Node) and x in rounds]
        rounds[node] = number = max((rounds[x] + isinstance(x, Read) for x in before), default=0)
        if isinstance(node, Read):
            found += [[] for _ in range(len(found), number + 1)]
            found[number].append(node)
    yield from found


class Numbers:
    """Integers as sums of powers of two, of a one that is no constant to the compiler."""

    def __init__(self, one: jax.Array):
        self._powers, self._sums = [one], dict[int, Any]()

    def after(self, place: int, *given: Any) -> Any:
        """The sum of a place and of what is given of several summands."""
        summands = [x for x in given if x is not None]
        if place or not summands:
            summands.append(self._sum(place) if place else np.int32(0))
        total = summands[0]
        for summand in summands[1:]:
            total = total + summand
        return total

    def _sum(self, number: int) -> Any:
        if number not in self._sums:
            while len(self._powers) < number.bit_length():
                self._powers.append(self._powers[-1] + self._powers[-1])
            highest = number.bit_length() - 1
            rest = number - (1 << highest)
            self._sums[number] = self._powers[highest] + self._sum(rest) if rest else self._powers[highest]
        return self._sums[number]


def apart(work: Callable[[Numbers, Sequence[Any]], list[Any]], given: Sequence[Any], blank: list[Any]) -> list[Any]:
    """``work`` on what is ``given`` to it, in a loop of one pass; ``blank`` has the shapes and types of its results.

    MLIR takes a loop that counts for what it is, and Triton looks at the whole of one with a single region: this one
    doubles its count and has a second region for the test. LLVM then finds that it has one pass, and no loop is left.
    """

    def body(carry: Any) -> Any:
        one, mine, _ = carry
        return one + one, _turned(mine), work(Numbers(one), mine)

    results: list[Any] = lax.while_loop(lambda carry: carry[0] < 2, body, (jnp.int32(1), list(given), blank))[2]
    return results


def _turned(given: Sequence[Any]) -> list[Any]:
    """What is given in another order, or changed: what a loop hands on as it is would be taken out of the loop."""
    alike: dict[Any, list[int]] = {}
    for place, x in enumerate(given):
        alike.setdefault((x.shape, x.dtype), []).append(place)
    turned = list(given)
    for places in alike.values():
        for place, other in zip(places, [*places[1:], places[0]], strict=True):
            x = given[other]
            changed = lax.neg if x.dtype == jnp.float32 else lax.bitwise_not
            turned[place] = x if len(places) > 1 else changed(x)
    return turned


__all__ = ["Memory", "MemoryGraph", "Numbers", "Rows", "apart"]
