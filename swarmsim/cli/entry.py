"""The command line as a process: exit codes, and what is told of errors and of Ctrl-C."""

import atexit
import contextlib
import errno
import gc
import io
import os
import signal
import sys
import threading
from collections.abc import Sequence
from typing import Any

from cyclopts import CycloptsError, UnusedCliTokensError

from swarmsim.cli.commands import app
from swarmsim.config.errors import InputError, stop_of

_HELP = "'swarmsim --help' and 'swarmsim COMMAND --help'"
_AGAIN_S = 0.05  # after which what swallowed Ctrl-C has ended
EXIT_INPUT, EXIT_HUNG_UP, EXIT_INTERRUPTED, EXIT_TERMINATED = 2, 129, 130, 143


class Terminated(KeyboardInterrupt):
    """SIGTERM, which batch systems send: a run is stopped as by Ctrl-C."""


class HungUp(KeyboardInterrupt):
    """SIGHUP: the terminal was closed, or its connection lost. A vehicle in flight must not be left alone by it."""


def _terminate(number: int, frame: object) -> None:
    raise Terminated


def _hang_up(number: int, frame: object) -> None:
    raise HungUp


def _handle_signals() -> None:
    signal.signal(signal.SIGTERM, _terminate)
    hang_up = getattr(signal, "SIGHUP", None)  # Windows has none
    if hang_up is not None and signal.getsignal(hang_up) is signal.SIG_DFL:  # nohup has it ignored
        signal.signal(hang_up, _hang_up)
    sys.unraisablehook = _unraisable


def _unraisable(found: Any) -> None:
    """Ctrl-C that met a finaliser or a callback, which swallow it, comes again when these have ended."""
    if not isinstance(found.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(found)
        return
    number = {Terminated: signal.SIGTERM, HungUp: getattr(signal, "SIGHUP", signal.SIGTERM)}.get(
        type(found.exc_value), signal.SIGINT
    )
    again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()


def _told(text: str) -> None:
    with contextlib.suppress(OSError):  # the terminal has gone
        sys.stderr.write(text)
        sys.stderr.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line ``arguments`` (those of the process when None); the exit code.

    Wrong input is told on standard error without a traceback; an error of swarmsim itself keeps its traceback.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        # line by line, so that a file or a pipe shows how far a run is; names may hold what a terminal cannot show
        sys.stdout.reconfigure(line_buffering=True, errors="backslashreplace")
    if arguments is None:
        _handle_signals()
    atexit.register(gc.freeze)  # the interpreter's last collection of garbage would take another second
    try:
        os.getcwd()
    except OSError as error:
        sys.stderr.write(f"the working folder cannot be used ({error.strerror}): change to another one\n")
        return EXIT_INPUT
    try:
        code = app(
            sys.argv[1:] if arguments is None else list(arguments),
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
        return code if isinstance(code, int) else 0
    except UnusedCliTokensError as error:
        extra = ", ".join(f"'{token}'" for token in error.unused_tokens or ())
        sys.stderr.write(f"one argument too many, or an unknown one: {extra}\n\nSee {_HELP}.\n")
        return EXIT_INPUT
    except CycloptsError as error:
        sys.stderr.write(f"{error}\n\nSee {_HELP}.\n")
        return EXIT_INPUT
    except InputError as error:
        _told(f"{describe(error)}\n")
        return _ended(EXIT_INPUT, arguments)
    except BrokenPipeError:  # the reader of a pipe, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        name = str(error.filename or "")
        _told(f"no file can have so long a name: '{name[:60]}...' ({len(name)} characters)\n")
        return EXIT_INPUT
    except (KeyboardInterrupt, RuntimeError) as error:
        stop = stop_of(error)
        if stop is None:
            raise
        code, by = EXIT_INTERRUPTED, "with Ctrl-C"
        if isinstance(stop, Terminated):
            code, by = EXIT_TERMINATED, "by SIGTERM"
        elif isinstance(stop, HungUp):
            code, by = EXIT_HUNG_UP, "by SIGHUP"
        _told(f"\nstopped {by}: nothing unfinished was left behind\n")
        return _ended(code, arguments)
    return 0


def _ended(code: int, arguments: Sequence[str] | None) -> int:
    """The exit code. The command line's own process ends with it at once where something else still computes.

    The interpreter would wait for the threads in which programs are compiled, which can take minutes.
    """
    others = [one for one in threading.enumerate() if one is not threading.main_thread() and not one.daemon]
    if arguments is None and (others or code != EXIT_INPUT):  # one that was stopped may compute in its main thread too
        with contextlib.suppress(OSError):
            sys.stdout.flush()
        os._exit(code)
    return code


def describe(error: InputError) -> str:
    """All problems of an `InputError` as text."""
    count = len(error.problems)
    heading = "" if count == 1 else f"{count} problems\n\n"
    return heading + "\n\n".join(str(problem) for problem in error.problems)
