"""What an ideal observer could name: the Bayes limit of identification by simulation.

    python -m experiments.validation.limits [--detector NAME] [--walls NAME …] [--net COUNTS]

The likelihood of each spectrum under each nuclide is averaged over thousands of draws of the very distributions of
walls, gain, resolution and background that the spectra were drawn from, the strength being known. Nobody who does not
know them names more nuclides rightly. Strangers, mixtures and the background alone are no alternatives here.
"""

from typing import Annotated

import numpy as np
from cyclopts import App, Parameter

from experiments.validation.spectra import NET_SHARE, WALLS, Floats, Instrument
from swarmsim.radiation import load_library

DEPTH_MAX = 4.0
BLOCK = 500  # draws whose likelihoods are computed at once

app = App(name="limits", help=__doc__, help_format="plaintext")


def log_evidence(counts: Floats, mean: Floats) -> tuple[Floats, Floats]:
    """Largest logarithm [n] of the likelihoods of ``counts`` [n, bins] given each of ``mean`` [k, bins], and their sum
    [n] relative to it.
    """
    each = counts @ np.log(np.maximum(mean, 1e-9)).T - mean.sum(axis=1)
    largest = each.max(axis=1)
    return largest, np.exp(each - largest[:, None]).sum(axis=1)


@app.default
def main(
    *,
    detector: str = "nai_2x2",
    walls: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = WALLS,
    net: float = 300.0,
    per_nuclide: int = 24,
    draws: int = 6000,
    seed: int = 0,
) -> None:
    """Print the share that is named rightly, and the nuclides that fall behind.

    Args:
        detector: Detector model.
        walls: Materials of the walls, of which each spectrum has one.
        net: Net counts.
        per_nuclide: Spectra of each nuclide.
        draws: Of walls, gain, resolution and background for each nuclide.
        seed: Of the random numbers.
    """
    instrument, rng = Instrument(detector, load_library(), walls), np.random.default_rng(seed)
    names, edges = instrument.detector.nuclide_names, np.asarray(instrument.detector.identification_bins)
    truth = np.repeat(np.arange(len(names)), per_nuclide)
    counts = instrument.draw(rng, truth, np.full(len(truth), net), DEPTH_MAX).counts
    binned = np.add.reduceat(counts, edges[:-1], axis=1).astype(np.float64)
    score = np.full((len(truth), len(names)), -np.inf)
    for k in range(len(names)):
        for _ in range(-(-draws // BLOCK)):
            mean = instrument.means(rng, np.full(BLOCK, k), np.full(BLOCK, net), DEPTH_MAX)
            largest, total = log_evidence(binned, np.add.reduceat(mean, edges[:-1], axis=1))
            score[:, k] = np.logaddexp(score[:, k], largest + np.log(total))
    right = (np.argmax(score, axis=1) == truth).reshape(len(names), per_nuclide).mean(axis=1)
    worst = [f"{names[k]} {right[k]:.2f}" for k in np.argsort(right) if right[k] < 0.9]
    share = f"{detector}, {net:g} net counts, rate {NET_SHARE:g} of the background: {right.mean():.3f}"
    print(share, *worst)


if __name__ == "__main__":
    app()
