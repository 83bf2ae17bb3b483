"""An estimate thread by thread, as an accelerator may compute it: the same as window by window."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim import device
from swarmsim.config.load import load_named
from swarmsim.config.mission import Knowledge
from swarmsim.config.radiation import DetectorMount
from swarmsim.estimation.fit import settle
from swarmsim.estimation.forward import rates, ways_from
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.normal_equations import Others
from swarmsim.estimation.state import no_sources
from swarmsim.radiation import build_detector, restrict
from tests.estimation.survey import library, orbit, place, presumed, windows

BEHIND = [((4.0, 0.0, 2.0), (0.15, 8.0, 2.0), "concrete"), ((-3.0, 2.0, 1.0), (0.2, 3.0, 1.0), "steel")]
PLACE, OTHER = jnp.array([6.0, 1.0, 0.8]), jnp.array([-6.0, 3.0, 0.5])


@cache
def counter(model):
    mount = DetectorMount(model=model, position_m=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    return restrict(build_detector(load_named("detectors", model), mount, library(), "physical"), ("Co-60",))


def flight(padding):
    """Windows of a UAV and of a rover, and some that were not measured."""
    line = np.c_[np.linspace(-12.0, 12.0, 9), np.full(9, 2.0), np.full(9, 6.0)]
    air, ground = windows(line), orbit((0.0, 0.0), 5.0, 7)
    air = replace(air, travel_m=jnp.tile(jnp.array([3.0, 0.5, 0.0]), (9, 1)))
    every = jax.tree.map(lambda *x: jnp.concatenate(x), air, ground, windows(np.zeros((padding, 3)), which=1))
    return replace(every, valid=jnp.arange(16 + padding) < 16)


def settled(padding):
    """The fit at a place beside another source, and what the place adds to the counts, without slopes and with them."""
    detectors = (counter("nai_1p5x1p5"), counter("nai_2x2"))
    known = presumed(place(BEHIND, half=40.0), detectors, half=40.0, knowledge=Knowledge(learning_rate=1.0))
    m = replace(flight(padding), rois=jnp.zeros((16 + padding, detectors[0].background_rois.shape[0])))
    spans = ((0, 9, 0, 3), (9, 16 + padding, 1, 1))

    @jax.jit
    def fitted(known, m):
        problem = problem_of(known, m, spans)
        there = [ways_from(problem, at) for at in (PLACE, OTHER, PLACE + jnp.array([0.4, -0.3, 0.2]))]
        own, other = (rates(problem, ways, jnp.int32(0), 0.2 * jnp.ones(2)).counts for ways in there[:2])
        pattern = 1.0 + 0.1 * jnp.sin(jnp.arange(own.size)).reshape(own.shape)
        problem = problem_of(known, replace(m, rois=pattern * (problem.background + 8e7 * own + 3e7 * other)), spans)
        nothing = no_sources(problem, 2, 1)
        others = Others(
            counts=nothing.added.counts.at[1].set(2e7 * other), variance=nothing.added.variance.at[1].set(0.01)
        )
        ways = there[2]
        found = settle(problem, ways, jnp.int32(0), others, nothing.unknowns, 3, fresh=True)
        return found, [rates(problem, ways, jnp.int32(0), jnp.zeros(2), slopes=slopes) for slopes in (False, True)]

    assert len(known.uncertain) == 2
    return fitted(known, m)


def test_a_fit_thread_by_thread_is_that_of_all_windows_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    expected, plain = settled(0)
    monkeypatch.setattr(device, "WINDOW_THREADS", True)
    monkeypatch.setattr(device, "on_processor", lambda: False)
    assert device.thread_by_thread()
    found, quick = settled(3)  # other shapes: nothing that was traced before serves
    assert float(expected.unknowns.activity_bq) > 1e5
    assert float(jnp.abs(expected.unknowns.lengths).max()) > 0.01
    std = np.sqrt(np.diag(np.linalg.inv(np.asarray(expected.towards, float))))
    # a difference of large numbers
    np.testing.assert_allclose((found.move - expected.move) / std, 0.0, atol=0.02)
    for name in ("value", "likelihood", "covariance", "towards"):
        one, other = (np.asarray(getattr(x, name)) for x in (found, expected))
        np.testing.assert_allclose(one, other, rtol=2e-3, atol=2e-3 * np.abs(other).max(), err_msg=name)
    for name in ("activity_bq", "others", "level", "lengths"):
        one, other = (np.asarray(getattr(x.unknowns, name)) for x in (found, expected))
        np.testing.assert_allclose(one, other, rtol=2e-3, atol=2e-3, err_msg=name)
    for name in ("gain", "background"):
        one, other = (np.asarray(getattr(x.unknowns, name))[:16] for x in (found, expected))
        np.testing.assert_allclose(one, other, atol=5e-3, err_msg=name)
    for one, other in zip(quick, plain, strict=True):
        np.testing.assert_allclose(one.counts[:16], other.counts, rtol=2e-3, atol=1e-5 * float(other.counts.max()))
        np.testing.assert_allclose(one.edge[:16], other.edge, atol=1e-4)
    assert quick[0].slopes.shape[1] == 0
    slopes = np.asarray(plain[1].slopes)
    # where rays to a window differ, each has the spectrum of what is scattered on its own way, not the mean one
    even = np.flatnonzero(np.asarray(plain[1].edge) < 1e-3)
    assert len(even) >= 12
    np.testing.assert_allclose(quick[1].slopes[even], slopes[even], rtol=2e-3, atol=1e-4 * np.abs(slopes).max())
    # at lengths that agree to some thousandths
    counts = np.asarray(expected.rates.counts)
    np.testing.assert_allclose(found.rates.counts[:16], counts, rtol=0.01, atol=1e-4 * counts.max())
