"""Figures of a flight by firmware agree with closed forms."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).parents[2] / "experiments" / "flight" / "firmware.py"


@pytest.fixture(scope="module")
def experiment():
    spec = importlib.util.spec_from_file_location("firmware_experiment", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where its dataclasses look for their annotations
    spec.loader.exec_module(module)
    return module


def along(axis, values):
    offset = np.zeros((len(values), 3))
    offset[:, axis] = values
    return offset


@pytest.mark.parametrize(("axis", "size_m", "back"), [(0, 5.0, False), (0, 5.0, True), (2, 3.0, False)])
def test_a_step_is_that_of_a_second_order_system(experiment, axis, size_m, back):
    damping, rate, time = 0.5, 2.0, np.arange(0.0, 20.0, 0.004)
    ringing = rate * np.sqrt(1.0 - damping**2)
    fade = np.exp(-damping * rate * time)
    share = 1.0 - fade * (np.cos(ringing * time) + damping * rate / ringing * np.sin(ringing * time))
    ends = [(0.0, 0.0, 0.0), tuple(size_m * np.eye(3)[axis])]
    before, asked = reversed(ends) if back else ends
    place = size_m * (1.0 - share if back else share)
    found = experiment.figures_of(experiment.Part("step", time, along(axis, place), asked), before)
    assert found["overshoot"] == pytest.approx(np.exp(-np.pi * damping * rate / ringing), rel=1e-3)
    rise = time[np.argmax(share >= 0.9)] - time[np.argmax(share >= 0.1)]
    assert found["rise_s"] == pytest.approx(rise, abs=0.005)
    outside = size_m * np.abs(share - 1.0) > experiment.BAND_M
    assert found["settles_s"] == pytest.approx(time[np.flatnonzero(outside)[-1]], abs=0.02)
    assert found["final_error_m"] == pytest.approx(0.0, abs=1e-3)


def test_a_step_that_comes_to_rest_short_of_its_end_says_by_how_much(experiment):
    time = np.arange(0.0, 20.0, 0.01)
    part = experiment.Part("step", time, along(0, 4.6 * (1.0 - np.exp(-time))), (5.0, 0.0, 0.0))
    found = experiment.figures_of(part, (0.0, 0.0, 0.0))
    assert found["final_error_m"] == pytest.approx(-0.4, abs=1e-3)
    assert found["overshoot"] < 1e-3


def test_a_step_that_had_begun_to_drift_rises_from_there(experiment):
    time = np.arange(0.0, 20.0, 0.001)
    drifted = 1.0 + 4.0 * (1.0 - np.exp(-time))
    found = experiment.figures_of(experiment.Part("step", time, along(0, drifted), (5.0, 0.0, 0.0)), (0.0, 0.0, 0.0))
    assert found["rise_s"] == pytest.approx(np.log(9.0), abs=0.002)  # of an exponential: tau ln 9


def test_drift_of_a_circle_about_any_place(experiment):
    phase = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    offset = np.stack([0.3 + 0.2 * np.cos(phase), -0.1 + 0.2 * np.sin(phase), 0.05 * np.sin(phase)], axis=1)
    found = experiment.figures_of(experiment.Part("hover", phase, offset, (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0))
    assert found["drift_rms_m"] == pytest.approx(0.2)
    assert found["drift_max_m"] == pytest.approx(0.2)
    assert found["height_rms_m"] == pytest.approx(0.05 / np.sqrt(2.0))
