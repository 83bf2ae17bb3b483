"""Distributions of a mission's values (``vary:``), as a user writes them."""

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from swarmsim.config.base import Gap, Length, Model, NonNegative

SOURCES_MAX = 16
VARIED_MAX = 200  # paths
CHOICES_MAX = 256
NORMAL_STDS = 5.0
"""A normal distribution without bounds is cut off this many standard deviations from its mean: 6e-7 of it."""

VariedPath = Annotated[str, Field(min_length=1, max_length=200)]
Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Region = Literal["open", "indoors", "behind_walls", "survey_area", "anywhere"]
REGIONS: tuple[Region, ...] = ("open", "indoors", "behind_walls", "survey_area", "anywhere")


class Normal(Model):
    """A normal distribution, cut off at ``min`` and ``max``; without them 5 standard deviations from the mean."""

    mean: Number
    std: float = Field(gt=0, le=1e12)
    min: Number | None = None
    max: Number | None = None

    @model_validator(mode="after")
    def _in_order(self) -> "Normal":
        if self.low >= self.high:
            raise ValueError("min must be smaller than max (without them: 5 standard deviations from the mean)")
        return self

    @property
    def low(self) -> float:
        """Least value."""
        return self.mean - NORMAL_STDS * self.std if self.min is None else self.min

    @property
    def high(self) -> float:
        """Greatest value."""
        return self.mean + NORMAL_STDS * self.std if self.max is None else self.max


class PlaceIn(Model):
    """A place of a source by region of the site; with several regions one is drawn first, by ``weights``.

    All but ``anywhere`` lie in the site's survey area. ``open``: ground with nothing on it or above it, ``near_m`` away
    from obstacles. ``indoors``: in a hollow box that stands on the ground (a building, a container), ``margin_m`` from
    its walls; every box is as likely, and every place in it. ``behind_walls``: outside, between ``margin_m`` and
    ``near_m`` from a wall that rises 1 m above the source and hides an eighth of the horizon. ``survey_area`` and
    ``anywhere``: wherever a source can lie, not within a solid thing or a wall. Sources keep ``apart_m`` from each
    other, horizontally.
    """

    region: Region | Annotated[tuple[Region, ...], Field(min_length=1, max_length=len(REGIONS))]
    weights: Annotated[tuple[NonNegative, ...], Field(max_length=len(REGIONS))] | None = None
    margin_m: Gap = 0.5
    near_m: Length = 3.0
    apart_m: Gap = 0.0

    @property
    def regions(self) -> tuple[Region, ...]:
        """The regions to choose from."""
        return (self.region,) if isinstance(self.region, str) else self.region

    @model_validator(mode="after")
    def _weighted(self) -> "PlaceIn":
        _check_weights(self.weights, len(self.regions), "region")
        return self


class AnyNuclide(Model):
    """Any nuclide of the library whose strongest gamma line has at least this yield."""

    yield_min_percent: float = Field(ge=0, le=100)


class Distribution(Model):
    """What a value of a mission is drawn from, for every mission anew: exactly one of these.

    ``uniform`` and ``log_uniform`` lie between two numbers (``uniform`` of a whole number may be either of them),
    ``normal`` is cut off at its bounds, ``choice`` takes one of several values, by ``weights``. ``count`` is for
    ``sources``: how many there are. ``place`` is for the position of a source, ``any_nuclide`` for its nuclide.
    """

    uniform: tuple[Number, Number] | None = None
    log_uniform: tuple[Number, Number] | None = None
    normal: Normal | None = None
    choice: Annotated[tuple[Any, ...], Field(min_length=1, max_length=CHOICES_MAX)] | None = None
    weights: Annotated[tuple[NonNegative, ...], Field(max_length=CHOICES_MAX)] | None = None
    count: tuple[Annotated[int, Field(ge=0, le=SOURCES_MAX)], Annotated[int, Field(ge=1, le=SOURCES_MAX)]] | None = None
    place: PlaceIn | None = None
    any_nuclide: AnyNuclide | None = None

    @property
    def kind(self) -> str:
        """The one that is given."""
        return next(name for name in DISTRIBUTIONS if getattr(self, name) is not None)

    @property
    def interval(self) -> tuple[float, float] | None:
        """Least and greatest number of a distribution over an interval; None for the others."""
        if self.normal is not None:
            return self.normal.low, self.normal.high
        return self.uniform or self.log_uniform

    @model_validator(mode="after")
    def _one(self) -> "Distribution":
        given = [name for name in DISTRIBUTIONS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(DISTRIBUTIONS)}")
        for ends in (self.uniform, self.log_uniform, self.count):
            if ends is not None and ends[0] > ends[1]:
                raise ValueError(f"{given[0]} is [least, greatest]: the first is greater than the second")
        if self.log_uniform is not None and self.log_uniform[0] <= 0:
            raise ValueError("log_uniform needs numbers greater than zero")
        if self.weights is not None and self.choice is None:
            raise ValueError("weights belong to a choice")
        _check_weights(self.weights, len(self.choice or ()), "choice")
        return self


DISTRIBUTIONS = ("uniform", "log_uniform", "normal", "choice", "count", "place", "any_nuclide")


def _check_weights(weights: tuple[float, ...] | None, count: int, what: str) -> None:
    if weights is None:
        return
    if len(weights) != count:
        raise ValueError(f"give a weight for each {what}: {count}, not {len(weights)}")
    if not math.fsum(weights) > 0:
        raise ValueError("at least one of the weights must be greater than zero")
