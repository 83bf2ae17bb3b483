"""Allan deviation of a sensor at rest, and the densities that it tells (IEEE Std 952-1997, annex C).

Everything is computed in float64 on the host.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from swarmsim.sensors.errors import FLICKER

Array = NDArray[np.float64]

_ROUNDS = 8  # of the fit: the weights have settled to a thousandth


@dataclass(frozen=True)
class AllanDeviation:
    """The overlapping Allan deviation of a record. M averaging times, trailing axes as those of the record."""

    tau_s: Array  # [M] averaging times, increasing
    deviation: Array  # [M, ...] in the unit of the record
    clusters: Array  # [M] whole averages that fit into the record, which do not overlap

    @property
    def relative_error(self) -> Array:
        """One standard deviation of each value [M] over the value, 1 / sqrt(2 (clusters - 1)).

        IEEE Std 952-1997, C.1.1; it is that of averages that do not overlap, and an upper bound of that of these.
        """
        error: Array = 1.0 / np.sqrt(2.0 * np.maximum(self.clusters - 1.0, 0.5))
        return error


def allan_deviation(record: ArrayLike, period_s: float, *, points: int = 40, clusters_min: int = 9) -> AllanDeviation:
    """The overlapping Allan deviation of ``record`` [N, ...], sampled every ``period_s``.

    With the integral theta of the record the variance at tau = m T is the mean of (theta[k + 2m] - 2 theta[k + m] +
    theta[k])^2 over all k, over 2 tau^2 (IEEE Std 952-1997, equation C.11, from D. W. Allan, "Statistics of atomic
    frequency standards", Proc. IEEE 54(2), 1966; overlapping: D. A. Howe, D. W. Allan and J. A. Barnes, "Properties of
    signal sources and measurement methods", 35th Frequency Control Symposium, 1981).

    Args:
        record: what a sensor reads at rest, a constant added or not.
        period_s: time between two samples.
        points: averaging times at most, evenly spaced in their logarithm from one period on.
        clusters_min: averages that fit into the record at the longest of them, at least 2.

    Raises:
        ValueError: the record has fewer samples than ``clusters_min``, is not finite, or the period is not positive.
    """
    values = np.asarray(record, np.float64)
    if clusters_min < 2 or points < 1:
        raise ValueError(f"clusters_min must be at least 2 and points at least 1, not {clusters_min} and {points}")
    if values.ndim == 0 or len(values) < clusters_min:
        raise ValueError(
            f"a record of the shape {values.shape} is too short: {clusters_min} samples or more are needed"
        )
    if not (np.isfinite(values).all() and period_s > 0):
        raise ValueError("the record must be finite and its period positive")
    longest = len(values) // clusters_min
    sizes = np.unique(np.round(np.geomspace(1, longest, points)).astype(int))
    centred = values - values.mean(axis=0)  # a constant cancels; without it the sums keep their digits
    zero = np.zeros((1, *values.shape[1:]))
    theta = np.concatenate([zero, np.cumsum(centred, axis=0)]) * period_s
    tau = sizes * period_s
    variance = [
        np.mean((theta[2 * m :] - 2.0 * theta[m:-m] + theta[: -2 * m]) ** 2, axis=0) / (2.0 * (m * period_s) ** 2)
        for m in sizes
    ]
    return AllanDeviation(tau_s=tau, deviation=np.sqrt(np.stack(variance)), clusters=len(values) / sizes)


@dataclass(frozen=True)
class Densities:
    """What an Allan deviation tells, in the unit U of its record; each [...] as its trailing axes."""

    random_walk: Array  # N, U sqrt(s): white noise, angle random walk of a gyroscope
    bias_instability: Array  # B, U: minimum over 0.664
    rate_random_walk: Array  # K, U / sqrt(s)


def densities(allan: AllanDeviation) -> Densities:
    """White noise N, bias instability B and rate random walk K of one sensor's Allan deviation.

    IEEE Std 952-1997, annex C: N is the line of slope -1/2 at tau = 1 s, B the minimum over 0.664, K the line of slope
    +1/2 at tau = 3 s. The lines are fitted to the variances by least squares: N^2 / tau + a + K^2 tau / 3, no part
    negative, each value weighted by the relative error of the fit there (its own would favour values that came out
    small). A record too short to show a part gives it with the error of what is left; B is then an upper bound.
    """
    tau = allan.tau_s
    shape = allan.deviation.shape[1:]
    variance = allan.deviation.reshape(len(tau), -1) ** 2
    basis = np.stack([1.0 / tau, np.ones_like(tau), tau / 3.0], axis=1)
    n2, _, k2 = np.array([_fit(basis, column, allan.relative_error) for column in variance.T]).T
    return Densities(
        random_walk=np.sqrt(n2).reshape(shape),
        bias_instability=allan.deviation.min(axis=0) / FLICKER,
        rate_random_walk=np.sqrt(k2).reshape(shape),
    )


def _fit(basis: Array, values: Array, relative_error: Array) -> Array:
    """Coefficients [3], none negative, of the basis [M, 3] that come nearest to ``values`` [M]."""
    fitted = values
    coefficients: Array = np.zeros(basis.shape[1])
    for _ in range(_ROUNDS):
        weight = 1.0 / np.maximum(fitted * relative_error, 1e-300)
        coefficients = nnls(basis * weight[:, None], values * weight)[0]
        fitted = basis @ coefficients
    return coefficients


def white_noise_variance(tau_s: ArrayLike, random_walk: float) -> Array:
    """Allan variance of white noise of density N: N^2 / tau."""
    return random_walk**2 / np.asarray(tau_s, np.float64)


def walk_variance(tau_s: ArrayLike, rate_random_walk: float, period_s: float = 0.0) -> Array:
    """Allan variance of a random walk of density K: K^2 tau / 3.

    Of one that is summed over samples every T = ``period_s`` instead of integrated (K^2 / 3) (tau + T^2 / (2 tau)).
    """
    tau = np.asarray(tau_s, np.float64)
    return rate_random_walk**2 / 3.0 * (tau + 0.5 * period_s**2 / tau)


def gauss_markov_variance(tau_s: ArrayLike, std: float, time_s: float) -> Array:
    """Allan variance of a Gauss-Markov process of standard deviation ``std`` and correlation time T.

    (2 std^2 T / tau) (1 - T / (2 tau) (3 - 4 exp(-tau / T) + exp(-2 tau / T))): IEEE Std 952-1997, equation C.30, with
    q_c^2 = 2 std^2 / T.
    """
    x = np.asarray(tau_s, np.float64) / time_s
    return 2.0 * std**2 / x * (1.0 - (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x))
