"""Open a run's recording in the Rerun viewer."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

from swarmsim.config.errors import InputError, file_errors_told
from swarmsim.config.names import one_of
from swarmsim.results.names import RECORDING

LIVE_PORT = 9876  # Rerun's own
_START_S = 30.0  # that the viewer may take to open
_ANSWER_S = 2.0
_OPENS_S = 0.5


def recording_of(run: Path) -> Path:
    """The recording of ``run``, which is a run's folder or a recording itself; `InputError` where there is none."""
    with file_errors_told("cannot be read", given=str(run)):
        there = run.exists()
    if not there:
        runs = sorted(str(path.parent) for path in Path("runs").glob(f"*/{RECORDING}"))
        allowed = one_of(runs) if runs else f"the folder of a run, with {RECORDING} in it; there is none in runs/ yet"
        raise InputError.of("there is no such run", given=str(run), allowed=allowed)
    recording = run / RECORDING if run.is_dir() else run
    if not recording.is_file() or recording.suffix != ".rrd":
        raise InputError.of("holds no recording", file=run, allowed=f"a folder with {RECORDING}, or a .rrd file")
    return recording


def viewer_command(recording: Path, web: bool) -> list[str]:
    """The command that shows ``recording``, on the desktop or in the browser, to this machine alone."""
    command = [sys.executable, "-m", "rerun", str(recording), "--bind", "127.0.0.1"]
    return [*command, "--web-viewer"] if web else command


def open_recording(run: Path, web: bool = False) -> None:
    """Show the recording of ``run`` and wait until the viewer is closed.

    Raises `InputError` where there is no recording and where the viewer cannot start (no display, no graphics).
    """
    ended = subprocess.run(viewer_command(recording_of(run), web), check=False)
    if ended.returncode != 0:
        hint = None if web else "on a machine without a display, use --web"
        raise InputError.of(f"the Rerun viewer ended with exit code {ended.returncode}", suggestion=hint)


def live_address(url: str | None, port: int = LIVE_PORT) -> str:
    """The address of a viewer to send to: ``url`` if given, else that of the desktop's, which is started if need be.

    Raises `InputError` where no viewer answers, and where the desktop's cannot start (no display, no graphics).
    """
    if url is None:
        if not _answers("127.0.0.1", port):
            _start_viewer([sys.executable, "-m", "rerun", "--port", str(port), "--bind", "127.0.0.1"], port)
        return f"rerun+http://127.0.0.1:{port}/proxy"
    try:
        parts = urlsplit(url)
        host, number = parts.hostname, parts.port
    except ValueError:
        host, number = None, None
    if not url.startswith("rerun") or host is None or number is None:
        allowed = "rerun+http://HOST:PORT/proxy"
        raise InputError.of("this is no address of a viewer", path="--live-url", given=url, allowed=allowed)
    if not _answers(host, number):
        hint = "start 'rerun' there first, and check host, port and firewall"
        raise InputError.of("no viewer answers there", path="--live-url", given=url, suggestion=hint)
    return url


def _start_viewer(command: list[str], port: int) -> None:
    """Start a viewer that outlives this process, and wait until it answers."""
    nothing = subprocess.DEVNULL
    viewer = subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing, start_new_session=True)
    end = time.monotonic() + _START_S
    while viewer.poll() is None and not _answers("127.0.0.1", port) and time.monotonic() < end:
        time.sleep(0.1)
    if viewer.poll() is None and time.monotonic() < end:
        time.sleep(_OPENS_S)  # it may answer before it finds that there is no display
        if viewer.poll() is None:
            return
    code = viewer.poll()
    if code is None:
        _end(viewer)
    told = f"did not answer within {_START_S:g} s" if code is None else f"ended with exit code {code}"
    hint = "on a machine without a display, start 'rerun' on another one and name it with --live-url"
    raise InputError.of(f"the Rerun viewer {told}", path="--live", suggestion=hint)


def _end(viewer: subprocess.Popen[bytes]) -> None:
    """End a viewer with what it started: `python -m rerun` runs the viewer as a process of its own."""
    if sys.platform == "win32":
        viewer.kill()
    else:
        os.killpg(viewer.pid, signal.SIGKILL)  # it leads a session of its own
    viewer.wait()


def _answers(host: str, port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=_ANSWER_S):
        return True
    return False
