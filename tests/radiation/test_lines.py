"""Peaks of gamma lines in the bins of identification, and how gain and resolution change them."""

import numpy as np
import pytest

from swarmsim.config.load import load_named
from swarmsim.radiation import Library
from swarmsim.radiation.lines import GAINS, identification_bins, orders
from swarmsim.radiation.response import build_response


def test_gain_moves_and_width_widens_peaks(library: Library) -> None:
    """A Gaussian peak keeps its counts, moves with the gain, and has the variance of the new width."""
    spec = load_named("detectors", "nai_2x2")
    response = build_response(spec, library.material(spec.crystal), library.material(spec.housing.material))
    channel, bins = np.arange(1024), np.asarray(identification_bins(response))
    sigma = float(response.sigma_kev(np.asarray(response.channel_centre_kev[341]))) / response.channel_width_kev
    peak = np.exp(-0.5 * ((channel - 341) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    table, middle = orders(response, peak), 0.5 * (bins[1:] + bins[:-1])
    for width in (0.87, 1.13):
        t = 0.5 * (width**2 - 1.0)
        wide = table[GAINS.index(1.0)].T @ np.array([1.0, 0.0, 0.0, t, t * t])
        assert wide.sum() == pytest.approx(1.0, abs=0.01)
        of_bins = np.sum((bins[1:] - bins[:-1]) ** 2 * wide) / 12.0  # within bins
        assert np.sum(wide * (middle - 341.5) ** 2) == pytest.approx((width * sigma) ** 2 + of_bins, rel=0.05)
    for gain in (0.9775, 1.0, 1.02):
        k = int(np.argmin(np.abs(np.asarray(GAINS) - gain)))
        u = gain - GAINS[k]
        moved = table[k].T @ np.array([1.0, u, u * u, 0.0, 0.0])
        assert np.sum(moved * middle) / moved.sum() == pytest.approx(gain * 341.5, rel=1e-3)
