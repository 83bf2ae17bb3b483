"""Where the posterior of a source may have modes besides the one that the search has found.

Between walls it has many, decimetres wide and metres apart. The screen (`swarmsim.estimation.screen`), one ray to a
window and no fit, agrees with fits to one or two in the logarithm within metres of the source: hundreds of places are
screened all around, and again, ever closer, about those that are likely (population Monte Carlo: Cappé, Guillin, Marin
and Robert, Journal of Computational and Graphical Statistics 13, 2004, 907).
"""

import jax
import jax.numpy as jnp

from swarmsim.device import each
from swarmsim.estimation.forward import Problem, with_one_ray
from swarmsim.estimation.likelihood import position_of
from swarmsim.estimation.normal_equations import Others, Unknowns
from swarmsim.estimation.pairs import COMPANION_M, ONE_M
from swarmsim.estimation.screen import Screen, looked_at, screen_of, screened
from swarmsim.estimation.search import GOLDEN_ANGLE_RAD, TOGETHER, attempt, bounds, mirrored_place, spread
from swarmsim.estimation.seek import as_known
from swarmsim.estimation.state import State
from swarmsim.estimation.weights import drawn_evenly, even_normals, flattened

SCOUTS = 384  # places that are screened at once
SCOUTED_M = 8.0  # two thirds of them within this distance of the source, the others up to three times as far
FAR_APART = 4.4  # so much farther apart are the others: two of three on a ninth of the area
HEIGHTS = 1.5  # standard deviations of the height within which they lie
CLOSER = 2  # times that as many are screened about the likely ones
SCATTER_M = 0.6  # standard deviation of their distance from those in each direction, `FAR_APART` times that far off
CLOSING_IN = 0.4  # the same each time over that of the time before
TRUST = 0.5  # power of what the screen finds: it is off by one to two
LIKELY_SCOUTS = 32.0  # weights of places are flattened until they count as this many
MOVES = 4  # Gauss-Newton steps of the place towards the mode beyond the way; the best of their places is taken
LONGEST_MOVE_M = 1.0
PLACES_BESIDE = 24  # around a source, at which another one of its nuclide is thought of
SHARE_BESIDE = 0.1  # of them, at which it may go unnoticed


def modes_around(
    problem: Problem, state: State, k: jax.Array, others: Others, u: Unknowns, count: int
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Likely places [count, 3] of source ``k``, in all of its modes; and what is known of another one beside it.

    The latter is the information [] (1/Bq^2) that the counts have about the activity of a source of its nuclide at
    least `ONE_M` and at most `COMPANION_M` off, at nine of ten places.
    """
    place, nuclide, limits = state.sources.place[k], state.sources.nuclide[k], bounds(problem)
    best = as_known(problem, state, k, jnp.array(False)).fit
    screen = screen_of(problem, others, best.rates, nuclide, position_of(problem.site, place), best.unknowns)
    quick = with_one_ray(problem)
    across = _beyond_the_way(problem, state, k, others, u)
    ring = jnp.clip(place + _ring(), *limits)
    _, told = each(lambda x: looked_at(quick, screen, nuclide, x), ring, TOGETHER)
    likely = _scouted(quick, screen, nuclide, place, across, count)
    return likely, jnp.sort(told)[int(SHARE_BESIDE * PLACES_BESIDE)]


def _scouted(
    problem: Problem, screen: Screen, nuclide: jax.Array, place: jax.Array, across: jax.Array, count: int
) -> jax.Array:  # fmt: skip
    """Likely places [count, 3] around ``place`` [3] and ``across`` [3] the way from it, by the screen."""
    limits, up_m = bounds(problem), HEIGHTS * problem.height_std_m
    around = spread(place, jnp.asarray(SCOUTED_M), up_m, SCOUTS, jnp.zeros(()))
    far = jnp.linalg.norm((around - place)[:, :2], axis=1) > SCOUTED_M
    # the place beyond the way is one of its own, wherever it is
    apart = jnp.where(far, FAR_APART, 1.0).at[-1].set(1.0)
    trust = TRUST * problem.learning_rate

    def scattered(apart: jax.Array, scale: jax.Array) -> jax.Array:
        """Standard deviations [SCOUTS, 3] of the places that are drawn about others, ``apart`` [SCOUTS] from these."""
        wide = SCATTER_M * jnp.stack([apart, apart, jnp.ones(SCOUTS)], axis=1)
        return scale * jnp.minimum(wide, jnp.stack([jnp.inf, jnp.inf, up_m]))

    def step(
        known: tuple[jax.Array, jax.Array, jax.Array], draws: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        """From places and the logarithms of the density that they were drawn from, to those drawn about likely ones."""
        (places, apart, log_density), (normal, scale) = known, draws
        log_posterior = trust * each(lambda x: screened(problem, screen, nuclide, x), places, TOGETHER)
        weight, std_m = flattened(log_posterior - log_density, LIKELY_SCOUTS), scattered(apart, scale)
        chosen = drawn_evenly(weight, SCOUTS)
        drawn = jnp.clip(places[chosen] + std_m[chosen] * normal, *limits)
        off = jnp.sum(jnp.square((drawn[:, None] - places) / std_m), axis=-1)
        of_each = jnp.log(weight) - jnp.sum(jnp.log(std_m), axis=1)
        log_density = jax.scipy.special.logsumexp(of_each - 0.5 * off, axis=1)
        return (drawn, apart[chosen], log_density), (places, weight)

    draws = even_normals(CLOSER + 1, SCOUTS), CLOSING_IN ** jnp.arange(CLOSER + 1.0)
    start = jnp.clip(around.at[0].set(place).at[-1].set(across), *limits), apart, -2.0 * TRUST * jnp.log(apart)
    places, weight = jax.tree.map(lambda x: x[-1], jax.lax.scan(step, start, draws)[1])
    return places[drawn_evenly(weight, count)]


def _beyond_the_way(problem: Problem, state: State, k: jax.Array, others: Others, u: Unknowns) -> jax.Array:
    """The place [3] of source ``k`` were it on the other side of the way from which most of it was heard."""

    def nearer(_: int, at: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        place, best, value = at
        fit = attempt(problem, s.nuclide[k], others, u, place).fit
        step = jnp.clip(jnp.nan_to_num(fit.move), -LONGEST_MOVE_M, LONGEST_MOVE_M)
        return place + step, jnp.where(fit.value > value, place, best), jnp.maximum(fit.value, value)

    s = state.sources
    mirrored = mirrored_place(problem, s.place[k], jnp.sum(state.added.counts[k], axis=1))
    return jax.lax.fori_loop(0, MOVES, nearer, (mirrored, mirrored, -jnp.asarray(jnp.inf)))[1]


def _ring() -> jax.Array:
    """Offsets [`PLACES_BESIDE`, 3] to another source beside one, evenly over the area."""
    index = jnp.arange(PLACES_BESIDE)
    radius = jnp.sqrt(ONE_M**2 + (COMPANION_M**2 - ONE_M**2) * (index + 0.5) / PLACES_BESIDE)
    angle = GOLDEN_ANGLE_RAD * index
    return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), jnp.zeros(PLACES_BESIDE)], axis=-1)
