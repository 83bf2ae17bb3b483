"""Who gives way in one mission: waiting and stepping aside."""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree
from swarmsim.world.neighbours import DENSE_MAX, WINDOW, Candidates, candidates, cleared, dot, norm, root

LOOK_AHEAD_S = 2.0  # to brake from 5 m/s and step aside by 3 m with an acceleration of 4 m/s²
SLOW_M_S = 0.1  # a slower multirotor near the ground counts as standing there
SPEED_MAX_M_S = 15.0  # the look-ahead is complete up to this speed
PUSH_FROM_M = 1.0  # height above ground where stepping aside sets in ...
PUSH_FULL_M = 3.0  # ... and where it is complete
ASIDE_S = 0.4  # time constant of stepping aside: see `kept_aside`
BACK_S = 1.5  # time constant of coming back
RELEASE = 1.5  # times the separation is what one that waits wants ahead of it
HOLD_SHARE = 0.2  # of the separation: one pushed further than this waits until it has come back
ENCOUNTERS = 8  # at most this many, the nearest, are stepped aside for at a time
SIDE_SHARE = 0.1  # of the separation: bias to one side, which resolves an encounter head on
CLIMB_SHARE = 0.3  # of the separation: bias up, or down where the other is above
_RANKS = 2**22  # more than any rank; sums are exact in float32


@pytree
class Traffic:
    """What the other vehicles ask of each one."""

    hold: jax.Array  # [V] bool: wait, another has the right of way
    push_m: jax.Array  # [V, 3] m, displacement of the reference away from the others, world; multirotors in flight
    nearest_m: jax.Array  # [V] m, distance in 3-D of the nearest other; inf where none is within the separation
    overflow: jax.Array  # [] bool: a window was too small, so that somebody may have been missed


@pytree
class _Fleet:
    """What the rules know of each vehicle; axis V."""

    position_m: jax.Array  # [V, 3]
    velocity_m_s: jax.Array  # [V, 3]
    precedence: jax.Array  # [V] int32: of two that meet the lower one goes first
    gap_m: jax.Array  # [V] separation from its kind
    margin: jax.Array  # [V] on the separation, when looking ahead
    flies: jax.Array  # [V] bool
    active: jax.Array  # [V] bool
    roams: jax.Array  # [V] bool: active, and no multirotor that stands on the ground


