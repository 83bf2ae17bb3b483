"""Settings of the policies, as they stand under ``phases.N.settings``."""

from collections.abc import Iterator, Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from swarmsim.config.base import ConvexPolygon, Gap, Model, Name, Vec2
from swarmsim.config.vehicles import VEHICLE_KINDS

Target = Literal["source", "hotspot"] | Vec2
"""A place to go to: the estimated source, the strongest hotspot of the map, or a point (ENU, m)."""


class PolicySettings(Model):
    """Base of the settings of a policy; a policy without settings uses it as it is.

    A policy of one's own declares its settings by a subclass as its attribute ``Settings``.
    """

    vehicles: ClassVar[tuple[str, ...]] = VEHICLE_KINDS
    """Kinds of vehicle that the policy can command."""
    partners: ClassVar[Mapping[str, str]] = {}
    """Fields that name a member of the team, and the kind of vehicle that it must be."""
    needs: ClassVar[tuple[str, ...]] = ()
    """What the mission must find for the policy: ``"source"``, ``"hotspot"``."""

    def needed(self) -> tuple[str, ...]:
        """What the mission must find for the policy with these settings."""
        return self.needs

    def faults(self, kinds: frozenset[str]) -> Iterator[tuple[str, str]]:
        """Field and message of each setting that does not suit the ``kinds`` of vehicle that are to follow it."""
        yield from ()


class _Targeted(PolicySettings):
    """Settings with a ``target``."""

    target: Target

    def needed(self) -> tuple[str, ...]:
        """The estimate that the target names; nothing for a point."""
        return (self.target,) if isinstance(self.target, str) else ()


class _Flown(PolicySettings):
    """Vertical speeds, and the height kept above the highest surface nearby, of policies that fly."""

    climb_speed_m_s: float = Field(default=2.0, ge=0.01, le=10)
    descent_speed_m_s: float = Field(default=1.5, ge=0.01, le=5)
    touchdown_speed_m_s: float = Field(default=0.5, ge=0.01, le=2)
    obstacle_clearance_m: Gap = 5.0


class ParallelLines(_Flown):
    """Survey an area by parallel lines, shared among the phase's UAVs.

    ``altitude_m`` is above ground; ``sweep_deg`` is the direction of the lines, counter-clockwise from east; without
    ``area_m`` the site's survey area is covered, without ``line_spacing_m`` lines stand half the altitude apart.
    """

    vehicles: ClassVar[tuple[str, ...]] = ("multirotor",)

    altitude_m: float = Field(gt=1, le=200)
    line_spacing_m: Annotated[float, Field(ge=0.1, le=1000)] | None = None
    sweep_deg: float = Field(default=0.0, ge=-360, le=360)
    speed_m_s: float = Field(ge=0.01, le=30)
    area_m: ConvexPolygon | None = None


class ApproachAndOrbit(_Targeted):
    """Drive the cheapest way to a target, then visit ``viewpoints`` round it at ``standoff_m``, ``laps`` times.

    The ways there and between viewpoints may pass nearer: nothing keeps a vehicle away from a source.
    """

    vehicles: ClassVar[tuple[str, ...]] = ("skid_steer",)

    speed_m_s: float = Field(ge=0.01, le=5)
    standoff_m: Annotated[float, Field(ge=0.01, le=1000)] = 4.0
    viewpoints: int = Field(default=8, ge=1, le=64)
    laps: int = Field(default=1, ge=1, le=10)
    target: Target = "source"


class Orbit(_Targeted, _Flown):
    """Fly to a target and circle it ``turns`` times at ``radius_m`` and ``altitude_m`` above ground."""

    vehicles: ClassVar[tuple[str, ...]] = ("multirotor",)

    radius_m: Annotated[float, Field(ge=0.1, le=1000)]
    altitude_m: float = Field(gt=1, le=200)
    speed_m_s: float = Field(ge=0.01, le=30)
    turns: float = Field(default=1.0, ge=0.01, le=100)
    target: Target = "hotspot"


class Waypoints(_Flown):
    """Visit points (ENU, m) in their order, ``laps`` times; ``altitude_m`` above ground is for multirotors only.

    Multirotors pass them within half a metre, in a curve.
    """

    points: tuple[Vec2, ...] = Field(min_length=1, max_length=1000)
    speed_m_s: float = Field(ge=0.01, le=30)
    altitude_m: float | None = Field(default=None, gt=1, le=200)
    laps: int = Field(default=1, ge=1, le=100)

    def faults(self, kinds: frozenset[str]) -> Iterator[tuple[str, str]]:
        """Multirotors need an altitude, rovers have none."""
        if "multirotor" in kinds and self.altitude_m is None:
            yield "altitude_m", "this field is missing: a multirotor flies its waypoints at a height above ground"
        if "skid_steer" in kinds and self.altitude_m is not None:
            yield "altitude_m", "a rover has no altitude: leave it out, or give the rovers a phase of their own"


class LandOn(_Flown):
    """Land on the member ``rover`` while it stands or drives, approaching at ``altitude_m`` above its deck.

    ``speed_m_s`` is that of the approach, over the rover's own.
    """

    vehicles: ClassVar[tuple[str, ...]] = ("multirotor",)
    partners: ClassVar[Mapping[str, str]] = {"rover": "skid_steer"}

    rover: Name
    altitude_m: float = Field(default=4.0, gt=1, le=200)
    speed_m_s: float = Field(ge=0.01, le=30)


class Hold(PolicySettings):
    """Stay where the vehicle is."""


SETTINGS: dict[str, type[PolicySettings]] = {
    "parallel_lines": ParallelLines,
    "approach_and_orbit": ApproachAndOrbit,
    "orbit": Orbit,
    "waypoints": Waypoints,
    "land_on": LandOn,
    "hold": Hold,
}
"""Settings of the policies that the package carries."""


def line_spacing(settings: ParallelLines) -> float:
    """Distance between survey lines, m: as given, or half the altitude."""
    return settings.line_spacing_m if settings.line_spacing_m is not None else settings.altitude_m / 2
