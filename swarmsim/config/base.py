"""What every configuration model shares: strictness, immutability, and the small vector types."""

import math
from itertools import combinations, pairwise
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


class Model(BaseModel):
    """Base of all configuration models: unknown fields are errors, values never change, numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)


Name = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]

# Every number has a lower and an upper bound. They lie far beyond what robots, sites and sources have, and well within
# what single precision, the memory of a computer and a day of simulation can take.
Positive = Annotated[float, Field(gt=0, le=1e9)]
NonNegative = Annotated[float, Field(ge=0, le=1e9)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Length = Annotated[float, Field(ge=1e-4, le=1e4)]  # m
Part = Annotated[float, Field(ge=1e-4, le=100)]  # m, of a vehicle
Gap = Annotated[float, Field(ge=0, le=1000)]  # m, such as a clearance
Duration = Annotated[float, Field(ge=1e-3, le=86_400)]  # s
Delay = Annotated[float, Field(ge=0, le=86_400)]  # s
Lag = Annotated[float, Field(ge=1e-4, le=10)]  # s, time constant of a first-order lag
Mass = Annotated[float, Field(ge=1e-4, le=1e5)]  # kg
Speed = Annotated[float, Field(ge=1e-3, le=300)]  # m/s
Acceleration = Annotated[float, Field(ge=1e-3, le=1000)]  # m/s2
RotationSpeed = Annotated[float, Field(ge=1e-3, le=1e5)]  # rad/s
Stiffness = Annotated[float, Field(ge=0.1, le=1e9)]  # N/m
Damping = Annotated[float, Field(ge=0, le=1e7)]  # N s/m
Friction = Annotated[float, Field(ge=0, le=10)]
Gain = Annotated[float, Field(ge=1e-3, le=1000)]  # of a controller, SI
Power = Annotated[float, Field(ge=0, le=1e6)]  # W
PhotonEnergy = Annotated[float, Field(ge=1, le=1e6)]  # keV
Coordinate = Annotated[float, Field(ge=-1e5, le=1e5)]  # m, ENU from the site's origin
BodyCoordinate = Annotated[float, Field(ge=-100, le=100)]  # m, in a vehicle's frame
Vec2 = tuple[Coordinate, Coordinate]
Vec3 = tuple[BodyCoordinate, BodyCoordinate, BodyCoordinate]


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


def _turn(a: Vec2, b: Vec2, c: Vec2) -> float:
    """Twice the area of a triangle, positive where it is counter-clockwise."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _without_crossings(points: tuple[Vec2, ...]) -> tuple[Vec2, ...]:
    """The corners of a polygon; ValueError when two of its sides cross or it has no area. Sides may touch."""
    sides = list(pairwise((*points, points[0])))
    for (a, b), (c, d) in combinations(sides, 2):
        if _turn(a, b, c) * _turn(a, b, d) < 0 and _turn(c, d, a) * _turn(c, d, b) < 0:
            raise ValueError("the polygon crosses itself: give its corners in order, once around")
    size = max(abs(x - y) for one in points for x, y in zip(one, points[0], strict=True))
    if abs(sum(_turn(points[0], a, b) for a, b in sides)) <= 1e-9 * size**2:
        raise ValueError("the polygon has no area: its corners lie on one line")
    return points


Polygon = Annotated[tuple[Vec2, ...], Field(min_length=3, max_length=32), AfterValidator(_without_crossings)]
