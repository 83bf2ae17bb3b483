"""Sources beside one another: one that is rather two, two that are rather one, and two nuclides in one place.

What a fit of one source has between two is hard to see afterwards: every window's rate has an error of the model of its
own, and these take up what one source cannot explain, in the open at 4 m up to a factor of three. No further source has
anything left to explain then. But errors of the model that are all of that size are themselves unlikely, and tell that
something is wrong (`strain`); and two sources fitted together explain the counts without them (`divided`).

What windows' rates depart from the model by is one factor for all that a window sees. A source that is sought beside
one of another nuclide that stands at a wrong place follows it there, for then the same factors explain both: two
nuclides in one place, of which the survey from the air knew the places to metres, are sought together (``mixed``).

On the other hand what the model does not know of walls about a strong source looks like a weak one beside it. That is
taken away, and what it said of place and activity counts as an error of the other (`joined`).
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.device import each, for_those, repeat_while
from swarmsim.estimation.fit import FLAT
from swarmsim.estimation.forward import Problem, silent, variance_of
from swarmsim.estimation.likelihood import height_precision, position_of, scaled_inverse
from swarmsim.estimation.normal_equations import LOOSE, Others, joint_equations, linearised, normal_equations
from swarmsim.estimation.search import FARTHEST, GOLDEN_ANGLE_RAD, TOGETHER, Tried, attempt, bounds, mirrored_place
from swarmsim.estimation.state import Sources, State, ratios, settled, without
from swarmsim.pytree import pytree

SIDES_M = (1.0, 2.0, 4.0)  # of two of about the same strength, from where one was found: on either side of it
AWAY_M = (3.0, 5.5, 9.0)  # of a weaker one, from where the stronger was found
DIRECTIONS = 12
FAR_MIXED_M = 8.0  # from where two of different nuclides were found, within which both are looked for in one place
AROUND_M = 2.0  # within which the places of both are changed by the same, in the first round
APART = 0.5  # of that, within which that of the second is changed besides
UP_STDS = 1.5  # standard deviations of a height, within which both are changed
CLOSER = 0.65  # the same in a further round, over that in the one before
ROUNDS = 13
ALONG = 8  # of the places of a round the first that do not lie along what the counts leave open
OVER = (1.0, 0.8)  # of the way to the other side, for either: where vehicles circle a source it is less far
PART = 18  # pairs of places that are tried in a step
# fractional parts of multiples of these fill six dimensions evenly: powers of the root of x^7 = x + 1 (as in
# `swarmsim.estimation.importance_sampling`)
_EVEN = (0.8986537, 0.8075785, 0.7257334, 0.6521828, 0.5860865, 0.5266888)
ONE_M = 3.0  # within it two sources of one nuclide are told as one
COMPANION_M = 12.0  # within it the rates of two sources rise and fall together
COMPANION_RATIO = 0.15
"""Of the stronger one's likelihood ratio: what a companion has less than is an error of the model.

