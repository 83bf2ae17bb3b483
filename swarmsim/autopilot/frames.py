"""Frames of autopilots: NED and FRD against the ENU and FLU of swarmsim, and places on the Earth against both.

Everything is computed in float64: a degree of latitude in float32 is known to 0.4 m.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# WGS-84 (NIMA TR8350.2, 2000): semi-major axis and flattening
EARTH_RADIUS_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)


def ned_of_enu(vector: ArrayLike) -> Array:
    """A vector [..., 3] in NED from one in ENU; the same function leads back."""
    x = np.asarray(vector, np.float64)
    return np.stack([x[..., 1], x[..., 0], -x[..., 2]], axis=-1)


enu_of_ned = ned_of_enu


def frd_of_flu(vector: ArrayLike) -> Array:
    """A vector [..., 3] in FRD from one in FLU; the same function leads back."""
    return np.asarray(vector, np.float64) * np.array([1.0, -1.0, -1.0])


flu_of_frd = frd_of_flu


def yaw_ned_of_enu(yaw_rad: float) -> float:
    """Heading clockwise from north from one counter-clockwise from east, within -pi and pi; and back."""
    return float(np.arctan2(np.cos(yaw_rad), np.sin(yaw_rad)))


yaw_enu_of_ned = yaw_ned_of_enu


def quaternion_ned_of_enu(quaternion: ArrayLike) -> Array:
    """Attitudes [..., 4] (w x y z) of FRD in NED from those of FLU in ENU; the same function leads back.

    With s = sqrt(1/2) the rotation from ENU to NED is (0, s, s, 0), and that from FRD to FLU is (0, 1, 0, 0): their
    product with the attitude between them, of which the sign with a positive w is taken.
    """
    w, x, y, z = np.moveaxis(np.asarray(quaternion, np.float64), -1, 0)
    turned: Array = np.sqrt(0.5) * np.stack([w + z, x + y, x - y, w - z], axis=-1)
    return np.where(turned[..., :1] >= 0.0, turned, -turned)


quaternion_enu_of_ned = quaternion_ned_of_enu


def yaw_of_quaternion(quaternion: ArrayLike) -> float:
    """Yaw of an attitude [4] (w x y z), about the third axis of its world, counter-clockwise seen against that axis."""
    w, x, y, z = np.asarray(quaternion, np.float64)
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def quaternion_of_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> tuple[float, float, float, float]:
    """Attitude (w x y z) of yaw, then pitch (about the second axis, nose down in FLU), then roll."""
    cr, sr = np.cos(0.5 * roll_rad), np.sin(0.5 * roll_rad)
    cp, sp = np.cos(0.5 * pitch_rad), np.sin(0.5 * pitch_rad)
    cy, sy = np.cos(0.5 * yaw_rad), np.sin(0.5 * yaw_rad)
    return (
        float(cr * cp * cy + sr * sp * sy),
        float(sr * cp * cy - cr * sp * sy),
        float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy),
    )


@dataclass(frozen=True)
class Geodetic:
    """A place on the Earth: WGS-84, altitude in the datum of whoever gave it."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


def _ecef(places: ArrayLike) -> Array:
    """Metres [..., 3] of places [..., 3]: latitude and longitude in degrees, altitude in m."""
    latitude, longitude, altitude = np.moveaxis(np.asarray(places, np.float64), -1, 0)
    latitude, longitude = np.radians(latitude), np.radians(longitude)
    n = EARTH_RADIUS_M / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    out = (n + altitude) * np.cos(latitude)
    up = (n * (1.0 - _ECCENTRICITY2) + altitude) * np.sin(latitude)
    return np.stack([out * np.cos(longitude), out * np.sin(longitude), up], axis=-1)


def _place(place: Geodetic) -> Array:
    return _ecef([place.latitude_deg, place.longitude_deg, place.altitude_m])


def _axes(origin: Geodetic) -> Array:
    """East, north and up [3, 3] at the origin, in ECEF."""
    latitude, longitude = np.radians([origin.latitude_deg, origin.longitude_deg])
    sb, cb, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-sl, cl, 0.0], [-sb * cl, -sb * sl, cb], [cb * cl, cb * sl, sb]])


def enu_of_geodetic(place: Geodetic, origin: Geodetic) -> Array:
    """Metres [3] east, north and up of the origin, on the tangent plane there."""
    return enu_of_places([place.latitude_deg, place.longitude_deg, place.altitude_m], origin)


def enu_of_places(places: ArrayLike, origin: Geodetic) -> Array:
    """Metres [..., 3] of places [..., 3] east, north and up of the origin, on the tangent plane there.

    A place is latitude and longitude in degrees, and altitude in m.
    """
    offset: Array = (_ecef(places) - _place(origin)) @ _axes(origin).T
    return offset


def moved_origin(offset_m: ArrayLike, origin: Geodetic, new: Geodetic) -> Array:
    """Metres [..., 3] east, north and up of ``new``, on the tangent plane there, from those of ``origin``."""
    earth = np.asarray(offset_m, np.float64) @ _axes(origin) + _place(origin)
    offset: Array = (earth - _place(new)) @ _axes(new).T
    return offset


def geodetic_of_enu(offset_m: ArrayLike, origin: Geodetic) -> Geodetic:
    """The place at metres [3] east, north and up of the origin.

    From ECEF by Bowring's iteration (Survey Review 28, 1985, 202), which two rounds bring below a micrometre here.
    """
    x, y, z = _place(origin) + _axes(origin).T @ np.asarray(offset_m, np.float64)
    out = np.hypot(x, y)
    latitude = np.arctan2(z, out * (1.0 - _ECCENTRICITY2))
    for _ in range(4):
        n = EARTH_RADIUS_M / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + n * _ECCENTRICITY2 * np.sin(latitude), out)
    n = EARTH_RADIUS_M / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    height = out * np.cos(latitude) + z * np.sin(latitude) - n * (1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    return Geodetic(float(np.degrees(latitude)), float(np.degrees(np.arctan2(y, x))), float(height))


@dataclass(frozen=True)
class Alignment:
    """Where the autopilot's local NED frame lies in the mission's world: one place in both. The axes agree."""

    world_m: tuple[float, float, float]  # ENU
    local_m: tuple[float, float, float]  # NED

    def to_local(self, position_m: ArrayLike) -> Array:
        """A place [3] of the world (ENU) in the local frame (NED)."""
        return np.asarray(self.local_m) + ned_of_enu(np.asarray(position_m, np.float64) - np.asarray(self.world_m))

    def to_world(self, position_m: ArrayLike) -> Array:
        """A place [3] of the local frame (NED) in the world (ENU)."""
        return np.asarray(self.world_m) + enu_of_ned(np.asarray(position_m, np.float64) - np.asarray(self.local_m))
