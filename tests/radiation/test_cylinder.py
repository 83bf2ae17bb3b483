"""Solid angle and effective area of a cylinder against closed forms and rays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation.cylinder import (
    absorbing_area,
    direction_basis,
    fit_effective_area,
    fraction_counted,
    half_diagonal,
    near_parts,
    near_ratio,
)

A, L = 0.0254, 0.0508
ATTENUATIONS = np.array([10.0, 60.0, 1e6])  # 1/m: nearly transparent, 662 keV in NaI, every photon counts
AREAS = fit_effective_area(A, L, ATTENUATIONS)
NEAR, SHARES = near_parts(A, L, ATTENUATIONS)


@jax.jit
def _fractions(distance: jax.Array, u: jax.Array, near: jax.Array, shares: jax.Array, areas: jax.Array) -> jax.Array:
    s = jnp.sqrt(jnp.maximum(1.0 - u * u, 0.0))
    reach = jnp.asarray(half_diagonal(A, L), distance.dtype)
    ratio = shares @ near_ratio(near, distance / reach, u, s)
    return ratio * (areas @ direction_basis(u, s)) / (4.0 * jnp.pi * (distance**2 + reach**2))


def fractions(distance: float, u: float, dtype=jnp.float32) -> np.ndarray:
    """Share of a point source's photons counted, for each of `ATTENUATIONS`."""
    arguments = (jnp.asarray(x, dtype) for x in (distance, u, NEAR, SHARES, AREAS))
    return np.asarray(_fractions(*arguments), np.float64)


@pytest.mark.parametrize("gap", [0.01, 0.1, 1.0, 20.0, 80.0, 500.0])
def test_on_axis_is_the_disc(gap: float) -> None:
    """Solid angle of the end face in closed form."""
    exact = 0.5 * A * A / (np.hypot(gap, A) * (np.hypot(gap, A) + gap))
    assert fractions(gap + L / 2, 1.0)[-1] == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("u", [0.0, 0.3, 0.7071, 0.95, 1.0])
def test_far_away_is_the_silhouette(u: float) -> None:
    area = 2 * A * L * np.sqrt(1 - u * u) + np.pi * A * A * u
    for distance in (20.0, 100.0, 500.0):
        assert fractions(distance, u)[-1] == pytest.approx(area / (4 * np.pi * distance**2), rel=0.005)


@pytest.mark.parametrize("u", [0.0, 0.4, 0.8, 1.0])
def test_float32_equals_float64(u: float) -> None:
    for distance in np.geomspace(1e-3, 500.0, 25):
        with jax.enable_x64(True):
            reference = fractions(distance, u, jnp.float64)
        np.testing.assert_allclose(fractions(distance, u), reference, rtol=3e-4)


@pytest.mark.parametrize("u", [0.0, 0.3, 0.6, 0.85, 0.97, 1.0])
@pytest.mark.parametrize("distance", [0.055, 0.07, 0.1, 0.25, 1.0])
def test_counts_against_rays(u: float, distance: float) -> None:
    """Isotropic rays in a cone about the crystal and their chords, by a ray tracer of the test's own."""
    rng = np.random.default_rng(3)
    s = np.sqrt(1 - u * u)
    origin = distance * np.array([s, 0.0, u])
    opening = min(np.hypot(A, L / 2) / distance * 1.05, 0.999)
    cosine = 1 - rng.random(200_000) * (1 - np.sqrt(1 - opening**2))
    azimuth = 2 * np.pi * rng.random(len(cosine))
    sine = np.sqrt(1 - cosine**2)
    e1, e2, e3 = np.array([u, 0, -s]), np.array([0.0, 1, 0]), -origin / distance
    ray = cosine[:, None] * e3 + sine[:, None] * (np.cos(azimuth)[:, None] * e1 + np.sin(azimuth)[:, None] * e2)
    chord = _chords(origin, ray)
    counted = [np.mean(-np.expm1(-mu * chord)) * 0.5 * (1 - np.sqrt(1 - opening**2)) for mu in ATTENUATIONS]
    near = 0.04 if distance < 0.06 else 0.02  # nearly in contact with the rim
    np.testing.assert_allclose(fractions(distance, u), counted, rtol=near)
    np.testing.assert_allclose(fraction_counted(A, L, distance, u, ATTENUATIONS), counted, rtol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("radius", "length", "least", "most"),
    [(0.005, 0.091, 1e6, 1e6), (0.0254, 0.0508, 14.0, 1e4), (0.0191, 0.0381, 14.0, 1e4)],
)
def test_near_tables_hold_between_their_rows_and_attenuations(
    radius: float, length: float, least: float, most: float
) -> None:
    """Of a Geiger tube, 5 mm from its end too, and for any line between 60 and 3000 keV in a crystal."""
    mu = np.geomspace(least, most, 9)
    near, shares = near_parts(radius, length, np.append(mu, [0.8 * least, 1.2 * most]))
    reach = half_diagonal(radius, length)
    for distance in (0.05, 0.056, 0.07, 0.1, 0.4, 3.0, 10.0):
        for u in np.cos(np.radians([0.0, 2.0, 5.0, 7.0, 14.0, 25.0, 61.0, 90.0])):
            arguments = jnp.float32(distance / reach), jnp.float32(u), jnp.float32(np.sqrt(1.0 - u * u))
            found = shares[:9] @ np.asarray(near_ratio(jnp.asarray(near, jnp.float32), *arguments), np.float64)
            far = fraction_counted(radius, length, 1e4 * reach, u, mu) * 1e8
            exact = fraction_counted(radius, length, distance, u, mu) * ((distance / reach) ** 2 + 1.0) / far
            np.testing.assert_allclose(found, exact, rtol=0.07 if radius < 0.01 else 0.03)


