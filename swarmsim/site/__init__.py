"""Ground truth of a site: terrain, obstacles, materials, and path lengths of rays through them."""

from swarmsim.site.model import Obstacles, Site, SiteModel, Steps, VisualMesh, nearest, sample, sample_with_gradient
from swarmsim.site.rays import Crossed, crossed, path_lengths
from swarmsim.site.store import ImportOptions, import_site, load_site

__all__ = [
    "Crossed",
    "ImportOptions",
    "Obstacles",
    "Site",
    "SiteModel",
    "Steps",
    "VisualMesh",
    "crossed",
    "import_site",
    "load_site",
    "nearest",
    "path_lengths",
    "sample",
    "sample_with_gradient",
]
