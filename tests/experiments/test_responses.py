"""The flown responses: references that can be flown, and figures that agree with closed forms."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).parents[2] / "experiments" / "flight" / "responses.py"


@pytest.fixture(scope="module")
def experiment():
    spec = importlib.util.spec_from_file_location("responses_experiment", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where its dataclasses look for their annotations
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("damping", [0.4, 0.7])
def test_overshoot_and_settling_are_those_of_a_second_order_system(experiment, damping):
    rate, time = 3.0, experiment.TICK_S * np.arange(3000)
    ringing = rate * np.sqrt(1.0 - damping**2)
    fade = np.exp(-damping * rate * time)
    share = 1.0 - fade * (np.cos(ringing * time) + damping * rate / ringing * np.sin(ringing * time))
    found = experiment.step_figures(share)
    assert found["overshoot"] == pytest.approx(np.exp(-np.pi * damping * rate / ringing), rel=1e-3)
    late = time >= found["settles_s"] - 1e-9
    assert np.abs(share[late] - 1.0).max() <= experiment.BAND
    assert np.abs(share[~late][-1] - 1.0) > experiment.BAND


def test_what_never_settles_says_so_and_what_was_there_settles_at_once(experiment):
    assert experiment.step_figures(np.full(200, 0.9)) == {"overshoot": 0.0, "settles_s": 200 * experiment.TICK_S}
    assert experiment.step_figures(np.ones(200)) == {"overshoot": 0.0, "settles_s": 0.0}


def test_references_are_consistent_and_within_the_limits(experiment):
    speed, acceleration = 8.0, 4.0
    made = experiment.flights(speed, 3.0, acceleration)
    assert len({flight.name for flight in made}) == len(made)
    (eight,) = [flight for flight in made if flight.name.startswith("Lissajous")]
    step = experiment.TICK_S
    time = experiment.times() - experiment.BEGIN_S
    smooth = (time > step) & (np.abs(time - 4.0) > 2.0 * step) & (time < time[-1] - step)  # it is entered over 4 s
    for value, rate in ((eight.position_m, eight.velocity_m_s), (eight.velocity_m_s, eight.acceleration_m_s2)):
        np.testing.assert_allclose(np.gradient(value, step, axis=0)[smooth], rate[smooth], atol=0.01)
    fastest = np.linalg.norm(eight.velocity_m_s[smooth], axis=1).max()
    assert fastest == pytest.approx(experiment.LISSAJOUS_SHARE * speed, rel=0.01)
    assert np.linalg.norm(eight.acceleration_m_s2[smooth], axis=1).max() < acceleration


def test_the_table_leaves_empty_what_is_not_asked(experiment):
    rows = [
        {"vehicle": "a", "flight": "step x 2 m", "overshoot": 0.0123, "settles_s": 2.4},
        {"vehicle": "a", "flight": "hover", "off_rms_m": 0.1, "off_max_m": 0.25},
    ]
    lines = experiment.table(rows).splitlines()
    assert lines[2] == "| a | step x 2 m | 1.23 | 2.40 |  |  |"
    assert lines[3] == "| a | hover |  |  | 0.10 | 0.25 |"
