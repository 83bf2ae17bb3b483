"""Land on a rover that drives: approach it by what it broadcasts, follow it above, touch down, and stay."""

from typing import Any

import jax
import jax.numpy as jnp

from swarmsim.config.policies import LandOn
from swarmsim.config.vehicles import SkidSteer
from swarmsim.control.commands import PositionCommand
from swarmsim.physics.rotations import yaw_of
from swarmsim.policies.protocol import Assignment
from swarmsim.policies.registry import register
from swarmsim.policies.view import Task, View
from swarmsim.pytree import on_host, pytree
from swarmsim.site import sample
from swarmsim.vehicles.skid_steer import skid_steer_params
from swarmsim.world.build import deck_of
from swarmsim.world.radio import Heard

LOST_S = 1.0  # a rover that was last heard longer ago is lost: its way is not predicted any further
NEVER_S = -1e6  # when a rover that was never heard was heard
TURN_S = 0.25  # time constant of the rover's estimated acceleration
ACCELERATION_MAX_M_S2 = 2.0  # a larger estimate is an error

CONE = 0.15  # the offset that is allowed grows by so much for each metre of height above the deck
INSIDE = 0.8  # share of the room between feet and edge that is used on the deck
LEAST_M = 0.02  # offset that is always allowed
BEGINS, ENDS = 0.7, 1.4  # share of the allowed offset below which a descent begins, and from which it is broken off
SLOWS = 0.35  # from this share on the descent is slower; it halts where all of it is used, and beyond that turns
DRIFT_M_S = 0.4  # speed over the deck that is allowed, and ...
DRIFT_1_S = 0.3  # ... how much more of it for each metre of height
NEAR_GAIN = 1.3  # above the deck the offset is corrected faster than elsewhere

FLARE_M = 0.7  # below this height above the deck the descent is that of the touchdown, above it grows ...
FLARE_1_S = 0.6  # ... by so much for each metre
TOUCH_M = 0.03  # feet lower than this above the deck touch it
TOUCHED_LOW_M = 0.2  # of a rover's height, so much may be wrong
PRESS_M_S = 1.5  # commanded descent on the deck: it unloads the rotors, so that the feet grip
LANDED_S = 1.0  # the autopilot has switched the motors off after less (`swarmsim.control.multirotor.LANDED_AFTER_S`)
COMMITTED_M = 1.0  # below this height nobody has the right of way over one that lands (`PUSH_FROM_M` of the traffic)

NEAR_M = 1.5  # horizontal distance from where on it is above the rover
RISEN_M = 1.5  # height above the ground and above the deck from which it flies towards a rover that is not near
AHEAD_S = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0)  # how far ahead on its way obstacles are looked for
OBSTACLE_M = 0.5  # what is higher above the terrain is one


@pytree
class Deck:
    """What is known of the rover from the scenario."""

    member: jax.Array  # [] int32: its number in the mission, which its broadcasts carry
    half_m: jax.Array  # [2] half length and half width of its deck
    height_m: jax.Array  # [] of the deck over its origin


@pytree
class Carrier:
    """The rover as it was heard last."""

    position_m: jax.Array  # [3] world
    velocity_m_s: jax.Array  # [3] world
    acceleration_m_s2: jax.Array  # [2] world, estimated from its velocities
    yaw_rad: jax.Array  # []
    sent_s: jax.Array  # [] when that was sent; NEVER_S: not yet


@pytree
class Landing:
    """Memory of the policy."""

    carrier: Carrier
    place_m: jax.Array  # [3] world, where the phase began; NaN before the first view
    descends: jax.Array  # [] bool: it follows the rover so well that it comes down
    touched_s: jax.Array  # [] since when it has stood on the deck; inf: it does not
    landed: jax.Array  # [] bool


@pytree
class _Sight:
    """The deck from the vehicle, now."""

    offset_m: jax.Array  # [2] of its middle from the vehicle, world
    velocity_m_s: jax.Array  # [3] world
    acceleration_m_s2: jax.Array  # [2] world
    yaw_rad: jax.Array  # []
    top_m: jax.Array  # [] height of the deck, world
    above_m: jax.Array  # [] of the vehicle's feet above it
    share: jax.Array  # [] offset over the one that keeps the feet on the deck, which widens with the height
    within: jax.Array  # [] bool: the vehicle's middle is over the deck
    fresh: jax.Array  # [] bool: the rover is not lost
    known: jax.Array  # [] bool: the rover has been heard
    free: jax.Array  # [] bool: nothing stands where the rotors will be, and no other vehicle on the deck


