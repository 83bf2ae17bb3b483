"""Another thread computes what is waited for, the same one each time unless it is interrupted."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from swarmsim.runtime import waiting
from swarmsim.runtime.waiting import waited_for


def test_values_and_errors_come_from_one_thread_that_is_kept():
    first = waited_for(threading.get_ident)
    assert first != threading.get_ident()
    assert [waited_for(threading.get_ident) for _ in range(3)] == [first] * 3
    with pytest.raises(ValueError, match="no"):
        waited_for(lambda: int("no"))
    assert waited_for(threading.get_ident) == first


def test_what_waits_within_has_a_thread_of_its_own():
    outer, inner = waited_for(lambda: (threading.get_ident(), waited_for(threading.get_ident)))
    assert len({outer, inner, threading.get_ident()}) == 3


def test_ctrl_c_ends_the_waiting_and_another_thread_goes_on():
    done = threading.Event()

    def long() -> None:
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        done.wait(20.0)

    before = waited_for(threading.get_ident)
    with pytest.raises(KeyboardInterrupt):
        waited_for(long)
    assert waited_for(threading.get_ident) != before
    done.set()


def test_a_thread_that_ends_leaves_no_other_behind():
    seen: list[int] = []
    thread = threading.Thread(target=lambda: seen.append(waited_for(threading.get_ident)))
    thread.start()
    thread.join()
    for _ in range(200):
        if seen[0] not in {one.ident for one in threading.enumerate()}:
            return
        time.sleep(0.05)
    pytest.fail("the thread that computed for it goes on")


LATE = """
import atexit
from swarmsim.runtime.waiting import waited_for

atexit.register(lambda: print(waited_for(lambda: 7)))  # called after whatever the first call has registered
waited_for(lambda: 1)
"""


def test_what_is_called_while_the_interpreter_ends_may_wait():
    done = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == ["7"]


def test_ctrl_c_while_the_thread_begins_leaves_none_behind(monkeypatch):
    started = threading.Thread.start

    def interrupted(thread: threading.Thread) -> None:
        started(thread)
        raise KeyboardInterrupt

    before = set(threading.enumerate())
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", interrupted)
        with pytest.raises(KeyboardInterrupt):
            waiting._Waiter()
    for _ in range(200):
        gc.collect()
        if set(threading.enumerate()) <= before:
            return
        time.sleep(0.05)
    pytest.fail("a thread that nobody knows of goes on")


FORKS = """
import os, signal, threading
from swarmsim.runtime.waiting import waited_for

def fork():
    assert waited_for(lambda: 1) == 1
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        os._exit(waited_for(lambda: 7))
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))

fork()
thread = threading.Thread(target=fork)
thread.start()
thread.join()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_makes_a_thread_of_its_own():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", FORKS], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["7", "7"]
