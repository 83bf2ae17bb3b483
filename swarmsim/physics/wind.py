"""Wind near the ground: a steady profile and Dryden gusts.

Both follow MIL-F-8785C, "Military specification: flying qualities of piloted airplanes" (1980), sections 3.7.2 and
3.7.3, low-altitude model. Its formulas are in feet; the functions here take and give SI.
"""

import math

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree

FOOT_M = 0.3048
ROUGHNESS_M = 0.15 * FOOT_M
"""Roughness length of the wind profile for take-off, approach and landing (category C), short vegetation."""
PROFILE_END_M = 1000.0 * FOOT_M
"""Height up to which the profile holds."""
GUST_HEIGHT_M = (10.0 * FOOT_M, 1000.0 * FOOT_M)
"""Heights between which the low-altitude turbulence holds."""
_PROFILE_AT_GUSTS = math.log(10.0 / 0.15) / math.log(20.0 / 0.15)
AIRSPEED_MIN_M_S = 0.5
"""Least speed at which the frozen gusts pass by a vehicle that drifts with the wind."""

GUST_NOISE = 5
"""Numbers of white noise that a step of the filters takes: one along the wind, two across, two up."""
_WAVES = 4
WAVE_MIN = 0.01
"""Shortest wave over 2 pi, in lengths of the gusts: nearer vehicles feel the same gust."""
GUST_DRAWS = _WAVES * (4 + 2 * GUST_NOISE)
"""Random numbers that the noise of all vehicles of a mission takes at a step."""


@pytree
class GustState:
    """State of the gust filters, scaled so that each gust component has unit variance in the steady state."""

    along: jax.Array  # [] along the mean wind, first order
    across: jax.Array  # [2] across it to the left, second order
    vertical: jax.Array  # [2] up, second order


def steady_wind(speed_m_s: jax.Array, from_rad: jax.Array, height_m: jax.Array) -> jax.Array:
    """Air velocity [3] m/s (world ENU) at ``height_m`` above the ground.

    ``speed_m_s`` is the wind at 20 ft (6.096 m), ``from_rad`` the bearing that it blows from, clockwise from north as
    weather stations give it. The profile is logarithmic, ln(h / z0) / ln(20 ft / z0), up to 1000 ft, where it ends. The
    specification's begins at 3 ft; what stands or lies on the ground is lower, so that here it goes on to nothing at
    z0.
    """
    speed = speed_m_s * _profile(height_m)
    along = _downwind(from_rad)
    return jnp.stack([speed * along[0], speed * along[1], jnp.zeros_like(speed)])


def _profile(height_m: jax.Array) -> jax.Array:
    """Wind [] at a height [] m over that at 20 ft."""
    height = jnp.clip(height_m, ROUGHNESS_M, PROFILE_END_M)
    return jnp.log(height / ROUGHNESS_M) / math.log(20.0 * FOOT_M / ROUGHNESS_M)


