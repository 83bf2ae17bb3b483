"""xacro expanded in a process of its own: it reads only files of the robot's folder, and its time is limited.

A xacro file is a program: it includes other files, loads YAML, and evaluates Python expressions, so that a file from
elsewhere could read any file of the user or run for ever.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from swarmsim.config.errors import InputError

TIME_LIMIT_S = 5.0
MEMORY_BYTES = 2**31
URDF_BYTES = 20_000_000
_PARENTS = 3  # folders above the file in which a package.xml is looked for
_CHILD = Path(__file__).with_name("expansion_child.py")


def robot_folder(path: Path) -> Path:
    """The folder that a body file and what it names must lie in.

    It is the folder of the ROS package (with a ``package.xml``) that ``path`` is in, where there is one at most three
    folders up, else the file's own.
    """
    folders = path.resolve().parents[: _PARENTS + 1]
    return next((folder for folder in folders if (folder / "package.xml").is_file()), folders[0])


def expand(path: Path, arguments: Mapping[str, str]) -> str:
    """URDF of the xacro or URDF file ``path``, for the xacro ``arguments``.

    Raises `InputError` when it cannot be expanded, reads files outside `robot_folder`, or takes longer than
    `TIME_LIMIT_S`.
    """
    with tempfile.TemporaryDirectory(prefix="swarmsim-xacro-") as scratch:
        task = {
            "path": str(path.resolve()),
            "arguments": dict(arguments),
            "folder": str(robot_folder(path)),
            "scratch": scratch,
            "memory_bytes": MEMORY_BYTES,
        }
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "TMPDIR": scratch}
        try:
            done = subprocess.run(
                [sys.executable, "-P", str(_CHILD)],
                input=json.dumps(task).encode(),
                capture_output=True,
                timeout=TIME_LIMIT_S,
                env=environment,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            message = f"xacro cannot expand this file: it takes more than {TIME_LIMIT_S:g} s"
            raise InputError.of(message, file=path, suggestion="look for macros that call each other") from error
    if done.returncode != 0 or len(done.stdout) > URDF_BYTES:
        told = done.stderr.decode("utf-8", "replace").strip().splitlines()
        reason = told[-1] if told else f"its process ended with {done.returncode}"
        reason = f"it grows to {len(done.stdout) / 1e6:.0f} MB" if len(done.stdout) > URDF_BYTES else reason
        raise InputError.of(f"xacro cannot expand this file: {reason}", file=path)
    return done.stdout.decode("utf-8")
