"""Progress of a rollout: the phase, the simulated time and the speed, and what is being compiled."""

import time
from collections.abc import Iterable
from contextlib import ExitStack
from types import TracebackType
from typing import Protocol

from rich.console import Console, RenderableType
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichBar
from rich.text import Text

from swarmsim.runtime.compilations import COMPILATIONS

_NAME_WIDTH = 28  # of the longest name of phases that is shown in full


COMPILING = "compiling: the first run of a mission takes minutes, later ones load what is compiled now"
"""What a log is told when programs begin to be compiled."""


class Progress(Protocol):
    """What a rollout reports to, from the host and between compiled segments only."""

    def phase(self, name: str, simulated_horizon_s: float) -> None:
        """A phase begins that will simulate at most ``simulated_horizon_s``; zero when it simulates nothing."""

    def advance(self, simulated_s: float, done: int, total: int) -> None:
        """The phase has simulated ``simulated_s`` of every mission so far; ``done`` of ``total`` segments are over."""

    def message(self, text: str) -> None:
        """Print a line that stays on the screen."""


class SilentProgress:
    """Reports nothing."""

    def phase(self, name: str, simulated_horizon_s: float) -> None:
        """Do nothing."""

    def advance(self, simulated_s: float, done: int, total: int) -> None:
        """Do nothing."""

    def message(self, text: str) -> None:
        """Do nothing."""


class _Bars(RichBar):
    """Bars, and below them what is being compiled and for how long."""

    def get_renderables(self) -> Iterable[RenderableType]:
        """Yield the bars, then the line while there is one."""
        yield from super().get_renderables()
        names, seconds = COMPILATIONS.under_way()
        if names:
            minutes, rest = divmod(int(seconds), 60)
            text = f"compiling for {minutes}:{rest:02d}: {', '.join(names)}; later runs load what is compiled now"
            yield Text(text, style="dim", overflow="ellipsis", no_wrap=True)


class RichProgress:
    """A bar on the terminal for each phase; a context manager, so that the terminal is left as it was.

    Below the bars stand the programs that are being compiled. Where there is no terminal, a line tells that once, and
    a line each which program is compiled and which phase begins.

    The speed is simulated time (of all ``missions`` together) over wall time since the first segment of the phase
    ended: the first one may hold the compilation.
    """

    def __init__(self, console: Console | None = None, missions: int = 1):
        """Draw on ``console`` (standard error when None)."""
        self._missions = missions
        self._bar = _Bars(
            TextColumn(f"{{task.description:<{_NAME_WIDTH}}}"),
            BarColumn(),
            TextColumn("{task.fields[simulated]:>18}"),
            TextColumn("{task.fields[speed]:>14}"),
            TimeElapsedColumn(),
            console=console or Console(stderr=True),
        )
        self._task: TaskID | None = None
        self._horizon_s = 0.0
        self._first: tuple[float, float] | None = None  # wall time and simulated time after the first segment
        self._listening = ExitStack()
        self._told: set[str] = set()

    def __enter__(self) -> "RichProgress":
        """Start drawing."""
        if not self._bar.console.is_terminal:
            self._listening.enter_context(COMPILATIONS.listened_to(self._tell_of_compiling))
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Stop drawing; a phase that came to its end is shown as full."""
        self._listening.close()
        if kind is None:
            self._close()
        self._bar.stop()

    def phase(self, name: str, simulated_horizon_s: float) -> None:
        """End the bar before and begin that of the phase."""
        self._close()
        self._horizon_s, self._first = simulated_horizon_s, None
        short = name if len(name) <= _NAME_WIDTH else f"{name[: _NAME_WIDTH - 2]} …"
        self._task = self._bar.add_task(short, total=None, simulated="", speed="")
        if not self._bar.console.is_terminal:
            self.message(name)

    def advance(self, simulated_s: float, done: int, total: int) -> None:
        """Move the bar of the phase."""
        if self._task is None:
            raise RuntimeError("advance() before the first phase()")
        now, speed = time.perf_counter(), ""
        if self._first is None:
            self._first = (now, simulated_s)
        elif (wall := now - self._first[0]) > 0:
            speed = f"{(simulated_s - self._first[1]) * self._missions / wall:,.0f} x real time"
        simulated = f"{simulated_s:.0f} / {self._horizon_s:.0f} s" if self._horizon_s > 0 else ""
        self._bar.update(self._task, completed=done, total=total, simulated=simulated, speed=speed)

    def message(self, text: str) -> None:
        """Print above the bars."""
        self._bar.console.print(text, highlight=False, markup=False)

    def _tell_of_compiling(self) -> None:
        if not self._told:
            self.message(COMPILING)
        for name in COMPILATIONS.under_way()[0]:
            if name not in self._told:
                self._told.add(name)
                self.message(f"compiling {name}")

    def _close(self) -> None:
        if self._task is not None:
            total = self._bar.tasks[self._bar.task_ids.index(self._task)].total or 1
            self._bar.update(self._task, completed=total, total=total)
            self._bar.stop_task(self._task)