def gust_scales(speed_m_s: jax.Array, height_m: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Standard deviations [2] m/s and lengths [2] m of the gusts, each (horizontal, vertical).

    With h in feet from 10 to 1000: L_w = h, L_u = L_v = h / (0.177 + 0.000823 h)^1.2, sigma_w = 0.1 W_20,
    sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4. Below 10 ft, where the specification ends, the gusts get
    weaker with the wind.
    """
    height = jnp.clip(height_m, *GUST_HEIGHT_M)
    calmer = jnp.minimum(1.0, _profile(height_m) / _PROFILE_AT_GUSTS)
    ratio = 0.177 + 0.000823 * height / FOOT_M
    vertical = 0.1 * speed_m_s * calmer
    return jnp.stack([vertical / ratio**0.4, vertical]), jnp.stack([height / ratio**1.2, height])


def gust_start(noise: jax.Array) -> GustState:
    """Filters in their steady state, so that gusts do not build up from calm, from white ``noise`` [`GUST_NOISE`]."""
    return GustState(along=noise[0], across=_steady(noise[1:3]), vertical=_steady(noise[3:5]))


def gust_noise(draws: jax.Array, position_m: jax.Array, lengths_m: jax.Array) -> jax.Array:
    """White noise [V, `GUST_NOISE`] in time for one `gust_step` of vehicles at ``position_m`` [V, 3].

    ``draws`` [`GUST_DRAWS`] are standard normal, new at each step and the same for all vehicles of a mission. Each
    vehicle's noise is standard normal too; that of two vehicles r apart has the correlation exp(-r / L), and so have
    their gusts: that of the Dryden model along the line between them (MIL-F-8785C takes its spectra from it; across, it
    would be (1 - r / 2 L) exp(-r / L)). L are the ``lengths_m`` [2] (horizontal, vertical) of `gust_scales`. The noise
    is made of a few waves of random length and direction (Rahimi and Recht, "Random features for large-scale kernel
    machines", 2007); as they are new at every step, the correlation over time is exact however few there are.
    """
    draws, position = draws.reshape(_WAVES, 4 + 2 * GUST_NOISE), jax.lax.stop_gradient(position_m)
    # Cauchy, the spectrum of exp(-r); bounded, so that the rounding of a position is not felt. A gust has no gradient
    # by place, as white noise has none by time.
    wave = draws[:, :3] / jnp.maximum(
        jnp.abs(draws[:, 3:4]), WAVE_MIN * jnp.max(jnp.abs(draws[:, :3]), axis=1, keepdims=True)
    )
    turns = jnp.sum(position[..., None, :] * wave, axis=-1)  # [V, waves]; sums of few, which no matrix unit rounds
    length = jnp.stack([lengths_m[0]] * 3 + [lengths_m[1]] * 2)
    phase = turns[..., None] / length
    waves = jnp.cos(phase) * draws[:, 4 : 4 + GUST_NOISE] + jnp.sin(phase) * draws[:, 4 + GUST_NOISE :]
    return jnp.sum(waves, axis=-2) / _WAVES**0.5


def gust_step(
    noise: jax.Array, state: GustState, *, speed_m_s: jax.Array, height_m: jax.Array, airspeed_m_s: jax.Array, dt: float
) -> GustState:
    """The filters ``dt`` s later; ``airspeed_m_s`` [] is the vehicle's speed through the air, ``speed_m_s`` as above.

    White noise through the Dryden filters 1 / (1 + L s / V) along the wind and (1 + sqrt(3) L s / V) / (1 + L s / V)^2
    across and up, discretised exactly (matrix exponential and covariance over the step), so that the variance does not
    depend on ``dt``. ``noise`` [`GUST_NOISE`] is a row of `gust_noise`.
    """
    _, lengths = gust_scales(speed_m_s, height_m)
    passed = jnp.clip(jnp.maximum(airspeed_m_s, AIRSPEED_MIN_M_S) * dt / lengths, 0.0, 0.5)
    keep = jnp.exp(-passed[0])
    return GustState(
        along=keep * state.along + jnp.sqrt(-jnp.expm1(-2.0 * passed[0])) * noise[0],
        across=_second_order(state.across, passed[0], noise[1:3]),
        vertical=_second_order(state.vertical, passed[1], noise[3:5]),
    )


def gust_velocity(state: GustState, speed_m_s: jax.Array, from_rad: jax.Array, height_m: jax.Array) -> jax.Array:
    """Gust [3] m/s (world ENU) to add to the steady wind."""
    (horizontal, vertical), _ = gust_scales(speed_m_s, height_m)
    along = _downwind(from_rad)
    u, v, w = horizontal * state.along, horizontal * _output(state.across), vertical * _output(state.vertical)
    return jnp.stack([u * along[0] - v * along[1], u * along[1] + v * along[0], w])


def _downwind(from_rad: jax.Array) -> jax.Array:
    """Unit vector [2] (east, north) towards which the wind blows."""
    return -jnp.stack([jnp.sin(from_rad), jnp.cos(from_rad)])


def _output(x: jax.Array) -> jax.Array:
    """Unit-variance gust of a second-order filter: (1 + sqrt(3) s) / (1 + s)^2 in partial fractions."""
    root = 3.0**0.5
    return root * x[0] + (1.0 - root) * x[1]


def _steady(n: jax.Array) -> jax.Array:
    """Draw from the second-order filter's steady covariance [[1/2, 1/4], [1/4, 1/4]] by its Cholesky factor."""
    return jnp.stack([0.5**0.5 * n[0], 0.125**0.5 * (n[0] + n[1])])


def _second_order(x: jax.Array, passed: jax.Array, n: jax.Array) -> jax.Array:
    """Step of x1' = -x1 + white noise, x2' = x1 - x2 over the time ``passed`` (in units of L / V, at most 0.5).

    The covariance gained is a quarter of incomplete gamma functions of 2 ``passed``; as differences from one they
    cancel in float32 (to nothing below a ``passed`` of about 1e-3), so their power series are summed.
    """
    keep = jnp.exp(-passed)
    t = 2.0 * passed
    second = 1.0 + t / 3 * (1.0 + t / 4 * (1.0 + t / 5 * (1.0 + t / 6 * (1.0 + t / 7 * (1.0 + t / 8)))))
    third = 1.0 + t / 4 * (1.0 + t / 5 * (1.0 + t / 6 * (1.0 + t / 7 * (1.0 + t / 8))))
    faded = keep * keep
    c11 = -0.5 * jnp.expm1(-t)
    c12 = 0.125 * faded * t * t * second
    c22 = faded * t * t * t * third / 24.0
    l11 = jnp.sqrt(c11)
    l21 = c12 / l11
    l22 = jnp.sqrt(jnp.maximum(c22 - l21 * l21, 0.0))
    return jnp.stack([keep * x[0] + l11 * n[0], keep * (x[1] + passed * x[0]) + l21 * n[0] + l22 * n[1]])
