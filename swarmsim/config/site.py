"""A site as it stands in ``configs/sites/<name>/site.yaml``."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from swarmsim.config.base import ConvexPolygon, Fraction, Model, Name, NonNegative, Polygon, Positive

Wall = Annotated[float, Field(ge=1e-5, le=100)]  # m


class ObstacleMaterial(Model):
    """What the obstacles of a mesh material or geometry are made of; the first match counts.

    ``match`` is a pattern as in a shell (``*``, ``?``), compared without case with the names of the mesh material and
    of the geometry. ``wall_m`` is the thickness of the shell of a hollow thing (a building) or of a sheet; leave it out
    for a solid one. Walls that a mesh draws with their own thickness have that, or ``wall_m`` of matter where they are
    drawn more than three times as thick. A ``traversable`` thing does not stop a rover (high grass).
    """

    match: str = Field(min_length=1)
    material: Name
    wall_m: Wall | None = None
    traversable: bool = False


class Traversability(Model):
    """What the cost of driving a metre is made of, and what stops a rover.

    cost = 1 + slope_weight (tan slope / tan slope_max)^2 + roughness_weight roughness + obstacle_weight (1 - d /
    obstacle_distance)^2 for obstacles nearer than obstacle_distance. A thing stops the rover when it rises more than
    ``step_max_m`` and begins below ``rover_height_m``.
    """

    slope_max_deg: float = Field(default=20.0, gt=0, lt=60)
    step_max_m: Positive = 0.15
    rover_height_m: Positive = 1.0
    roughness_weight: NonNegative = 10.0
    slope_weight: NonNegative = 2.0
    obstacle_distance_m: Positive = 2.0
    obstacle_weight: NonNegative = 2.0


class Plane(Model):
    """Level ground laid under a model that brings none, such as a building.

    It reaches ``margin_m`` beyond the model on every side and lies at ``height_m`` in the file's coordinates, in m.
    """

    margin_m: float = Field(default=20.0, gt=0, le=500)
    height_m: float = Field(default=0.0, ge=-10_000, le=10_000)


class Zone(Model):
    """A polygon that the rover must not enter."""

    name: Name
    polygon_m: Polygon


class SiteSpec(Model):
    """A site: its source file and how to read it.

    ``unit_m`` and ``up_axis`` override what the file says of itself; ``height_unit_m`` is the unit of the heights of an
    elevation model, where it differs. ``ground`` are patterns of the mesh materials or geometries that are bare ground;
    without them the ground is told from the shape; ``plane`` lays level ground under a model that has none.
    ``extent_m`` is what the longer side of a mesh may measure, a guard against wrong units; ``holes_max`` is the
    fraction of the ground that may be missing and is then filled by interpolation. Obstacles that no rule of
    ``obstacles`` matches are of ``default_material``: shells of ``default_wall_m``, or solid without it.
    """

    name: Name
    description: str = ""
    file: str = Field(min_length=1)
    licence: str
    unit_m: Positive | None = None
    height_unit_m: Positive | None = None
    up_axis: Literal["X", "Y", "Z"] | None = None
    cell_m: Annotated[float, Field(ge=1e-3, le=1e6)]
    extent_m: tuple[Positive, Positive] = (10.0, 1000.0)
    holes_max: Fraction = 0.15
    max_file_mb: Positive = 100.0
    ground: tuple[str, ...] = ()
    plane: Plane | None = None
    ground_material: Name = "soil"
    obstacles: tuple[ObstacleMaterial, ...] = ()
    default_material: Name = "concrete"
    default_wall_m: Wall | None = None
    zones: tuple[Zone, ...] = ()
    survey_area_m: ConvexPolygon | None = None
    traversability: Traversability = Traversability()
    orthophoto: str | None = None

    @model_validator(mode="after")
    def _extent_in_order(self) -> "SiteSpec":
        if self.extent_m[0] >= self.extent_m[1]:
            raise ValueError("extent_m is [shortest, longest]: the first must be smaller than the second")
        return self