def right_of_way(
    position_m: jax.Array,
    velocity_m_s: jax.Array,
    *,
    height_m: jax.Array,
    flies: jax.Array,
    active: jax.Array,
    rank: jax.Array,
    radius_m: jax.Array,
    separation_m: jax.Array,
    ground_separation_m: jax.Array,
    held: jax.Array | None = None,
    near: Candidates | None = None,
    window: int = WINDOW,
    dense_max: int = DENSE_MAX,
) -> Traffic:
    """Who waits, and who steps aside.

    Precedence. Multirotors yield to multirotors, rovers to rovers. Of two multirotors one in flight (more than
    ``PUSH_FROM_M`` above ground) goes before one on the ground; of two alike the lower rank goes first. This is a
    total order, so the first of any crowd never waits, ends its task and leaves the way to the next: there is no
    deadlock. By rank alone a vehicle would take off below another that has just been pushed over its pad.

    Waiting. A vehicle holds while one that precedes it is closer than the separation, or will be within
    ``LOOK_AHEAD_S``, whether that one goes on at its present velocity or stops where it is: nobody knows where another
    turns. It may so pass in front where it is fast enough, slows down to pass behind where it is not, and keeps a
    distance to one that it follows. Without looking ahead two vehicles of 5 m/s meet 0.6 s after they come within 6 m
    of each other, too late to give way.

    Stepping aside. A multirotor in flight that holds moves its reference away from the point of closest approach by
    the missing separation: across the other's way, not along it, with a bias upwards (downwards where the other is
    above) and to the other's right, which decides a meeting head on. All pushes together are at most one separation.
    They fade in between ``PUSH_FROM_M`` and ``PUSH_FULL_M`` above ground and never lead below the latter, so that
    nobody is pushed onto a neighbour's pad. Rovers only hold: one that stands in another's way is not avoided, which
    is left to the planner of their paths.

    Args:
        position_m: [V, 3] m, world ENU, middle of the collision cylinder. Non-finite: taken as absent.
        velocity_m_s: [V, 3] m/s, world.
        height_m: [V] m above ground, 0 where it stands.
        flies: [V] bool, multirotors; the others are rovers.
        active: [V] bool, under way: its task has begun and not ended. One that waits for a later phase is not.
        rank: [V] int32, distinct, from 0 to 2²² - 1.
        radius_m: [V] m, of the collision cylinders.
        separation_m: [] m, between multirotors, 3-D.
        ground_separation_m: [] m, between rovers, 3-D.
        held: [V] bool, which were told to wait before: they set out only where the look-ahead leaves `RELEASE` times
            the separation, or they would set out into the way of what is about to pass. None: nobody.
        near: pairs with all that are within `reach_of`; they are searched for if not given.
        window, dense_max: see `neighbours`.

    Returns:
        Traffic, exact unless ``overflow`` is set; a push counts the nearest ``ENCOUNTERS`` that have the right of way
        (of a cell list: within the separation, and as many beyond).
    """
    place, usable = cleared(position_m)
    moving = usable & active
    known = jnp.all(jnp.isfinite(velocity_m_s), axis=-1) & moving
    height = jnp.where(jnp.isfinite(height_m), height_m, 0.0)
    flying = flies & (height > PUSH_FROM_M)
    velocity = jnp.where(known[:, None], velocity_m_s, 0.0)
    pace = jnp.minimum(norm(velocity), SPEED_MAX_M_S)
    fleet = _Fleet(
        position_m=place,
        velocity_m_s=velocity,
        precedence=(rank + jnp.where(flying, 0, _RANKS)).astype(jnp.int32),
        gap_m=jnp.where(flies, separation_m, ground_separation_m),
        margin=jnp.ones_like(radius_m) if held is None else jnp.where(held, RELEASE, 1.0),
        flies=flies,
        active=moving,
        roams=moving & (flying | ~flies | (pace > SLOW_M_S)),
    )
    reach = reach_of(usable, radius_m, fleet.gap_m)
    if near is None:
        near = candidates(place, usable, usable, reach, window, dense_max)
    dense = near.index is None
    index, valid = _yields(fleet, near, close=True, coming=dense)
    overflow = near.overflow
    if not dense:
        # Looking ahead reaches further. A list of its own, without those that stand on closely spaced pads, keeps the
        # windows short.
        ahead = reach + 2.0 * LOOK_AHEAD_S * jnp.max(pace, initial=0.0)
        far = candidates(place, moving, fleet.roams, ahead, window, dense_max)
        more = _yields(fleet, far, close=False, coming=True)
        index, valid = (jnp.concatenate(x, axis=1) for x in zip((index, valid), more, strict=True))
        overflow = overflow | far.overflow
    return Traffic(
        hold=jnp.any(valid, axis=1),
        push_m=_limited(_push(fleet, index, valid), height, flies, separation_m),
        nearest_m=_nearest(fleet, near),
        overflow=overflow,
    )


def reach_of(usable: jax.Array, radius_m: jax.Array, gap_m: jax.Array) -> jax.Array:
    """Distance [] m within which vehicles [V] may touch, or be closer than their separation ``gap_m`` [V]."""
    widest = jnp.max(jnp.where(usable, radius_m, 0.0), initial=0.0)
    return jnp.maximum(jnp.max(gap_m, initial=0.0), 2.0 * widest)


def kept_aside(
    push_m: jax.Array, wanted_m: jax.Array, height_m: jax.Array, flies: jax.Array, separation_m: jax.Array, dt: float
) -> tuple[jax.Array, jax.Array]:
    """The push that vehicles are given, from the push given before and the one that `right_of_way` wants now.

    What is wanted falls as a vehicle steps aside, to nothing where it is aside: obeyed at once it would lead the
    vehicle back into the other's way, over and over. A leaky integral holds it aside until the other has passed: it
    comes to rest with ``BACK_S / (BACK_S + ASIDE_S)`` of the separation in place of one half, and then comes back
    within ``BACK_S``.

    Args:
        push_m: [V, 3] m, given at the last judgement.
        wanted_m: [V, 3] m, of `right_of_way`.
        height_m, flies, separation_m: as of `right_of_way`.
        dt: time between two judgements, s.

    Returns:
        Push [V, 3], and which vehicles [V] are so far aside that they wait.
    """
    push = push_m * jnp.exp(-dt / BACK_S) + (dt / ASIDE_S) * wanted_m
    push = _limited(push, jnp.where(jnp.isfinite(height_m), height_m, 0.0), flies, separation_m)
    return push, dot(push, push) > (HOLD_SHARE * separation_m) ** 2


def _nearest(fleet: _Fleet, near: Candidates) -> jax.Array:
    """Distance [V] m of the nearest other one within the separation; inf where there is none."""
    apart = fleet.position_m[:, None] - near.of(fleet.position_m)
    square = jnp.min(jnp.where(near.pair, dot(apart, apart), jnp.inf), axis=1, initial=jnp.inf)
    within = square <= jnp.max(fleet.gap_m, initial=0.0) ** 2
    return jnp.where(within, root(jnp.where(within, square, 0.0)), jnp.inf)


