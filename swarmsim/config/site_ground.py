"""A site's arrays on the host, as the checks of a scenario ask about them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.scenario import Scenario

if TYPE_CHECKING:
    from swarmsim.site import Site

Floats = NDArray[np.float64]

POROUS_KG_M3 = 100.0  # a thing of a lower bulk density is foliage or straw: a source can lie in it


class Ground:
    """The site's arrays on the host."""

    def __init__(self, site: Site, scenario: Scenario):
        self.cell = float(site.cell_m)
        self.terrain = np.asarray(site.terrain_m, float)
        self.surface = np.asarray(site.surface_m, float)
        self.site = site
        self.low = np.asarray(site.origin_m, float) - self.cell / 2
        self.high = self.low + self.cell * np.array(self.terrain.shape[::-1])
        self.area = np.asarray(site.survey_area_m, float)
        boxes = site.obstacles
        self.centre = np.asarray(boxes.centre_m, float)
        self.half = np.asarray(boxes.half_extent_m, float)
        self.axis = np.asarray(boxes.axis, float)
        self.wall = np.asarray(boxes.wall_m, float)
        self.material = [site.material_names[int(i)] for i in np.asarray(boxes.material)]
        self.porous = np.array([scenario.materials[name].density_kg_m3 < POROUS_KG_M3 for name in self.material])

    @property
    def extent(self) -> str:
        """What positions are allowed, in words."""
        (west, south), (east, north) = self.low, self.high
        return f"x from {west:g} to {east:g}, y from {south:g} to {north:g}"

    def fence(self, margin_m: float) -> tuple[Floats, Floats]:
        """South-west and north-east corner [2] of the fence: the middles of the outermost cells, less the margin."""
        return self.low + 0.5 * self.cell + margin_m, self.high - 0.5 * self.cell - margin_m

    def holds(self, xy: Floats) -> bool:
        """Whether ``xy`` [2] lies on the site."""
        return bool(np.all(xy >= self.low) and np.all(xy <= self.high))

    def cell_value(self, raster: Floats, xy: Floats) -> float:
        """Value of the cell that ``xy`` [2] lies in."""
        rows, columns = raster.shape
        column, row = np.clip(((xy - self.low) / self.cell).astype(int), 0, [columns - 1, rows - 1])
        return float(raster[row, column])

    def rises_within(self, xy: Floats, radius: float) -> float:
        """How far the highest surface rises above the ground within ``radius`` of ``xy`` [2], m."""
        rows, columns = self.terrain.shape
        corners = np.stack([xy - radius, xy + radius])
        (left, low), (right, high) = np.clip(((corners - self.low) / self.cell).astype(int), 0, [columns - 1, rows - 1])
        window = np.s_[low : high + 1, left : right + 1]
        return float(np.max(self.surface[window] - self.terrain[window]))

    def clearances(self, xy: Floats) -> Floats:
        """Clearance [p] at points [p, 2], bilinear as the bumpers have it."""
        from swarmsim.site.model import sample_on_host

        return sample_on_host(self.site.clearance_m, self.site, xy)

    def rises(self, xy: Floats) -> Floats:
        """How far the highest surface rises above the terrain [p] at points [p, 2], bilinear as paths are planned."""
        from swarmsim.site.model import sample_on_host

        rises: Floats = sample_on_host(self.surface, self.site, xy) - sample_on_host(self.terrain, self.site, xy)
        return rises

    def least_clearance(self, xy: Floats) -> float:
        """Least clearance of a rover at points [p, 2]."""
        return float(np.min(self.clearances(xy)))

    def above(self, xy: Floats, height_m: float) -> Floats:
        """Points [n, 3] that lie ``height_m`` above the terrain at ``xy`` [n, 2]."""
        from swarmsim.site.model import height_at

        return np.concatenate([xy, (height_at(self.site, xy) + height_m)[:, None]], axis=1)

    def depth(self, points: Floats) -> Floats:
        """How deep points [..., 3] lie within each box, along the box's own axes [..., K, 3]; < 0 outside."""
        offset = points[..., None, :] - self.centre
        along = offset[..., 0] * self.axis[:, 0] + offset[..., 1] * self.axis[:, 1]
        across = -offset[..., 0] * self.axis[:, 1] + offset[..., 1] * self.axis[:, 0]
        depth: Floats = self.half - np.abs(np.stack([along, across, offset[..., 2]], axis=-1))
        return depth

    def blocked(self, points: Floats) -> NDArray[np.bool_]:
        """Which boxes [..., K] points [..., 3] lie in where no source can: solid ones, and walls of hollow ones."""
        depth = self.depth(points)
        within = np.all(depth > 0, axis=-1)
        in_cavity = (self.wall > 0) & np.all(depth >= self.wall[:, None], axis=-1)
        blocked: NDArray[np.bool_] = within & ~in_cavity & ~self.porous
        return blocked


def point_text(xy: Floats) -> str:
    """Coordinates of a point [2], as messages write them."""
    return f"[{xy[0]:.4g}, {xy[1]:.4g}]"
