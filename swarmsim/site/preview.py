"""Preview of a site's rasters, to check an import by eye."""

from pathlib import Path
from typing import Any

import numpy as np

from swarmsim.site.model import SiteModel


def write_preview(model: SiteModel, path: Path) -> None:
    """Write a PNG with the ground, the height of obstacles above it, and the cost of driving."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    site = model.site
    ground, surface, cost = (np.asarray(r) for r in (site.terrain_m, site.surface_m, site.cost))
    cell = float(site.cell_m)
    west, south = np.asarray(site.origin_m) - 0.5 * cell
    extent = (west, west + cell * ground.shape[1], south, south + cell * ground.shape[0])
    above = np.where(surface - ground > 0.05, surface - ground, np.nan)
    driving = np.where(np.isfinite(cost), cost, np.nan)
    panels: list[tuple[str, Any, str]] = [
        ("ground [m]", ground, "terrain"),
        ("height above ground [m]", above, "viridis"),
        ("cost of driving a metre (white: impassable)", driving, "YlGn_r"),
    ]
    figure = Figure(figsize=(15, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    polygon = np.asarray(site.survey_area_m)
    closed = np.concatenate([polygon, polygon[:1]])
    for axes, (title, raster, colours) in zip(figure.subplots(1, 3), panels, strict=True):
        image = axes.imshow(raster, origin="lower", extent=extent, cmap=colours, interpolation="nearest")
        axes.plot(closed[:, 0], closed[:, 1], color="crimson", lw=0.8, ls="--")
        axes.set(title=title, xlabel="east [m]", ylabel="north [m]")
        figure.colorbar(image, ax=axes, shrink=0.8)
    figure.suptitle(f"{model.name}: {model.report['area_m2'] / 1e4:.2f} ha; dashed: survey area")
    figure.savefig(path, dpi=110)
