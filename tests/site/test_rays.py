"""Path lengths against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from yards import MATERIALS, make_site

from swarmsim.site import crossed, path_lengths
from swarmsim.site.rays import by_threads, crossed_from
from swarmsim.site.wall_network import COEFFICIENTS, OUTPUTS

CONCRETE = MATERIALS.index("concrete")
lengths_of, crossed_of = jax.jit(path_lengths), jax.jit(crossed)
gradients = jax.jit(
    jax.grad(lambda site, a, b: path_lengths(site, a, b) @ jnp.arange(1.0, len(MATERIALS) + 1.0), argnums=(1, 2))
)


def lengths(site, a, b):
    found = np.asarray(lengths_of(site, jnp.array(a, jnp.float32), jnp.array(b, jnp.float32)))
    return dict(zip(MATERIALS, found, strict=True))


def test_solid_box_across_its_middle_and_its_diagonal():
    site = make_site([((1.0, 2.0, 3.0), (2.0, 1.0, 0.5), 0.0, 0.0, "concrete")])
    assert lengths(site, (-20, 2, 3), (20, 2, 3))["concrete"] == pytest.approx(4.0, rel=1e-6)
    diagonal = np.array([2.0, 1.0, 0.5])
    middle = np.array([1.0, 2.0, 3.0])
    through = lengths(site, middle - 3 * diagonal, middle + 3 * diagonal)
    assert through["concrete"] == pytest.approx(2 * np.linalg.norm(diagonal), rel=1e-5)
    assert through["air"] == pytest.approx(4 * np.linalg.norm(diagonal), rel=1e-5)


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi / 2, 2.5])
def test_shell_counts_its_two_walls(yaw):
    site = make_site([((0.0, 0.0, 5.0), (4.0, 3.0, 5.0), yaw, 0.2, "brick")])
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    across = lengths(site, 20 * ahead + [0, 0, 5], -20 * ahead + [0, 0, 5])
    assert across["brick"] == pytest.approx(0.4, rel=1e-4)
    from_inside = lengths(site, (0, 0, 5), 20 * ahead + [0, 0, 5])
    assert from_inside["brick"] == pytest.approx(0.2, rel=1e-4)
    inside = lengths(site, (0, 0, 4), 2 * ahead + [0, 0, 4])
    assert inside["brick"] == 0.0


def test_shell_thicker_than_its_box_is_solid():
    site = make_site([((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.0, 1.5, "steel")])
    assert lengths(site, (-5, 0, 0), (5, 0, 0))["steel"] == pytest.approx(2.0, rel=1e-6)


def test_thin_wall_keeps_its_thickness_at_500_m():
    site = make_site([((0.0, 0.0, 0.0), (0.002, 50.0, 50.0), 0.0, 0.0, "steel")])
    assert lengths(site, (-250, 10, 3), (250, 10, 3))["steel"] == pytest.approx(0.004, rel=0.02)
    assert lengths(site, (-0.005, 0, 0), (0.005, 0, 0))["steel"] == pytest.approx(0.004, rel=1e-4)


def test_contact_of_a_centimetre():
    site = make_site([((40.0, 30.0, 1.0), (1.0, 1.0, 1.0), 0.0, 0.0, "concrete")])
    through = lengths(site, (38.995, 30, 1), (39.005, 30, 1))
    assert through["concrete"] == pytest.approx(0.005, rel=2e-3)
    assert sum(through.values()) == pytest.approx(0.01, rel=2e-3)


def slope_site(rise):
    return make_site(terrain=np.tile(rise * np.arange(-300.0, 301.0, 100.0), (7, 1)))


@pytest.mark.parametrize(
    ("a", "b"), [((-100, 0, 5), (100, 0, -3)), ((0, 0, 1), (3, 2, -1)), ((-200, 50, 20), (250, 60, 9))]
)
def test_ground_below_a_slope(a, b):
    """Below the plane z = 0.1 x: the share of the segment where z - 0.1 x < 0."""
    site = slope_site(0.1)
    above_a, above_b = a[2] - 0.1 * a[0], b[2] - 0.1 * b[0]
    assert above_a > 0 > above_b
    expected = -above_b / (above_a - above_b) * np.linalg.norm(np.subtract(b, a))
    assert lengths(site, a, b)["soil"] == pytest.approx(expected, rel=2e-3)


def test_ground_wholly_above_and_wholly_below():
    site = slope_site(0.0)
    assert lengths(site, (-5, 0, 0.5), (80, 3, 0.1))["soil"] == 0.0
    assert lengths(site, (-5, 0, -0.5), (7, 0, -0.5))["soil"] == pytest.approx(12.0, rel=1e-6)


def test_ground_length_is_continuous_in_the_end():
    """A hill's crossing moves smoothly with the ray: a finer sweep has smaller steps."""
    x = np.arange(-60.0, 61.0)
    site = make_site(terrain=np.tile(3.0 * np.exp(-((x / 8.0) ** 2)), (3, 1)), cell=1.0, origin=(-60.0, -1.0))
    heights = jnp.linspace(0.0, 6.0, 12_001)
    ends = jnp.stack([jnp.full_like(heights, 60.0), jnp.zeros_like(heights), heights], -1)
    soil = jax.jit(jax.vmap(path_lengths, (None, None, 0)))(site, jnp.array([-60.0, 0.0, 0.5]), ends)[
        :, MATERIALS.index("soil")
    ]
    assert soil[0] > 15.0
    assert float(soil[-1]) < 10.0
    steps, coarse = np.abs(np.diff(soil)).max(), np.abs(np.diff(soil[::10])).max()
    assert steps < 0.15
    assert steps < 0.25 * coarse


