"""The radio: what each vehicle broadcasts, and which team mates' broadcasts reach it."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmsim import randomness
from swarmsim.physics.rotations import yaw_of
from swarmsim.pytree import pytree
from swarmsim.world.model import World
from swarmsim.world.neighbours import neighbours
from swarmsim.world.state import GroupState, RadioState, WorldState


@pytree
class Heard:
    """What one vehicle knows of its K nearest team mates within range; rows that are not ``valid`` are zero."""

    member: jax.Array  # [K] int32: number of the sender in the mission; -1 where not valid
    position_m: jax.Array  # [K, 3] world, when it was sent
    velocity_m_s: jax.Array  # [K, 3] world, when it was sent
    yaw_rad: jax.Array  # [K] heading then, counter-clockwise from east
    count_rate_cps: jax.Array  # [K] last reading then; zero without a detector
    age_s: jax.Array  # [] since it was sent
    valid: jax.Array  # [K] bool


def radio_start(world: World, groups: tuple[GroupState, ...]) -> RadioState:
    """Nothing has been sent; what is on its way are the starting places."""
    slots, vehicles, mates = world.radio.delay + 1, world.vehicles, world.radio.mates
    position = jnp.concatenate([g.vehicle.body.position_m for g in groups])
    yaw = _yaw(groups)
    if mates == 0:
        slots, vehicles, position, yaw = 0, 0, position[:0], yaw[:0]
    return RadioState(
        position_m=jnp.broadcast_to(position, (slots, *position.shape)),
        velocity_m_s=jnp.zeros((slots, vehicles, 3)),
        yaw_rad=jnp.broadcast_to(yaw, (slots, vehicles)),
        count_rate_cps=jnp.zeros((slots, vehicles)),
        tick=jnp.int32(0),
        heard_index=jnp.zeros((vehicles, mates), jnp.int32),
        heard=jnp.zeros((vehicles, mates), bool),
    )


def broadcast(world: World, state: WorldState, number: jax.Array) -> RadioState:
    """The radio after every vehicle has sent its state in judging period ``number`` []."""
    radio, mates = state.radio, world.radio.mates
    if mates == 0:
        return radio
    bodies = [g.vehicle.body for g in state.groups]
    rates = [
        jnp.zeros(group.size) if g.counter is None else g.counter.reading.rate_cps
        for group, g in zip(world.groups, state.groups, strict=True)
    ]
    sent = RadioState(
        position_m=_pushed(radio.position_m, jnp.concatenate([b.position_m for b in bodies])),
        velocity_m_s=_pushed(radio.velocity_m_s, jnp.concatenate([b.velocity_m_s for b in bodies])),
        yaw_rad=_pushed(radio.yaw_rad, _yaw(state.groups)),
        count_rate_cps=_pushed(radio.count_rate_cps, jnp.concatenate(rates)),
        tick=state.clock.tick,
        heard_index=radio.heard_index,
        heard=radio.heard,
    )
    near = neighbours(sent.position_m[-1], world.radio.range_m, mates)
    key = jax.random.fold_in(randomness.consumer(state.key, "radio"), number)
    kept = jax.random.uniform(key, near.valid.shape) >= world.radio.loss
    return replace(sent, heard_index=near.index, heard=near.valid & kept)


def _yaw(groups: tuple[GroupState, ...]) -> jax.Array:
    """Headings [V] rad of all vehicles."""
    return jax.vmap(yaw_of)(jnp.concatenate([g.vehicle.body.quaternion for g in groups]))


def _pushed(slots: jax.Array, value: jax.Array) -> jax.Array:
    return jnp.concatenate([value[None], slots[:-1]])


def heard(world: World, radio: RadioState, tick: jax.Array, first: int, size: int) -> Heard | None:
    """What the vehicles ``first`` to ``first + size`` (in the order of the groups) heard last; leading axis U.

    ``tick`` [] int32 are the control periods since the start, which the messages' age is counted to.
    """
    if world.radio.mates == 0:
        return None
    index, valid = radio.heard_index[first : first + size], radio.heard[first : first + size]

    def of(values: jax.Array) -> jax.Array:
        found = values[-1][index]
        return jnp.where(valid.reshape(valid.shape + (1,) * (found.ndim - 2)), found, 0.0)

    member = jnp.concatenate([jnp.asarray(group.member, jnp.int32) for group in world.groups])
    ticks = world.radio.delay * world.timing.judge_ticks + tick - radio.tick
    age = jnp.full(size, ticks * jnp.float32(world.timing.control_period_s))
    return Heard(
        member=jnp.where(valid, member[index], -1),
        position_m=of(radio.position_m),
        velocity_m_s=of(radio.velocity_m_s),
        yaw_rad=of(radio.yaw_rad),
        count_rate_cps=of(radio.count_rate_cps),
        age_s=age,
        valid=valid,
    )
