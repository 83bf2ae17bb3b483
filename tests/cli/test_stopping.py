"""Ctrl-C and signals: a command stops at once, whatever runs beside it and wherever they meet it."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("where", ["__del__", "__set_name__"])
def test_ctrl_c_is_heard_where_python_swallows_or_wraps_it(where: str) -> None:
    script = f"""
import os, signal, sys, time
from swarmsim.cli import entry
class Meets:
    def {where}(self, *of):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.2)
def command(*arguments, **options):
    made = Meets()
    if {where!r} == "__set_name__":
        type("Owner", (), dict(made=made))
    del made
    time.sleep(600)
entry.app = command
entry.main()
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 130
    assert ended.stderr.strip() == "stopped with Ctrl-C: nothing unfinished was left behind"


@pytest.mark.parametrize(
    ("sent", "code", "told"),
    [
        (signal.SIGINT, 130, "stopped with Ctrl-C"),
        (signal.SIGTERM, 143, "stopped by SIGTERM"),
        (signal.SIGHUP, 129, "stopped by SIGHUP"),
    ],
)
def test_a_run_is_stopped_at_once_whatever_another_thread_does(sent: int, code: int, told: str, tmp_path: Path) -> None:
    """The main thread waits for one that does not end; what the command wrote for itself is taken away."""
    script = """
import sys, threading, time
from pathlib import Path
from swarmsim.atomic_folder import atomic_folder
from swarmsim.cli import entry
def command(*arguments, **options):
    with atomic_folder(Path(sys.argv[1]), lambda _: None):
        threading.Thread(target=time.sleep, args=(600,)).start()
        print("ready", flush=True)
        time.sleep(600)
entry.app = command
entry.main()
"""
    arguments, pipe = [sys.executable, "-c", script, str(tmp_path / "run")], subprocess.PIPE
    with subprocess.Popen(arguments, stdout=pipe, stderr=pipe, text=True) as running:
        assert running.stdout is not None
        ready = running.stdout.readline()
        running.send_signal(sent)
        try:
            _, error = running.communicate(timeout=60)
        finally:
            running.kill()
    assert ready == "ready\n", error
    assert running.returncode == code
    assert told in error
    assert list(tmp_path.iterdir()) == []


def test_wrong_input_ends_the_process_though_another_thread_computes() -> None:
    """What a policy does wrong is found while other programs are compiled."""
    script = """
import sys, threading, time
from swarmsim.cli import entry
from swarmsim.config.errors import InputError
def command(*arguments, **options):
    threading.Thread(target=time.sleep, args=(600,)).start()
    raise InputError.of("is wrong", path="phases.0.policy")
entry.app = command
sys.exit(entry.main())
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert ended.stderr == "phases.0.policy: is wrong\n"
