"""Open a run's recording in the Rerun viewer."""

import subprocess
import sys
from pathlib import Path

from swarmsim.config.errors import InputError
from swarmsim.config.names import one_of
from swarmsim.results.names import RECORDING


def recording_of(run: Path) -> Path:
    """The recording of ``run``, which is a run's folder or a recording itself; `InputError` where there is none."""
    if not run.exists():
        runs = sorted(str(path.parent) for path in Path("runs").glob(f"*/{RECORDING}"))
        allowed = one_of(runs) if runs else f"the folder of a run, with {RECORDING} in it; there is none in runs/ yet"
        raise InputError.of("there is no such run", given=str(run), allowed=allowed)
    recording = run / RECORDING if run.is_dir() else run
    if not recording.is_file() or recording.suffix != ".rrd":
        raise InputError.of("holds no recording", file=run, allowed=f"a folder with {RECORDING}, or a .rrd file")
    return recording


def viewer_command(recording: Path, web: bool) -> list[str]:
    """The command that shows ``recording``: on the desktop, or in the browser, served to this machine alone."""
    command = [sys.executable, "-m", "rerun", str(recording)]
    return [*command, "--web-viewer", "--bind", "127.0.0.1"] if web else command


def open_recording(run: Path, web: bool = False) -> None:
    """Show the recording of ``run`` and wait until the viewer is closed.

    Raises `InputError` where there is no recording and where the viewer cannot start (no display, no graphics).
    """
    ended = subprocess.run(viewer_command(recording_of(run), web), check=False)
    if ended.returncode != 0:
        hint = None if web else "on a machine without a display, use --web"
        raise InputError.of(f"the Rerun viewer ended with exit code {ended.returncode}", suggestion=hint)
