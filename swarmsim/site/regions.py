"""Regions of a site that sources are placed in: open ground, the inside of hollow boxes, places behind walls."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.scenario import Scenario
from swarmsim.config.site_ground import Ground
from swarmsim.config.start_checks import OVERHEAD_M
from swarmsim.config.vary import PlaceIn, Region
from swarmsim.site.model import SiteModel
from swarmsim.site.raster import in_polygon
from swarmsim.site.rooms import Rooms, rooms_of

Floats = NDArray[np.float64]
Numbers = Callable[[int], Floats]
"""Gives n independent numbers, uniform in (0, 1)."""

TOGETHER = 64  # points that are proposed at a time
PROPOSED_MAX = 20_000  # until a region counts as empty
DIRECTIONS = 24  # in which it is looked for a wall, one each 15 degrees
HIDDEN_MIN = 3  # of these one after the other that a wall hides: 45 degrees
RISES_M = 1.0  # a wall hides what lies this far or more below its top


class Regions:
    """Where sources can be on a site: points of its regions, drawn uniformly."""

    def __init__(self, scenario: Scenario, site_model: SiteModel):
        """Look at the site's boxes and rasters; the scenario tells which materials are porous (foliage, straw)."""
        self._site = site_model.site
        self._ground = Ground(self._site, scenario)
        ground = self._ground
        self._solid = ~ground.porous & np.all(ground.half > 0, axis=1)
        self._cells: dict[Any, NDArray[np.int64]] = {}

    def draw(self, region: Region, place: PlaceIn, height_m: float, numbers: Numbers, taken: Floats) -> Floats | None:
        """A place [2] in ``region`` for a source at ``height_m``, away from the places ``taken`` [m, 2].

        None where there is none, or hardly any: none of `PROPOSED_MAX` proposals.
        """
        propose = self._proposal(region, place, height_m)
        if propose is None:
            return None
        for _ in range(0, PROPOSED_MAX, TOGETHER):
            xy = propose(numbers(3 * TOGETHER).reshape(3, TOGETHER))
            suits = self.holds(region, place, height_m, xy)
            suits &= np.all(np.linalg.norm(xy[:, None] - taken[None], axis=2) >= place.apart_m, axis=1)
            if suits.any():
                first: Floats = xy[np.argmax(suits)]
                return first
        return None

    def holds(self, region: Region, place: PlaceIn, height_m: float, xy: Floats) -> NDArray[np.bool_]:
        """Whether a source ``height_m`` above the places ``xy`` [n, 2] is in the region [n]."""
        ground = self._ground
        if region == "anywhere":
            suits = np.all((xy >= ground.low + place.margin_m) & (xy <= ground.high - place.margin_m), axis=1)
        else:
            suits = in_polygon(xy, ground.area)
        tests: dict[Region, tuple[Callable[..., NDArray[np.bool_]], ...]] = {
            "open": (self._in_the_open,),
            "indoors": (self._inside,),
            "behind_walls": (self._free, self._hidden),
        }
        for test in (self._possible, *tests.get(region, ())):
            rows = np.flatnonzero(suits)  # the dearest test comes last
            if len(rows):
                suits[rows] = test(place, self._ground.above(xy[rows], height_m))
        return suits

    def _proposal(self, region: Region, place: PlaceIn, height_m: float) -> Callable[[Floats], Floats] | None:
        """What makes places [n, 2], uniform over a part of the site that holds the region, of numbers [3, n]."""
        if region == "indoors":
            rooms = rooms_of(self._site, place.margin_m)
            return partial(_in_rooms, rooms) if len(rooms.box) else None
        key = (region == "behind_walls", place.near_m if region == "behind_walls" else region != "anywhere")
        if (cells := self._cells.get(key)) is None:
            of = self._near_walls(place.near_m) if region == "behind_walls" else self._cells_of(region != "anywhere")
            cells = self._cells[key] = of
        return partial(self._in_cells, cells) if len(cells) else None

    def _in_cells(self, cells: NDArray[np.int64], numbers: Floats) -> Floats:
        """Places [n, 2] in cells [c, 2] (column, row)."""
        corner = cells[(numbers[0] * len(cells)).astype(int)]
        made: Floats = self._ground.low + self._ground.cell * (corner + numbers[1:].T)
        return made

    def _possible(self, place: PlaceIn, points: Floats) -> NDArray[np.bool_]:
        """Whether a source can be at points [n, 3]: not in a solid thing or a wall."""
        return ~np.any(self._ground.blocked(points), axis=1)

    def _inside(self, place: PlaceIn, points: Floats) -> NDArray[np.bool_]:
        """Whether points [n, 3] lie within a hollow box, the margin away from its walls."""
        ground, depth = self._ground, self._ground.depth(points)
        room = np.all(depth[..., :2] >= (ground.wall + place.margin_m)[:, None] - 1e-9, axis=-1)
        inside: NDArray[np.bool_] = np.any(room & (depth[..., 2] >= ground.wall) & (ground.wall > 0), axis=1)
        return inside

    def _free(self, place: PlaceIn, points: Floats) -> NDArray[np.bool_]:
        """Whether points [n, 3] are outdoors, the margin away from all boxes, those overhead included."""
        free: NDArray[np.bool_] = self._apart(points) >= place.margin_m
        return free

    def _apart(self, points: Floats) -> Floats:
        """Horizontal distance [n] of points [n, 3] to the nearest box, whatever its height; negative within one."""
        real = np.all(self._ground.half > 0, axis=1)
        outside = -self._ground.depth(points)[:, real, :2]
        distance = np.linalg.norm(np.maximum(outside, 0.0), axis=-1)
        signed = np.where(distance > 0.0, distance, outside.max(axis=-1))
        return np.min(signed, axis=1, initial=np.inf)

    def _in_the_open(self, place: PlaceIn, points: Floats) -> NDArray[np.bool_]:
        """Whether points [n, 3] have nothing overhead and are ``near_m`` from obstacles, closed zones, the border."""
        ground = self._ground
        rows, columns = ground.surface.shape
        cell = np.clip(((points[:, :2] - ground.low) / ground.cell).astype(int), 0, [columns - 1, rows - 1])
        at = (cell[:, 1], cell[:, 0])
        overhead = ground.surface[at] - ground.terrain[at] > OVERHEAD_M
        apart = np.minimum(self._apart(points), ground.clearances(points[:, :2]))
        free: NDArray[np.bool_] = (apart >= place.near_m) & ~overhead
        return free

    def _hidden(self, place: PlaceIn, points: Floats) -> NDArray[np.bool_]:
        """Whether a wall within ``near_m`` of points [n, 3] hides them from a sector of the horizon."""
        ground = self._ground
        standing = np.flatnonzero(self._solid)
        rise = ground.centre[standing, 2] + ground.half[standing, 2] >= points[:, None, 2] + RISES_M
        rise &= ground.centre[standing, 2] - ground.half[standing, 2] <= points[:, None, 2]
        hidden = np.zeros((len(points), DIRECTIONS), bool)
        for k, angle in enumerate(2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS):
            hidden[:, k] = np.any(rise & self._meets(standing, points, angle, place.near_m), axis=1)
        run = np.concatenate([hidden, hidden[:, : HIDDEN_MIN - 1]], axis=1)
        windows = np.lib.stride_tricks.sliding_window_view(run, HIDDEN_MIN, axis=1)
        sector: NDArray[np.bool_] = np.any(np.all(windows, axis=2), axis=1)
        return sector

    def _meets(self, boxes: NDArray[np.int64], points: Floats, angle: float, reach_m: float) -> NDArray[np.bool_]:
        """Whether horizontal rays of length ``reach_m`` from points [n, 3] outside meet the boxes' outlines [n, k]."""
        ground = self._ground
        axis, half = ground.axis[boxes], ground.half[boxes, :2]

        def along_axes(x: Any, y: Any) -> Floats:
            return np.stack([x * axis[:, 0] + y * axis[:, 1], y * axis[:, 0] - x * axis[:, 1]], axis=-1)

        start = along_axes(*np.moveaxis(points[:, None, :2] - ground.centre[boxes, :2], -1, 0))
        way = along_axes(np.cos(angle), np.sin(angle))
        way = np.where(np.abs(way) < 1e-12, 1e-12, way)
        one, other = (-half - start) / way, (half - start) / way
        enters = np.minimum(one, other).max(axis=-1)
        leaves = np.maximum(one, other).min(axis=-1)
        meets: NDArray[np.bool_] = (enters <= leaves) & (leaves >= 0.0) & (enters <= reach_m)
        return meets

    def _cells_of(self, surveyed: bool) -> NDArray[np.int64]:
        """Cells (column, row) [c, 2] of the site, or those that the survey area's bounding box touches."""
        ground = self._ground
        rows, columns = ground.terrain.shape
        low, high = np.zeros(2, int), np.array([columns, rows])
        if surveyed:
            low = np.maximum(((ground.area.min(axis=0) - ground.low) / ground.cell).astype(int), 0)
            high = np.minimum(np.ceil((ground.area.max(axis=0) - ground.low) / ground.cell).astype(int), high)
        column, row = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        return np.stack([column.ravel(), row.ravel()], axis=1)

    def _near_walls(self, near_m: float) -> NDArray[np.int64]:
        """Cells (column, row) [c, 2] of the survey area that may lie within ``near_m`` of a solid box."""
        ground, cells = self._ground, self._cells_of(True)
        reach = near_m + ground.cell
        centre = ground.low + ground.cell * (cells + 0.5)
        near = np.zeros(len(cells), bool)
        for k in np.flatnonzero(self._solid):
            offset = centre - ground.centre[k, :2]
            along, across = offset @ ground.axis[k], offset @ np.array([-ground.axis[k, 1], ground.axis[k, 0]])
            near |= (np.abs(along) <= ground.half[k, 0] + reach) & (np.abs(across) <= ground.half[k, 1] + reach)
        return cells[near]


def _in_rooms(rooms: Rooms, numbers: Floats) -> Floats:
    """Places [n, 2] in hollow boxes, each box as likely."""
    room = (numbers[0] * len(rooms.box)).astype(int)
    (along, across), (c, s) = rooms.reach_m[room].T * (2.0 * numbers[1:] - 1.0), rooms.axis[room].T
    made: Floats = rooms.centre_m[room, :2] + np.stack([c * along - s * across, s * along + c * across], axis=1)
    return made
