"""Which samples show a counter in its dead time, and which are chance or a low background."""

import numpy as np
import pytest

from swarmsim.config.load import load_named
from swarmsim.radiation.rate import most_shown
from swarmsim.results.saturation import saturated

DETECTORS = ("csi_1x1", "geiger_sbm20", "cebr3_1p5x1p5", "nai_1p5x1p5", "nai_2x2")


def judged(name: str, rate_cps: np.ndarray, vehicles: int = 1) -> np.ndarray:
    """Of counts drawn with ``rate_cps`` [n] by each of some vehicles with that detector."""
    spec = load_named("detectors", name)
    dead = (spec.dead_time.paralyzable_us * 1e-6, spec.dead_time.non_paralyzable_us * 1e-6)
    exposure = np.full(len(rate_cps) * vehicles, spec.sample_period_s)
    counts = np.random.default_rng(0).poisson(np.repeat(rate_cps, vehicles) * exposure).astype(float)
    vehicle = np.tile(np.arange(vehicles), len(rate_cps))
    quiet = spec.background.rate_cps if dead[0] > 0.0 else 0.0
    return saturated(vehicle, counts, exposure, np.full(len(counts), most_shown(*dead)), np.full(len(counts), quiet))


def background(name: str, duration_s: float, share: float = 1.0) -> np.ndarray:
    spec = load_named("detectors", name)
    return np.full(int(duration_s / spec.sample_period_s), share * spec.background.rate_cps)


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("duration_s", [30.0, 200.0, 1800.0])
def test_background_is_no_saturation(name: str, duration_s: float) -> None:
    """A Geiger tube counts less than once in two seconds: empty intervals are chance, however many there are."""
    assert not judged(name, background(name, duration_s), vehicles=3).any()
    assert not judged(name, background(name, duration_s, 0.3)).any()


@pytest.mark.parametrize("name", [name for name in DETECTORS if name != "geiger_sbm20"])
def test_a_counter_that_falls_silent_is_paralysed(name: str) -> None:
    rate = background(name, 200.0)
    silent = slice(len(rate) // 2, len(rate) // 2 + len(rate) // 4)
    rate[silent] *= 0.01
    found = judged(name, rate)
    assert found[silent].mean() > 0.9
    assert found.sum() < 1.1 * found[silent].sum() + 10


def test_two_of_a_team_are_judged_by_themselves() -> None:
    rate = background("nai_1p5x1p5", 100.0)
    spec = load_named("detectors", "nai_1p5x1p5")
    counts = np.column_stack([np.zeros(len(rate)), rate * spec.sample_period_s]).ravel()
    vehicle = np.tile([0, 1], len(rate))
    n = len(counts)
    found = saturated(
        vehicle, counts, np.full(n, spec.sample_period_s), np.full(n, np.inf), np.full(n, spec.background.rate_cps)
    )
    assert found[vehicle == 0].mean() > 0.95
    assert not found[vehicle == 1].any()


def test_a_rate_near_the_highest_is_saturated() -> None:
    spec = load_named("detectors", "geiger_sbm20")
    highest = 1e6 / spec.dead_time.non_paralyzable_us
    assert not judged("geiger_sbm20", np.full(20, 0.5 * highest)).any()
    assert judged("geiger_sbm20", np.full(20, 0.95 * highest)).all()
