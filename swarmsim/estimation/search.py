"""Where the likelihood of a source is largest: a search of two stages, both from several starts.

1. Adam (optax) with a cosine-decayed step. Rays through walls and terrain cost a hundred times what the rest of the
   likelihood does, so the exact net rates r0, and the activity and the background that fit them best, are computed at
   the start of each segment of `SPREAD_M`; within one, r = r0 d0² / d² with d the distance to the crystal, the only
   part that changes quickly. What is held (attenuation, build-up, direction) changes r by a few per cent over the few
   metres of a segment, and is exact again at the next. The source is spread out at first, so that a start is not
   caught between windows close to the ground.
2. A pattern search with exact rates. Where walls throw shadows the likelihood is a ragged funnel: it rises towards
   the source over metres but has steps of several nats every half metre, over which no gradient leads. Points around
   the best ones so far, ever closer, find its bottom.
"""

import jax
import jax.numpy as jnp
import optax

from swarmsim.estimation.likelihood import (
    FIXED_STD_M,
    FitProblem,
    exact_rates,
    expected_counts,
    height_precision,
    observed_rates,
    poisson_log_likelihood,
    position_of,
    scaled_inverse,
)
from swarmsim.site import sample_with_gradient

Bounds = tuple[jax.Array, jax.Array]  # lower and upper [5]

# The first stage computes exact rates once per entry. Each entry is the length in m over which the source is taken to
# be spread: it turns 1/d² to 1/(d² + s²), without which a start outside the ring that a rover drove could not cross it.
SPREAD_M = (10.0, 5.0, 2.0, 0.0, 0.0, 0.0)
PROFILE_STEPS = 10  # Fisher steps for activity and background with the position held
LOG_ACTIVITY = (0.0, 34.5)  # 1 Bq to 1e15 Bq
LOG_SCALE = (-4.6, 4.6)  # 1 % to 100 times the nominal background
LOG_STEP = 1.0  # longest Fisher step of a logarithm
HEIGHT_REACH = 4.0  # the height is sought within this many of its standard deviations
# Adam moves every coordinate by about its rate per iteration: logarithms by these per metre of learning rate.
LOG_RATES = (0.3, 0.1)
OFFSPRING = 8  # points tried around each of the best ones in a round of the pattern search
LAST_REACH = 0.05  # of the first round's reach is that of the last
GOLDEN_ANGLE_RAD = 2.399963  # pi (3 - sqrt 5): points turned by it from one to the next never line up
GOLDEN_RATIO = 0.618034  # multiples of it modulo 1 fill an interval evenly


def bounds(problem: FitProblem) -> tuple[jax.Array, jax.Array]:
    """Lower and upper bounds [5] of theta."""
    site = problem.site
    ny, nx = site.terrain_m.shape
    extent = site.cell_m * jnp.array([nx - 1, ny - 1], jnp.float32)
    reach = HEIGHT_REACH * jnp.maximum(problem.height_std_m, FIXED_STD_M)

    def limits(corner: jax.Array, height: jax.Array, end: int) -> jax.Array:
        return jnp.concatenate([corner, height[None], jnp.array([LOG_ACTIVITY[end], LOG_SCALE[end]])])

    low = limits(site.origin_m, problem.height_m - reach, 0)
    return low, limits(site.origin_m + extent, problem.height_m + reach, 1)


def background_only(problem: FitProblem) -> tuple[jax.Array, jax.Array]:
    """Best log background scale [] without a source, and its log likelihood []."""
    m = problem.measurements
    none = jnp.zeros_like(m.counts)

    def step(_: int, log_scale: jax.Array) -> jax.Array:
        mean, slope = jax.jvp(lambda s: expected_counts(problem, none, s), (log_scale,), (jnp.ones_like(log_scale),))
        mean = jnp.maximum(mean, 1e-6)
        score = jnp.sum(jnp.where(m.valid, slope * (m.counts - mean) / mean, 0.0))
        information = jnp.sum(jnp.where(m.valid, slope * slope / mean, 0.0))
        return jnp.clip(log_scale + jnp.clip(score / jnp.maximum(information, 1e-12), -LOG_STEP, LOG_STEP), *LOG_SCALE)

    log_scale = jax.lax.fori_loop(0, 2 * PROFILE_STEPS, step, jnp.zeros(()))
    return log_scale, poisson_log_likelihood(m.counts, expected_counts(problem, none, log_scale), m.valid)


