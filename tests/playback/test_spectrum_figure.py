"""What is on the figure of a spectrum."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.text import Text

from swarmsim.playback import figures
from swarmsim.results.record import MissionRecord
from swarmsim.site.model import SiteModel
from tests.playback.prints import check_print, texts

pytestmark = pytest.mark.usefixtures("print_style")


def test_spectrum_has_its_fit_lines_and_residuals(found: MissionRecord, site: SiteModel) -> None:
    figure = figures.spectrum(found, site)
    upper, lower = figure.axes
    assert upper.get_yscale() == "log"
    assert lower.get_xlabel() == "Energy [keV]"
    assert upper.get_ylabel() == "Counts per 11.7 keV"
    assert found.spectrum is not None
    measured = next(line for line in upper.lines if str(line.get_label()).startswith("measured"))
    assert np.sum(measured.get_ydata()) == pytest.approx(found.spectrum.counts.sum())
    places = {text.get_text(): text.get_position()[0] for text in upper.texts}
    assert places == {"1173 keV": pytest.approx(1173.2), "1332 keV": pytest.approx(1332.5)}
    residuals = np.asarray(lower.lines[-1].get_ydata())
    assert residuals.std() == pytest.approx(1.0, abs=0.15)  # the fit is the truth here
    assert "Co-60, confidence > 0.999" in texts(figure)


@pytest.mark.parametrize(
    ("scores", "said"),
    [
        ({"Co-60": 1.0, "Cs-137": 0.89}, "Co-60, confidence > 0.999"),
        ({"Co-60": 1.0, "Cs-137": 0.91}, "Co-60, confidence > 0.999; with Cs-137"),
        ({"Ba-133": 0.99, "Co-60": 1.0, "Cs-137": 0.95}, "Co-60, confidence > 0.999; with Ba-133 and Cs-137"),
    ],
)
def test_title_of_a_spectrum_names_all_that_it_is_sure_of(
    scores: dict[str, float], said: str, found: MissionRecord, site: SiteModel
) -> None:
    assert found.spectrum is not None
    spectrum = dataclasses.replace(found.spectrum, scores=scores, live_time_s=1200.0)
    figure = figures.spectrum(dataclasses.replace(found, spectrum=spectrum), site)
    check_print(figure)
    (title,) = [text for text in figure.findobj(Text) if text.get_text() == said]
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert title.get_window_extent().x1 < legend.get_window_extent().x0


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([661.7, 36.4, 31.8, 32.2], ["32–36 keV", "662 keV"]),
        ([39.5, 45.4, 121.8, 1085.8, 1089.7, 1112.1], ["40–45 keV", "122 keV", "1088 keV", "1112 keV"]),
        ([1368.6, 2754.0, 2994.0], ["1369 keV", "2754 keV", "2994 keV"]),
        ([], []),
        ([*np.arange(30.0, 2990.0, 20.0)], ["30–2970 keV"]),
    ],
)
def test_labels_of_lines_are_beside_one_another_above_the_curves(
    lines: list[float], said: list[str], found: MissionRecord, site: SiteModel
) -> None:
    assert found.spectrum is not None
    spectrum = dataclasses.replace(found.spectrum, lines_kev=np.array(lines))
    figure = figures.spectrum(dataclasses.replace(found, spectrum=spectrum), site)
    figure.canvas.draw()
    upper = figure.axes[0]
    assert [text.get_text() for text in upper.texts] == said
    inside = upper.get_window_extent()
    boxes = [Text.get_window_extent(text) for text in upper.texts]  # without the leader
    assert all(inside.x0 <= b.x0 and b.x1 <= inside.x1 and b.y1 <= inside.y1 for b in boxes)
    assert all(a.x1 <= b.x0 + 0.5 for a, b in pairwise(boxes))
    top = upper.transData.transform((0.0, float(np.max(upper.lines[0].get_ydata()))))[1]
    assert all(b.y0 > top for b in boxes)
