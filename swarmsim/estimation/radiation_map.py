"""Counts interpolated to a map of the rate with its uncertainty: a Gaussian process of low rank.

The rate over the area is a constant background plus a Gaussian process with the separable Matérn 5/2 kernel k(dx)
k(dy), k(d) = (1 + a + a²/3) exp(-a), a = sqrt(5) |d| / length scale (Rasmussen & Williams 2006, eq. 4.17). A
separable kernel has a Karhunen–Loève expansion that is a product of two expansions in one dimension, so the best
basis of a given size costs two small eigenproblems on the host. What the truncated basis misses is added to the noise
of samples and to the variance of cells as an independent remainder, the "fully independent training conditional"
(Snelson & Ghahramani 2006; Quiñonero-Candela & Rasmussen 2005, section 6), so the posterior stays that of a proper
Gaussian process.
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarmsim.config.errors import InputError
from swarmsim.config.mission import Mapping
from swarmsim.estimation.measurements import Measurements, cleared
from swarmsim.pytree import pytree, static

Floats = NDArray[np.floating]
Basis = tuple[Floats, Floats, Floats]  # support [g], projection [g, p], values at the cells [nc, p]

VARIANCE_KEPT = 0.95  # of the prior's variance in the basis, mean over the map
RANK_MAX = 1024  # a larger basis would take seconds and hundreds of megabytes
RANK_SURELY = 1.5  # length scales of the area (each side and one more) over the rank are at most 1.3
CELLS_MAX = 250_000
CHUNK = 128  # samples taken into the normal equations at a time: bounds the memory of large batches


@pytree
class MappingParams:
    """The map's grid and the basis of its Gaussian process (rank r, 1-D support of gx and gy points)."""

    origin_m: jax.Array  # [2] m, centre of cell [0, 0], south-west, world ENU
    cell_m: jax.Array  # [] m
    length_scale_m: jax.Array  # [] m
    support_x_m: jax.Array  # [gx] m, world
    support_y_m: jax.Array  # [gy] m, world
    project_x: jax.Array  # [gx, r] kernel against the support -> basis, x factor
    project_y: jax.Array  # [gy, r] y factor
    columns: jax.Array  # [nx, r] x factor of the basis at the cells' columns
    rows: jax.Array  # [ny, r] y factor of the basis at the cells' rows
    significance_sigma: jax.Array  # [] hotspot threshold
    hotspots_max: int = static()
    separation_cells: int = static()  # hotspot separation


@pytree
class RadiationMap:
    """Interpolated rate; row 0 is the south edge, column 0 the west edge."""

    mean_cps: jax.Array  # [ny, nx] counts/s
    std_cps: jax.Array  # [ny, nx] counts/s, posterior; returns to the prior's far from any sample
    significance: jax.Array  # [ny, nx] standard normal under bare background, cell by cell
    background_cps: jax.Array  # [] counts/s, robust level of the background


def matern(distance: jax.Array, length_scale: jax.Array) -> jax.Array:
    """Matérn 5/2 correlation [...] at ``distance`` [...] in m (any sign)."""
    a = jnp.sqrt(5.0) * jnp.abs(distance) / length_scale
    return (1.0 + a + a * a / 3.0) * jnp.exp(-a)


