"""Sources as users write them: where they are, and the points that lines and areas are computed as."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from swarmsim.config.errors import InputError
from swarmsim.config.scenario import load_scenario
from swarmsim.config.sources import POINTS_MAX, SPACING_M, Source, points_of

LINE = "line_m: [[-10, -30], [10, -30]], height_m: 0"
SQUARE = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0))


def source(**place: Any) -> Source:
    height = {} if "on" in place else {"height_m": 0.0}
    return Source(**({"nuclide": "Co-60", "activity_mbq": 1.0} | height | place))


def mean_inverse_square(made: Source, seen_from: np.ndarray) -> np.ndarray:
    """Activity-weighted mean of 1 / r2 [n] at places [n, 3] over flat ground at height 0."""
    xy, share = points_of(made)
    offset = np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)[None] - seen_from[:, None]
    return share @ (1.0 / np.sum(offset**2, axis=-1)).T


def of_line(length: float, x: np.ndarray, h: float) -> np.ndarray:
    """The same of a line from 0 to ``length`` along x: the angle that it is seen under, over its length and h."""
    return (np.arctan((length - x) / h) + np.arctan(x / h)) / (h * length)


@pytest.mark.parametrize(("over_spacing", "within"), [(1.0, 0.04), (2.0, 0.005), (5.0, 5e-4)])
def test_a_line_is_its_closed_form(over_spacing: float, within: float) -> None:
    for length in (0.3, 0.9, 1.8, 2.5, 7.7, 20.0):
        made, x = source(line_m=((0.0, 0.0), (length, 0.0))), np.linspace(-3.0, length + 3.0, 200)
        h = over_spacing * SPACING_M
        seen = mean_inverse_square(made, np.stack([x, 0.0 * x, 0.0 * x + h], axis=-1))
        np.testing.assert_allclose(seen, of_line(length, x, h), rtol=within)


@pytest.mark.parametrize(("height", "within"), [(1.0, 0.04), (2.0, 0.005), (5.0, 2e-3)])
def test_an_area_is_the_closed_form_of_a_disc_over_its_middle(height: float, within: float) -> None:
    corners, radius = 32, 6.0
    outer = radius / np.sqrt(corners / (2 * np.pi) * np.sin(2 * np.pi / corners))  # of a polygon as large as the disc
    angle = 2 * np.pi * np.arange(corners) / corners
    made = source(area_m=tuple(zip(*(outer * np.stack([np.cos(angle), np.sin(angle)])).tolist(), strict=True)))
    seen = mean_inverse_square(made, np.array([[0.0, 0.0, height]]))
    assert seen[0] == pytest.approx(np.log(1 + (radius / height) ** 2) / radius**2, rel=within)


@pytest.mark.parametrize("spacing", [0.4, 1.0, 2.5])
def test_points_share_the_activity_evenly_and_stay_near_each_other(spacing: float) -> None:
    bent = ((0.0, 0.0), (8.0, 0.0), (8.0, 3.0))
    xy, share = points_of(source(line_m=bent, spacing_m=spacing))
    assert share.sum() == pytest.approx(1.0)
    assert share[xy[:, 1] == 0.0].sum() == pytest.approx(8.0 / 11.0)
    assert max(np.linalg.norm(b - a) for a, b in pairwise(xy[xy[:, 1] == 0.0])) <= spacing * (1 + 1e-6)
    np.testing.assert_allclose(share @ xy, [(8 * 4 + 3 * 8) / 11, 3 * 1.5 / 11])
    pentagon = ((0.0, 0.0), (7.3, 1.0), (8.0, 6.2), (3.0, 9.0), (-1.0, 4.0))
    xy, share = points_of(source(area_m=pentagon, spacing_m=spacing))
    triangles = [np.array([pentagon[0], pentagon[k], pentagon[k + 1]]) for k in (1, 2, 3)]
    areas = [0.5 * np.linalg.det(np.stack([t[1] - t[0], t[2] - t[0]])) for t in triangles]
    assert share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(
        share @ xy, sum(a * t.mean(axis=0) for a, t in zip(areas, triangles, strict=True)) / sum(areas)
    )
    moment = sum(  # of a quadratic over a triangle: the mean of its values at the middles of the sides
        a * np.mean([((t[k] + t[k - 1]) / 2) ** 2 for k in range(3)], axis=0)
        for a, t in zip(areas, triangles, strict=True)
    )
    np.testing.assert_allclose(share @ xy**2, moment / sum(areas))
    nearest = np.sort(np.linalg.norm(xy[:, None] - xy[None], axis=-1), axis=1)[:, 1]
    assert nearest.max() <= spacing * (1 + 1e-6)


def test_the_number_of_points_stays_when_an_area_moves_or_turns() -> None:
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    counts = set()
    for matrix, shift in ((np.eye(2), 0.0), (np.eye(2), 33.3), (turn, 0.0), (turn, -17.1)):
        corners = np.array(SQUARE) @ matrix.T + shift
        counts.add(len(points_of(source(area_m=tuple(map(tuple, corners.tolist())))).share))
    assert len(counts) == 1
    assert len(points_of(source(position_m=(3.0, 4.0))).share) == 1


@pytest.mark.parametrize(
    "huge", [{"line_m": ((0.0, 0.0), (9e4, 0.0))}, {"area_m": ((0.0, 0.0), (9e4, 0.0), (0.0, 9e4))}]
)
def test_more_points_than_there_may_be_are_counted_not_made(huge: dict) -> None:
    huge = huge | {"spacing_m": 1e-4}
    with pytest.raises(ValueError, match=r"\d"):
        points_of(source(**huge))


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("", "give exactly one of position_m, line_m, area_m and on (a vehicle): none is given"),
        ("position_m: [0, 0], on: uav1", "area_m and on (a vehicle): position_m and on are given"),
        ("position_m: [0, 0]", "height_m is missing: position_m needs a height above the ground"),
        (LINE.partition(", height")[0], "height_m is missing: line_m needs a height"),
        ("on: uav1, height_m: 1", "a source on a vehicle has no height_m: its place is offset_m"),
        ("position_m: [0, 0], height_m: 1, offset_m: [0, 0, 1]", "offset_m is for a source on a vehicle"),
        ("position_m: [0, 0], height_m: 1, spacing_m: 2", "spacing_m is for line_m and area_m"),
        (f"{LINE}, spacing_m: 0", "is too small"),
        ("line_m: [[1, 2]], height_m: 0", "has too few values"),
        ("line_m: [[1, 2], [1, 2]], height_m: 0", "the line has no length"),
        ("area_m: [[0, 0], [5, 0], [1, 1], [0, 5]], height_m: 0", "the polygon is not convex"),
        ("area_m: [[0, 0], [5, 5], [9, 9]], height_m: 0", "the polygon has no area"),
        ("on: uav7", "there is no vehicle 'uav7'"),
        ("on: orfeus", "did you mean 'orpheus'"),
        ("on: uav1, offset_m: [1, 2]", "3 values"),
        (f"{LINE}, spacing_m: 0.01", f"at most {POINTS_MAX} of all sources of a mission"),
        (f"{LINE}, spacing_m: 0.01", "too large to be computed as points 0.01 m apart"),
        ("area_m: [[0, 0], [60, 0], [60, 60]], height_m: 0", "set a larger spacing_m"),
    ],
)  # fmt: skip
def test_a_place_that_is_none_is_told(mission: Path, place: str, message: str) -> None:
    made = f"sources.0={{nuclide: Co-60, activity_mbq: 5{', ' if place else ''}{place}}}"
    with pytest.raises(InputError) as caught:
        load_scenario(mission, [made])
    assert message in str(caught.value)
    assert all((problem.path or "").startswith("sources.0") for problem in caught.value.problems)


def test_a_resolved_scenario_reads_back_every_form(mission: Path, tmp_path: Path) -> None:
    forms = [
        LINE,
        "area_m: [[0, -30], [5, -30], [5, -35]], height_m: 0.1, spacing_m: 2",
        "on: uav1, offset_m: [0, 0, 1]",
    ]
    listed = ", ".join(f"{{nuclide: F-18, activity_mbq: 5, {form}}}" for form in forms)
    loaded = load_scenario(mission, [f"sources=[{listed}]"])
    (tmp_path / "again.yaml").write_text(loaded.to_yaml(), encoding="utf-8")
    assert load_scenario(tmp_path / "again.yaml").mission.sources == loaded.mission.sources
    assert [one.form for one in loaded.mission.sources] == ["line", "area", "carried"]


def test_a_source_in_python_is_checked_too() -> None:
    with pytest.raises(ValidationError, match="give exactly one of"):
        Source(nuclide="Co-60", activity_mbq=1.0, height_m=1.0)
