"""How often nuclides are identified, named wrongly, and found to be unknown.

    python -m experiments.validation.identification [--detectors NAME …] [--walls NAME …] [--per-nuclide N]

Every nuclide of the library, bare and behind 0 to 4 mean free paths of any wall, anywhere on a way of up to 30 m in
air, at a net rate of half the background, with the gain (3 %), the resolution (15 %) and the background's amplitude
(20 %) and tilt (10 %) drawn at random. Writes ``identification.csv`` (one row for each nuclide and condition) and, for
each detector, ``confusion_<detector>.png`` and ``calibration_<detector>.csv``.
"""

import csv
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import matplotlib as mpl
import numpy as np
from cyclopts import App, Parameter
from numpy.typing import NDArray

from experiments.validation.spectra import WALLS, Cases, Instrument, without
from swarmsim.radiation import Detector, Identification, identify, load_library
from swarmsim.radiation.identify import NONE, UNKNOWN

mpl.use("Agg")
from matplotlib import pyplot as plt

DETECTORS = ("nai_1p5x1p5", "nai_2x2", "cebr3_1p5x1p5")
NET = (100.0, 300.0, 1000.0, 3000.0)
DEPTH_MAX = 4.0
CONFUSED_NET = 300.0  # counts of the figure
SURE = 0.9
BATCH = 50
BACKGROUNDS = 200  # spectra of the background alone, of each live time
CLASSES = (0.0, 0.5, 0.7, 0.9, 0.99, 1.0)

app = App(name="identification", help=__doc__, help_format="plaintext")
_identify = jax.jit(jax.vmap(identify, in_axes=(None, 0, 0)))


