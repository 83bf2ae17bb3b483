"""How a rollout tells what it is doing."""

import io

import pytest
from rich.console import Console

from swarmsim.runtime.progress import RichProgress, SilentProgress


def test_the_bar_shows_phase_time_and_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 12.0])
    monkeypatch.setattr("swarmsim.runtime.progress.time.perf_counter", lambda: next(clock))
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    with RichProgress(console, missions=2) as progress:
        progress.phase("survey flight", 300.0)
        progress.advance(100.0, 1, 3)
        progress.advance(200.0, 2, 3)
        progress.message("said")
    text = screen.getvalue()
    assert "survey flight" in text
    assert "200 / 300 s" in text
    assert "100 x real time" in text  # 2 missions of 100 s in 2 s
    assert "said" in text


def test_a_bar_needs_a_phase_and_silence_needs_nothing() -> None:
    with pytest.raises(RuntimeError, match="before the first phase"):
        RichProgress().advance(1.0, 1, 2)
    silent = SilentProgress()
    silent.phase("survey", 1.0)
    silent.advance(1.0, 1, 1)
    silent.message("nothing")


def test_a_long_name_leaves_room_for_the_bar() -> None:
    screen = io.StringIO()
    with RichProgress(Console(file=screen, force_terminal=True, width=100)) as progress:
        progress.phase("survey_west + survey_east + first_look", 300.0)
        progress.advance(100.0, 1, 3)
    assert "survey_west + survey_east  …" in screen.getvalue()
    assert "first_look" not in screen.getvalue()
