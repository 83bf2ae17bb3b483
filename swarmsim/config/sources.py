"""A radioactive source as a user writes it: a point, a line, an area, or something that a vehicle carries."""

import math
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from swarmsim.config.base import ConvexPolygon, Length, Model, Name, Vec2, Vec3

Floats = NDArray[np.float64]
Form = Literal["point", "line", "area", "carried"]
FORMS: dict[str, Form] = {"position_m": "point", "line_m": "line", "area_m": "area", "on": "carried"}
"""Form of a source by the field that says where it is."""

SPACING_M = 1.0
ACTIVITY_MAX_MBQ = 1e9
POINTS_MAX = 1000  # that all sources of a mission are computed as: each costs a ray to every detector
_EDGE = 1e-6  # of a part or a cell: a smaller piece is left out
_SIGNS = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])


def _with_length(points: tuple[Vec2, ...]) -> tuple[Vec2, ...]:
    if sum(math.dist(a, b) for a, b in pairwise(points)) < 1e-3:
        raise ValueError("the line has no length: its points are one and the same")
    return points


Polyline = Annotated[tuple[Vec2, ...], Field(min_length=2, max_length=32), AfterValidator(_with_length)]


class Source(Model):
    """A radioactive source: truth, known to the simulation and not to the mission.

    It is where exactly one of these says: a point at ``position_m``; spread evenly along the line through the points
    ``line_m``, or over the convex polygon ``area_m``; or a point ``on`` the vehicle of that name, ``offset_m`` from its
    origin in the body frame (FLU). ``height_m`` is above the terrain, below each part of a line or an area.
    ``activity_mbq`` is that of the whole source at the start of the mission; it decays with the nuclide's half-life.

    A line or an area is computed as points at most ``spacing_m`` apart (1 m without it). In free air their rates are
    those of the integral within 0.5 % from twice that distance on, and within 4 % at that distance itself, so half the
    distance at which detectors pass is near enough. Each point costs a ray to every detector.
    """

    nuclide: Name
    position_m: Vec2 | None = None
    line_m: Polyline | None = None
    area_m: ConvexPolygon | None = None
    on: Name | None = None
    offset_m: Vec3 | None = None
    height_m: float | None = Field(default=None, ge=-5, le=100)
    spacing_m: Length | None = None
    activity_mbq: float = Field(ge=0, le=ACTIVITY_MAX_MBQ)

    @model_validator(mode="after")
    def _one_place(self) -> "Source":
        given = [field for field in FORMS if getattr(self, field) is not None]
        if len(given) != 1:
            had = f"{' and '.join(given)} are given" if given else "none is given"
            raise ValueError(f"give exactly one of position_m, line_m, area_m and on (a vehicle): {had}")
        if self.form == "carried" and self.height_m is not None:
            raise ValueError("a source on a vehicle has no height_m: its place is offset_m, in the vehicle's frame")
        if self.form != "carried" and self.height_m is None:
            raise ValueError(f"height_m is missing: {given[0]} needs a height above the ground")
        if self.form != "carried" and self.offset_m is not None:
            raise ValueError(f"offset_m is for a source on a vehicle: {given[0]} has none")
        if self.form in ("point", "carried") and self.spacing_m is not None:
            raise ValueError("spacing_m is for line_m and area_m: a point is one")
        return self

    @property
    def place_field(self) -> str:
        """The field that says where it is."""
        return next(field for field in FORMS if getattr(self, field) is not None)

    @property
    def form(self) -> Form:
        """What it is."""
        return FORMS[self.place_field]

    @property
    def spacing(self) -> float:
        """Largest distance of neighbouring points of a line or an area, m."""
        return SPACING_M if self.spacing_m is None else self.spacing_m

    @property
    def corners_m(self) -> tuple[Vec2, ...]:
        """Corners of a line or an area; the place of a point; none of a source on a vehicle."""
        point = () if self.position_m is None else (self.position_m,)
        return self.line_m or self.area_m or point


class Points(NamedTuple):
    """Points that stand for a source at rest."""

    xy_m: Floats  # [n, 2] world
    share: Floats  # [n] of the activity, sums to 1


def points_of(source: Source) -> Points:
    """The points of a source at rest; ValueError, with their number, where there are more than `POINTS_MAX`.

    They are those of Gauss's and Legendre's rule of two points, in equal parts of each leg of a line. An area is cut by
    a grid along one of its sides; each piece has four points of equal activity, with the mean and the covariance of the
    piece, which in a rectangle is the same rule. Their number does not change when the whole is moved or turned.
    """
    if source.line_m is not None:
        return _along(np.array(source.line_m), source.spacing)
    if source.area_m is not None:
        return _over(np.array(source.area_m), source.spacing)
    return Points(np.array([source.position_m], float), np.ones(1))


