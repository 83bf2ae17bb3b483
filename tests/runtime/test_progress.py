"""How a rollout tells what it is doing."""

import io

import jax.numpy as jnp
import pytest
from rich.console import Console

from swarmsim.runtime.clock import Clock
from swarmsim.runtime.compilations import COMPILATIONS
from swarmsim.runtime.programs import Program
from swarmsim.runtime.progress import COMPILING, RichProgress, SilentProgress


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


@pytest.mark.parametrize("terminal", [True, False])
def test_it_says_what_is_being_compiled_and_for_how_long(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("swarmsim.runtime.compilations.time.monotonic", lambda: now[0])
    screen = io.StringIO()
    with RichProgress(Console(file=screen, force_terminal=terminal, width=100)) as progress:
        progress.phase("prepare", 0.0)
        with COMPILATIONS.of("estimate"), COMPILATIONS.of("run"):
            now[0] = 175.0
            assert COMPILATIONS.under_way() == (("estimate", "run"), 75.0)
            progress._bar.refresh()
        assert COMPILATIONS.under_way() == ((), 0.0)
        before = screen.tell()
        progress._bar.refresh()
        assert "compiling" not in screen.getvalue()[before:]
    assert ("compiling for 1:15: estimate, run; later runs" in screen.getvalue()) == terminal
    assert screen.getvalue().count(COMPILING) == (0 if terminal else 1)
    lines = screen.getvalue().splitlines()
    assert terminal or [line for line in lines if line in ("prepare", "compiling estimate", "compiling run")] == [
        "prepare", "compiling estimate", "compiling run",
    ]  # fmt: skip


def test_a_program_is_told_while_it_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SWARMSIM_CACHE", "0")  # or an earlier test run has stored it
    seen: list[tuple[str, ...]] = []
    with COMPILATIONS.listened_to(lambda: seen.append(COMPILATIONS.under_way()[0])):
        assert Program("twice", lambda x: 2.0 * x, clock=Clock())(jnp.float32(1.5)) == 3.0
    assert seen == [("twice",)]
    with pytest.raises(ValueError, match="no"), COMPILATIONS.of("fails"):
        raise ValueError("no")
    assert COMPILATIONS.under_way() == ((), 0.0)


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
