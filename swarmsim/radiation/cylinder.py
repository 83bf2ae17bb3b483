"""Geometry of a cylindrical crystal seen from a point: effective area of parallel rays, and what is different close by.

Directions are given by u = |cos| and s = sin of the angle between the crystal's axis and the line to the source. The
counts per photon are A(u) / (4 pi (r^2 + S^2)) G(r, u): A the integral of the interaction probability over the
silhouette for parallel rays, S half the crystal's diagonal, and G a tabulated ratio that is 1 far away and takes the
solid angle and the chords of rays from a point into account. Against rays, from 5 cm on, it is within 3 % for
crystals, and within 6 % for a slender Geiger tube, beside its end too.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_RAYS = 96  # per axis of the grid over the silhouette
_CONE_RAYS = 4096
NEAR_ROWS, _NEAR_FINE, _NEAR_BEND = 77, 104.0, 2.5
"""Rows of the table of G: number FINE l / (l + BEND) at a distance r, l = ln(1 + 2 r / S).

They lie 5 % apart beside an end of a slender tube and farther apart elsewhere, and reach r = 440 S, where G is still
0.3 % above 1.
"""
NEAR_COLUMNS, _NEAR_TURN = (
    31,
    8.0,
)  # from the axis to the side, 0.7 degrees apart on the axis: evenly in ln(1 + 8 angle)
NEAR_TABLES = 3  # of which the G of every line is a sum; see `near_parts`
_NEAR_NODES = 12  # attenuations that these are made from


def direction_basis(u: jax.Array, s: jax.Array) -> jax.Array:
    """Basis [5] of functions of the direction for the effective area; see `fit_effective_area`."""
    return jnp.stack([jnp.ones_like(u), u, s, u * s, u * u])


def near_ratio(table: jax.Array, distance: jax.Array, u: jax.Array, s: jax.Array) -> jax.Array:
    """G [NEAR_TABLES] at ``distance`` [] in units of S; bilinear in ``table`` (`Detector.near`, see `near_parts`)."""
    nearness = jnp.log1p(2.0 * distance)
    row = jnp.clip(_NEAR_FINE * nearness / (nearness + _NEAR_BEND), 0.0, NEAR_ROWS - 1.001)
    turned = jnp.log1p(_NEAR_TURN * jnp.arctan2(s, u)) / math.log1p(_NEAR_TURN * math.pi / 2)
    column = jnp.clip(turned * (NEAR_COLUMNS - 1), 0.0, NEAR_COLUMNS - 1.001)
    i, j = row.astype(jnp.int32), column.astype(jnp.int32)
    y, x = row - i, column - j
    flat = table.reshape(NEAR_TABLES, -1)
    place = i * NEAR_COLUMNS + j

    def at(offset: int) -> jax.Array:
        return flat.at[:, place + offset].get(mode="promise_in_bounds")

    low = (1.0 - x) * at(0) + x * at(1)
    high = (1.0 - x) * at(NEAR_COLUMNS) + x * at(NEAR_COLUMNS + 1)
    log_mean, *departures = (1.0 - y) * low + y * high
    return jnp.exp(log_mean) * jnp.stack([jnp.ones_like(log_mean), *(1.0 + x for x in departures)])


def half_diagonal(radius_m: float, length_m: float) -> float:
    """S: radius [m] of the sphere around the crystal."""
    return float(np.hypot(radius_m, 0.5 * length_m))


def near_tables(radius_m: float, length_m: float, attenuation_1_m: Floats) -> Floats:
    """G [k, NEAR_ROWS, NEAR_COLUMNS] for each attenuation [k]; host side."""
    reach = half_diagonal(radius_m, length_m)
    rows = np.arange(NEAR_ROWS)
    distances = 0.5 * np.expm1(_NEAR_BEND * rows / (_NEAR_FINE - rows))
    angles = np.expm1(np.linspace(0.0, np.log1p(_NEAR_TURN * np.pi / 2), NEAR_COLUMNS)) / _NEAR_TURN
    seen = np.array([
        [fraction_counted(radius_m, length_m, max(d, 1e-6) * reach, float(np.cos(a)), attenuation_1_m) for a in angles]
        for d in distances
    ])  # fmt: skip
    # rays in the same pattern far away: what the pattern does to the integral cancels in the ratio
    away = 1e4
    far = [fraction_counted(radius_m, length_m, away * reach, float(np.cos(a)), attenuation_1_m) for a in angles]
    ratio = seen * (distances**2 + 1.0)[:, None, None] / (np.array(far) * away**2)
    ratio[-1] = 1.0
    return np.moveaxis(ratio, -1, 0)


def near_parts(radius_m: float, length_m: float, attenuation_1_m: Floats) -> tuple[Floats, Floats]:
    """Tables [NEAR_TABLES, NEAR_ROWS, NEAR_COLUMNS], and the weights of the G of each attenuation in them; host side.

    The first is the logarithm of the mean G over all attenuations: next to an end of a slender tube G itself is far
    from linear between two rows. The others are departures from that mean, relative to it, in their principal
    directions: G linear between tables of three attenuations was 9 % off at 5 cm. The weights [..., NEAR_TABLES] are
    those of the mean and of the mean with each departure, and sum to 1.
    """
    least, most = float(np.min(attenuation_1_m)), float(np.max(attenuation_1_m))
    nodes = np.geomspace(least, max(most, 1.01 * least), _NEAR_NODES)
    tables = near_tables(radius_m, length_m, nodes)
    mean = np.mean(tables, axis=0)
    left, size, directions = np.linalg.svd((tables / mean - 1.0).reshape(_NEAR_NODES, -1), full_matrices=False)
    along = (left * size)[:, : NEAR_TABLES - 1]  # how far each attenuation departs in each direction
    scale = np.max(np.abs(along), axis=0) + 1e-12
    departures = (directions[: NEAR_TABLES - 1] * scale[:, None]).reshape(-1, *mean.shape)
    at = np.log(attenuation_1_m)
    weights = np.stack([np.interp(at, np.log(nodes), column) for column in (along / scale).T], axis=-1)
    weights = np.concatenate([1.0 - np.sum(weights, axis=-1, keepdims=True), weights], axis=-1)
    return np.concatenate([np.log(mean)[None], departures]), weights


def fraction_counted(radius_m: float, length_m: float, distance_m: float, u: float, attenuation_1_m: Floats) -> Floats:
    """Share [k] of an isotropic point source's photons that interact in the crystal, for each attenuation [k].

    The integral of 1 - exp(-mu chord) over the solid angle, with evenly spread rays in the cone around the crystal.
    """
    s, reach = np.sqrt(max(1.0 - u * u, 0.0)), half_diagonal(radius_m, length_m)
    place = distance_m * np.array([s, 0.0, u])
    lowest = np.sqrt(1.0 - (reach / distance_m) ** 2) if distance_m > reach else -1.0
    # 1 - lowest cancels far away
    cone = (reach / distance_m) ** 2 / (1.0 + lowest) if distance_m > reach else 2.0
    number = np.arange(_CONE_RAYS)
    share, azimuth = (number + 0.5) / _CONE_RAYS, 2.399963229728653 * number
    drop = share * cone
    across = np.sqrt(np.maximum(drop * (2.0 - drop), 0.0))
    axis = np.array([-s, 0.0, -u])
    side, up = np.array([-u, 0.0, s]), np.array([0.0, 1.0, 0.0])
    ray = (1.0 - drop)[:, None] * axis
    ray = ray + across[:, None] * (np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * up)
    chord = _chord(place, ray, radius_m, length_m)
    return np.array([0.5 * cone * np.mean(-np.expm1(-mu * chord)) for mu in attenuation_1_m])


def _chord(place: Floats, ray: Floats, radius: float, length: float) -> Floats:
    """Length [n] of rays from ``place`` [3] along unit vectors [n, 3] inside the cylinder about the z axis."""
    a = np.maximum(ray[:, 0] ** 2 + ray[:, 1] ** 2, 1e-18)
    b = place[0] * ray[:, 0] + place[1] * ray[:, 1]
    square = b * b - a * (place[0] ** 2 + place[1] ** 2 - radius**2)
    root = np.sqrt(np.maximum(square, 0.0))
    enter = np.where(square > 0.0, (-b - root) / a, np.inf)
    leave = np.where(square > 0.0, (-b + root) / a, -np.inf)
    along = np.where(np.abs(ray[:, 2]) < 1e-12, 1e-12, ray[:, 2])
    ends = np.sort(np.stack([(-0.5 * length - place[2]) / along, (0.5 * length - place[2]) / along]), axis=0)
    return np.maximum(np.minimum(leave, ends[1]) - np.maximum(np.maximum(enter, ends[0]), 0.0), 0.0)


def absorbing_area(radius_m: float, length_m: float, u: float, attenuation_1_m: Floats) -> Floats:
    """Integral of the interaction probability over the silhouette [m2], for parallel rays and each attenuation [k].

    The probability is 1 - exp(-mu l) for a ray with chord l. Host side, with the midpoint rule.
    """
    if u > 1.0 - 1e-12:
        return np.asarray(np.pi * radius_m**2 * -np.expm1(-np.asarray(attenuation_1_m) * length_m))
    s = float(np.sqrt(max(1.0 - u * u, 0.0)))
    half = radius_m * u + 0.5 * length_m * s
    offsets = (np.arange(_RAYS) + 0.5) / _RAYS * 2.0 - 1.0
    # sine substitution across the axis: the midpoint rule stays accurate at the round edge
    angle = offsets * 0.5 * np.pi
    across = radius_m * np.sin(angle)
    cell = (radius_m * np.cos(angle) * np.pi / _RAYS)[None, :] * (2.0 * half / _RAYS)
    along = (offsets * half)[:, None]
    half_chord = np.sqrt(np.maximum(radius_m**2 - across**2, 0.0))[None, :]
    origin_x, origin_z = along * u, -along * s
    enter, leave = (-half_chord - origin_x) / s, (half_chord - origin_x) / s
    if u > 0:
        enter = np.maximum(enter, (-0.5 * length_m - origin_z) / u)
        leave = np.minimum(leave, (0.5 * length_m - origin_z) / u)
    chord = np.maximum(leave - enter, 0.0)
    return np.array([np.sum(cell * -np.expm1(-mu * chord)) for mu in attenuation_1_m])


def fit_effective_area(radius_m: float, length_m: float, attenuation_1_m: Floats) -> Floats:
    """Coefficients [k, 5] of `direction_basis` for the absorbing area of each attenuation [k]; host side.

    The limit of a transparent crystal is its volume (the constant), that of an opaque one its silhouette (u and s). The
    basis contains both limits, and the fit between them is within 1 % of `absorbing_area` at any angle.
    """
    angles = np.linspace(0.0, 0.5 * np.pi, 13)
    u, s = np.cos(angles), np.sin(angles)
    u[-1] = 0.0
    basis = np.stack([np.ones_like(u), u, s, u * s, u * u], axis=1)
    weight = np.where((angles == angles[0]) | (angles == angles[-1]), 30.0, 1.0)
    grid = np.geomspace(min(attenuation_1_m) * 0.99, max(attenuation_1_m) * 1.01, 40)
    areas = np.stack([absorbing_area(radius_m, length_m, float(c), grid) for c in u])  # [angles, grid]
    scale = weight[:, None] / areas
    systems = ((basis * w[:, None], a * w) for a, w in zip(areas.T, scale.T, strict=True))
    coefficients = np.stack([np.linalg.lstsq(left, right, rcond=None)[0] for left, right in systems])
    log_mu = np.log(attenuation_1_m)
    return np.stack([np.interp(log_mu, np.log(grid), column) for column in coefficients.T], axis=-1)
