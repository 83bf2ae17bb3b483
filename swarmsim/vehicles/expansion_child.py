"""The process in which `swarmsim.vehicles.expansion` expands a xacro file: reads a task, writes URDF or the reason.

Before the file is touched, an audit hook refuses everything but reading the robot's folder and Python's own modules.
"""

import errno
import json
import os
import sys
import sysconfig
from typing import Any

import yaml  # noqa: F401  (loaded before the hook; xacro imports it when a file calls load_yaml)
from xacrodoc import XacroDoc

_REFUSED = ("subprocess.", "os.", "shutil.", "socket.", "ctypes.", "ftplib.", "http.", "urllib.", "pty.", "signal.")
_ALLOWED = ("os.listdir", "os.scandir", "os.putenv", "os.walk", "os.fwalk")  # listing a folder reads no file


def _guard(folder: str, scratch: str) -> None:
    """Refuse, from now on, files outside ``folder`` and ``scratch`` and everything that is not reading a file."""
    modules = tuple({os.path.realpath(path) for path in (*sysconfig.get_paths().values(), *sys.path) if path})
    mine = (os.path.realpath(scratch),)
    readable = (os.path.realpath(folder), *mine)

    def within(path: str, folders: tuple[str, ...]) -> bool:
        return any(path == parent or path.startswith(parent.rstrip(os.sep) + os.sep) for parent in folders)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            writes = bool((arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC))
            module = path.endswith((".py", ".pyc", ".so", ".pyd")) and within(path, modules)
            if not (within(path, mine) or (not writes and (within(path, readable) or module))):
                raise PermissionError(errno.EACCES, f"outside the robot's folder {folder}", path)
            if not os.path.isfile(path) and os.path.exists(path):
                raise PermissionError(errno.EACCES, "not a regular file", path)
        elif event in ("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.chmod", "os.truncate"):
            if not within(os.path.realpath(os.fsdecode(arguments[0])), mine):
                raise PermissionError(errno.EACCES, "may not be changed", arguments[0])
        elif event.startswith(_REFUSED) and event not in _ALLOWED:
            raise PermissionError(errno.EACCES, f"may not use {event}")

    sys.addaudithook(hook)


def main() -> int:
    """Expand the file of the task on the standard input; the exit code."""
    task = json.load(sys.stdin)
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (task["memory_bytes"], task["memory_bytes"]))
    output, sys.stdout = sys.stdout, sys.stderr  # xacro may print
    os.chdir(os.path.dirname(task["path"]))  # includes are relative to the file
    _guard(task["folder"], task["scratch"])
    try:
        urdf = XacroDoc.from_file(task["path"], subargs=task["arguments"], walk_up=False).to_urdf_string()
    except RecursionError:
        sys.stderr.write("macros or includes call each other without end\n")
        return 1
    except MemoryError:
        sys.stderr.write("it takes too much memory\n")
        return 1
    except BaseException as error:
        sys.stderr.write(" ".join(f"{error or type(error).__name__}".split()) + "\n")
        return 1
    output.buffer.write(urdf.encode("utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
