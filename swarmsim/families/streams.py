"""Streams of random numbers by seed and name, and numbers of a distribution made from them (host side)."""

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtri_exp

from swarmsim.config.family import Varied
from swarmsim.config.vary import Distribution, Normal

_SCALE = 2.0**-53


class Stream:
    """Independent numbers, uniform in (0, 1), of one name and one seed: the same whatever other streams there are.

    Philox 4x64 (Salmon et al. 2011), keyed by numpy's SeedSequence from the seed and the SHA-256 of the name. Only its
    raw words are used: numpy keeps those the same from release to release, and its distributions not.
    """

    def __init__(self, seed: int, name: str):
        """The stream ``name`` of the mission ``seed``."""
        words = np.frombuffer(hashlib.sha256(name.encode()).digest()[:16], "<u4")
        self._bits = np.random.Philox(np.random.SeedSequence(seed % 2**32, spawn_key=tuple(map(int, words))))

    def numbers(self, count: int) -> NDArray[np.float64]:
        """The next ``count`` numbers; 53 bits each, neither 0 nor 1."""
        words = np.asarray(self._bits.random_raw(count), np.uint64) >> np.uint64(11)
        return np.minimum((words.astype(np.float64) + 0.5) * _SCALE, 1.0 - _SCALE)

    def number(self) -> float:
        """The next number."""
        return float(self.numbers(1)[0])


def drawn(varied: Varied, number: float, nuclides: Sequence[str]) -> Any:
    """The value of a distribution (all but ``place``) that ``number``, uniform in (0, 1), stands for.

    ``nuclides`` are those that ``any_nuclide`` chooses from.
    """
    distribution = varied.distribution
    match distribution.kind:
        case "uniform" | "log_uniform":
            return _within(distribution, number, varied.whole)
        case "normal":
            assert distribution.normal is not None
            return truncated_normal(distribution.normal, number)
        case "choice":
            assert distribution.choice is not None
            return distribution.choice[chosen(number, distribution.weights or (1.0,) * len(distribution.choice))]
        case "count":
            assert distribution.count is not None
            least, most = distribution.count
            return least + int(number * (most - least + 1))
        case "any_nuclide":
            return nuclides[int(number * len(nuclides))]
    raise ValueError(f"{distribution.kind} needs a site")


def chosen(number: float, weights: Sequence[float]) -> int:
    """The index that ``number`` chooses by ``weights``; never one of no weight."""
    steps = np.cumsum(weights) / math.fsum(weights)
    index = int(np.searchsorted(steps, number, side="right"))
    return min(index, int(np.flatnonzero(weights)[-1]))


def _within(distribution: Distribution, number: float, whole: bool) -> float | int:
    ends = distribution.interval
    assert ends is not None
    low, high = ends
    if whole:
        return int(low) + int(number * (int(high) - int(low) + 1))
    if distribution.uniform is not None:
        value = low * (1.0 - number) + high * number
    else:
        value = math.exp(math.log(low) * (1.0 - number) + math.log(high) * number)
    return min(max(value, low), high)


def truncated_normal(normal: Normal, number: float) -> float:
    """The quantile ``number`` of a normal distribution cut off at its bounds, by logarithms: exact far in a tail."""
    low, high = ((bound - normal.mean) / normal.std for bound in (normal.low, normal.high))
    mirrored = low > 0.0  # where the probabilities would round to one
    if mirrored:
        low, high, number = -high, -low, 1.0 - number
    below, above = log_ndtr(low), log_ndtr(high)
    score = float(ndtri_exp(above + math.log(number + (1.0 - number) * math.exp(below - above))))
    value = normal.mean + normal.std * (-score if mirrored else score)
    return min(max(value, normal.low), normal.high)
