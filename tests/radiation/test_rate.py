"""Count rates against closed forms and published figures, dead time, Poisson draws."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.config.errors import InputError
from swarmsim.config.load import load_named
from swarmsim.config.radiation import DeadTime
from swarmsim.radiation import (
    Detector,
    Library,
    build_detector,
    draw_counts,
    line_rates,
    net_rate,
    observed_rate,
    restrict,
)
from swarmsim.radiation.attenuation import linear_attenuation
from swarmsim.radiation.rate import highest_rate, rate_showing, saturating_rate
from tests.radiation.points import MOUNT, point, through

UP, EAST = jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0])
Detectors = dict[tuple[str, str], Detector]


def at(detector: Detector, height: float, axis: jax.Array = UP, uncollided: bool = False, **metres: float) -> float:
    """Net rate above 170 MBq of Co-60, through air unless told otherwise."""
    lengths = through(detector, **(metres or {"air": height}))
    position = jnp.array([0.0, 0.0, height])
    return float(net_rate(detector, point(detector, "Co-60"), lengths, position, axis, uncollided=uncollided))


def test_physical_at_20_m(detectors: Detectors) -> None:
    """The reference figure, 34-35 cps net uncollided, and its neighbours; never tuned."""
    small = detectors["nai_1p5x1p5", "physical"]
    assert 34.0 < at(small, 20.0, EAST, uncollided=True) < 35.0
    assert 32.5 < at(small, 20.0, UP, uncollided=True) < 34.0
    # 1.30 photons for each unscattered one; the scattered ones are soft and counted nearly twice as often
    assert at(small, 20.0, EAST) == pytest.approx(1.60 * at(small, 20.0, EAST, uncollided=True), rel=0.03)


def test_3688_cps(detectors: Detectors) -> None:
    """End-on distance at which the 2 x 2 inch crystal counts 3688 cps with its background."""
    for kind, low, high in (("paper_ideal", 3.90, 4.00), ("physical", 3.00, 3.10)):
        detector = detectors["nai_2x2", kind]
        near, far = (float(observed_rate(detector, at(detector, distance))) for distance in (low, high))
        assert near > 3688 > far


def test_ideal_is_pure_geometry(detectors: Detectors) -> None:
    detector = detectors["nai_1p5x1p5", "paper_ideal"]
    photons = 170e6 * (0.9985 + 0.99983)
    side, end = 0.0381**2, np.pi / 4 * 0.0381**2
    front, face = np.pi / 8 * 0.01905, 0.01905  # how much nearer than the centre a side-on and an end-on crystal count
    for height in (5.0, 20.0, 100.0, 500.0):
        assert at(detector, height, EAST) == pytest.approx(
            photons * side / (4 * np.pi * (height - front) ** 2), rel=4e-3
        )
        assert at(detector, height, UP) == pytest.approx(photons * end / (4 * np.pi * (height - face) ** 2), rel=4e-3)


def test_walls_attenuate_by_line(library: Library, detectors: Detectors) -> None:
    """exp(-mu x) for each line, for both kinds; scattered photons come on top for the physical one alone."""
    for kind in ("physical", "paper_ideal"):
        detector = detectors["nai_2x2", kind]
        source, position = point(detector, "Co-60"), jnp.array([0.0, 0.0, 4.0])
        free, _ = line_rates(detector, source, through(detector), position, UP)
        direct, scattered = line_rates(detector, source, through(detector, concrete=0.2, steel=0.01), position, UP)
        for line, energy in enumerate((1173.23, 1332.49)):
            depth = 0.2 * linear_attenuation(library.material("concrete"), energy)
            depth += 0.01 * linear_attenuation(library.material("steel"), energy)
            assert float(direct[line] / free[line]) == pytest.approx(float(np.exp(-depth)), rel=1e-4)
        assert (float(jnp.sum(scattered)) > float(jnp.sum(direct))) == (kind == "physical")


def test_splitting_a_layer_changes_nothing_and_layers_build_up_together(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    whole = at(detector, 4.0, concrete=0.2)
    assert at(detector, 4.0, concrete=0.2, air=1e-6) == pytest.approx(whole, rel=1e-4)
    brick_in_concrete = at(detector, 4.0, concrete=0.1, brick=0.1 * 2300 / 1800)
    assert brick_in_concrete == pytest.approx(whole, rel=0.12)


def test_thick_walls_and_float32_limits(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    assert at(detector, 10.0, lead=5.0) == 0.0
    for nuclide in detector.nuclide_names:
        source = point(detector, nuclide, 1e15)
        for gap in (0.0, 1e-3, 0.1, 500.0):
            position = jnp.array([0.0, 0.0, 0.0254 + gap])
            lengths = through(detector, air=gap, concrete=gap)
            assert np.isfinite(float(net_rate(detector, source, lengths, position, UP)))


@pytest.mark.parametrize("kind", ["physical", "paper_ideal"])
@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (1.0, 0.0, 0.0)])
def test_float32_equals_float64(detectors: Detectors, kind: str, direction: tuple[float, float, float]) -> None:
    detector = detectors["nai_1p5x1p5", kind]
    distances = np.geomspace(0.02, 500.0, 24)
    rates = []
    for dtype in (jnp.float32, jnp.float64):
        with jax.enable_x64(dtype == jnp.float64):
            cast, source = (_as(dtype, tree) for tree in (detector, point(detector, "Eu-152")))
            axis, air = UP.astype(dtype), _as(dtype, through(detector, air=1.0))

            def rate(distance: jax.Array, cast=cast, source=source, axis=axis, air=air) -> jax.Array:
                way = replace(air, length_m=distance * air.length_m)
                return net_rate(cast, source, way, distance * jnp.asarray(direction, distance.dtype), axis)

            rates.append(np.asarray(jax.jit(jax.vmap(rate))(jnp.asarray(distances, dtype))))
    np.testing.assert_allclose(rates[0], rates[1], rtol=3e-4)


def _as(dtype: jnp.dtype, tree):
    return jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def test_superposition_and_linearity(detectors: Detectors) -> None:
    detector = detectors["nai_1p5x1p5", "physical"]
    position, lengths = jnp.array([3.0, 4.0, 5.0]), through(detector, air=7.07)
    rates = [float(net_rate(detector, point(detector, "Cs-137", a), lengths, position, UP)) for a in (1e6, 3e6, 0.0)]
    assert rates[1] == pytest.approx(3 * rates[0], rel=1e-5)
    assert rates[2] == 0.0


@pytest.mark.parametrize("kind", ["physical", "paper_ideal"])
@pytest.mark.parametrize("place", [(3.0, 1.0, 2.0), (12.0, -5.0, 20.0)])
def test_gradients(detectors: Detectors, kind: str, place: tuple[float, float, float]) -> None:
    detector = detectors["nai_2x2", kind]

    def rate(position: jax.Array, log_activity: jax.Array) -> jax.Array:
        source = point(detector, "Co-60")
        source = type(source)(position_m=position, activity_bq=1e8 * jnp.exp(log_activity), nuclide=source.nuclide)
        away = jnp.linalg.norm(position - jnp.array(place))
        way = through(detector, concrete=0.1)
        way = replace(way, length_m=way.length_m.at[0].set(away))
        return net_rate(detector, source, way, jnp.array(place), UP)

    origin = jnp.array([0.2, -0.1, 0.3])
    by_position, by_activity = jax.grad(rate, (0, 1))(origin, jnp.float32(0.1))
    assert float(by_activity) == pytest.approx(float(rate(origin, jnp.float32(0.1))), rel=1e-4)
    step = 0.02
    for k in range(3):
        move = step * jnp.eye(3)[k]
        finite = (rate(origin + move, jnp.float32(0.1)) - rate(origin - move, jnp.float32(0.1))) / (2 * step)
        small = 2e-3 * float(jnp.max(jnp.abs(by_position)))
        assert float(by_position[k]) == pytest.approx(float(finite), rel=0.01, abs=small)


def test_gradient_exists_on_the_axis_and_at_the_crystal(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]

    def rate(position: jax.Array) -> jax.Array:
        return net_rate(detector, point(detector, "Co-60"), through(detector, air=5.0), position, UP)

    for place in ((0.0, 0.0, 5.0), (5.0, 0.0, 0.0), (0.0, 0.0, 0.0254), (0.0, 0.0, 0.0)):
        assert np.all(np.isfinite(np.asarray(jax.grad(rate)(jnp.array(place)))))


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.6, 0.0, 0.8)])
def test_the_rate_is_steady_to_the_centre_of_the_crystal(
    detectors: Detectors, direction: tuple[float, float, float]
) -> None:
    """A source there has no direction, and counts as one beside it does."""
    d = detectors["nai_2x2", "physical"]
    distance = jnp.concatenate([jnp.zeros(1), jnp.geomspace(1e-8, 1e-3, 40)])
    axis, way = jnp.array([0.0, 0.0, 1.0]), through(d, air=0.0)
    rate = jax.jit(jax.vmap(lambda place: net_rate(d, point(d, "Cs-137"), way, place, axis)))
    found = np.asarray(rate(distance[:, None] * jnp.array(direction)))
    assert found.max() / found.min() < 1.6


def test_restrict_keeps_the_rate(detectors: Detectors) -> None:
    detector = detectors["nai_1p5x1p5", "physical"]
    alone = restrict(detector, ("Co-60",))
    assert alone.yields.shape == (1, 2)
    assert at(alone, 12.0) == pytest.approx(at(detector, 12.0), rel=1e-6)
    with pytest.raises(InputError, match="Co-61"):
        restrict(detector, ("Co-61",))


def with_dead_time(library: Library, **law: object) -> Detector:
    spec = load_named("detectors", "nai_2x2").model_copy(update={"dead_time": DeadTime(**law)})
    few = Library(library.nuclides[:1], library.materials)
    return build_detector(spec, MOUNT, few, "paper_ideal")


def test_dead_time_laws(library: Library) -> None:
    tau, net = 5e-6, jnp.geomspace(1.0, 1e6, 40)
    true = np.asarray(net) + 167.0
    laws = {
        "none": ({}, true),
        "paralyzable": ({"paralyzable_us": 5.0}, true * np.exp(-true * tau)),
        "non_paralyzable": ({"non_paralyzable_us": 5.0}, true / (1 + true * tau)),
        "hybrid": (
            {"paralyzable_us": 5.0, "non_paralyzable_us": 2.0},
            true * np.exp(-true * tau) / (1 + true * 2e-6),
        ),
    }
    detectors = {model: with_dead_time(library, model=model, **taus) for model, (taus, _) in laws.items()}
    for model, (_, expected) in laws.items():
        np.testing.assert_allclose(observed_rate(detectors[model], net), expected, rtol=1e-5)
    detector = detectors["paralyzable"]
    rates = jnp.linspace(1e4, 6e5, 4001)
    best = int(jnp.argmax(observed_rate(detector, rates)))
    assert float(rates[best]) + 167 == pytest.approx(1 / tau, rel=0.01)
    assert float(observed_rate(detector, rates[best])) == pytest.approx(1 / (tau * np.e), rel=1e-4)
    assert float(observed_rate(detectors["non_paralyzable"], jnp.float32(1e9))) == pytest.approx(1 / tau, rel=1e-3)


def test_a_share_of_the_highest_rate_is_shown_at_the_lowest_rate_that_shows_it(library: Library) -> None:
    assert rate_showing(with_dead_time(library, model="none"), 0.75) == np.inf
    # 0.75 / tau is shown at 3 / tau
    counter = with_dead_time(library, model="non_paralyzable", non_paralyzable_us=5.0)
    assert rate_showing(counter, 0.75) == pytest.approx(3.0 / 5e-6, rel=1e-5)
    for taus in ({"paralyzable_us": 5.0}, {"paralyzable_us": 5.0, "non_paralyzable_us": 2.0}):
        counter = with_dead_time(library, model="hybrid" if len(taus) == 2 else "paralyzable", **taus)
        rate = rate_showing(counter, 0.75)
        assert rate < saturating_rate(float(counter.paralyzable_s), float(counter.non_paralyzable_s))
        shown = float(observed_rate(counter, jnp.float32(rate - float(counter.background_cps))))
        assert shown == pytest.approx(0.75 * highest_rate(counter), rel=1e-4)


def test_poisson_counts(detectors: Detectors) -> None:
    """Physical counts stand for the real time; the ideal kind draws Poisson(rate) whatever the real time is."""
    mean, period_s, n = 134.0, 0.09, 20_000
    keys = jax.random.split(jax.random.key(1), n)
    for kind, expected, seconds in (("physical", mean * period_s, period_s), ("paper_ideal", mean, 1.0)):
        detector = detectors["nai_1p5x1p5", kind]
        counts, exposure = jax.vmap(lambda k, d=detector: draw_counts(d, k, jnp.float32(mean), period_s))(keys)
        assert np.allclose(exposure, seconds)
        sample = np.asarray(counts, np.float64)
        assert sample.mean() == pytest.approx(expected, abs=4 * np.sqrt(expected / n))
        assert sample.var() / sample.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / n))
        assert np.all(sample == np.round(sample))
    nothing, _ = draw_counts(detectors["nai_2x2", "physical"], keys[0], jnp.float32(0.0), jnp.float32(1.0))
    assert float(nothing) == 0.0


def test_mount_is_normalised(detectors: Detectors) -> None:
    detector = detectors["nai_2x2", "physical"]
    np.testing.assert_allclose(detector.mount_axis, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(detector.mount_position_m, MOUNT.position_m)


def test_kind_is_checked(library: Library) -> None:
    with pytest.raises(ValueError, match="paper_ideal"):
        build_detector(load_named("detectors", "nai_2x2"), MOUNT, library, "ideal")
