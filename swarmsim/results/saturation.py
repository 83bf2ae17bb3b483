"""Samples in which a counter was in its dead time, so that what it shows says little of the rate."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]

SATURATED_SHARE = 0.75  # of the highest rate that a counter can show: a paralysable one loses a third of the pulses
PARALYSED_SHARE = 0.1  # of the nominal background: a paralysable counter that shows less is paralysed, or broken
JUDGED_COUNTS = 50.0  # of background expected in the time that is judged: of so many a tenth is no chance
SILENT_COUNTS, SILENT_SHARE = 50.0, 0.02  # of background expected while silent: what else is an empty interval or two


def saturated(
    vehicle: NDArray[np.integer], counts: Floats, exposure_s: Floats, highest_cps: Floats, quiet_cps: Floats
) -> NDArray[np.bool_]:
    """Whether each sample [n] shows a counter in its dead time: near the highest rate that it can show, or silent.

    A counter is silent that shows less than a tenth of its background for long.

    Args:
        vehicle: number of the vehicle, in the order of time.
        counts: of the sample.
        exposure_s: that they stand for.
        highest_cps: rate that the counter can show; inf without dead time.
        quiet_cps: nominal background of a counter that can be paralysed, else 0.
    """
    near = counts > SATURATED_SHARE * highest_cps * exposure_s
    expected, silent = exposure_s * quiet_cps, np.zeros(len(counts), bool)
    for number in np.unique(vehicle):
        own = np.flatnonzero(vehicle == number)
        part = np.floor(np.cumsum(expected[own]) / JUDGED_COUNTS).astype(int)
        shown, natural = (np.bincount(part, each[own]) for each in (counts, expected))
        silent[own] = ((shown < PARALYSED_SHARE * natural) & (natural >= 0.5 * JUDGED_COUNTS))[part]
    if expected[silent].sum() <= SILENT_SHARE * expected.sum() + SILENT_COUNTS:
        return near
    return near | silent
