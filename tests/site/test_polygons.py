"""Faces of many corners, concave ones and ones that cross themselves, as triangles."""

import time

import numpy as np
import pytest
from yards import PLATE_OBJ, spec, write_plate_dae

from swarmsim.site.importer import build
from swarmsim.site.polygons import CONCAVE_MAX, Cutter, PolygonError

ARROW = [(-20, -20), (20, -20), (20, 20), (0, -15), (-20, 20)]
"""A concave face, of 900 m2: a fan from any corner but the fourth covers what lies outside."""


@pytest.mark.parametrize("first", range(5))
@pytest.mark.parametrize("suffix", ["obj", "dae"])
def test_concave_faces(tmp_path, suffix, first):
    path, corners = tmp_path / f"arrow.{suffix}", ARROW[first:] + ARROW[:first]
    if suffix == "obj":
        path.write_text("".join(f"v {x} {y} 0\n" for x, y in corners) + "f 1 2 3 4 5\n")
    else:
        points = " ".join(f"{x} {y} 0" for x, y in corners)
        faces = "<polylist count='1'>{inputs}<vcount>5</vcount><p>0 1 2 3 4</p></polylist>"
        write_plate_dae(path, points=points, faces=faces)
    raw = build(path, spec(file=path.name))
    assert raw.report["area_m2"] == pytest.approx(900.0, rel=0.05)
    assert raw.report["triangles"] == 3


@pytest.mark.parametrize("n", [5, 12, 200, 1000])
def test_polygons_are_filled_by_triangles_of_their_own_sense(n):
    rng = np.random.default_rng(n)
    angle = (np.arange(n) + rng.uniform(0.0, 0.8, (20, n))) * 2.0 * np.pi / n
    outline = rng.uniform(0.2, 1.0, (20, n, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    tilted = outline @ np.array([[1.0, 0.0, 0.3], [0.0, 1.0, -0.8]]) + [4e5, 5e6, 300.0]
    cutter = Cutter()
    triangles, polygon = cutter.cut(tilted.reshape(-1, 3), np.full(20, n))
    a, b, c = np.moveaxis(outline.reshape(-1, 2)[triangles], 1, 0)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    after = np.roll(outline, -1, axis=1)
    whole = 0.5 * (outline[..., 0] * after[..., 1] - outline[..., 1] * after[..., 0]).sum(axis=1)
    assert area.min() > -1e-9
    np.testing.assert_allclose(np.bincount(polygon, area), whole, rtol=1e-6)
    assert cutter.crossed == 0


def ring(radii):
    """A polygon [n, 3] around the origin."""
    angle = np.linspace(0.0, 2.0 * np.pi, len(radii), endpoint=False)
    return radii[:, None] * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)


def area_of(corners, triangles):
    a, b, c = np.moveaxis(corners[triangles], 1, 0)
    return 0.5 * np.cross(b - a, c - a)[:, 2]


def test_a_hole_joined_to_the_outline_is_left_open():
    outline, hole = ring(np.tile([20.0, 18.0], 30)), ring(np.tile([5.0, 4.0], 20))[::-1]
    keyhole = np.concatenate([outline, outline[:1], np.roll(hole, 1, axis=0), hole[-1:]])
    keyhole += [4e5, 5e6, 0.0]
    cutter = Cutter()
    area = area_of(keyhole, cutter.cut(keyhole, np.array([len(keyhole)]))[0])
    assert area.min() >= 0.0
    filled = [Cutter().cut(part, np.array([len(part)]))[0] for part in (outline, hole)]
    assert area.sum() == pytest.approx(area_of(outline, filled[0]).sum() + area_of(hole, filled[1]).sum())
    assert cutter.crossed == 0


def test_concave_corners_of_a_file_are_limited():
    largest = np.tile([20.0, 10.0], CONCAVE_MAX // 2)
    cutter, started = Cutter(), time.process_time()
    triangles, _ = cutter.cut(ring(largest), np.array([CONCAVE_MAX]))
    assert time.process_time() - started < 1.0
    whole = 0.5 * CONCAVE_MAX * 200.0 * np.sin(2.0 * np.pi / CONCAVE_MAX)
    assert area_of(ring(largest), triangles).sum() == pytest.approx(whole)
    with pytest.raises(PolygonError, match="one of them 12"):  # of the same file
        cutter.cut(ring(np.tile([20.0, 10.0], 6)), np.array([12]))
    many = np.tile(ring(np.tile([20.0, 10.0], 6)), (2000, 1))
    assert len(Cutter().cut(many, np.full(2000, 12))[0]) == 20_000


def star(n, turns):
    angle = 2.0 * np.pi * turns / n * np.arange(n)
    return np.resize([0.58, 0.13], n)[:, None] * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)


CROSSING = {
    "stars": star(500, 399),
    "pentagram": ring(np.ones(5))[[0, 2, 4, 1, 3]],
    "anywhere": np.random.default_rng(0).uniform(-20.0, 20.0, (1000, 3)),
    "few places": np.random.default_rng(0).integers(0, 4, (1000, 3)).astype(float),
}


@pytest.mark.parametrize("corners", CROSSING.values(), ids=CROSSING)
def test_faces_that_cross_themselves_are_cut_in_bounds_and_told(corners):
    cutter, started = Cutter(), time.process_time()
    triangles, _ = cutter.cut(corners, np.array([len(corners)]))
    assert time.process_time() - started < 5.0
    assert cutter.crossed == 1
    assert len(triangles) <= len(corners) - 2
    assert np.isin(triangles, np.arange(len(corners))).all()


@pytest.mark.parametrize("corners", [np.zeros((9, 3)), np.outer([0, 3, 1, 2, 5, 4], [1.0, 2.0, 3.0])])
def test_faces_without_area_are_not_told(corners):
    cutter = Cutter()
    assert len(cutter.cut(corners, np.array([len(corners)]))[0]) <= len(corners) - 2
    assert cutter.crossed == 0


@pytest.mark.parametrize("suffix", ["obj", "dae"])
def test_the_number_of_faces_that_cross_themselves_is_told(tmp_path, suffix):
    path, corners = tmp_path / f"plate.{suffix}", (np.round(ring(np.full(5, 9.0)))[:, :2]).astype(int).tolist()
    if suffix == "obj":
        path.write_text(PLATE_OBJ + "".join(f"v {x} {y} 1\n" for x, y in corners) + "f 5 7 9 6 8\n")
    else:
        points = "-20 -20 0 20 -20 0 20 20 0 -20 20 0 " + " ".join(f"{x} {y} 1" for x, y in corners)
        faces = "<polylist count='2'>{inputs}<vcount>4 5</vcount><p>0 1 2 3 4 6 8 5 7</p></polylist>"
        write_plate_dae(path, points=points, faces=faces)
    told = " ".join(build(path, spec(file=path.name)).report["warnings"])
    assert "faces that cross themselves: 1;" in told
