"""The values that missions of a family draw from their seeds."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from swarmsim.config.documents import Place
from swarmsim.config.errors import InputError
from swarmsim.config.family import COUNT, Varied
from swarmsim.config.scenario import Scenario
from swarmsim.config.sources import points_of
from swarmsim.config.vary import Region
from swarmsim.families.streams import Stream, chosen, drawn
from swarmsim.site.model import SiteModel
from swarmsim.site.regions import Regions

ATTEMPTS = 20  # to place all sources of a mission, where those placed first leave no room
Row = dict[str, Any]


@dataclass(frozen=True)
class Draws:
    """What B missions drew.

    ``values`` are in the form that `Simulation.rollout` takes: for each path a value for each mission. A source that
    is not there has no activity.
    """

    seeds: tuple[int, ...]  # [B]
    values: Mapping[str, Sequence[Any]]  # [B] each
    family: tuple[Varied, ...]
    regions: tuple[Mapping[str, Region], ...]  # [B] of the sources that are placed by region, by their paths
    given: tuple[str, ...] = ()  # paths that the family does not draw, whose values were given

    def told(self, index: int) -> Row:
        """What mission ``index`` drew or was given, by path, of the sources that are there; also their number."""
        row = {path: each[index] for path, each in self.values.items()}
        there: dict[int, bool] = {}
        if any(varied.distribution.count is not None for varied in self.family):
            activities = [path.split(".") for path in row if path.startswith(f"{COUNT}.")]
            there = {int(k): row[f"{COUNT}.{k}.{what}"] > 0 for _, k, what, *_ in activities if what == "activity_mbq"}
        found: Row = {f"{COUNT}.count": sum(there.values())} if there else {}
        for varied in self.family:
            if varied.path not in row or not there.get(_source(varied.place), True):
                continue
            found[varied.path] = row[varied.path]
            if region := self.regions[index].get(varied.path):
                found[f"{varied.path.rpartition('.')[0]}.region"] = region
        return found | {path: row[path] for path in self.given}


def _source(place: Place) -> int:
    """Number of the source that a place is of; -1 for any other."""
    return int(place[1]) if place[0] == COUNT and len(place) > 1 else -1


class Drawer:
    """Draws the values of a scenario's `vary`; a mission's depend on its seed alone."""

    def __init__(self, scenario: Scenario, site_model: SiteModel):
        """Look up what the distributions choose from. Raises `InputError` where that is nothing."""
        self._scenario, self._site_name = scenario, site_model.name
        self._count = next((v for v in scenario.family if v.distribution.count is not None), None)
        self._placed = [v for v in scenario.family if v.distribution.place is not None]
        self._others = [v for v in scenario.family if v is not self._count and v not in self._placed]
        self._regions = Regions(scenario, site_model) if self._placed else None
        self._nuclides = {
            v.key: _nuclides(scenario, v) for v in scenario.family if v.distribution.any_nuclide is not None
        }
        self._given = self._of_mission()
        self._check_regions()

    def draw(self, seeds: Sequence[int] | np.ndarray) -> Draws:
        """The values of the missions ``seeds``. Raises `InputError` where sources find no place."""
        numbers = tuple(int(seed) for seed in seeds)
        rows = [self._row(seed) for seed in numbers]
        values = {path: [row[path] for row, _ in rows] for path in (rows[0][0] if rows else ())}
        return Draws(numbers, values, self._scenario.family, tuple(regions for _, regions in rows))

    def _of_mission(self) -> Row:
        """The mission's own values at every path: those of a source that is not there."""
        data = self._scenario.mission.model_dump(mode="json")
        found: Row = {}
        for varied in self._scenario.family:
            if varied is not self._count:
                found[varied.path] = _at(data, varied.place)
        if self._count is not None:
            for number, source in enumerate(self._scenario.mission.sources):
                found.setdefault(f"{COUNT}.{number}.activity_mbq", source.activity_mbq)
        return found

    def _row(self, seed: int) -> tuple[Row, dict[str, Region]]:
        """The values of a mission, and the regions of its sources."""
        row, there = dict(self._given), len(self._scenario.mission.sources)
        if self._count is not None:
            there = drawn(self._count, Stream(seed, self._count.path).number(), ())
            row |= {f"{COUNT}.{k}.activity_mbq": 0.0 for k in range(there, len(self._scenario.mission.sources))}
        for varied in self._others:
            if _source(varied.place) < there:
                number = Stream(seed, varied.path).number()
                row[varied.path] = drawn(varied, number, self._nuclides.get(varied.key, ()))
        placed = [varied for varied in self._placed if _source(varied.place) < there]
        if not placed:
            return row, {}
        sources = self._sources(row)[:there]
        for attempt in range(ATTEMPTS):
            places, regions, crowded = self._places(seed, attempt, placed, sources)
            if crowded is None:
                return row | places, regions
            self._check_region(crowded, regions[crowded.path], float(sources[_source(crowded.place)]["height_m"]))
        raise InputError([self._scenario.problem(
            ("vary", placed[0].key, "place"),
            f"the {there} sources of the mission of seed {seed} find no places so far apart",
            suggestion="make apart_m smaller, add a region, or draw fewer sources",
        )])  # fmt: skip

    def _places(
        self, seed: int, attempt: int, placed: Sequence[Varied], sources: Sequence[Row]
    ) -> tuple[Row, dict[str, Region], Varied | None]:
        """Places of the sources, one after the other, and their regions; and the first one that found none."""
        assert self._regions is not None
        found: Row = {}
        regions: dict[str, Region] = {}
        drawing = {_source(varied.place) for varied in placed}
        taken: list[Any] = []
        for number, source in enumerate(sources):
            if number not in drawing:
                taken += [source["position_m"]] if source["position_m"] else self._spread(number)
        for varied in placed:
            place = varied.distribution.place
            assert place is not None
            stream = Stream(seed, varied.path if attempt == 0 else f"{varied.path} {attempt}")
            region = place.regions[chosen(stream.number(), place.weights or (1.0,) * len(place.regions))]
            height = float(sources[_source(varied.place)]["height_m"])
            away = np.array(taken, float).reshape(-1, 2)
            xy = self._regions.draw(region, place, height, stream.numbers, away)
            regions[varied.path] = region
            if xy is None:
                return found, regions, varied
            found[varied.path] = xy.tolist()
            taken.append(found[varied.path])
        return found, regions, None

    def _spread(self, number: int) -> list[Any]:
        """Places of a line or an area; none of a source on a vehicle, which is nowhere before the mission begins."""
        source = self._scenario.mission.sources[number]
        return [] if source.on is not None else points_of(source).xy_m.tolist()

    def _sources(self, row: Row) -> list[Row]:
        """The mission's sources with the values of a row."""
        sources: list[Row] = [source.model_dump(mode="json") for source in self._scenario.mission.sources]
        for varied in self._others:
            if (number := _source(varied.place)) >= 0:
                inner: Any = sources[number]
                for step in varied.place[2:-1]:
                    inner = inner[step]
                inner[varied.place[-1]] = row[varied.path]
        return sources

    def _check_regions(self) -> None:
        """Raise an `InputError` where a region is empty at the least or the greatest height of a source."""
        heights = {v.place[1]: v.distribution.interval for v in self._others if v.place[2:] == ("height_m",)}
        told: set[Any] = set()
        for varied in self._placed:
            number, place = _source(varied.place), varied.distribution.place
            assert place is not None
            own = self._scenario.mission.sources[number].height_m
            assert own is not None  # a source that is placed is a point
            for height in set(heights.get(number) or (own,)):
                for region in place.regions:
                    if (varied.key, region, height) not in told:
                        told.add((varied.key, region, height))
                        self._check_region(varied, region, height)

    def _check_region(self, varied: Varied, region: Region, height_m: float) -> None:
        """Raise an `InputError` where a region has no place, however near other sources are."""
        place = varied.distribution.place
        assert place is not None
        assert self._regions is not None
        numbers = Stream(0, f"is there any {region}").numbers  # any will do
        if self._regions.draw(region, place, height_m, numbers, np.zeros((0, 2))) is not None:
            return
        raise InputError([self._scenario.problem(
            ("vary", varied.key, "place"),
            f"the site '{self._site_name}' has no place in the region '{region}' for a source {height_m:g} m above "
            "the ground",
            allowed=_WANTED[region],
            suggestion="leave the region out, make margin_m smaller, or vary height_m in other bounds",
        )])  # fmt: skip


