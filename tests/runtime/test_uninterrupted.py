"""Ctrl-C waits for what must not be left half done, and is not lost."""

import signal
import threading

import pytest

from swarmsim.runtime.uninterrupted import uninterrupted


def interrupted(done: list[str], error: Exception | None = None) -> None:
    with uninterrupted():
        signal.raise_signal(signal.SIGINT)
        done.append("all of it")
        if error is not None:
            raise error


@pytest.mark.parametrize("error", [None, ValueError("something else")], ids=["done", "failed"])
def test_ctrl_c_comes_after_the_block(error):
    done: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted(done, error)
    assert done == ["all of it"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_without_a_signal_nothing_changes():
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with uninterrupted(), uninterrupted():
        pass
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_another_thread_is_let_alone():
    seen = []

    @uninterrupted()
    def work():
        seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGINT)]


def test_a_decorated_call_returns_what_it_makes():
    @uninterrupted()
    def made(number: int) -> int:
        return number + 1

    assert [made(1), made(2)] == [2, 3]