@register("land_on")
class LandOnRover:
    """Land on a rover, and ride on it.

    The vehicle flies towards where the rover is by its last broadcast, extrapolated over the delay, and turns its feet
    along the deck. It comes down as long as its offset stays within a cone that stands on the deck. Where it leaves
    that cone, or the rover is lost, passes an obstacle or carries another vehicle already, it climbs and tries anew. On
    the deck it presses down until its motors are off. It is done then, and is carried along.
    """

    Settings = LandOn
    vehicles = ("multirotor",)
    listens = True

    def task(self, assignment: Assignment) -> Deck:
        """Number and deck of the rover (host)."""
        settings, scenario = assignment.settings, assignment.scenario
        assert isinstance(settings, LandOn)
        number = [member.name for member in scenario.members].index(settings.rover)
        spec = scenario.vehicles[number]
        assert isinstance(spec, SkidSteer)
        half_length, half_width, height = deck_of(spec, skid_steer_params(spec))
        return Deck(
            member=on_host(number, "int32"), half_m=on_host((half_length, half_width)), height_m=on_host(height)
        )

    def start(self, task: Task, key: jax.Array) -> Landing:
        """Nothing is known of where the rover is."""
        carrier = Carrier(
            position_m=jnp.zeros(3),
            velocity_m_s=jnp.zeros(3),
            acceleration_m_s2=jnp.zeros(2),
            yaw_rad=jnp.zeros(()),
            sent_s=jnp.float32(NEVER_S),
        )
        never = jnp.array(False)
        return Landing(
            carrier=carrier, place_m=jnp.full(3, jnp.nan), descends=never, touched_s=jnp.float32(jnp.inf), landed=never
        )

    def act(self, task: Task, memory: Landing, view: View, key: jax.Array) -> tuple[Landing, PositionCommand]:
        """Follow the rover, come down on it, or wait where it is not known."""
        assert view.heard is not None
        carrier = _listened(memory.carrier, task.known, view.heard, view.time_s)
        sight = _seen(task, carrier, view)
        place = jnp.where(jnp.isfinite(memory.place_m), memory.place_m, view.position_m)
        on_deck = jnp.where(sight.fresh, sight.within, jnp.isfinite(memory.touched_s))
        touches = (view.height_m < TOUCH_M) & on_deck & (jnp.abs(sight.above_m) < TOUCHED_LOW_M)
        touched = jnp.where(touches, jnp.minimum(memory.touched_s, view.time_s), jnp.inf)
        landed = memory.landed | (view.time_s - touched >= LANDED_S)
        memory = Landing(
            carrier=carrier,
            place_m=place,
            descends=_descends(memory.descends, sight, view),
            touched_s=touched,
            landed=landed,
        )
        return memory, _command(task, memory, sight, view, touches | landed)

    def done(self, task: Task, memory: Landing, view: View) -> jax.Array:
        """Whether [] it stands on the rover with its motors off."""
        return memory.landed


def _listened(carrier: Carrier, deck: Deck, heard: Heard, time_s: jax.Array) -> Carrier:
    """The rover as of its latest message; a message that is lost leaves what is known of it."""
    mine = heard.valid & (heard.member == deck.member)
    sent = time_s - heard.age_s
    new = jnp.any(mine) & (sent > carrier.sent_s + 1e-3)

    def of(values: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(mine.reshape(-1, *(1,) * (values.ndim - 1)), values, 0.0), axis=0)

    position, velocity, yaw = of(heard.position_m), of(heard.velocity_m_s), of(heard.yaw_rad)
    since = jnp.maximum(sent - carrier.sent_s, 1e-3)
    found = (velocity[:2] - carrier.velocity_m_s[:2]) / since
    found = found * jnp.minimum(1.0, ACCELERATION_MAX_M_S2 / _norm(found))
    weight = 1.0 - jnp.exp(-since / TURN_S)
    smooth = carrier.acceleration_m_s2 + weight * (found - carrier.acceleration_m_s2)
    smooth = jnp.where(since < LOST_S, smooth, 0.0)  # after a gap nothing is known of it
    return Carrier(
        position_m=jnp.where(new, position, carrier.position_m),
        velocity_m_s=jnp.where(new, velocity, carrier.velocity_m_s),
        acceleration_m_s2=jnp.where(new, smooth, carrier.acceleration_m_s2),
        yaw_rad=jnp.where(new, yaw, carrier.yaw_rad),
        sent_s=jnp.where(new, sent, carrier.sent_s),
    )