def mapping_params(spec: Mapping, area_m: ArrayLike, variance_kept: float = VARIANCE_KEPT) -> MappingParams:
    """Grid over the bounding box of the survey area, and the basis on it (host).

    Args:
        spec: configuration.
        area_m: [V, 2] vertices of the surveyed area, world ENU, m.
        variance_kept: share of the prior's variance that the basis must carry.

    Raises:
        InputError: the grid or the basis would be too large; says which value to change.
    """
    area = np.asarray(area_m, np.float64)
    low, extent = area.min(axis=0), np.ptp(area, axis=0)
    shape = np.maximum(np.ceil(extent / spec.cell_m - 1e-6).astype(int), 1)
    if shape.prod() > CELLS_MAX:
        raise InputError.of(
            f"makes a map of {shape[0]} x {shape[1]} cells over an area of {extent[0]:.0f} x {extent[1]:.0f} m",
            path="mapping.cell_m",
            given=f"{spec.cell_m:g}",
            allowed=f"at most {CELLS_MAX} cells",
            suggestion="give a larger cell_m or a smaller area",
        )
    origin = low + 0.5 * (extent - (shape - 1) * spec.cell_m)
    cells = [origin[i] + spec.cell_m * np.arange(shape[i]) for i in range(2)]
    least = np.prod([np.ptp(each) / spec.length_scale_m + 1.0 for each in cells])
    if least > RANK_SURELY * RANK_MAX:  # told before the eigenproblems, which could take hours
        raise _too_short(spec.length_scale_m, f"about {least:.3g}")
    bases = [_basis(c, spec.length_scale_m) for c in cells]
    pairs = _pairs(bases, variance_kept, spec.length_scale_m)
    (support_x, project_x, columns), (support_y, project_y, rows) = (
        (support, project[:, pair], values[:, pair])
        for (support, project, values), pair in zip(bases, pairs, strict=True)
    )
    return MappingParams(
        origin_m=_float32(origin),
        cell_m=_float32(spec.cell_m),
        length_scale_m=_float32(spec.length_scale_m),
        support_x_m=_float32(support_x),
        support_y_m=_float32(support_y),
        project_x=_float32(project_x),
        project_y=_float32(project_y),
        columns=_float32(columns),
        rows=_float32(rows),
        significance_sigma=_float32(spec.significance_sigma),
        hotspots_max=spec.hotspots_max,
        separation_cells=max(1, int(np.ceil(spec.hotspot_separation_m / spec.cell_m))),
    )


def _float32(x: ArrayLike) -> jax.Array:
    return jnp.asarray(x, jnp.float32)


def _matern_host(distance: Floats, length_scale: float) -> Floats:
    a = np.sqrt(5.0) * np.abs(distance) / length_scale
    return (1.0 + a + a * a / 3.0) * np.exp(-a)


def _basis(cells: Floats, length_scale: float) -> Basis:
    """Support [g], projection [g, p] and values at the cells [nc, p] of the 1-D expansion, largest eigenvalue first."""
    margin = 0.5 * length_scale
    count = max(int(np.ceil((cells[-1] - cells[0] + 2 * margin) / (0.4 * length_scale))), 2) + 1
    support = np.linspace(cells[0] - margin, cells[-1] + margin, count)
    value, vector = np.linalg.eigh(_matern_host(support[:, None] - support, length_scale))
    keep = np.flatnonzero(value > 1e-4 * value[-1])[::-1]  # smaller ones would be rounding error in float32
    project = vector[:, keep] / np.sqrt(value[keep])
    return support, project, _matern_host(cells[:, None] - support, length_scale) @ project


def _pairs(bases: list[Basis], variance_kept: float, length_scale: float) -> tuple[NDArray, NDArray]:
    """Which products of x and y functions to keep: those of most variance, until ``variance_kept`` is reached."""
    x, y = (np.mean(values**2, axis=0) for _, _, values in bases)
    variance = np.outer(x, y).ravel()
    order = np.argsort(-variance, kind="stable")
    rank = int(np.searchsorted(np.cumsum(variance[order]), variance_kept)) + 1
    if rank > RANK_MAX:
        raise _too_short(length_scale, str(rank))
    i, j = np.unravel_index(order[:rank], (x.size, y.size))
    return i, j


def _too_short(length_scale: float, rank: str) -> InputError:
    return InputError.of(
        f"is too short for the size of the survey area: the map would need {rank} basis functions",
        path="mapping.length_scale_m",
        given=f"{length_scale:g}",
        allowed=f"at most {RANK_MAX} basis functions",
        suggestion="give a longer length_scale_m or a smaller area",
    )


