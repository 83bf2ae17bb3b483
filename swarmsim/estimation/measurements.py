"""Detector measurements as arrays of fixed size, and their sums over windows."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree


@pytree
class Measurements:
    """Counting intervals of one mission. Rows that are not ``valid`` are padding: their contents never matter."""

    time_s: jax.Array  # [n] s, end of the interval, mission clock
    position_m: jax.Array  # [n, 3] m, crystal, world ENU
    travel_m: jax.Array  # [n, 3] m, way of the crystal during the interval, with its middle at position_m; world
    axis: jax.Array  # [n, 3] unit vector along the crystal's axis, world
    counts: jax.Array  # [n] counts in the interval
    exposure_s: jax.Array  # [n] s, real time that the counts stand for, dead time included
    valid: jax.Array  # [n] bool
    detector: jax.Array  # [n] int32, index into the tuple of detector models
    rois: jax.Array | None = None  # [n, R] the counts by region of interest
    chord_m: jax.Array | None = None  # [n, 3] middle of the straight line between the ends of the way, less position_m


def aggregate(measurements: Measurements, per_window: int) -> Measurements:
    """Sum every ``per_window`` consecutive measurements to one window.

    Counts and exposures add up (a sum of Poisson variables is Poisson); the position is the exposure-weighted mean,
    the axis the exposure-weighted mean made a unit vector again, the time that of the last valid sample, the detector
    that of the first valid one. The ways add up. Samples must be ordered so that a window holds
    one vehicle (and one detector) only: aggregate each vehicle's own samples (vmap over vehicles), then
    `concatenate`. A remainder shorter than a window makes a last, shorter window.

    Args:
        measurements: n samples.
        per_window: samples in a window, at least 1 (static).

    Returns:
        Measurements with ceil(n / per_window) rows; a window without a valid sample is not valid.

    Raises:
        ValueError: ``per_window`` is below 1.
    """
    if per_window < 1:
        raise ValueError(f"a window needs at least one sample: per_window is {per_window}")
    n = measurements.counts.shape[0]
    windows = -(-n // per_window)

    def windowed(x: jax.Array) -> jax.Array:
        padded = jnp.pad(x, [(0, windows * per_window - n)] + [(0, 0)] * (x.ndim - 1))
        return padded.reshape(windows, per_window, *x.shape[1:])

    m = jax.tree.map(windowed, cleared(measurements))
    total = jnp.sum(m.exposure_s, axis=1)
    weight = (m.exposure_s / jnp.maximum(total, 1e-12)[:, None])[..., None]
    # Positions relative to one of the window's own: a mean of large coordinates would lose digits in float32.
    first = jnp.argmax(m.valid, axis=1)
    origin = jnp.take_along_axis(m.position_m, first[:, None, None], axis=1)
    offset = jnp.sum(weight * (m.position_m - origin), axis=1)
    axis = jnp.sum(weight * m.axis, axis=1)
    norm = jnp.linalg.norm(axis, axis=-1, keepdims=True)
    travel = jnp.sum(m.travel_m, axis=1)
    begin = jnp.take_along_axis(m.position_m - 0.5 * m.travel_m, first[:, None, None], axis=1)
    return Measurements(
        time_s=jnp.max(m.time_s, axis=1),
        position_m=origin[:, 0] + offset,
        travel_m=travel,
        axis=jnp.where(norm > 1e-6, axis / jnp.maximum(norm, 1e-6), jnp.array([0.0, 0.0, 1.0])),
        counts=jnp.sum(m.counts, axis=1),
        exposure_s=total,
        valid=jnp.any(m.valid, axis=1),
        detector=jnp.take_along_axis(m.detector, first[:, None], axis=1)[:, 0],
        rois=None if m.rois is None else jnp.sum(m.rois, axis=1),
        chord_m=(begin - origin)[:, 0] + 0.5 * travel - offset,
    )


def concatenate(*parts: Measurements) -> Measurements:
    """Measurements of several vehicles or phases after one another; leading axes (vehicle, sample) are flattened.

    Regions of interest are padded with zeros to the largest number of them, and left out where a part has none.
    """

    def flat(x: jax.Array, trailing: int) -> jax.Array:
        return x.reshape(-1, *x.shape[x.ndim - trailing :]) if trailing else x.reshape(-1)

    def join(*leaves: jax.Array, trailing: int) -> jax.Array:
        return jnp.concatenate([flat(leaf, trailing) for leaf in leaves])

    vectors = ("position_m", "travel_m", "axis", "chord_m")
    names = set(Measurements.__dataclass_fields__) - {"rois"}  # type: ignore[attr-defined]
    parts = tuple(p if p.chord_m is not None else replace(p, chord_m=jnp.zeros_like(p.travel_m)) for p in parts)
    fields = {f: join(*(getattr(p, f) for p in parts), trailing=int(f in vectors)) for f in names}
    regions = [part.rois for part in parts if part.rois is not None]
    if len(regions) < len(parts):
        return Measurements(**fields)
    most = max(rois.shape[-1] for rois in regions)
    padded = [jnp.pad(rois, [(0, 0)] * (rois.ndim - 1) + [(0, most - rois.shape[-1])]) for rois in regions]
    return Measurements(**fields, rois=join(*padded, trailing=1))


def cleared(m: Measurements) -> Measurements:
    """The same with harmless contents in rows that are not valid, or have no exposure or a non-finite value."""
    finite = jnp.isfinite(m.counts) & jnp.isfinite(m.exposure_s)
    finite &= jnp.all(jnp.isfinite(m.position_m) & jnp.isfinite(m.travel_m) & jnp.isfinite(m.axis), axis=-1)
    valid = m.valid & finite & (m.exposure_s > 0.0)
    return Measurements(
        time_s=jnp.where(valid, m.time_s, 0.0),
        position_m=jnp.where(valid[:, None], m.position_m, jnp.array([0.0, 0.0, 1e4])),
        travel_m=jnp.where(valid[:, None], m.travel_m, 0.0),
        axis=jnp.where(valid[:, None], m.axis, jnp.array([0.0, 0.0, 1.0])),
        counts=jnp.where(valid, m.counts, 0).astype(jnp.float32),
        exposure_s=jnp.where(valid, m.exposure_s, 0.0),
        valid=valid,
        detector=jnp.where(valid, m.detector, 0),
        rois=None if m.rois is None else jnp.where(valid[:, None], m.rois, 0.0),
        chord_m=None if m.chord_m is None else jnp.where(valid[:, None], m.chord_m, 0.0),
    )
