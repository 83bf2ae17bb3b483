"""Read a flight from a log file, whichever of the three kinds it is."""

import mmap
from dataclasses import replace
from pathlib import Path

from swarmsim.autopilot.logs.ardupilot import read_dataflash
from swarmsim.autopilot.logs.dataflash import HEADER
from swarmsim.autopilot.logs.flight_log import FlightLog
from swarmsim.autopilot.logs.px4 import MAGIC, read_ulog
from swarmsim.autopilot.logs.tlog import read_tlog
from swarmsim.config.errors import InputError, file_errors_told

ALLOWED = "a MAVLink log (.tlog), an ArduPilot dataflash log (.bin) or a PX4 log (.ulg)"
BYTES_MAX = 4_000_000_000
_HEAD = 4096


def read_log(path: Path, system: int | None = None) -> FlightLog:
    """The flight of the vehicle with the id ``system`` (of the only one when None) in a log.

    The kind is told by the file's first bytes, and by its name where these tell nothing. A log that breaks off, or is
    damaged in places, is read as far as it goes, which `FlightLog.notes` then say. Raises `InputError` for a file that
    is no such log, or holds no position of the vehicle.
    """
    path = Path(path)
    with file_errors_told("the log cannot be read", file=path):
        folder = path.is_dir()
    if folder:
        raise InputError.of("is a folder, not a log", file=path, allowed=ALLOWED)
    try:
        with file_errors_told("the log cannot be read", file=path):
            size = path.stat().st_size
            if size == 0:
                raise InputError.of("is empty: the vehicle has written nothing", allowed=ALLOWED)
            if size > BYTES_MAX:
                raise InputError.of("is too large", given=f"{size / 1e9:.1f} GB", allowed=f"{BYTES_MAX / 1e9:g} GB")
            with path.open("rb", buffering=0) as file:
                head = file.read(_HEAD)
                if head.startswith(MAGIC):
                    return read_ulog(path, size, system)
                return _mapped(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), head, path.suffix.lower(), system)
    except InputError as error:
        raise InputError([replace(problem, file=str(path)) for problem in error.problems]) from error


def _mapped(data: mmap.mmap, head: bytes, suffix: str, system: int | None) -> FlightLog:
    if suffix == ".ulg":
        raise InputError.of("is no PX4 log: it does not begin as one", allowed=ALLOWED)
    if head.startswith(HEADER) or suffix == ".bin":
        return read_dataflash(data, system)
    if suffix == ".tlog" or head[8:9] in (b"\xfd", b"\xfe"):
        return read_tlog(data, system)
    raise InputError.of("is no log of a flight that is known", allowed=ALLOWED)
