"""Places of a mission for others: relative to the site's origin, or on the globe where the site says where it lies."""

from collections.abc import Callable
from typing import Any

import numpy as np

from swarmsim.results.n42_elements import Element, element
from swarmsim.results.record import Floats

RELATIVE = (
    "Places are relative to the origin of the site, whose place on the globe is not known: azimuth clockwise from the "
    "site's north (its y axis), inclination above its horizontal plane, distance in metres."
)
GEOGRAPHIC = (
    "Places are WGS 84, by the projection of the site's elevation model ({crs}); elevations are in metres in that "
    "model's own vertical reference."
)


def places_of(report: dict[str, Any]) -> tuple[str, Callable[[Floats], list[Element]]]:
    """What places [n, 3] (ENU, m) of a site with this import report mean, and the function that writes them."""
    reference = report.get("georeference")
    if not reference or not reference.get("crs"):
        return RELATIVE, _relative
    return GEOGRAPHIC.format(crs=reference["crs"]), lambda position_m: _geographic(reference, position_m)


def _relative(position_m: Floats) -> list[Element]:
    east, north, up = np.asarray(position_m, float).T
    level = np.hypot(east, north)
    azimuth, inclination = np.degrees(np.arctan2(east, north)), np.degrees(np.arctan2(up, level))
    return [
        element(
            "RelativeLocation",
            element("RelativeLocationAzimuthValue", f"{a:.6f}"),
            element("RelativeLocationInclinationValue", f"{i:.6f}"),
            element("DistanceValue", f"{d:.4f}", units="m"),
            element("Origin", element("OriginDescription", "origin of the site")),
        )
        for a, i, d in zip(azimuth, inclination, np.hypot(level, up), strict=True)
    ]


def _geographic(reference: dict[str, Any], position_m: Floats) -> list[Element]:
    latitude, longitude, elevation = geographic(reference, position_m)
    return [
        element(
            "GeographicPoint",
            element("LatitudeValue", f"{a:.9f}"),
            element("LongitudeValue", f"{b:.9f}"),
            element("ElevationValue", f"{c:.3f}"),
            datum="WGS84",
        )
        for a, b, c in zip(latitude, longitude, elevation, strict=True)
    ]


def geographic(reference: dict[str, Any], position_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Latitude [n] and longitude [n] in degrees (WGS 84) and elevation [n] in m of places [n, 3] (ENU, m).

    ``reference`` is the georeference of a site from an elevation model (`swarmsim.site.elevation.Elevation.reference`):
    the projection, and where the site's origin lies in it.
    """
    from rasterio.crs import CRS
    from rasterio.warp import transform

    crs = CRS.from_user_input(reference["crs"])
    east, north, up = np.asarray(position_m, float).T
    unit = float(crs.linear_units_factor[1])  # metres
    scale = float(reference.get("metres_per_projected_metre") or 1.0)
    x = (reference["easting_m"] + east / scale) / unit
    y = (reference["northing_m"] + north / scale) / unit
    longitude, latitude = transform(crs, "EPSG:4326", x, y)[:2]
    return np.asarray(latitude), np.asarray(longitude), up + float(reference["elevation_m"])