Such errors about sources in barns had 0.001 to 0.07, either of two equal sources in the open 2 and 4 m apart 0.8 to 1.
"""


@pytree
class Two:
    """Two sources in the place of one."""

    number: jax.Array  # [] int32 of that one
    slot: jax.Array  # [] int32 of the second
    offset_m: jax.Array  # [2, 3] of both from where the one was
    place: jax.Array  # [3] of the first
    first: Others  # what it adds [n, R], [n]
    second: Tried
    value: jax.Array  # [] likelihood of both, less the prior of the first one's height over that which it had


def strain(problem: Problem, state: State) -> tuple[jax.Array, jax.Array]:
    """Minus twice the log prior [] of what windows' rates depart from the model by, over that of no departure.

    With the right number of sources it is about 20 in a mission of 400 windows of which the model is right. The second
    is its mean [] where each window that tells departs by an error from that prior.
    """
    u, tail, valid = state.unknowns, problem.tail, problem.measurements.valid
    model = linearised(problem, silent(problem), state.added, jnp.zeros(3), u)
    relative = jnp.square(u.gain) / model.variance[1]
    at = normal_equations(problem, model, u)
    told = jnp.clip(1.0 - at.own[1, 1] * at.precision[1], 0.0, 1.0)
    digamma = jax.scipy.special.digamma
    usual = (tail + 1.0) * (digamma(0.5 * (tail + 1.0)) - digamma(0.5 * tail))
    each_ = (tail + 1.0) * jnp.log1p(relative / tail)
    return jnp.sum(jnp.where(valid, each_, 0.0)), usual * jnp.sum(jnp.where(valid, told, 0.0))


def divisible(s: Sources) -> jax.Array:
    """Whether [] there is room for one more, or two that may be placed anew."""
    return jnp.any(s.present) & (~jnp.all(s.present) | _nearest(s, jnp.array(False))[2])


def are_mixed(s: Sources) -> jax.Array:
    """Whether [] two of different nuclides stand within `COMPANION_M`."""
    return _nearest(s, jnp.array(True))[2]


def divided(problem: Problem, state: State, mixed: jax.Array) -> tuple[Two, State, jax.Array]:
    """Two sources in the place of one; the two nearest to one another, if they are near enough, are placed anew.

    With ``mixed`` [] only the two nearest of different nuclides are: from where they are, and from one place.

    Returns:
        the two, the state with the first of them, and twice the logarithm of the likelihood ratio [] over ``state``.
    """
    s = state.sources
    stronger, weaker, beside = _nearest(s, mixed)
    numbers, full = jnp.arange(s.present.shape[0]), jnp.all(s.present)
    pair = without(state, weaker)
    starts = _offsets()
    here = jnp.stack([jnp.zeros(3), (s.place[weaker] - s.place[stronger]).at[2].set(0.0)])
    changes = _around(problem, PART)
    in_one = [_in_one_place((starts.shape[0] - PART) // 2) + at for at in here]
    anew = jnp.where(mixed, jnp.concatenate([*in_one, here + changes]), here + _around(problem, starts.shape[0]))
    parts = starts.shape[0] // PART
    looks = parts * numbers.shape[0]

    def base(k: jax.Array) -> tuple[jax.Array, State]:
        """Whether [] the source ``k`` is one of a pair that is placed anew, and the state with that one alone."""
        again = beside & (k == stronger)
        return again, jax.tree.map(partial(jnp.where, again), pair, state)

    def along(best: Two, rest: State, now: jax.Array, reach_m: jax.Array) -> jax.Array:
        nothing = jnp.zeros((PART - ALONG, 2, 3))
        return for_those(now, lambda: _along(problem, rest, best, reach_m), lambda: nothing)

    def look(number: jax.Array, best: Two) -> Two:
        seeking = number < looks
        k = jnp.where(seeking, number // parts, best.number)
        again, rest = base(k)
        first = jnp.where(again, anew, starts).reshape(parts, PART, 2, 3)[number % parts]
        smaller = CLOSER ** (number - looks)
        near = (changes * smaller).at[ALONG:].set(along(best, rest, ~seeking, AROUND_M * smaller))
        offsets = jnp.where(seeking, first, best.offset_m + near)
        possible = again | ~(mixed | full | (beside & (k == weaker)))
        asked = jnp.where(seeking, s.present[k] & possible, best.value > -jnp.inf)
        slot = jnp.where(again, weaker, jnp.argmin(s.present)).astype(jnp.int32)
        nuclide, share = s.nuclide[jnp.where(again, weaker, k)], jnp.where(mixed, 1.0, 0.5)

        def best_of() -> Two:
            two = each(lambda x: _as_two(problem, rest, k, slot, share, nuclide, x), offsets, TOGETHER)
            found = jax.tree.map(lambda x: x[jnp.argmax(two.value)], two)
            return jax.tree.map(partial(jnp.where, found.value > best.value), found, best)

        return for_those(asked, best_of, lambda: best)

    zero = jnp.int32(0)
    shape = jax.eval_shape(lambda: _as_two(problem, state, zero, zero, jnp.float32(1.0), zero, starts[0]))
    nothing: Two = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    nothing = replace(nothing, value=-jnp.asarray(jnp.inf))
    two = jax.lax.fori_loop(0, looks + ROUNDS, look, nothing)
    k, rest = two.number, base(two.number)[1]
    sources = replace(
        rest.sources,
        place=rest.sources.place.at[k].set(two.place),
        activity_bq=rest.sources.activity_bq.at[k].multiply(jnp.where(mixed, 1.0, 0.5)),
    )
    added = Others(
        counts=rest.added.counts.at[k].set(two.first.counts), variance=rest.added.variance.at[k].set(two.first.variance)
    )
    with_first = replace(rest, sources=sources, added=added)
    return two, with_first, 2.0 * (two.value - state.likelihood)


def _nearest(s: Sources, mixed: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The two nearest of one nuclide, or of two if ``mixed``, the stronger and the weaker one [].

    And whether [] they are near enough to be placed anew.
    """
    apart = _apart_m(s, s.activity_bq, mixed)
    weaker, stronger = jnp.unravel_index(jnp.argmin(apart), apart.shape)
    return stronger, weaker, jnp.min(apart) < COMPANION_M