def test_nothing_counts_more_than_all_photons() -> None:
    for distance in (0.0, 1e-4, 0.01, 0.02):
        for u in (0.0, 0.5, 1.0):
            found = fractions(distance, u)
            assert np.all((found > 0.0) & (found <= 1.1))


def _chords(origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        qa = ray[:, 0] ** 2 + ray[:, 1] ** 2
        qb = origin[0] * ray[:, 0] + origin[1] * ray[:, 1]
        discriminant = qb**2 - qa * (origin[0] ** 2 + origin[1] ** 2 - A * A)
        root = np.sqrt(np.maximum(discriminant, 0))
        z = np.sort(np.stack([(-L / 2 - origin[2]) / ray[:, 2], (L / 2 - origin[2]) / ray[:, 2]]), axis=0)
        length = np.minimum((-qb + root) / qa, z[1]) - np.maximum((-qb - root) / qa, z[0])
        return np.where(discriminant > 0, np.maximum(length, 0.0), 0.0)


def test_absorbing_area_limits() -> None:
    for u in (0.0, 0.3, 0.8, 1.0):
        thin, thick = absorbing_area(A, L, u, np.array([1e-3, 1e6]))
        assert thin == pytest.approx(1e-3 * np.pi * A * A * L, rel=2e-3)
        assert thick == pytest.approx(2 * A * L * np.sqrt(1 - u * u) + np.pi * A * A * u, rel=0.01)


def test_end_on_and_side_on_closed_forms() -> None:
    """End-on every chord is L; side-on they are 2 sqrt(a^2 - x^2)."""
    mu = np.array([20.0, 60.0, 400.0])
    x = np.linspace(-A, A, 40_001)
    chord = 2 * np.sqrt(np.maximum(A * A - x * x, 0))
    side = [L * np.trapezoid(-np.expm1(-m * chord), x) for m in mu]
    fitted = fit_effective_area(A, L, mu)
    end_on, side_on = direction_basis(jnp.float32(1), jnp.float32(0)), direction_basis(jnp.float32(0), jnp.float32(1))
    np.testing.assert_allclose(fitted @ np.asarray(end_on), np.pi * A * A * -np.expm1(-mu * L), rtol=0.002)
    np.testing.assert_allclose(fitted @ np.asarray(side_on), side, rtol=0.003)


def test_fit_between_is_within_one_percent() -> None:
    mu = np.geomspace(15.0, 3000.0, 7)
    fitted = fit_effective_area(A, L, mu)
    for u in np.cos(np.linspace(0.02, 1.55, 9)):
        basis = np.asarray(direction_basis(jnp.float32(u), jnp.float32(np.sqrt(1 - u * u))))
        np.testing.assert_allclose(fitted @ basis, absorbing_area(A, L, float(u), mu), rtol=0.012)
