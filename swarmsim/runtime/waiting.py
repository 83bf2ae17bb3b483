"""Waiting for what takes long such that Ctrl-C interrupts it."""

import os
import threading
import weakref
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any, TypeVar

T = TypeVar("T")

LOOKS_AGAIN_S = 0.5

_waiters = threading.local()  # the one of each thread that is idle
if hasattr(os, "register_at_fork"):  # a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=lambda: _waiters.__dict__.clear())  # of the thread that goes on there


def waited_for(long: Callable[[], T]) -> T:
    """The value of ``long``, which another thread computes: Ctrl-C interrupts waiting, but not XLA itself."""
    answers: SimpleQueue[tuple[bool, Any]] = SimpleQueue()

    def compute() -> None:
        try:
            answers.put((True, long()))
        except BaseException as error:  # goes to the thread that waits
            answers.put((False, error))

    waiter: _Waiter = getattr(_waiters, "idle", None) or _Waiter()
    _waiters.idle = None  # one that goes on computing after Ctrl-C is left behind
    waiter.work.put(compute)
    sound, answer = _awaited(answers)
    _waiters.idle = waiter
    try:
        if sound:
            value: T = answer
            return value
        raise answer
    finally:
        del answer  # an error refers to this call, which would keep it


def _awaited(answers: "SimpleQueue[T]") -> T:
    """The first of them. A signal that comes just before the thread begins to wait does not wake it: it looks again."""
    while True:
        with suppress(Empty):
            return answers.get(timeout=LOOKS_AGAIN_S)


class _Waiter:
    """A thread that computes one thing after another for the thread that made it, as long as that one wants it.

    It is not made anew for each: the memory allocator of a process that has compiled much hands thousands of free
    pieces to every new thread and takes them back when it ends, which takes up to 20 ms.
    """

    def __init__(self) -> None:
        self.work: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        end = weakref.finalize(self, self.work.put, None)  # before the thread begins: Ctrl-C may come in between
        end.atexit = False  # what is called while the interpreter ends may still wait
        Thread(target=_serve, args=(self.work,), name="swarmsim-wait", daemon=True).start()


def _serve(work: SimpleQueue[Callable[[], None] | None]) -> None:
    while (compute := work.get()) is not None:
        compute()
        del compute  # and what it refers to