def interpolate(params: MappingParams, measurements: Measurements, windows: jax.Array | float = 1.0) -> RadiationMap:
    """Map of the count rate from counts at known places (one detector type, one height above ground).

    The background level is the median of a kernel-smoothed rate over the windows; the noise of a window is the
    Poisson variance at its smoothed (not its own) count, as weights from own counts would favour low draws; the
    prior's variance is the mean square of the smoothed excess (empirical Bayes), at least the noise of one window.
    All are finite for any input; without a valid sample the map is 0 ± 1 and insignificant.

    Args:
        params: grid and basis.
        measurements: n counting windows, or sums of several.
        windows: how many windows each row [n] is the sum of; the levels are those of the single windows.
    """
    m = cleared(measurements)
    rate, noise, background, variance = _levels(params, m, jnp.where(m.valid, windows, 0.0))
    mean, var, gain, noise_var = posterior(params, m, rate, noise, background, variance)
    return RadiationMap(
        mean_cps=jnp.maximum(mean, 0.0),  # beside a strong source the interpolation swings below nothing
        std_cps=jnp.sqrt(jnp.maximum(var, 0.0)),
        significance=_significance(mean - background, gain, noise_var, background),
        background_cps=background,
    )


def _kernels(params: MappingParams, m: Measurements) -> tuple[jax.Array, jax.Array]:
    """Kernel [n, gx], [n, gy] of the samples against the support."""
    kx = matern(m.position_m[:, :1] - params.support_x_m, params.length_scale_m)
    ky = matern(m.position_m[:, 1:2] - params.support_y_m, params.length_scale_m)
    return kx, ky