def _apart_m(s: Sources, strength: jax.Array, mixed: jax.Array | bool = False) -> jax.Array:
    """Distances [K, K] of each source from each of more ``strength`` [K] of its nuclide, or of others if ``mixed``.

    Infinite from all others.
    """
    apart = jnp.linalg.norm(s.place[:, None, :2] - s.place[:, :2], axis=-1)
    asked = ((s.nuclide[:, None] == s.nuclide) != mixed) & s.present[:, None] & s.present
    numbers = jnp.arange(strength.shape[0])
    less = (strength[:, None] < strength) | ((strength[:, None] == strength) & (numbers[:, None] > numbers))
    return jnp.where(asked & less, apart, jnp.inf)


def _around(problem: Problem, count: int) -> jax.Array:
    """Changes [count, 2, 3] of the places of two within `AROUND_M`: of both by the same, of the second besides."""
    up = jnp.minimum(UP_STDS * problem.height_std_m / AROUND_M, 1.0)
    share = jnp.mod((jnp.arange(count)[:, None] + 0.5) * jnp.array(_EVEN), 1.0)
    change = _flat(jnp.sqrt(share[:, :2]), 2.0 * jnp.pi * share[:, 2:4]).at[..., 2].set(up * (2.0 * share[:, 4:] - 1.0))
    both, second = change[:, 0] * AROUND_M, change[:, 1] * AROUND_M * APART
    return jnp.stack([both, both + second], axis=1)


