"""Count rate of one detector from one point source, dead time, and drawn counts (device side).

    rate = sum over lines of  A y A_eff(E, theta) Omega/(4 pi S) exp(-sum mu_k x_k) B(E)

with activity A, silhouette S of the crystal, and effective area A_eff, the integral of the detection probability over
the silhouette.
"""

import jax
import jax.numpy as jnp

from swarmsim.radiation.cylinder import direction_basis, solid_angle_per_area
from swarmsim.radiation.detector import Detector, Source
from swarmsim.radiation.library import BUILD_UP_SCALE
from swarmsim.radiation.poisson import poisson


def line_rates(
    detector: Detector, source: Source, lengths_m: jax.Array, position_m: jax.Array, axis: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Counts per second [L] of each line from unscattered photons, and [L] from scattered ones.

    ``lengths_m`` [M] is the path through each material, ``position_m`` [3] the crystal's centre and ``axis`` [3] its
    unit axis, world ENU. The build-up of several layers with optical depths t_k is that of the depth sum(t_k), with
    C, D and P averaged over the layers with weights t_k. For a single material that is its own build-up. The order of
    the layers is not known from their lengths and has no effect. Scattered photons are counted with the efficiency and
    the direction of their line.
    """
    direct, scattered = transmission(detector.transport_1_m[source.nuclide] @ lengths_m)
    seen = _seen(detector, source, position_m, axis)
    return seen * direct, seen * scattered


def transmission(optical: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Unscattered and scattered photons [..., L] behind matter, relative to the photons without it.

    ``optical`` [..., 4, L] is the optical depth t and t C, t D, t P: t exp(-t) C (1 + t / 0.2)^P exp(D t) scattered.
    """
    depth, c, d, p = (optical[..., k, :] for k in range(4))
    growth = d + p / (depth + 1e-9) * jnp.log1p(depth / BUILD_UP_SCALE)
    return jnp.exp(-depth), c * jnp.exp(growth - depth)


def _seen(detector: Detector, source: Source, position_m: jax.Array, axis: jax.Array) -> jax.Array:
    """Counts per second of each line [L] without attenuation."""
    offset = source.position_m - position_m
    distance = jnp.sqrt(jnp.sum(offset * offset) + 1e-12)
    u = jnp.abs(jnp.dot(offset, axis)) / distance
    across = jnp.cross(offset, axis) / distance
    s = jnp.sqrt(jnp.sum(across * across) + 1e-10)  # keeps the gradient finite on the axis
    geometry = solid_angle_per_area(detector.radius_m, detector.length_m, distance, u, s)
    area = detector.effective_area_m2[source.nuclide] @ direction_basis(u, s)
    return (source.activity_bq * geometry) * detector.yields[source.nuclide] * area


def net_rate(
    detector: Detector,
    source: Source,
    lengths_m: jax.Array,
    position_m: jax.Array,
    axis: jax.Array,
    *,
    uncollided: bool = False,
) -> jax.Array:
    """Counts per second [] that ``source`` adds, before dead time; see `line_rates` for the arguments.

    ``uncollided`` excludes photons that scattered before the crystal (build-up 1). Differentiable in the source's
    position and activity, the crystal's position and the lengths.
    """
    direct, scattered = line_rates(detector, source, lengths_m, position_m, axis)
    return jnp.sum(direct if uncollided else direct + scattered)


def observed_rate(detector: Detector, net_cps: jax.Array) -> jax.Array:
    """Counts per second [...] after dead time, of source and background together.

    Hybrid law m = n exp(-n t_p) / (1 + n t_n) of Lee and Gardner (Applied Radiation and Isotopes 53, 2000, 731), which
    is the paralyzable law for t_n = 0, the non-paralyzable one for t_p = 0, and no dead time when both are 0.
    """
    rate = net_cps + detector.background_cps
    return rate * jnp.exp(-rate * detector.paralyzable_s) / (1.0 + rate * detector.non_paralyzable_s)


def exposure_of(detector: Detector, live_s: jax.Array | float) -> jax.Array:
    """Exposure [] in s that the counts of a live time of ``live_s`` [] stand for.

    ``physical``: the live time. ``paper_ideal``: as of the Gazebo plugin, whose every message represents one second
    whatever the message rate.
    """
    return jnp.asarray(live_s if detector.kind == "physical" else 1.0, jnp.float32)


def draw_counts(
    detector: Detector, key: jax.Array, mean_observed_cps: jax.Array, live_s: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Counts of one measurement and the exposure in s that they represent, both []: Poisson(rate x exposure)."""
    exposure = exposure_of(detector, live_s)
    return poisson(key, mean_observed_cps * exposure), exposure


def spectrum_rate(
    detector: Detector, source: Source, lengths_m: jax.Array, position_m: jax.Array, axis: jax.Array
) -> jax.Array:
    """Counts per second in each channel [channels] that ``source`` adds; they sum to `net_rate`."""
    direct, scattered = line_rates(detector, source, lengths_m, position_m, axis)
    return direct @ detector.peak_spectrum[source.nuclide] + scattered @ detector.scattered_spectrum[source.nuclide]
