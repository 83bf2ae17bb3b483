"""What every configuration model shares: strictness, immutability, and the small vector types."""

import math
from itertools import pairwise
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


class Model(BaseModel):
    """Base of all configuration models: unknown fields are errors, values never change, numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)


Name = Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
PositiveVec3 = tuple[Positive, Positive, Positive]


def _convex_counter_clockwise(points: tuple[Vec2, ...]) -> tuple[Vec2, ...]:
    """The corners of a convex polygon, counter-clockwise; ValueError when they do not bound one."""
    ring = (*points, points[0], points[1])
    edges = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(ring)]
    turns = [u[0] * v[1] - u[1] * v[0] for u, v in pairwise(edges)]
    size = max(abs(x) for edge in edges for x in edge)
    if size == 0 or max(map(abs, turns)) <= 1e-9 * size**2:
        raise ValueError("the polygon has no area: its corners lie on one line")
    if min(turns) < -1e-9 * size**2 and max(turns) > 1e-9 * size**2:
        raise ValueError("the polygon is not convex: give its corners in order, all turning the same way")
    windings = sum(math.atan2(t, u[0] * v[0] + u[1] * v[1]) for t, (u, v) in zip(turns, pairwise(edges), strict=True))
    if abs(windings) > 3 * math.pi:
        raise ValueError("the polygon crosses itself: give its corners in order, once around")
    return points if sum(turns) > 0 else points[::-1]


ConvexPolygon = Annotated[
    tuple[Vec2, ...], Field(min_length=3, max_length=32), AfterValidator(_convex_counter_clockwise)
]
