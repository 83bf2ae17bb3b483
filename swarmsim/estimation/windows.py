"""Counts gathered while vehicles measure: samples of a vehicle added up over windows, in arrays of fixed size."""

import jax
import jax.numpy as jnp

from swarmsim.estimation.measurements import Measurements
from swarmsim.pytree import pytree


@pytree
class Windows:
    """Sums over the samples of each window; U vehicles of W windows each."""

    samples: jax.Array  # [U] int32: samples that each vehicle has taken
    time_s: jax.Array  # [U, W] end of the last sample
    position_m: jax.Array  # [U, W, 3] sum over samples of exposure times place, world
    travel_m: jax.Array  # [U, W, 3] sum of the ways, world
    begin_m: jax.Array  # [U, W, 3] where the way begins, world
    axis: jax.Array  # [U, W, 3] sum over samples of exposure times crystal axis, world
    counts: jax.Array  # [U, W]
    exposure_s: jax.Array  # [U, W]
    rois: jax.Array  # [U, W, R] the counts by region of interest


def windows_start(vehicles: int, windows: int, rois: int) -> Windows:
    """Nothing measured yet."""
    scalars, vectors = jnp.zeros((vehicles, windows)), jnp.zeros((vehicles, windows, 3))
    return Windows(
        samples=jnp.zeros(vehicles, jnp.int32),
        time_s=scalars,
        position_m=vectors,
        travel_m=vectors,
        begin_m=vectors,
        axis=vectors,
        counts=scalars,
        exposure_s=scalars,
        rois=jnp.zeros((vehicles, windows, rois)),
    )


def gather(windows: Windows, samples: Measurements, new: jax.Array, per_window: int) -> Windows:
    """The windows with further samples, which follow one another in time.

    Args:
        windows: of U vehicles.
        samples: [F, U] on every field.
        new: [F, U] bool, which of them are to be taken.
        per_window: consecutive samples of a vehicle in a window (static).

    Returns:
        The sums; samples beyond the last window are dropped.
    """
    frames, vehicles = new.shape
    number = windows.samples + jnp.cumsum(new, axis=0) - 1  # [F, U]
    slot = jnp.where(new, number // per_window, windows.counts.shape[1])
    vehicle = jnp.broadcast_to(jnp.arange(vehicles), (frames, vehicles))
    exposure = jnp.where(new, samples.exposure_s, 0.0)
    opening = jnp.where(number % per_window == 0, slot, windows.counts.shape[1])

    def add(total: jax.Array, value: jax.Array) -> jax.Array:
        return total.at[vehicle, slot].add(value, mode="drop")

    return Windows(
        samples=windows.samples + jnp.sum(new, axis=0, dtype=jnp.int32),
        time_s=windows.time_s.at[vehicle, slot].max(samples.time_s, mode="drop"),
        position_m=add(windows.position_m, exposure[..., None] * samples.position_m),
        travel_m=add(windows.travel_m, samples.travel_m),
        begin_m=windows.begin_m.at[vehicle, opening].set(samples.position_m - 0.5 * samples.travel_m, mode="drop"),
        axis=add(windows.axis, exposure[..., None] * samples.axis),
        counts=add(windows.counts, samples.counts),
        exposure_s=add(windows.exposure_s, exposure),
        rois=windows.rois if samples.rois is None else add(windows.rois, samples.rois),
    )


def merged(windows: Windows, most: int) -> Windows:
    """The windows of each vehicle in at most ``most`` (static): neighbours put together.

    The information that is lost where windows are put together goes with their counts and with the square of the
    change of the rate along them. The rate of a source falls within a distance that itself goes with the root of one
    over the rate, so the loss is least if the length of the windows goes with the rate to the power of minus two thirds
    (the law of optimal quantisation, Panter and Dite, Proc. IRE 39, 1951, 44). Half of the windows share the way in
    this manner, the other half the time.
    """
    used = windows.exposure_s > 0.0
    sparse = jnp.sum(used, axis=1) <= most
    rate = windows.counts / jnp.maximum(windows.exposure_s, 1e-9)
    along = jnp.sqrt(jnp.sum(jnp.square(windows.travel_m), axis=-1)) * rate ** (2.0 / 3.0)
    share = 0.5 * (_shares(along) + _shares(windows.exposure_s))
    share = share / jnp.maximum(jnp.sum(share, axis=1, keepdims=True), 1e-9)
    middle = jnp.cumsum(share, axis=1) - 0.5 * share
    bins = jnp.where(sparse[:, None], jnp.cumsum(used, axis=1) - 1, jnp.floor(middle * most)).astype(jnp.int32)
    slot = jnp.where(used, jnp.clip(bins, 0, most - 1), most)
    vehicle = jnp.broadcast_to(jnp.arange(used.shape[0])[:, None], slot.shape)
    before = jnp.concatenate([jnp.full((used.shape[0], 1), -1), slot[:, :-1]], axis=1)
    opening = jnp.where(slot != before, slot, most)

    def add(value: jax.Array) -> jax.Array:
        empty = jnp.zeros((used.shape[0], most, *value.shape[2:]), value.dtype)
        return empty.at[vehicle, slot].add(value, mode="drop")

    latest = jnp.zeros((used.shape[0], most)).at[vehicle, slot].max(windows.time_s, mode="drop")
    begin = jnp.zeros((used.shape[0], most, 3)).at[vehicle, opening].set(windows.begin_m, mode="drop")
    return Windows(
        samples=windows.samples,
        time_s=latest,
        position_m=add(windows.position_m),
        travel_m=add(windows.travel_m),
        begin_m=begin,
        axis=add(windows.axis),
        counts=add(windows.counts),
        exposure_s=add(windows.exposure_s),
        rois=add(windows.rois),
    )


def _shares(values: jax.Array) -> jax.Array:
    """Values [U, W] over their sum."""
    return values / jnp.maximum(jnp.sum(values, axis=1, keepdims=True), 1e-9)


def measured(windows: Windows, detector: int) -> Measurements:
    """The windows as measurements [U W] of detector model ``detector``; unused ones are not valid."""
    valid = windows.exposure_s > 0.0
    exposure = jnp.where(valid, windows.exposure_s, 1.0)[..., None]
    position = windows.position_m / exposure
    norm = jnp.sqrt(jnp.sum(windows.axis**2, axis=-1, keepdims=True))
    axis = jnp.where(norm > 1e-6 * exposure, windows.axis / jnp.maximum(norm, 1e-9), jnp.array([0.0, 0.0, 1.0]))
    each = Measurements(
        time_s=windows.time_s,
        position_m=position,
        travel_m=windows.travel_m,
        axis=axis,
        counts=windows.counts,
        exposure_s=windows.exposure_s,
        valid=valid,
        detector=jnp.full(valid.shape, detector, jnp.int32),
        rois=windows.rois,
        chord_m=jnp.where(valid[..., None], windows.begin_m + 0.5 * windows.travel_m - position, 0.0),
    )
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), each)
