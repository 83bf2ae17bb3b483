"""The radiation map updated as samples come, on the device: sums over bins of the ground, read as a map when needed.

Counts of a Poisson process add up, so the counts, the exposure and the mean place of all samples in a bin are all that
the map needs of them, if the bin is small against the map's length scale. The sums have a fixed size, whatever the
number of samples; adding U samples costs a scatter of U rows, and `read` interpolates the bins as if each were one
measurement.
"""

import jax
import jax.numpy as jnp

from swarmsim.estimation.measurements import Measurements
from swarmsim.estimation.radiation_map import MappingParams, RadiationMap, interpolate
from swarmsim.pytree import pytree, static

BINS_PER_LENGTH_SCALE = 4.0  # the kernel falls by 1.3 % over an eighth of its length scale
OUTSIDE_SHARE = 0.5  # of the length scale: samples up to this far outside the map count for its edge
_EXPOSURE_UNIT_S = 1.0
_COUNTS_UNIT = 4096.0


@pytree
class Binned:
    """Sums over all samples in each bin; row 0 is the south edge, column 0 the west edge.

    Exposure and counts are each kept as a multiple of a unit and a rest below it: both are exact to float32 of the unit
    and not of the sum, so that 10^5 small samples leave no rounding error behind.
    """

    whole: jax.Array  # [by, bx, 2] exposure in 1 s, counts in 4096: whole numbers
    rest: jax.Array  # [by, bx, 2] s, counts: below one unit
    samples: jax.Array  # [by, bx] number of samples
    offset_m_s: jax.Array  # [by, bx, 2] m s, sum of exposure times the place relative to the bin's centre
    ignored: jax.Array  # [] int32, fresh samples that were not used: outside the map, or not sound
    bin_cells: int = static()  # side of a bin in cells of the map

    @property
    def exposure_s(self) -> jax.Array:
        """Exposure [by, bx] in s, as of the reference detector."""
        return _EXPOSURE_UNIT_S * self.whole[..., 0] + self.rest[..., 0]

    @property
    def counts(self) -> jax.Array:
        """Counts [by, bx]."""
        return _COUNTS_UNIT * self.whole[..., 1] + self.rest[..., 1]


def default_bin_cells(params: MappingParams) -> int:
    """Side of a bin in cells, so that bins are about a quarter of the length scale (host: the parameters are known)."""
    return max(1, round(float(params.length_scale_m) / (BINS_PER_LENGTH_SCALE * float(params.cell_m))))