def _along(problem: Problem, state: State, two: Two, reach_m: jax.Array) -> jax.Array:
    """Changes [`PART` - `ALONG`, 2, 3] of the places of ``two``, as far as the counts leave them open together.

    Within ``reach_m``, but for either on the other side of the way. The first is the Gauss-Newton step of both.
    """
    k, slot, second = two.number, two.slot, two.second
    u = replace(second.fit.unknowns, activity_bq=jnp.zeros(()))
    u = replace(u, others=u.others.at[slot].set(1.0))
    variance = variance_of(problem, position_of(problem.site, second.place)) + second.fit.rates.edge
    counts = second.fit.unknowns.activity_bq * second.fit.rates.counts
    added = Others(
        counts=state.added.counts.at[k].set(two.first.counts).at[slot].set(counts),
        variance=state.added.variance.at[k].set(two.first.variance).at[slot].set(variance),
    )
    places = state.sources.place.at[k].set(two.place).at[slot].set(second.place)
    model = linearised(problem, silent(problem), added, jnp.zeros(3), u)
    at = jax.vmap(lambda place: position_of(problem.site, place))(places)
    information, push = joint_equations(problem, model, u, at)
    both = (4 * jnp.stack([k, slot])[:, None] + jnp.arange(4)).reshape(8)
    precise = height_precision(problem.height_std_m)
    prior = jnp.array([FLAT, FLAT, precise, LOOSE] * 2)
    above = jnp.array([0.0, 0.0, precise, 0.0] * 2) * (places[both // 4, jnp.array([2] * 8)] - problem.height_m)
    covariance = scaled_inverse(information[both][:, both] + jnp.diag(prior))
    step = covariance @ (push[both] - above)
    moved = np.array([0, 1, 2, 4, 5, 6])
    covariance, step = covariance[moved][:, moved], jnp.clip(jnp.nan_to_num(step[moved]), -reach_m, reach_m)
    widest = jnp.sqrt(jnp.maximum(jnp.max(jnp.diagonal(covariance)), 1e-12))
    root = jnp.linalg.cholesky(covariance / jnp.square(widest) + 1e-4 * jnp.eye(6))
    share = jnp.mod((jnp.arange(PART - ALONG)[:, None] + 0.5) * jnp.array(_EVEN), 1.0)
    drawn = jax.scipy.special.ndtri(share) @ root.T * jnp.minimum(reach_m, FARTHEST * widest)
    drawn = drawn.at[0].set(step).reshape(-1, 2, 3)
    sides = _other_side(problem, (two.place, second.place), (two.first.counts, counts))
    return drawn.at[1 : 1 + sides.shape[0]].set(sides)


def _other_side(
    problem: Problem, places: tuple[jax.Array, jax.Array], counts: tuple[jax.Array, jax.Array]
) -> jax.Array:
    """Changes [4, 2, 3] that bring either of two to the other side of the way past it."""
    first, second = (
        mirrored_place(problem, place, jnp.sum(seen, axis=1)) - place
        for place, seen in zip(places, counts, strict=True)
    )
    still = jnp.zeros(3)
    over = jnp.stack([jnp.stack([first, still]), jnp.stack([still, second])])
    return jnp.concatenate([over * part for part in OVER])


def _in_one_place(count: int) -> jax.Array:
    """Places [count, 2, 3] of two in one place, from where one was found."""
    index = jnp.arange(count)
    way = _flat(FAR_MIXED_M * jnp.sqrt(index / count), GOLDEN_ANGLE_RAD * index)
    return jnp.stack([way, way], axis=1)


def _offsets() -> jax.Array:
    """Places [m, 2, 3] of the first and of the second source, from that of the one: m pairs of them."""
    way = _flat(jnp.ones(DIRECTIONS), 2.0 * jnp.pi * jnp.arange(DIRECTIONS) / DIRECTIONS)
    half = way[: DIRECTIONS // 2]
    sides = [jnp.stack([half, -half], axis=1) * side for side in SIDES_M]
    return jnp.concatenate(sides + [jnp.stack([jnp.zeros_like(way), way], axis=1) * away for away in AWAY_M])


def _flat(radius: jax.Array, angle: jax.Array) -> jax.Array:
    """Places [..., 3] around the origin, in its plane."""
    return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), jnp.zeros_like(radius)], axis=-1)


def _as_two(
    problem: Problem,
    state: State,
    k: jax.Array,
    slot: jax.Array,
    share: jax.Array,
    nuclide: jax.Array,
    offset_m: jax.Array,
) -> Two:
    """Source ``k`` [] as two, at so far [2, 3] from its place: with a ``share`` [] of its activity, and a second.

    The second is of ``nuclide`` [], and is to stand in ``slot`` [].
    """
    s, (low, high) = state.sources, bounds(problem)
    place = jnp.clip(s.place[k] + offset_m, low, high)
    nuclides = jnp.stack([s.nuclide[k], nuclide])

    def next_(number: jax.Array | int, carry: tuple[Others, Tried]) -> tuple[Others, Tried]:
        added, _ = carry
        tried = attempt(problem, nuclides[number], added, state.unknowns, place[number], fitted=number == 1)
        found = tried.fit.rates
        counts = added.counts.at[k].set(share * s.activity_bq[k] * found.counts)
        variance = variance_of(problem, position_of(problem.site, place[number])) + found.edge
        first = Others(counts=counts, variance=added.variance.at[k].set(variance))
        return jax.tree.map(partial(jnp.where, number == 0), first, added), tried

    shape = jax.eval_shape(lambda: attempt(problem, nuclide, state.added, state.unknowns, place[1]))
    nothing: Tried = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    # a loop, so that what lies between a place and the windows is compiled once
    added, second = jax.lax.fori_loop(0, 2, next_, (state.added, nothing))
    first = Others(counts=added.counts[k], variance=added.variance[k])
    above = jnp.square(place[0, 2] - problem.height_m) - jnp.square(s.place[k, 2] - problem.height_m)
    return Two(
        number=k.astype(jnp.int32),
        slot=slot,
        offset_m=place - s.place[k],
        place=place[0],
        first=first,
        second=second,
        value=second.fit.likelihood - 0.5 * height_precision(problem.height_std_m) * above,
    )