def test_overlapping_boxes_and_ground_never_exceed_the_distance():
    boxes = [((0, 0, 0), (3, 3, 3), 0.0, 0.0, "concrete"), ((1, 0, 0), (3, 3, 3), 0.3, 0.0, "brick")]
    site = make_site(boxes, terrain=np.full((7, 7), 2.0))
    found = lengths(site, (-2, 0, 0), (2, 0, 0))
    assert sum(found.values()) == pytest.approx(4.0, rel=1e-5)
    assert found["air"] == 0.0


BOXES = [
    ((0, 0, 0), (3, 2, 4), 0.3, 0.2, "brick"), ((2, 1, 0), (1, 1, 1), 0.0, 0.0, "steel"),
    ((-4, 3, 1), (2, 0.1, 3), 1.2, 0.0, "concrete"), ((0, -5, 2), (0.5, 4, 0.5), 0.0, 0.05, "wood"),
]  # fmt: skip
UNDULATING = make_site(BOXES, terrain=np.tile(np.sin(np.arange(-60, 61) / 5.0), (3, 1)), cell=1.0, origin=(-60.0, -1.0))
coordinate = st.one_of(st.integers(-6, 6).map(float), st.floats(-250, 250, width=32))
point = st.tuples(coordinate, coordinate, coordinate)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(a=point, b=point)
def test_properties_of_any_ray(a, b):
    """Finite, never negative, the sum is the distance, the same in both directions."""
    there = np.array(list(lengths(UNDULATING, a, b).values()))
    back = np.array(list(lengths(UNDULATING, b, a).values()))
    distance = float(np.linalg.norm(np.subtract(b, a)))
    assert np.isfinite(there).all()
    assert (there >= -1e-4).all()
    assert there.sum() == pytest.approx(distance, rel=1e-4, abs=1e-6)
    np.testing.assert_allclose(there, back, atol=2e-3 + 1e-4 * distance)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(a=point, b=point)
def test_box_lengths_equal_dense_sampling(a, b):
    site = make_site([BOXES[0]])
    t = (np.arange(20_000) + 0.5) / 20_000
    p = np.array(a) + t[:, None] * np.subtract(b, a)
    c, s = np.cos(0.3), np.sin(0.3)
    local = np.abs(np.stack([c * p[:, 0] + s * p[:, 1], c * p[:, 1] - s * p[:, 0], p[:, 2]], -1))
    matter = (local <= [3, 2, 4]).all(1) & ~(local <= [2.8, 1.8, 3.8]).all(1)
    distance = float(np.linalg.norm(np.subtract(b, a)))
    on_face = any(abs(x) in (2.0, 3.0, 4.0) for x in (a[2], b[2])) and a[2] == b[2]
    if not on_face:  # in the plane of a face, inside and outside are the same
        assert lengths(site, a, b)["brick"] == pytest.approx(matter.mean() * distance, abs=2e-3 + 3e-4 * distance)


