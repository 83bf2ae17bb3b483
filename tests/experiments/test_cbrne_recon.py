"""The experiment's table: what it compares, and the one figure that needs no flight."""

import importlib.util
from pathlib import Path

import pytest

import swarmsim

pytestmark = pytest.mark.optimised

SCRIPT = Path(__file__).parents[2] / "experiments" / "cbrne_recon" / "run.py"


@pytest.fixture(scope="module")
def experiment():
    spec = importlib.util.spec_from_file_location("cbrne_recon", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_net_rate_above_the_source_is_that_of_the_crystal(experiment):
    physical = experiment.net_rate_above_source(swarmsim.build(swarmsim.load("recon")))
    ideal = experiment.net_rate_above_source(swarmsim.build(swarmsim.load("recon_paper")))
    assert 34.0 <= physical <= 35.0
    # side-on, every photon: A y d L / (4 pi r^2)
    assert ideal == pytest.approx(170e6 * 1.9983 * 0.0381**2 / (4 * 3.14159265 * 400.0), rel=0.01)


def test_the_median_decides_whether_a_bar_is_met(experiment):
    rows = [
        {"survey_measurements": n, "survey_duration_s": s}
        for n, s in ((9_000, 300.0), (10_300, 310.0), (10_400, 400.0))
    ]
    figures = [f for f in experiment.PAPER if f.key in rows[0]]
    table = {row[0]: row for row in experiment.compare(rows, figures)}
    assert table["aerial measurements"][2:] == ["1.03e+04", "9130 to 1.039e+04", "yes"]
    assert table["aerial duration [s]"][4] == "yes"
    assert experiment.compare([{"source_error_m": None}], experiment.OWN[1:2])[0][4] == "no"


def test_figures_name_columns_that_missions_have(experiment):
    from swarmsim.results.batch import batch_row
    from tests.synthetic import mission

    row = batch_row(mission())
    known = {*row, "real_time_factor", "net_at_20_m_cps"}
    assert {figure.key for figure in (*experiment.PAPER, *experiment.OWN)} <= known