def joined(problem: Problem, state: State) -> tuple[State, jax.Array]:
    """The state without those that are companions of a source that explains more; and whether [] there is any.

    One is taken away after another, the one that is missed least first, and the others are fitted anew at their places:
    of two that stand for one another neither is missed.
    """
    before, number = state.sources, jnp.arange(state.sources.present.shape[0])

    def look(carry: _Joining) -> _Joining:
        s = carry.state.sources
        some = jnp.any(_apart_m(s, s.activity_bq) < COMPANION_M)
        ratio = for_those(some, lambda: ratios(problem, carry.state), lambda: jnp.zeros(number.shape))
        apart = _apart_m(s, ratio)  # [weaker, stronger]
        beside = (apart < ONE_M) | ((apart < COMPANION_M) & (ratio[:, None] < COMPANION_RATIO * ratio))
        asked = jnp.any(beside, axis=1)
        away = jnp.argmin(jnp.where(asked, ratio, jnp.inf))
        to = jnp.argmin(jnp.where(beside[away], apart[away], jnp.inf))

        def join() -> _Joining:
            stands_for = jnp.where(carry.stands_for == away, to, carry.stands_for)
            return _Joining(state=settled(problem, without(carry.state, away)), stands_for=stands_for, over=carry.over)

        return for_those(jnp.any(asked), join, lambda: replace(carry, over=jnp.array(True)))

    start = _Joining(state=state, stands_for=number, over=jnp.array(False))
    found = repeat_while(lambda carry: ~carry.over, look, start)
    # of each that is left those that it stands for, at the places and activities that they had
    beside = (found.stands_for[:, None] == number) & (number[:, None] != number) & before.present[:, None]
    some = jnp.any(beside)
    apart = jnp.linalg.norm(before.place[:, None, :2] - before.place[:, :2], axis=-1)
    sources = replace(
        found.state.sources,
        joined_m=jnp.max(jnp.where(beside, apart, 0.0), axis=0),
        beside_m=_about_mean(before, beside),
        # of those nearer it is the sum that the counts tell
        beside_bq=jnp.sum(jnp.where(beside & (apart > ONE_M), before.activity_bq[:, None], 0.0), axis=0),
    )
    return replace(found.state, sources=sources), some


@pytree
class _Joining:
    """How far companions have been taken away."""

    state: State
    stands_for: jax.Array  # [K] int32, the source that each is counted with: itself, if it is left
    over: jax.Array  # [] bool


def _about_mean(s: Sources, beside: jax.Array) -> jax.Array:
    """Root [K] of the second moment of each source and those ``beside`` it [K, K], by activity, about their mean."""
    activity = jnp.where(beside, s.activity_bq[:, None], 0.0)
    share = activity / jnp.maximum(s.activity_bq + jnp.sum(activity, axis=0), 1e-9)
    offset = s.place[:, None, :2] - s.place[:, :2]
    mean, second = jnp.einsum("ws,wsi->si", share, offset), jnp.einsum("ws,wsi->s", share, jnp.square(offset))
    return jnp.sqrt(jnp.maximum(second - jnp.sum(jnp.square(mean), axis=-1), 0.0))