def _along(corners: Floats, spacing: float) -> Points:
    legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    parts = np.ceil(legs / (math.sqrt(3.0) * spacing) - _EDGE)
    if 2 * parts.sum() > POINTS_MAX:
        raise ValueError(f"{2 * parts.sum():.0f}")
    xy, share = [], []
    for start, end, length, count in zip(corners, corners[1:], legs, parts.astype(int), strict=False):
        if count:
            middles = (np.arange(count) + 0.5) / count
            at = (middles[:, None] + 0.5 / count / math.sqrt(3.0) * np.array([-1.0, 1.0])).reshape(-1, 1)
            xy.append(start + at * (end - start))
            share.append(np.full(2 * count, 0.5 * length / count))
    return Points(np.concatenate(xy), np.concatenate(share) / legs.sum())


def _over(corners: Floats, spacing: float) -> Points:
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    along = sides[lengths > 0] / lengths[lengths > 0, None]
    frames = np.stack([along, along[:, ::-1] * [-1.0, 1.0]], axis=1)  # [k, axis, 2]
    boxes = [np.ptp(corners @ frame.T, axis=0) for frame in frames]
    best = int(np.argmin([box[0] * box[1] for box in boxes]))
    frame, cells = frames[best], np.maximum(np.ceil(boxes[best] / (math.sqrt(3.0) * spacing) - _EDGE), 1.0)
    if np.prod(cells) > POINTS_MAX:  # the polygon fills half of the smallest of these rectangles at least
        raise ValueError(f"some {2.0 * np.prod(cells):.0f}")
    own = corners @ frame.T
    low, size = own.min(axis=0), boxes[best] / cells
    xy, area = [], []
    for i in range(int(cells[0])):
        strip = _cut(own, 0, low[0] + i * size[0], size[0])
        for j in range(int(cells[1])):
            piece = _cut(strip, 1, low[1] + j * size[1], size[1])
            if len(piece) > 2 and (here := _moments(piece))[0] > _EDGE * size[0] * size[1]:
                area += [0.25 * here[0]] * 4
                xy.append(here[1] + _SIGNS @ here[2])
    if len(area) > POINTS_MAX:
        raise ValueError(f"{len(area)}")
    return Points(np.concatenate(xy) @ frame, np.array(area) / math.fsum(area))


def _cut(corners: Floats, axis: int, low: float, width: float) -> Floats:
    """What of a convex polygon [k, 2] lies in a strip across ``axis`` (Sutherland and Hodgman, CACM 17, 1974)."""
    for limit, sign in ((low, 1.0), (low + width, -1.0)):
        inside = sign * (corners[:, axis] - limit)
        kept = []
        for k in range(len(corners)):
            a, b, da, db = corners[k - 1], corners[k], inside[k - 1], inside[k]
            if (da >= 0.0) != (db >= 0.0):
                kept.append(a + da / (da - db) * (b - a))
            if db >= 0.0:
                kept.append(b)
        corners = np.array(kept).reshape(-1, 2)
    return corners


def _moments(corners: Floats) -> tuple[float, Floats, Floats]:
    """Area, centroid [2] and principal radii of gyration (rows [2, 2]) of a convex polygon [k, 2]."""
    fan = np.stack(
        [np.broadcast_to(corners[0], corners[2:].shape), corners[1:-1], corners[2:]], axis=1
    )  # [k - 2, 3, 2]
    (ux, uy), (vx, vy) = (fan[:, 1] - fan[:, 0]).T, (fan[:, 2] - fan[:, 0]).T
    area = 0.5 * (ux * vy - uy * vx)
    total = float(area.sum())
    if total <= 0.0:
        return 0.0, corners[0], np.zeros((2, 2))
    middle = fan.mean(axis=1)
    centroid = area @ middle / total
    spread = (area / 12.0)[:, None, None] * np.einsum("kci,kcj->kij", *[fan - middle[:, None]] * 2)
    spread = spread + area[:, None, None] * np.einsum("ki,kj->kij", *[middle - centroid] * 2)
    variance, axes = np.linalg.eigh(spread.sum(axis=0) / total)
    return total, centroid, np.sqrt(np.maximum(variance, 0.0))[:, None] * axes.T