def _seen(task: Task, carrier: Carrier, view: View) -> _Sight:
    """Where the deck is from the vehicle, now."""
    deck, params = task.known, task.params
    age = view.time_s - carrier.sent_s
    ahead, fresh = jnp.clip(age, 0.0, LOST_S), age < LOST_S
    velocity, acceleration = carrier.velocity_m_s, carrier.acceleration_m_s2
    turned = jnp.where(fresh, 1.0, 0.0) * acceleration
    place = carrier.position_m[:2] + ahead * velocity[:2] + 0.5 * ahead * ahead * turned
    top = carrier.position_m[2] + ahead * velocity[2] + deck.height_m
    offset = place - view.position_m[:2]
    above = view.position_m[2] + jnp.min(params.contact_position_m[:, 2]) - top
    cosine, sine = jnp.cos(carrier.yaw_rad), jnp.sin(carrier.yaw_rad)
    in_deck = jnp.abs(jnp.stack([cosine * offset[0] + sine * offset[1], cosine * offset[1] - sine * offset[0]]))
    room = deck.half_m - _feet(params, yaw_of(view.quaternion) - carrier.yaw_rad)
    spare = jnp.maximum(INSIDE * room, LEAST_M)
    now = jnp.append(velocity[:2] + ahead * turned, velocity[2])
    return _Sight(
        offset_m=offset,
        velocity_m_s=jnp.where(fresh, now, 0.0),
        acceleration_m_s2=turned,
        yaw_rad=carrier.yaw_rad,
        top_m=top,
        above_m=above,
        share=jnp.max(in_deck / (spare + CONE * jnp.maximum(above, 0.0))),
        within=jnp.all(in_deck < deck.half_m),
        fresh=fresh,
        known=carrier.sent_s > 0.5 * NEVER_S,
        free=_free(task, carrier, place, velocity) & ~_occupied(task, view, carrier.position_m, top),
    )


def _feet(params: Any, turn_rad: jax.Array) -> jax.Array:
    """How far [2] the feet reach along and across a deck that the vehicle is turned against by ``turn_rad`` []."""
    feet = params.contact_position_m[: params.contact_position_m.shape[0] - params.rotor_spin.shape[-1]]
    cosine, sine = jnp.cos(turn_rad), jnp.sin(turn_rad)
    along, across = cosine * feet[:, 0] - sine * feet[:, 1], sine * feet[:, 0] + cosine * feet[:, 1]
    return jnp.stack([jnp.max(jnp.abs(along)), jnp.max(jnp.abs(across))])


def _free(task: Task, carrier: Carrier, place: jax.Array, velocity: jax.Array) -> jax.Array:
    """Whether [] no obstacle is where the rotors will be over the rover, now and soon."""
    soon = place + AHEAD_S[2] * velocity[:2]
    clearance = jnp.minimum(*(sample(task.site.clearance_m, task.site, xy) for xy in (place, soon)))
    return clearance > task.params.collision_radius_m


def _occupied(task: Task, view: View, rover_m: jax.Array, top: jax.Array) -> jax.Array:
    """Whether [] another vehicle is on the deck, or just above it."""
    heard = view.heard
    assert heard is not None
    apart = heard.position_m - jnp.append(rover_m[:2], top)
    wide = 2.0 * task.params.collision_radius_m
    beside = jnp.sum(apart[:, :2] * apart[:, :2], axis=-1) < wide * wide
    others = heard.valid & (heard.member != task.known.member)
    return jnp.any(others & beside & (jnp.abs(apart[:, 2]) < COMMITTED_M))


def _descends(before: jax.Array, sight: _Sight, view: View) -> jax.Array:
    """Whether [] it comes down: the conditions for beginning are tighter than those for going on."""
    slip = _norm(view.velocity_m_s[:2] - sight.velocity_m_s[:2])
    allowed = DRIFT_M_S + DRIFT_1_S * jnp.maximum(sight.above_m, 0.0)
    committed = before & (sight.above_m < COMMITTED_M)
    able = sight.fresh & (sight.free | (committed & (sight.above_m < FLARE_M))) & (~view.hold | committed)
    high = sight.above_m > -TOUCHED_LOW_M
    begins = (sight.share < BEGINS) & (slip < allowed)
    goes_on = (sight.share < ENDS) & (slip < 2.0 * allowed)
    return able & high & jnp.where(before, goes_on, begins)