_WANTED: dict[Region, str] = {
    "open": "ground of the survey area with nothing on it or above it, near_m from obstacles",
    "indoors": "the inside of a hollow obstacle (wall_m in the site's file) that stands on the ground, margin_m from "
    "its walls",
    "behind_walls": "ground of the survey area within near_m of a wall that rises 1 m above the source",
    "survey_area": "a place of the survey area that is not within a solid thing or a wall",
    "anywhere": "a place of the site that is not within a solid thing or a wall",
}


def with_given(draws: Draws, given: Mapping[str, Sequence[Any]]) -> Draws:
    """The draws with ``given`` values in their stead, which no region is known of."""
    regions = tuple({path: each for path, each in found.items() if path not in given} for found in draws.regions)
    own = tuple(path for path in given if path not in draws.values)
    return replace(draws, values={**draws.values, **given}, regions=regions, given=own)


def _nuclides(scenario: Scenario, varied: Varied) -> tuple[str, ...]:
    """Nuclides of the library that ``any_nuclide`` chooses from."""
    wanted = varied.distribution.any_nuclide
    assert wanted is not None
    strongest = {name: max(line.yield_percent for line in n.lines) for name, n in scenario.nuclides.items()}
    found = tuple(name for name in strongest if strongest[name] >= wanted.yield_min_percent)
    if not found:
        best = max(strongest, key=lambda name: strongest[name])
        raise InputError([scenario.problem(
            ("vary", varied.key, "any_nuclide"),
            "no nuclide of the library has so strong a line",
            given=f"{wanted.yield_min_percent:g} %",
            allowed=f"at most {strongest[best]:g} % ({best})",
        )])  # fmt: skip
    return found


def _at(data: Any, place: Place) -> Any:
    """The value at ``place`` of plain data; None where it stands for a default that is not written out."""
    for step in place:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def columns(told: Mapping[str, Any]) -> Row:
    """What a mission drew, as columns of a table: ``drawn_sources_0_activity_mbq``, places by axis, lists as text."""
    found: Row = {}
    for path, value in told.items():
        name = "drawn_" + path.replace(".", "_")
        if path.endswith("position_m") and isinstance(value, list | tuple) and len(value) == 2:
            stem = name.removesuffix("_m")
            found |= {f"{stem}_east_m": float(value[0]), f"{stem}_north_m": float(value[1])}
        else:
            found[name] = json.dumps(value) if isinstance(value, list | tuple | dict) else value
    return found
