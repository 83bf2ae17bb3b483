"""Wind profile and Dryden gusts against MIL-F-8785C."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.physics import wind

FOOT = 0.3048


def test_profile_is_logarithmic_and_anchored_at_20_ft():
    at = lambda h: float(jnp.linalg.norm(wind.steady_wind(5.0, 0.3, h)))  # noqa: E731 - one line, used thrice
    assert at(20 * FOOT) == pytest.approx(5.0, rel=1e-6)
    assert at(20.0) == pytest.approx(5.0 * np.log(20.0 / (0.15 * FOOT)) / np.log(20 / 0.15), rel=1e-5)
    assert at(3 * FOOT) == pytest.approx(5.0 * np.log(3 / 0.15) / np.log(20 / 0.15), rel=1e-5)
    assert at(0.15 * FOOT) == at(0.0) == at(-3.0) == 0.0  # what lies on the ground
    calm, length = wind.gust_scales(10.0, 0.05)
    gusty, same = wind.gust_scales(10.0, 10 * FOOT)
    assert (np.asarray(calm) < 0.05 * np.asarray(gusty)).all()
    np.testing.assert_array_equal(length, same)


@pytest.mark.parametrize(
    ("bearing_deg", "towards"), [(0.0, [0, -1, 0]), (90.0, [-1, 0, 0]), (180.0, [0, 1, 0]), (270.0, [1, 0, 0])]
)
def test_wind_blows_from_its_bearing(bearing_deg, towards):
    blown = wind.steady_wind(1.0, np.radians(bearing_deg), 20 * FOOT)
    np.testing.assert_allclose(blown, towards, atol=1e-6)


def test_gust_scales_of_the_specification():
    # 100 ft above ground, 10 m/s at 20 ft.
    ratio = 0.177 + 0.0823
    sigma, length = wind.gust_scales(10.0, 100 * FOOT)
    np.testing.assert_allclose(sigma, [1.0 / ratio**0.4, 1.0], rtol=1e-5)
    np.testing.assert_allclose(length, [100 * FOOT / ratio**1.2, 100 * FOOT], rtol=1e-5)


def noise_of(key):
    return jax.random.normal(key, (wind.GUST_NOISE,))


def _series(dt, steps, batch, airspeed, height, speed=10.0):
    """Gust components [steps, batch, 3] in the wind's axes, divided by their standard deviations."""
    keys = jax.random.split(jax.random.key(3), batch)

    def one(key):
        def body(state, k):
            noise = noise_of(jax.random.fold_in(key, k))
            state = wind.gust_step(noise, state, speed_m_s=speed, height_m=height, airspeed_m_s=airspeed, dt=dt)
            return state, wind.gust_velocity(state, speed, jnp.pi * 1.5, height)  # blows to the east: u is x

        return jax.lax.scan(body, wind.gust_start(noise_of(jax.random.fold_in(key, 10**6))), jnp.arange(steps))[1]

    (horizontal, vertical), lengths = wind.gust_scales(speed, height)
    series = np.asarray(jax.jit(jax.vmap(one, out_axes=1))(keys), np.float64)
    return series / np.array([horizontal, horizontal, vertical]), np.asarray(lengths, np.float64)


def test_gusts_of_near_vehicles_are_correlated_as_the_dryden_model_says():
    """Along the line between them: exp(-r / L), for whichever direction; each by itself is as before."""
    lengths = np.array([60.0, 20.0])
    place = np.array([[0, 0, 0], [10, 0, 0], [0, 0, 20], [40, 40, 0], [600.0, 0, 0]])

    def body(state, key):
        draws = jax.random.normal(key, (wind.GUST_DRAWS,))
        noise = wind.gust_noise(draws, jnp.asarray(place, jnp.float32), jnp.asarray(lengths, jnp.float32))
        return state, noise

    _, noise = jax.jit(lambda k: jax.lax.scan(body, 0, k))(jax.random.split(jax.random.key(8), 60_000))
    noise = np.asarray(noise, np.float64)
    np.testing.assert_allclose(noise.mean(0), 0.0, atol=0.02)
    np.testing.assert_allclose(noise.var(0), 1.0, atol=0.03)
    apart = np.linalg.norm(place[:, None] - place[None], axis=-1)
    for part, length in ((slice(0, 3), lengths[0]), (slice(3, 5), lengths[1])):
        found = np.einsum("tik,tjk->ij", noise[..., part], noise[..., part]) / noise[..., part][:, 0].size
        np.testing.assert_allclose(found, np.exp(-apart / length), atol=0.02)
    between = np.einsum("tik,til->kl", noise, noise) / noise[..., 0].size
    np.testing.assert_allclose(between, np.eye(5), atol=0.02)