@pytest.mark.parametrize("b", [(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (0.0, 0.0, -9.0), (4.0, -3.0, 2.0)])
def test_gradient_is_finite(b):
    for gradient in gradients(UNDULATING, jnp.zeros(3), jnp.array(b)):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize(("a", "b"), [((0, 0, -2), (5, 0, -2)), ((-5, 0, 2), (5, 0, 2)), ((-5, 2, 2), (5, 2, 2))])
def test_gradients_in_the_plane_of_a_face_can_be_used(a, b):
    """Where the length has none: a change of 0.1 mm decides whether the box is crossed."""
    site = make_site([((0, 0, 0), (2, 2, 2), 0.0, 0.0, "brick")])
    for gradient in gradients(site, jnp.array(a, jnp.float32), jnp.array(b, jnp.float32)):
        assert np.max(np.abs(gradient)) < 1e5


def test_how_low_the_lower_end_lies():
    """Above the ground below it, whichever end it is; a house high above the ground sees nothing of it."""
    site = make_site([((0, 0, 0), (3, 2, 4), 0.3, 0.0, "brick")], terrain=np.full((7, 7), 100.0))
    for height, expected in ((0.5, 1.0 / 1.0625), (2.0, 0.5), (20.0, 1.0 / 101.0)):
        one, other = jnp.array([0.0, 0.0, 100.0 + height]), jnp.array([30.0, 5.0, 130.0])
        for ends in ((one, other), (other, one)):
            assert float(crossed_of(site, *ends).shape.low) == pytest.approx(expected, rel=1e-3)


def test_gradient_equals_difference():
    site = make_site([((0, 0, 0), (3, 2, 4), 0.3, 0.0, "brick")])
    a, b = jnp.array([-10.0, 1.0, 1.0]), jnp.array([12.0, 0.5, 2.0])
    brick = MATERIALS.index("brick")
    gradient = jax.jit(jax.grad(lambda b: path_lengths(site, a, b)[brick]))(b)
    step = 0.05
    difference = [
        (lengths(site, a, b + step * e)["brick"] - lengths(site, a, b - step * e)["brick"]) / (2 * step)
        for e in jnp.eye(3)
    ]
    np.testing.assert_allclose(gradient, difference, atol=2e-3)


@pytest.mark.slow
def test_a_thread_for_each_segment_crosses_the_same():
    """The way of an accelerator, evaluated without one, for several beginnings at once."""
    rng = np.random.default_rng(2)
    site = make_site([
        ((*rng.uniform(-8.0, 8.0, 2), 1.0), (*rng.uniform(0.3, 3.0, 2), 1.5), rng.uniform(0.0, 3.0), wall, "concrete")
        for wall in (0.0, 0.1, 0.0, 0.2, 0.0)
    ])  # fmt: skip
    starts = jnp.asarray(np.c_[rng.uniform(-12.0, 12.0, (3, 2)), rng.uniform(0.3, 2.0, 3)], jnp.float32)
    ends = jnp.asarray(np.c_[rng.uniform(-12.0, 12.0, (40, 2)), rng.uniform(0.3, 15.0, 40)], jnp.float32)
    expected = jax.jit(jax.vmap(lambda a: crossed_from(site, a, ends)))(starts)

    def all_threads(site, starts):
        return jax.vmap(lambda a: by_threads(site, a, ends, platform="gpu, interpreted"))(starts)

    assert str(jax.make_jaxpr(all_threads)(site, starts)).count("pallas_call[") == 1
    found = jax.jit(all_threads)(site, starts)
    np.testing.assert_allclose(found.length_m, expected.length_m, atol=1e-4)
    np.testing.assert_allclose(found.place, expected.place, atol=1e-4)
    one_by_one = jax.jit(jax.vmap(lambda a: jax.vmap(lambda b: crossed(site, a, b))(ends)))(starts)
    for name in ("thin_m", "scattered", "closed", "walls", "ground"):
        for other in (found, one_by_one):
            np.testing.assert_allclose(getattr(other.shape, name), getattr(expected.shape, name), atol=2e-4)
    assert float(expected.length_m.max()) > 5.0
    assert float(expected.shape.scattered.min()) < -0.7


@pytest.mark.slow
@pytest.mark.parametrize("together", ["on lines", "anywhere"])
def test_clusters_that_are_left_out_are_not_crossed(together):
    """Many boxes, thin and long, hollow and solid, from places within and beside them: as of each segment alone."""
    rng = np.random.default_rng(7)
    site = make_site([
        ((*rng.uniform(-60.0, 60.0, 2), rng.uniform(0.0, 8.0)),
         10.0 ** rng.uniform(-1.3, 1.2, 3) * (1.0, 1.0, 0.3), rng.uniform(-3.0, 3.0), wall, "concrete")
        for wall in rng.choice([0.0, 0.0, 0.05, 0.2], 150)
    ])  # fmt: skip
    starts = np.c_[rng.uniform(-70.0, 70.0, (12, 2)), rng.uniform(0.2, 20.0, 12)]
    starts[:4] = site.obstacles.centre_m[:4]
    if together == "on lines":
        x, y = np.meshgrid(np.arange(-70.0, 70.0, 5.0), np.arange(-70.0, 71.0, 14.0))
        ends = np.c_[x.ravel(), y.ravel(), np.where(y.ravel() > 40.0, 0.5, 18.0)]
    else:
        ends = np.c_[rng.uniform(-70.0, 70.0, (300, 2)), 10.0 ** rng.uniform(-1.0, 1.5, 300)]
    ends[:3] = starts[:3]
    starts, ends = jnp.asarray(starts, jnp.float32), jnp.asarray(ends, jnp.float32)

    def rises(way):
        """Lengths, and their derivatives towards the north-east."""
        return jax.jvp(lambda a: way(a).length_m, (jnp.zeros(3),), (jnp.array([1.0, 1.0, 0.0]),))

    both = jax.jit(lambda: jax.lax.map(lambda a: rises(lambda d: crossed_from(site, a + d, ends)), starts))()
    alone = jax.jit(
        lambda: jax.vmap(lambda a: rises(lambda d: jax.vmap(lambda b: crossed(site, a + d, b))(ends)))(starts)
    )()
    np.testing.assert_allclose(both[0], alone[0], atol=1e-4)
    np.testing.assert_allclose(both[1], alone[1], atol=2e-3 * float(jnp.max(jnp.abs(alone[1]))))
    assert float(jnp.max(both[0][..., CONCRETE])) > 5.0
    crosses = jnp.mean(both[0][..., CONCRETE] > 0.0)
    assert 0.1 < float(crosses) < 1.0


@pytest.mark.slow
def test_an_end_that_is_no_number_hides_nothing_from_its_neighbours():
    site = make_site([((5.0, 0.0, 1.0), (0.5, 20.0, 3.0), 0.0, 0.0, "concrete")])
    ends = jnp.array([[10.0, y, 1.0] for y in np.linspace(-3.0, 3.0, 16)], jnp.float32)
    start, found = (
        jnp.array([0.0, 0.0, 1.0]),
        jax.jit(lambda b: crossed_from(site, jnp.array([0.0, 0.0, 1.0]), b).length_m),
    )
    expected = np.asarray(jax.vmap(lambda b: path_lengths(site, start, b))(ends))
    for nothing in (np.nan, np.inf):
        lengths = np.asarray(found(ends.at[7].set(nothing)))
        np.testing.assert_allclose(np.delete(lengths, 7, axis=0), np.delete(expected, 7, axis=0), atol=1e-5)
    assert expected[:, CONCRETE].min() > 0.9


@pytest.mark.slow
def test_what_is_wanted_is_crossed_as_if_all_were():
    site = make_site([((5.0, 0.0, 1.0), (0.5, 20.0, 3.0), 0.0, 0.0, "concrete")])
    start = jnp.array([0.0, 0.0, 1.0])
    ends = jnp.array([[10.0, y, 1.0] for y in np.linspace(-3.0, 3.0, 53)], jnp.float32)
    wanted = (jnp.arange(53) % 5 == 0) & ((jnp.arange(53) < 16) | (jnp.arange(53) >= 32))
    found = jax.jit(lambda wanted: crossed_from(site, start, ends, wanted))
    some, every = found(wanted), jax.jit(lambda: crossed_from(site, start, ends))()
    for one, other in zip(jax.tree.leaves(some), jax.tree.leaves(every), strict=True):
        np.testing.assert_allclose(np.asarray(one)[wanted], np.asarray(other)[wanted], rtol=1e-5, atol=1e-5)
    between = slice(16, 32)  # a block of its own
    assert np.all(np.asarray(some.length_m)[between] == 0.0)
    assert np.all(np.asarray(some.shape.scattered)[between] == 0.0)
    assert np.all(np.asarray(every.length_m)[between, CONCRETE] > 0.9)
    threads = jax.jit(lambda wanted: by_threads(site, start, ends, wanted, "gpu, interpreted"))(wanted)
    for one, other in zip(jax.tree.leaves(threads), jax.tree.leaves(every), strict=True):
        np.testing.assert_allclose(np.asarray(one)[wanted], np.asarray(other)[wanted], rtol=1e-4, atol=1e-4)
    assert np.all(np.asarray(threads.shape.scattered)[~wanted] == 0.0)


def share_of(shape):
    """Photons of 662 keV and a growth of 1, at each depth of a wall."""
    return np.exp(shape.scattered[::COEFFICIENTS])


def shape_of(site, a, b):
    way = crossed_of(site, jnp.array(a, jnp.float32), jnp.array(b, jnp.float32))
    return float(way.length_m[CONCRETE]), float(way.shape.thin_m[CONCRETE]), way.shape


def test_the_short_way_through_a_wall_and_what_is_seen_of_it():
    """A wall 0.2 m thick across the middle of a line of 10 m; wide, then ending where the line crosses it."""
    site = make_site([((0.0, 0.0, 0.0), (0.1, 200.0, 200.0), 0.0, 0.0, "concrete")])
    length, thin, shape = shape_of(site, (-5, 0, 0), (5, 0, 0))
    assert (length, thin) == (pytest.approx(0.2, rel=1e-4), pytest.approx(0.2, rel=1e-4))
    np.testing.assert_allclose(share_of(shape), 1.0, atol=0.02)
    assert (float(shape.closed), float(shape.walls)) == (0.0, 1.0)
    length, thin, oblique = shape_of(site, (-3, 4, 0), (3, -4, 0))  # at 53 degrees
    assert (length, thin) == (pytest.approx(1 / 3, rel=1e-4), pytest.approx(0.2, rel=1e-3))
    assert np.all(np.diff(share_of(oblique)[:4]) < 0.0)  # the thicker it is, the less comes through at an angle
    assert float(share_of(oblique)[3]) < 0.5
    ends = [share_of(shape_of(site, (-5, y, 0), (5, y, 0))[2]) for y in (199.99, 190.0)]
    np.testing.assert_allclose(ends[0], 0.5, atol=0.05)
    np.testing.assert_allclose(ends[1], 1.0, atol=0.05)


def test_a_line_out_of_a_building_knows_that_it_is_closed():
    site = make_site([((0.0, 0.0, 5.0), (4.0, 3.0, 5.0), 0.0, 0.2, "concrete")])
    inside, outside, behind = (1.0, 0.0, 5.0), (20.0, 12.0, 5.0), (-20.0, 0.0, 5.0)
    for a, b in ((inside, outside), (outside, inside)):
        length, thin, shape = shape_of(site, a, b)
        assert length > 0.2
        assert thin == pytest.approx(0.2, rel=1e-3)
        assert float(shape.closed) == pytest.approx(1.0, rel=1e-4)
        assert float(shape.walls) == pytest.approx(1.0, rel=1e-4)
    _, thin, shape = shape_of(site, behind, (20.0, 2.0, 5.0))
    assert thin == pytest.approx(0.4, rel=1e-3)
    assert (float(shape.closed), float(shape.walls)) == (0.0, pytest.approx(2.0, rel=1e-4))
    _, _, shape = shape_of(site, (0.0, 20.0, 5.0), (20.0, 20.0, 5.0))
    assert (shape.scattered.tolist(), float(shape.closed), float(shape.walls)) == ([0.0] * OUTPUTS, 0.0, 1.0)


def test_the_mirror_image_of_the_ground():
    site = make_site(terrain=np.full((7, 7), 2.0))
    found = crossed_of(site, jnp.array([0.0, 0.0, 3.0]), jnp.array([4.0, 0.0, 6.0])).shape.ground
    ratio, u = 25.0 / 41.0, 5.0 / np.sqrt(41.0)
    np.testing.assert_allclose(found, [ratio * np.sqrt(u), ratio * u], rtol=1e-5)
    below = crossed_of(site, jnp.array([0.0, 0.0, 1.0]), jnp.array([4.0, 0.0, 1.5])).shape.ground
    np.testing.assert_allclose(below, 0.0, atol=1e-6)