def _levels(
    params: MappingParams, m: Measurements, windows: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Rate [n], its noise variance [n], background level [] and prior variance [] from kernel-smoothed counts.

    Each row counts as ``windows`` [n] windows, 0 where it is not valid.
    """
    counts, exposure = m.counts, m.exposure_s
    kx, ky = _kernels(params, m)

    def smooth(v: jax.Array) -> jax.Array:
        return jnp.sum((kx @ (kx.T @ (v[:, None] * ky))) * ky, axis=1)

    smoothed = smooth(counts) / jnp.maximum(smooth(exposure), 1e-9)
    live = jnp.where(m.valid, m.exposure_s, 1.0)
    # A window expected to hold less than one count is given the variance of one: its rate is known no better.
    noise = jnp.maximum(smoothed * live, 1.0) / (live * live)
    number = jnp.sum(windows)
    order = jnp.argsort(jnp.where(m.valid, smoothed, jnp.inf))
    ordered, below = smoothed[order], jnp.cumsum(windows[order])
    # Windows number (N - 1) / 2 and N / 2, rounded down and counted from 0: the median of N.
    half = jnp.stack([jnp.maximum(number - 1.0, 0.0) // 2.0, number // 2.0])
    middle = ordered[jnp.minimum(jnp.sum(below[:, None] <= half, axis=0), ordered.size - 1)]
    background = jnp.where(number > 0, jnp.mean(middle), 0.0)
    share = windows / jnp.maximum(number, 1.0)
    each = live / jnp.maximum(windows, 1.0)
    excess = jnp.sum(share * (smoothed - background) ** 2)
    # At least the noise of one window: an unmeasured place is not known better than one measured once. At most what
    # normal equations in float32 can hold.
    window_noise = jnp.maximum(smoothed * each, 1.0) / (each * each)
    scale = jnp.where(number > 0, jnp.sum(share * window_noise), 1.0)
    variance = jnp.where(number > 0, jnp.clip(excess, scale, 1e3 * scale), 1.0)
    return counts / live, noise, background, variance


def posterior(
    params: MappingParams,
    m: Measurements,
    rate: jax.Array,
    noise: jax.Array,
    background: jax.Array,
    variance: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Posterior of the Gaussian process on the map's cells.

    Args:
        params: grid and basis.
        m: samples; only place and ``valid`` are used.
        rate: [n] measured rate, counts/s.
        noise: [n] variance of the measured rate.
        background: [] prior mean, counts/s.
        variance: [] prior variance.

    Returns:
        mean [ny, nx]; variance [ny, nx]; gain [ny, nx], the response of the mean to a unit step of all samples; and
        the part [ny, nx] of the mean's variance that comes from the noise of the samples.
    """
    rank = params.columns.shape[1]
    pad = -m.valid.shape[0] % CHUNK

    def chunked(v: jax.Array) -> jax.Array:
        return jnp.pad(v, [(0, pad)] + [(0, 0)] * (v.ndim - 1)).reshape(-1, CHUNK, *v.shape[1:])

    kernels = _kernels(params, m)
    inputs = jax.tree.map(chunked, (*kernels, m.valid, rate - background, noise))

    Carry = tuple[jax.Array, jax.Array]

    def accumulate(carry: Carry, x: tuple[jax.Array, ...]) -> tuple[Carry, None]:
        kx, ky, valid, excess, noise = x
        basis = (kx @ params.project_x) * (ky @ params.project_y)
        missed = jnp.maximum(1.0 - jnp.sum(basis * basis, axis=1), 0.0)
        weight = jnp.where(valid, variance / jnp.where(valid, noise + variance * missed, 1.0), 0.0)
        data = jnp.stack([jnp.where(valid, excess, 0.0), jnp.ones_like(excess)], axis=1)
        weighted = weight[:, None] * basis
        return (carry[0] + weighted.T @ basis, carry[1] + weighted.T @ data), None

    zero = jnp.zeros((rank, rank)), jnp.zeros((rank, 2))
    (gram, moment), _ = jax.lax.scan(accumulate, zero, inputs)
    factor = jax.scipy.linalg.cholesky(gram + jnp.eye(rank), lower=True)
    root = jax.scipy.linalg.solve_triangular(factor, jnp.eye(rank), lower=True)
    inverse = root.T @ root
    answer = inverse @ moment

    def row(y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        basis = params.columns * y
        through = basis @ inverse
        first = jnp.sum(through * basis, axis=1)
        second = jnp.sum(through * through, axis=1)
        missed = jnp.maximum(1.0 - jnp.sum(basis * basis, axis=1), 0.0)
        return basis @ answer, missed + first, first - second

    response, var, from_noise = jax.lax.map(row, params.rows)
    return background + response[..., 0], variance * var, response[..., 1], variance * jnp.maximum(from_noise, 0.0)


def _significance(excess: jax.Array, gain: jax.Array, noise_var: jax.Array, background: jax.Array) -> jax.Array:
    """Signed root of the Poisson deviance between each cell's effective counts and the background's.

    The mean is linear in the counts. Divided by its gain it is an unbiased estimate of a level excess with variance
    noise_var / gain², which is that of a counter exposed for background gain² / noise_var seconds. The signed root of
    that counter's deviance 2 (n log(n/b) - n + b) is standard normal under bare background to a higher order than (n
    - b) / sqrt(b), whose skewness would double the false alarms at 5 sigma already with 900 counts (McCullagh &
    Nelder 1989, on deviance residuals).
    """
    known = (gain > 0.1) & (noise_var > 0.0) & (background > 0.0)
    level = jnp.maximum(background, 1e-6)
    relative = jnp.where(known, excess / (jnp.where(known, gain, 1.0) * level), 0.0)
    relative = jnp.maximum(relative, -0.999)
    expected = level * level * gain**2 / jnp.where(known, noise_var, 1.0)
    deviance = 2.0 * expected * ((1.0 + relative) * jnp.log1p(relative) - relative)
    apart = known & (deviance > 0.0)  # the gradient of a root ends at zero
    return jnp.where(apart, jnp.sign(relative) * jnp.sqrt(jnp.where(apart, deviance, 1.0)), 0.0)
