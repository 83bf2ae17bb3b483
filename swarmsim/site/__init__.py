"""The ground truth of a place: terrain, obstacles, materials, and rays through them."""

from swarmsim.site.model import Obstacles, Site, SiteModel, VisualMesh, sample, sample_with_gradient
from swarmsim.site.rays import path_lengths

__all__ = ["Obstacles", "Site", "SiteModel", "VisualMesh", "path_lengths", "sample", "sample_with_gradient"]