def identified(detector: Detector, cases: Cases) -> Identification:
    """Identify all cases, in batches of one size so that one program does."""
    n = len(cases.nuclide)
    rows = np.resize(np.arange(n), (-(-n // BATCH), BATCH))
    parts = [_identify(detector, cases.counts[batch], cases.live_s[batch]) for batch in rows]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:n], *parts)


def figures(truth: NDArray[np.int64], found: Identification, right: NDArray[np.bool_]) -> dict[str, float]:
    """Shares of the answers: right, unknown, none, wrong and stated with confidence."""
    answer, sure = np.asarray(found.nuclide), np.asarray(found.confidence) > SURE
    wrong = (answer >= 0) & ~right
    return {
        "cases": len(truth),
        "right": float(np.mean(right)),
        "unknown": float(np.mean(answer == UNKNOWN)),
        "none": float(np.mean(answer == NONE)),
        "wrong": float(np.mean(wrong)),
        "wrong_and_sure": float(np.mean(wrong & sure)),
    }


def measured(instrument: Instrument, per_nuclide: int, rng: np.random.Generator) -> tuple[list[dict[str, Any]], Any]:
    """Rows of the table, and truth, answers and confidences of the cases behind walls at `CONFUSED_NET`."""
    detector, names = instrument.detector, instrument.detector.nuclide_names
    truth = np.repeat(np.arange(len(names)), per_nuclide)
    rows: list[dict[str, Any]] = []
    confused: Any = None
    for net in NET:
        for depth_max in (0.0, DEPTH_MAX):
            cases = instrument.draw(rng, truth, np.full(len(truth), net), depth_max)
            found = identified(detector, cases)
            if net == CONFUSED_NET and depth_max > 0.0:
                confused = truth, np.asarray(found.nuclide), np.asarray(found.confidence)
            for k, name in enumerate(names):
                of = truth == k
                part = jax.tree.map(lambda leaf, of=of: leaf[of], found)
                values = figures(truth[of], part, np.asarray(part.nuclide) == k)
                rows.append({"case": "in the library", "net": net, "depth_max": depth_max, "nuclide": name} | values)
        cases = instrument.draw(rng, np.full(BACKGROUNDS, -1), np.full(BACKGROUNDS, net), 0.0)
        found = identified(detector, cases)
        values = figures(cases.nuclide, found, np.asarray(found.nuclide) == NONE)
        rows.append({"case": "background", "net": net, "depth_max": 0.0, "nuclide": "-"} | values)
    return rows + left_out(instrument, per_nuclide, rng), confused


def left_out(instrument: Instrument, per_nuclide: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Rows of the table for nuclides that the library lacks."""
    rows = []
    for k, name in enumerate(instrument.detector.nuclide_names):
        nets, lacking = np.repeat(NET, per_nuclide), without(instrument.detector, k)
        for depth_max in (0.0, DEPTH_MAX):
            cases = instrument.draw(rng, np.full(len(nets), k), nets, depth_max)
            found = identified(lacking, cases)
            for net in NET:
                part = jax.tree.map(lambda leaf, of=nets == net: leaf[of], found)
                # names of the other nuclides move up, so that none of them is the one left out: all are wrong
                values = figures(cases.nuclide[nets == net], part, np.asarray(part.nuclide) == UNKNOWN)
                rows.append({"case": "left out", "net": net, "depth_max": depth_max, "nuclide": name} | values)
    return sorted(rows, key=lambda row: (row["net"], row["depth_max"]))


def calibration(instrument: Instrument, n: int, rng: np.random.Generator) -> list[dict[str, float]]:
    """Share of right answers by stated confidence, over random nuclides, background alone, and strengths."""
    truth = np.where(rng.random(n) < 0.2, -1, rng.integers(len(instrument.detector.nuclide_names), size=n))
    cases = instrument.draw(rng, truth, 30.0 * 100.0 ** rng.random(n), DEPTH_MAX)
    found = identified(instrument.detector, cases)
    confidence, right = np.asarray(found.confidence), np.asarray(found.nuclide) == truth
    rows = []
    for low, high in itertools.pairwise(CLASSES):
        of = (confidence > low) & (confidence <= high)
        rows.append(
            {
                "above": low,
                "answers": int(of.sum()),
                "stated": float(confidence[of].mean()) if of.any() else float("nan"),
                "right": float(right[of].mean()) if of.any() else float("nan"),
            }
        )
    return rows


def draw_confusion(names: Sequence[str], truth: NDArray[np.int64], answer: NDArray[np.int64], file: Path) -> None:
    """Figure of the share of each answer (columns) for each nuclide (rows)."""
    columns = [*names, "none", "unknown"]
    place = np.where(answer == NONE, len(names), np.where(answer == UNKNOWN, len(names) + 1, answer))
    share = np.zeros((len(names), len(columns)))
    np.add.at(share, (truth, place), 1.0)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1.0)
    figure, axes = plt.subplots(figsize=(7.0, 6.4), layout="constrained")
    image = axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0)
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_xlabel("Answer")
    axes.set_ylabel("Nuclide")
    figure.colorbar(image, ax=axes, label="Share of the answers")
    figure.savefig(file, dpi=150)
    plt.close(figure)


def write(file: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows as CSV."""
    with file.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def told(rows: Sequence[dict[str, Any]]) -> None:
    """Print the means over nuclides for each condition, and the nuclides that fall behind."""
    keys = dict.fromkeys((row["case"], row["net"], row["depth_max"]) for row in rows)
    for key in keys:
        of = [row for row in rows if (row["case"], row["net"], row["depth_max"]) == key]
        mean = {name: np.mean([row[name] for row in of]) for name in ("right", "unknown", "none", "wrong_and_sure")}
        worst = [f"{row['nuclide']} {row['right']:.2f}" for row in of if row["right"] < 0.9]
        shares = ", ".join(f"{name} {value:.3f}" for name, value in mean.items())
        print(f"{key[0]}, {key[1]:g} net, 0 to {key[2]:g} mean free paths: {shares}; {' '.join(worst)}", flush=True)


@app.default
def main(
    *,
    detectors: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = DETECTORS,
    walls: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = WALLS,
    per_nuclide: int = 40,
    calibration_cases: int = 4000,
    seed: int = 0,
    out: Path = Path("results/identification"),
) -> None:
    """Measure, write and draw.

    Args:
        detectors: Detector models.
        walls: Materials of the walls, of which each spectrum has one.
        per_nuclide: Spectra of each nuclide in each condition.
        calibration_cases: Spectra of the calibration.
        seed: Of the random numbers.
        out: Folder of the results.
    """
    out.mkdir(parents=True, exist_ok=True)
    library, table = load_library(), []
    for name in detectors:
        print(name, flush=True)
        instrument, rng = Instrument(name, library, walls), np.random.default_rng(seed)
        rows, (truth, answer, _) = measured(instrument, per_nuclide, rng)
        told(rows)
        table += [{"detector": name} | row for row in rows]
        draw_confusion(library.nuclide_names, truth, answer, out / f"confusion_{name}.png")
        calibrated = calibration(instrument, calibration_cases, rng)
        for row in calibrated:
            print(", ".join(f"{key} {value:.3f}" for key, value in row.items()), flush=True)
        write(out / f"calibration_{name}.csv", calibrated)
    write(out / "identification.csv", table)


if __name__ == "__main__":
    app()