def _yields(fleet: _Fleet, near: Candidates, close: bool, coming: bool) -> tuple[jax.Array, jax.Array]:
    """The vehicles that each yields to: index [V, E], and whether there is one [V, E].

    They are the nearest, at most ``ENCOUNTERS``, of those within the separation (``close``) and of those that will be
    (``coming``).
    """
    fleet = jax.lax.stop_gradient(fleet)
    # Gathers from a long list of candidates are what costs time: all that is asked of the other stands in one row.
    # An inactive vehicle precedes nobody, and its kind is nobody's.
    kind = jnp.where(fleet.active, fleet.flies.astype(jnp.float32), -1.0)
    row = jnp.concatenate([fleet.position_m, kind[:, None], fleet.precedence[:, None].astype(jnp.float32)], axis=1)
    row = jnp.concatenate([row, fleet.velocity_m_s], axis=1) if coming else row
    mine, other = row[:, None], near.of(row)
    precedes = near.pair & fleet.active[:, None] & (other[..., 3] == mine[..., 3])
    precedes &= other[..., 4] < mine[..., 4]
    gap = fleet.gap_m[:, None] ** 2
    apart = mine[..., :3] - other[..., :3]
    square = dot(apart, apart)
    found = (square < gap) if close else jnp.zeros_like(precedes)
    if coming:
        both = _closest(apart, other[..., 5:] - mine[..., 5:])  # the other flies on ...
        alone = _closest(apart, -mine[..., 5:])  # ... or stops, as at a corner of its path
        room = gap * fleet.margin[:, None] ** 2
        meets = (dot(both, both) < room) | (dot(alone, alone) < room)
        found |= near.of(fleet.roams) & (square >= gap) & meets
    score = jnp.where(precedes & found, -square, -jnp.inf)
    if score.shape[1] <= ENCOUNTERS:
        slot = jnp.broadcast_to(jnp.arange(score.shape[1]), score.shape)
    else:
        score, slot = jax.lax.top_k(score, ENCOUNTERS)
    return near.named(slot), jnp.isfinite(score)


def _push(fleet: _Fleet, index: jax.Array, valid: jax.Array) -> jax.Array:
    """Sum [V, 3] of what each is to step aside for the vehicles ``index`` [V, E] that are ``valid`` [V, E]."""
    apart = fleet.position_m[:, None] - fleet.position_m[index]
    velocity = fleet.velocity_m_s[index]
    gap = fleet.gap_m[:, None]
    stopped = _closest(apart, velocity)
    step = jnp.where(valid, jnp.maximum(gap - norm(stopped), 0.0), 0.0)
    return jnp.sum(step[..., None] * _aside(stopped, velocity, gap[..., None]), axis=1)


def _closest(apart: jax.Array, velocity: jax.Array) -> jax.Array:
    """Offset [..., 3] from the other one when it is closest within the look-ahead, moving at a relative velocity."""
    time = dot(apart, velocity) / jnp.maximum(dot(velocity, velocity), 1e-6)
    return apart - jnp.clip(time, 0.0, LOOK_AHEAD_S)[..., None] * velocity


def _aside(offset: jax.Array, velocity: jax.Array, gap: jax.Array) -> jax.Array:
    """Unit vector [..., 3] away from the other one, with a bias where the offset [..., 3] gives no direction."""
    east, north, _ = jnp.moveaxis(jnp.broadcast_to(velocity, offset.shape), -1, 0)
    pace = jnp.sqrt(east * east + north * north + 1.0)
    up = CLIMB_SHARE * jnp.tanh(offset[..., 2] + 1.0)
    # The constant decides for one that hovers exactly above one that climbs.
    bias = jnp.stack([SIDE_SHARE * north / pace + 1e-3, -SIDE_SHARE * east / pace, up], axis=-1)
    away = offset + gap * bias
    return away / jnp.sqrt(jnp.sum(away**2, axis=-1, keepdims=True) + 1e-12)


def _limited(push: jax.Array, height: jax.Array, flies: jax.Array, separation: jax.Array) -> jax.Array:
    """The push [V, 3] at most one separation long, faded out towards the ground, and not leading down to it."""
    push = push * jnp.minimum(1.0, separation / jnp.maximum(norm(push), 1e-6))[:, None]
    lowest = -jnp.maximum(height - PUSH_FULL_M, 0.0)
    push = push.at[:, 2].set(jnp.maximum(push[:, 2], lowest))
    fade = jnp.clip((height - PUSH_FROM_M) / (PUSH_FULL_M - PUSH_FROM_M), 0.0, 1.0)
    return jnp.where(flies[:, None], fade[:, None] * push, 0.0)
