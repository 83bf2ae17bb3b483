"""The keyboard: keys out of bytes, keys that are held without being released, and the terminal as it was."""

import contextlib
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import textwrap
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.manual.keyboard import Keyboard
from swarmsim.autopilot.manual.keys import ESCAPE_S, SEQUENCE_BYTES, KeyDecoder
from swarmsim.autopilot.manual.sticks import CENTRED, Event, Sticks
from swarmsim.config.errors import InputError
from swarmsim.config.manual import Keys, Manual

MANUAL = Manual(key_share=0.5, first_s=0.7, repeat_s=0.25)


def decoded(*parts, at_s=0.0):
    decoder = KeyDecoder()
    return [key for part in parts for key in decoder.feed(part, at_s)]


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wW +", ["w", "w", "space", "+"]),
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"\x1bOA\x1bOD", ["up", "left"]),  # application mode
        (b"\x1b[1;5A", ["up"]),  # with Ctrl
        (b"\x1b[3~\x1b[5~\x1b[6;2~", ["delete", "pageup", "pagedown"]),
        (b"\r\n\t\x7f\x08", ["enter", "enter", "tab", "backspace", "backspace"]),
        (b"\x1bw", []),  # Alt and w
        (b"\x1b\x1b[A", ["escape", "up"]),
        (b"\x00\x01\x02\x80\xc3\xa9\xff", []),
        (b"\x1b[200~w\x1b[99;1;1z\x1b[<0;1;1M", ["w"]),  # bracketed paste, unknown, a mouse
        (b"\x1b[" + b"1" * 100 + b"w", []),
    ],
)
def test_keys_of_bytes(data, keys):
    found = decoded(data)
    assert [key for key in found if key != "1"] == keys or (len(data) > SEQUENCE_BYTES and "up" not in found)


@given(st.lists(st.sampled_from([b"w", b" ", b"\x1b[A", b"\x1bOB", b"\x1b[3~", b"\x1b[1;2C"])), st.data())
def test_sequences_split_between_reads_are_the_same_keys(parts, data):
    whole = b"".join(parts)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=8)))
    split = [whole[a:b] for a, b in zip([0, *cuts], [*cuts, len(whole)], strict=True)]
    assert decoded(*split) == decoded(whole)


@given(st.binary(max_size=200))
def test_garbage_leaves_a_decoder_that_works(garbage):
    decoder = KeyDecoder()
    decoder.feed(garbage, 0.0)
    decoder.feed(b"", 1.0 + ESCAPE_S)
    assert decoder.feed(b"w", 2.0) == ["w"]


def test_an_escape_that_nothing_follows_is_a_key():
    decoder = KeyDecoder()
    assert decoder.feed(b"\x1b", 0.0) == []
    assert decoder.feed(b"", 0.5 * ESCAPE_S) == []
    assert decoder.feed(b"", 1.5 * ESCAPE_S) == ["escape"]


@pytest.fixture
def terminal():
    ours, theirs = pty.openpty()
    yield ours, theirs
    for fd in (ours, theirs):
        with contextlib.suppress(OSError):
            os.close(fd)


@pytest.fixture
def keyboard(terminal):
    with Keyboard(MANUAL, terminal[1]) as opened:
        yield opened, lambda keys: os.write(terminal[0], keys)


def test_a_key_counts_until_it_repeats_and_as_long_as_it_repeats(keyboard):
    board, types = keyboard
    assert board.read(0.0).sticks == CENTRED
    types(b"\x1b[A")
    assert board.read(0.0).sticks == Sticks(forward=0.5)
    assert board.read(0.69).sticks == Sticks(forward=0.5)
    types(b"\x1b[A")
    board.read(0.69)
    for k in range(20):
        types(b"\x1b[A")
        assert board.read(0.73 + 0.04 * k).sticks == Sticks(forward=0.5)
    assert board.read(1.49 + 0.24).sticks == Sticks(forward=0.5)
    assert board.read(1.49 + 0.26).sticks == CENTRED


@pytest.mark.parametrize(
    ("keys", "sticks"),
    [
        (b"\x1b[D", Sticks(left=0.5)),
        (b"\x1b[C", Sticks(left=-0.5)),
        (b"\x1b[B", Sticks(forward=-0.5)),
        (b"w", Sticks(up=0.5)),
        (b"S", Sticks(up=-0.5)),
        (b"a", Sticks(turn=0.5)),
        (b"d", Sticks(turn=-0.5)),
        (b"wa", Sticks(up=0.5, turn=0.5)),
        (b"ws", Sticks(up=-0.5)),  # the later one counts
        (b"wah", CENTRED),  # hold
        (b"zqx", CENTRED),
        (b"+w", Sticks(up=0.6)),
        (b"-" * 9 + b"w", Sticks(up=0.1)),
        (b"wasdqe", CENTRED),  # pasted
    ],
)
def test_what_keys_command(keyboard, keys, sticks):
    board, types = keyboard
    types(keys)
    assert board.read(0.0).sticks == sticks


def test_a_held_key_asks_once(keyboard):
    board, types = keyboard
    types(b" ")
    assert board.read(0.0).events == (Event.TAKE_OVER,)
    for k in range(20):
        types(b" ")
        assert board.read(0.5 + 0.03 * k).events == ()
    types(b" ")
    assert board.read(3.0).events == (Event.TAKE_OVER,)
    types(b"hlr")
    assert board.read(4.0).events == (Event.HOLD, Event.LAND, Event.RETURN)