def _command(task: Task, memory: Landing, sight: _Sight, view: View, stands: jax.Array) -> PositionCommand:
    """Position and velocity that follow the rover, and the climb or descent."""
    settings, control = task.settings, task.params.control
    distance = _norm(sight.offset_m)
    near, low = distance < NEAR_M, memory.descends & (sight.above_m < COMMITTED_M)
    over, blocked = _obstacles(task, sight, view)
    waits = (view.hold & ~low) | ~sight.known
    # one that is beside the rover, or still on the ground, rises first
    risen = jnp.clip(jnp.minimum(sight.above_m, view.height_m) / RISEN_M, 0.0, 1.0)
    risen = jnp.where(risen > 0.5, 2.0 * risen - 1.0, 0.0)
    pace = jnp.where(memory.descends, 1.0, jnp.where(near & (sight.above_m > 0.0), 1.0, risen) * blocked)
    pace = jnp.where(waits | stands, 0.0, pace)
    step = sight.offset_m * jnp.minimum(1.0, _reach(control, settings.speed_m_s) / distance)
    step = jnp.where(near, NEAR_GAIN, 1.0) * pace * step
    follow = jnp.where(sight.fresh, pace, 0.0)
    rise = control.position_gain_1_s * jnp.maximum(settings.altitude_m - sight.above_m, over)
    climb = jnp.clip(rise, -settings.descent_speed_m_s, settings.climb_speed_m_s)
    down = settings.touchdown_speed_m_s + FLARE_1_S * jnp.maximum(sight.above_m - FLARE_M, 0.0)
    down = jnp.minimum(down, settings.descent_speed_m_s) * jnp.clip((1.0 - sight.share) / (1.0 - SLOWS), -1.0, 1.0)
    rate = jnp.where(memory.descends, -down, climb) + jnp.where(near, follow, 0.0) * sight.velocity_m_s[2]
    rate = jnp.where(waits, 0.0, rate)
    rate = jnp.where(stands, -PRESS_M_S, rate)
    # on the deck it moves as the deck does, whatever was heard of that: nothing but its own velocity is commanded
    level = jnp.where(stands, view.velocity_m_s[:2], follow * sight.velocity_m_s[:2])
    push = jnp.where(low | stands, 0.0, view.push_m)
    place = view.position_m + jnp.append(step, 0.0) + push
    return PositionCommand(
        position_m=jnp.where(sight.known | stands, place, memory.place_m),
        velocity_m_s=jnp.append(level, rate),
        acceleration_m_s2=jnp.append(jnp.where(stands, 0.0, follow) * sight.acceleration_m_s2, 0.0),
        yaw_rad=jnp.where(sight.known, _along(view, sight.yaw_rad), task.yaw_rad),
        hold_position=jnp.ones(()),
    )


def _obstacles(task: Task, sight: _Sight, view: View) -> tuple[jax.Array, jax.Array]:
    """How far [] the feet are to rise over the obstacles on the way, and which share [] of the way may be flown now."""
    site, clearance = task.site, task.settings.obstacle_clearance_m
    distance = _norm(sight.offset_m)
    highest = jnp.float32(-jnp.inf)
    for seconds in AHEAD_S:
        part = jnp.minimum(1.0, seconds * task.settings.speed_m_s / distance)
        onward = jnp.where(part < 1.0, 0.0, seconds) * sight.velocity_m_s[:2]  # with the rover
        place = view.position_m[:2] + part * sight.offset_m + onward
        surface, terrain = sample(site.surface_m, site, place), sample(site.terrain_m, site, place)
        highest = jnp.maximum(highest, jnp.where(surface - terrain > OBSTACLE_M, surface, -jnp.inf))
    missing = highest + clearance - (view.position_m[2] + jnp.min(task.params.contact_position_m[:, 2]))
    return missing, jnp.clip(2.0 * (1.0 - missing / jnp.maximum(clearance, 1.0)), 0.0, 1.0)


def _reach(control: Any, speed_m_s: jax.Array) -> jax.Array:
    """Offset [] m that the position controller closes at ``speed_m_s`` [] (the inverse of its approach)."""
    gain, brake = control.position_gain_1_s, 0.5 * control.acceleration_max_m_s2
    linear = brake / (gain * gain)
    far = speed_m_s * speed_m_s / (2.0 * brake) + 0.5 * linear
    return jnp.where(speed_m_s < gain * linear, speed_m_s / gain, far)


def _along(view: View, yaw_rad: jax.Array) -> jax.Array:
    """Heading [] along a deck, which looks the same from both ends: the one that is nearer to the vehicle's own."""
    own = yaw_of(view.quaternion)
    twice = 2.0 * (yaw_rad - own)
    return own + 0.5 * jnp.arctan2(jnp.sin(twice), jnp.cos(twice) + 1e-6)


def _norm(vector: jax.Array) -> jax.Array:
    """Length [] of a vector [2], with a gradient at zero."""
    return jnp.sqrt(jnp.sum(vector * vector) + 1e-9)