def start(params: MappingParams, bin_cells: int | None = None) -> Binned:
    """No samples yet.

    Args:
        params: grid of the map.
        bin_cells: side of a bin in cells of the map (static); by default `default_bin_cells`, which needs concrete
            parameters, so inside `jit` it must be given. Coarser bins make `read` cheaper.

    Raises:
        ValueError: ``bin_cells`` is below 1.
    """
    bin_cells = default_bin_cells(params) if bin_cells is None else bin_cells
    if bin_cells < 1:
        raise ValueError(f"a bin has at least one cell: bin_cells is {bin_cells}")
    shape = -(-params.rows.shape[0] // bin_cells), -(-params.columns.shape[0] // bin_cells)
    return Binned(
        whole=jnp.zeros((*shape, 2)),
        rest=jnp.zeros((*shape, 2)),
        samples=jnp.zeros(shape),
        offset_m_s=jnp.zeros((*shape, 2)),
        ignored=jnp.int32(0),
        bin_cells=bin_cells,
    )


def update(
    params: MappingParams,
    state: Binned,
    position_m: jax.Array,
    counts: jax.Array,
    exposure_s: jax.Array,
    fresh: jax.Array,
    sensitivity: jax.Array,
) -> Binned:
    """The sums with U further samples.

    A team of different detectors gives one map, in counts per second of a reference detector, by scaling each exposure
    with the detector's sensitivity. That assumes that all see the same mixture of energies, so that background and
    sources scale alike; the ratio of the nominal background rates is then that of the effective areas. A detector of
    another material or threshold departs from it by the difference of their responses to the source and to the
    background.

    Args:
        params: grid of the map.
        state: sums so far.
        position_m: [U, 2] or [U, 3] m, detector in the middle of the exposure, world; all at about one height above
            ground.
        counts: [U] counts, corrected for dead time by their exposure.
        exposure_s: [U] s, live time.
        fresh: [U] bool, whether there is a new sample; the others are disregarded.
        sensitivity: [U] nominal background rate of the vehicle's detector over that of the reference detector.

    Returns:
        The sums. A sample further outside the map than half a length scale, or with a non-finite or negative value or
        no exposure, is only counted in ``ignored``.
    """
    place = position_m[:, :2]
    effective = exposure_s * sensitivity
    sound = jnp.all(jnp.isfinite(place), axis=-1) & jnp.isfinite(counts) & (counts >= 0.0)
    sound &= jnp.isfinite(effective) & (exposure_s > 0.0) & (sensitivity > 0.0)
    place = jnp.where(sound[:, None], place, params.origin_m)
    side = state.bin_cells * params.cell_m
    corner = params.origin_m - 0.5 * params.cell_m
    extent = params.cell_m * jnp.array([params.columns.shape[0], params.rows.shape[0]])
    beyond = jnp.max(jnp.maximum(corner - place, place - corner - extent), axis=-1)
    used = fresh & sound & (beyond <= OUTSIDE_SHARE * params.length_scale_m)

    by, bx = state.samples.shape
    last = jnp.array([bx - 1, by - 1])
    bin_ = jnp.clip(jnp.floor(jax.lax.stop_gradient((place - corner) / side)), 0, last).astype(jnp.int32)
    exposure = jnp.where(used, effective, 0.0)
    offset = exposure[:, None] * (place - corner - (bin_ + 0.5) * side)
    at = jnp.where(used, bin_[:, 1], by), bin_[:, 0]  # row `by` does not exist: dropped
    rest = jnp.stack([exposure, jnp.where(used, counts, 0.0)], axis=-1)
    whole, rest = _carried(state.whole, state.rest.at[at].add(rest, mode="drop"), at)
    return Binned(
        whole=whole,
        rest=rest,
        samples=state.samples.at[at].add(1.0, mode="drop"),
        offset_m_s=state.offset_m_s.at[at].add(offset, mode="drop"),
        ignored=state.ignored + jnp.sum(fresh & ~used, dtype=jnp.int32),
        bin_cells=state.bin_cells,
    )


def _carried(whole: jax.Array, rest: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Whole units and rests after moving full units from the rest in the bins ``at`` ([U] rows, [U] columns)."""
    unit = jnp.array([_EXPOSURE_UNIT_S, _COUNTS_UNIT])
    here = rest.at[at].get(mode="fill", fill_value=0.0)
    carry = jax.lax.stop_gradient(jnp.floor(here / unit))
    # Several samples in one bin write the same values.
    moved = whole.at[at].get(mode="fill", fill_value=0.0) + carry
    return whole.at[at].set(moved, mode="drop"), rest.at[at].set(here - carry * unit, mode="drop")


def measurements(params: MappingParams, state: Binned) -> Measurements:
    """The bins as measurements, one row [by bx] each, at the mean place of their samples; empty bins are not valid.

    Heights, axes and times are not known any more: they are zero, up and zero.
    """
    by, bx = state.samples.shape
    exposure = state.exposure_s
    valid = (state.samples > 0.0) & (exposure > 0.0)
    column, row = jnp.meshgrid(jnp.arange(bx), jnp.arange(by))
    side = state.bin_cells * params.cell_m
    centre = params.origin_m - 0.5 * params.cell_m + (jnp.stack([column, row], axis=-1) + 0.5) * side
    place = centre + state.offset_m_s / jnp.where(valid, exposure, 1.0)[..., None]
    rows = by * bx
    return Measurements(
        time_s=jnp.zeros(rows),
        position_m=jnp.pad(place.reshape(rows, 2), ((0, 0), (0, 1))),
        travel_m=jnp.zeros((rows, 3)),
        axis=jnp.tile(jnp.array([0.0, 0.0, 1.0]), (rows, 1)),
        counts=state.counts.reshape(rows),
        exposure_s=exposure.reshape(rows),
        valid=valid.reshape(rows),
        detector=jnp.zeros(rows, jnp.int32),
    )


def read(params: MappingParams, state: Binned) -> RadiationMap:
    """The map of everything measured so far, in counts per second of the reference detector.

    The samples are taken for the windows of `interpolate`, and should be as long as those that are given to it. The
    samples of one bin share what the basis misses there. `interpolate` takes it for independent from sample to sample,
    and is therefore more confident where a vehicle stays in one place.
    """
    return interpolate(params, measurements(params, state), state.samples.reshape(-1))