def test_a_key_that_is_held_asks_once_whatever_delays_its_repetition(keyboard):
    """A slow connection leaves gaps: the second press of a toggle would hand the vehicle back."""
    board, types = keyboard
    asked = []
    for now in (0.0, 0.95, 1.0, 1.05, 1.9, 2.0, 2.8):
        types(b" ")
        asked += board.read(now).events
    assert asked == [Event.TAKE_OVER]
    types(b" ")
    assert board.read(4.0).events == (Event.TAKE_OVER,)


def test_what_can_be_done_is_told(keyboard):
    board, _ = keyboard
    assert "space: take over" in board.told(False)
    assert "space: hand back" in board.told(True)
    assert "50 %" in board.told(True)


def test_a_terminal_that_has_gone_centres_the_sticks(terminal):
    ours, theirs = terminal
    with Keyboard(MANUAL, theirs) as board:
        os.write(ours, b"w")
        assert board.read(0.0).sticks.up > 0.0
        os.close(ours)
        reading = board.read(0.1)
        assert reading.lost is not None
        assert reading.sticks == CENTRED
        assert board.read(0.2).lost is not None


def local(fd):
    return termios.tcgetattr(fd)


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, ValueError])
def test_the_terminal_is_as_it_was(terminal, error):
    before, handlers = local(terminal[1]), [signal.getsignal(n) for n in (signal.SIGTSTP, signal.SIGCONT)]
    try:
        with Keyboard(MANUAL, terminal[1]):
            during = local(terminal[1])
            assert not during[3] & (termios.ICANON | termios.ECHO)
            assert during[3] & termios.ISIG  # Ctrl-C
            assert not during[0] & termios.IXON
            if error is not None:
                raise error
    except (KeyboardInterrupt, ValueError):
        pass
    assert local(terminal[1]) == before
    assert [signal.getsignal(n) for n in (signal.SIGTSTP, signal.SIGCONT)] == handlers


def test_standard_input_that_is_no_terminal_is_refused(tmp_path, monkeypatch):
    file = tmp_path / "keys"
    file.write_bytes(b"w")
    with file.open("rb") as opened, pytest.raises(InputError, match="terminal"), Keyboard(MANUAL, opened.fileno()):
        pass
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(InputError, match="standard input"):
        Keyboard(MANUAL)


LEADER = """
    import fcntl, os, signal, subprocess, sys, termios
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)  # as a shell: it moves the foreground
    job = subprocess.Popen([sys.executable, "-c", sys.argv[1]], process_group=0)
    os.tcsetpgrp(0, job.pid)
    print("job", job.pid, flush=True)
    while True:
        _, status = os.waitpid(job.pid, os.WUNTRACED)
        if not os.WIFSTOPPED(status):
            break
        os.tcsetpgrp(0, os.getpid())
        print("stopped", flush=True)
        sys.stdin.readline()  # the test has looked at the terminal
        os.tcsetpgrp(0, job.pid)
        os.kill(job.pid, signal.SIGCONT)
    os.tcsetpgrp(0, os.getpid())
    print("over", os.waitstatus_to_exitcode(status), flush=True)
    sys.stdin.readline()
"""
JOB = """
    import time
    from swarmsim.autopilot.manual.keyboard import Keyboard
    from swarmsim.config.manual import Manual
    with Keyboard(Manual()) as board:
        print("ready", flush=True)
        while True:
            board.read(time.monotonic())
            time.sleep(0.02)
"""


def until_said(fd, words, seconds=60.0):
    said, deadline = b"", time.monotonic() + seconds
    while words.encode() not in said:
        assert select.select([fd], [], [], max(deadline - time.monotonic(), 0.0))[0], said
        said += os.read(fd, 1024)
    return said.decode()


def cooked(fd):
    return bool(local(fd)[3] & termios.ICANON)


def test_the_terminal_is_given_back_while_stopped_and_after_ctrl_c():
    ours, theirs = pty.openpty()
    leader = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(LEADER), textwrap.dedent(JOB)],
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
    )  # fmt: skip
    try:
        job = int(until_said(ours, "ready").split("job")[1].split()[0])
        assert not cooked(theirs)
        os.kill(job, signal.SIGTSTP)
        until_said(ours, "stopped")
        assert cooked(theirs)
        os.write(ours, b"\n")
        deadline = time.monotonic() + 20.0
        while cooked(theirs):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.write(ours, b"\x1a\x1c")  # Ctrl-Z and Ctrl-\ do nothing in flight
        time.sleep(0.2)
        assert not cooked(theirs)
        os.write(ours, b"\x03")
        assert "over" in until_said(ours, "over")
        assert cooked(theirs)
    finally:
        leader.kill()
        leader.wait()
        os.close(ours)
        os.close(theirs)


def test_keys_are_different_and_known():
    assert Keys(forward="W", climb="i").forward == "w"
    with pytest.raises(ValueError, match="twice"):
        Keys(forward="w")
    with pytest.raises(ValueError, match="no key"):
        Keys(forward="ctrl-x")