def profile(problem: FitProblem, rates: jax.Array, log_scale: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Best log activity and log scale [2] at a held position with net rates ``rates`` [n], and their covariance."""
    m = problem.measurements
    # Start where the source gives as much as the background to the windows that see it best.
    brightest = jnp.max(jnp.where(m.valid, rates, 0.0))
    level = observed_rates(problem.detectors, m, jnp.zeros_like(rates), jnp.ones(()))
    start = jnp.log(jnp.maximum(jnp.max(jnp.where(m.valid, level, 0.0)), 1.0) / jnp.maximum(brightest, 1e-20))

    Carry = tuple[jax.Array, jax.Array]

    def step(_: int, carry: Carry) -> Carry:
        v, _covariance = carry
        mean, jacobian = jax.jvp(lambda a: expected_counts(problem, jnp.exp(a) * rates, v[1]), (v[0],), (jnp.ones(()),))
        _, by_scale = jax.jvp(lambda s: expected_counts(problem, jnp.exp(v[0]) * rates, s), (v[1],), (jnp.ones(()),))
        mean = jnp.maximum(mean, 1e-6)
        j = jnp.where(m.valid, jnp.stack([jacobian, by_scale]), 0.0)
        f = (j / mean) @ j.T
        covariance = scaled_inverse(f)
        delta = covariance @ (j @ ((m.counts - mean) / mean))
        v = jnp.clip(v + jnp.clip(delta, -LOG_STEP, LOG_STEP), *jnp.array([LOG_ACTIVITY, LOG_SCALE]).T)
        return v, covariance

    first = jnp.stack([jnp.clip(start, *LOG_ACTIVITY), log_scale])
    return jax.lax.fori_loop(0, PROFILE_STEPS, step, (first, jnp.eye(2)))


def best_at(problem: FitProblem, place: jax.Array, log_scale: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Theta [5] with the activity and background that suit ``place`` [3] (x, y, height above the ground) best, its
    log posterior [], and the covariance [2, 2] of those two with the place held.
    """
    rates = exact_rates(problem, position_of(problem.site, place))
    nuisance, covariance = profile(problem, rates, log_scale)
    theta = jnp.concatenate([place, nuisance])
    value = _log_posterior(problem, theta, jnp.exp(theta[3]) * rates)
    return theta, jnp.where(jnp.isnan(value), -jnp.inf, value), covariance


def gradient_search(
    problem: FitProblem,
    bounds: Bounds,
    initial_xy: jax.Array,
    log_scale: jax.Array,
    learning_rate_m: jax.Array,
    iterations: int,
) -> jax.Array:
    """Theta [S, 5] at the end of Adam from each start [S, 2]; ``log_scale`` [] is where the background starts."""
    per_segment = -(-iterations // len(SPREAD_M))
    optimiser = optax.adam(optax.cosine_decay_schedule(1.0, per_segment * len(SPREAD_M), alpha=1e-3))
    height_rate = jnp.where(problem.height_std_m > FIXED_STD_M, jnp.minimum(problem.height_std_m, 1.0), 0.0)
    rate = learning_rate_m * jnp.concatenate([jnp.ones(2), height_rate[None], jnp.array(LOG_RATES)])

    low, high = bounds
    zero = jnp.zeros(initial_xy.shape[0])
    columns = (initial_xy[:, 0], initial_xy[:, 1], zero + problem.height_m, zero, zero + log_scale)
    theta = jnp.clip(jnp.stack(columns, axis=-1), low, high)
    gradient = jax.vmap(jax.grad(_held_loss), (0, 0, 0, None, None))

    Carry = tuple[jax.Array, optax.OptState]

    def segment(carry: Carry, spread: jax.Array) -> tuple[Carry, None]:
        strength = jax.lax.map(lambda t: _strength(problem, t), carry[0])
        rates = jax.vmap(lambda t, s: s / (_squared_distance(problem, t, t) + spread**2))(carry[0], strength)
        anchor = carry[0].at[:, 3:].set(jax.vmap(lambda r: profile(problem, r, log_scale)[0])(rates))

        def iteration(carry: Carry, _: None) -> tuple[Carry, None]:
            theta, memory = carry
            update, memory = optimiser.update(gradient(theta, anchor, strength, spread, problem), memory)
            # A spread source's height would make up for the spread.
            step = jnp.where((jnp.arange(5) == 2) & (spread > 0.0), 0.0, rate * update)
            return (jnp.clip(theta + step, low, high), memory), None

        return jax.lax.scan(iteration, (anchor, carry[1]), None, length=per_segment)[0], None

    return jax.lax.scan(segment, (theta, optimiser.init(theta)), jnp.array(SPREAD_M))[0][0]


def _strength(problem: FitProblem, theta: jax.Array) -> jax.Array:
    """Net rate per becquerel times squared distance [n]: what changes slowly with the position."""
    return exact_rates(problem, position_of(problem.site, theta)) * _squared_distance(problem, theta, theta)


def _squared_distance(problem: FitProblem, theta: jax.Array, anchor: jax.Array) -> jax.Array:
    """Squared distance [n] in m² from ``theta`` to every crystal, on the tangent plane of the ground at ``anchor``."""
    ground, slope = sample_with_gradient(problem.site.terrain_m, problem.site, anchor[:2])
    place = jnp.append(theta[:2], ground + slope @ (theta[:2] - anchor[:2]) + theta[2])
    return jnp.maximum(jnp.sum((problem.measurements.position_m - place) ** 2, axis=-1), 1e-4)


def _held_loss(
    theta: jax.Array, anchor: jax.Array, strength: jax.Array, spread: jax.Array, problem: FitProblem
) -> jax.Array:
    """Negative log posterior [] at ``theta`` [5] with the strength [n] of ``anchor`` [5] and a source spread over m."""
    rates = strength / (_squared_distance(problem, theta, anchor) + spread**2)
    return -_log_posterior(problem, theta, jnp.exp(theta[3]) * rates)


def _log_posterior(problem: FitProblem, theta: jax.Array, net_cps: jax.Array) -> jax.Array:
    """Log posterior [] at ``theta`` [5] with the net rates ``net_cps`` [n]: the likelihood and the height's prior."""
    m = problem.measurements
    prior = 0.5 * height_precision(problem.height_std_m) * (theta[2] - problem.height_m) ** 2
    return poisson_log_likelihood(m.counts, expected_counts(problem, net_cps, theta[4]), m.valid) - prior


def pattern_search(
    problem: FitProblem, bounds: Bounds, candidates: jax.Array, log_scale: jax.Array, reach_m: jax.Array, rounds: int
) -> jax.Array:
    """The best theta [5] found around ``candidates`` [S, 5] in ``rounds`` rounds of reach from ``reach_m`` [] down.

    In each, `OFFSPRING` places around each of the S best so far are tried, with the activity and the background that
    suit them best; the S best of all stay.
    """
    low, high = bounds
    beam = candidates.shape[0]
    index = jnp.arange(beam * OFFSPRING)
    share = jnp.sqrt((index % OFFSPRING + 0.5) / OFFSPRING)

    def fit(place: jax.Array) -> tuple[jax.Array, jax.Array]:
        return best_at(problem, place, log_scale)[:2]

    def round_(best: tuple[jax.Array, jax.Array], k: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        reach = reach_m * LAST_REACH ** (k / max(rounds - 1, 1))
        turn = GOLDEN_ANGLE_RAD * (index + index.size * k)
        height = 2.0 * jnp.mod((index + index.size * k) * GOLDEN_RATIO, 1.0) - 1.0
        up = height * jnp.minimum(reach, 1.5 * problem.height_std_m)
        offset = jnp.stack([reach * share * jnp.cos(turn), reach * share * jnp.sin(turn), up], axis=-1)
        places = jnp.clip(jnp.repeat(best[0][:, :3], OFFSPRING, axis=0) + offset, low[:3], high[:3])
        tried = jax.lax.map(fit, places)
        everyone = [jnp.concatenate(pair) for pair in zip(best, tried, strict=True)]
        value, chosen = jax.lax.top_k(everyone[1], beam)
        return (everyone[0][chosen], value), None

    start = jax.lax.map(fit, candidates[:, :3])
    (theta, value), _ = jax.lax.scan(round_, start, jnp.arange(rounds))
    return theta[jnp.argmax(value)]