def test_rounding_of_a_place_is_not_felt_and_gusts_have_no_gradient_by_place():
    lengths = jnp.array([60.0, 20.0])
    place = jnp.array([[200.0, 150.0, 30.0]])

    def noise(key, at):
        return wind.gust_noise(jax.random.normal(key, (wind.GUST_DRAWS,)), at, lengths)

    keys = jax.random.split(jax.random.key(4), 3000)
    near = place * (1.0 + 1.2e-7)
    apart = jnp.abs(jax.vmap(noise, (0, None))(keys, near) - jax.vmap(noise, (0, None))(keys, place))
    assert float(apart.max()) < 2e-3
    slope = jax.grad(lambda at: jnp.sum(noise(keys[0], at)))(place)
    np.testing.assert_array_equal(slope, 0.0)


def test_gusts_have_the_dryden_variance_and_correlation():
    airspeed, height, dt = 10.0, 30.0, 0.1
    series, (long, short) = _series(dt, 400, 2000, airspeed, height)
    np.testing.assert_allclose(series.var(axis=(0, 1)), 1.0, atol=0.04)
    assert abs(series.mean()) < 0.02
    for lag in (5, 20, 50):
        found = (series[lag:] * series[:-lag]).mean(axis=(0, 1))
        passed = airspeed * lag * dt / np.array([long, long, short])
        # Longitudinal and transverse correlation of the Dryden spectra.
        expected = np.exp(-passed) * np.array([1.0, 1 - passed[1] / 2, 1 - passed[2] / 2])
        np.testing.assert_allclose(found, expected, atol=0.05)
    cross = (series[..., 0] * series[..., 1]).mean()
    assert abs(cross) < 0.03


@pytest.mark.parametrize("passed", [1e-5, 1e-3, 0.02, 0.3])
def test_second_order_filter_is_discretised_exactly(passed):
    noise = np.stack([np.asarray(wind._second_order(jnp.zeros(2), jnp.float32(passed), jnp.eye(2)[i])) for i in (0, 1)])
    found = noise.T.astype(np.float64) @ noise.astype(np.float64)
    s = np.linspace(0.0, passed, 4001)
    response = np.exp(-s) * np.stack([np.ones_like(s), s])  # exp(A s) B
    expected = np.trapezoid(response[:, None] * response[None], s)
    np.testing.assert_allclose(found, expected, rtol=2e-4)
    decay = np.stack([np.asarray(wind._second_order(jnp.eye(2)[i], jnp.float32(passed), jnp.zeros(2))) for i in (0, 1)])
    np.testing.assert_allclose(decay.T, np.exp(-passed) * np.array([[1, 0], [passed, 1]]), rtol=1e-6)


def test_gusts_are_keyed_and_die_in_calm():
    start = wind.gust_start(noise_of(jax.random.key(1)))
    step = lambda key: wind.gust_step(  # noqa: E731 - one call, three keys
        noise_of(jax.random.key(key)), start, speed_m_s=5.0, height_m=20.0, airspeed_m_s=5.0, dt=0.01
    )
    same, other = step(1), step(2)
    np.testing.assert_array_equal(step(1).across, same.across)
    assert float(other.along) != float(same.along)
    np.testing.assert_array_equal(wind.gust_velocity(same, 0.0, 1.0, 20.0), 0.0)
