"""Navigation sensors of a world that is stepped: what policies and beliefs outside of the step read.

    sensors = swarmsim.fit_sensors(simulation.scenario, world)
    sensed = swarmsim.switch_on(sensors, state)
    ...
    state, _ = swarmsim.step(world, state, commands)
    sensed, readings = swarmsim.sense(sensors, sensed, state)

`switch_on` and `sense` are pure, and the step knows nothing of them: a mission that reads no sensor compiles and costs
what it did.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim import randomness
from swarmsim.config.errors import InputError
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.scenario import Scenario
from swarmsim.config.sensors import Place
from swarmsim.physics.contact import Plane
from swarmsim.physics.rotations import normalise, rotate_inverse
from swarmsim.pytree import on_host, pytree, static
from swarmsim.sensors.suite import Readings, Suite, SuiteState, begin, read, suite_of
from swarmsim.sensors.truth import Truth
from swarmsim.vehicles.state import GRAVITY_M_S2, RigidState
from swarmsim.world.model import World
from swarmsim.world.state import GroupState, WorldState


@pytree
class Fitted:
    """Vehicles of one group with the same sensors; leading axis n."""

    suite: Suite  # leaves [n, …]
    member: jax.Array  # [n] int32: number of each in the mission
    group: int = static()
    local: tuple[int, ...] = static()  # rows of the group


@pytree
class Sensors:
    """The sensors of a team."""

    fitted: tuple[Fitted, ...]
    period_s: jax.Array  # [] between two calls of `sense`
    periods: int = static()  # control periods between two calls


@pytree
class Sensed:
    """What sensors carry from call to call; for each of `Sensors.fitted`, leading axis n."""

    states: tuple[SuiteState, ...]
    bodies: tuple[RigidState, ...]  # at the last call: accelerometers need the change of velocity


def fit_sensors(
    scenario: Scenario,
    world: World,
    *,
    periods: int = 1,
    place: Place | None = None,
    others: dict[str, Sequence[str]] | None = None,
) -> Sensors:
    """The sensors that the vehicles of a scenario name (host); vehicles without any have none.

    Args:
        scenario: whose vehicles they are.
        world: that is stepped, of this scenario.
        periods: control periods between two calls of `sense`.
        place: where the mission's origin lies; the defaults of `Place` without it.
        others: for a vehicle's name (`uav1`) the names of sensors that it carries in the stead of its type's.

    Raises:
        InputError: ``periods`` is less than one, a name is unknown, or a vehicle has two sensors of a kind.
    """
    if periods < 1:
        raise InputError.of("sensors are read every one or more control periods", given=str(periods))
    period = periods * world.timing.control_period_s
    wanted = _names(scenario, others or {})
    suites: dict[tuple[str, ...], Suite] = {}
    found = []
    for number, group in enumerate(world.groups):
        members = np.asarray(group.member)
        by_names: dict[tuple[str, ...], list[int]] = {}
        for local, member in enumerate(members):
            by_names.setdefault(wanted[int(member)], []).append(local)
        for names, rows in by_names.items():
            if not names:
                continue
            if names not in suites:
                vehicle = scenario.vehicles[int(members[rows[0]])].model_copy(update={"sensors": names})
                suites[names] = suite_of(vehicle, period, place=place, known=scenario.sensors)
            found.append(
                Fitted(
                    suite=jax.tree.map(partial(np.repeat, repeats=len(rows), axis=0), _with_axis(suites[names])),
                    member=on_host(members[rows], np.int32),
                    group=number,
                    local=tuple(rows),
                )
            )
    return Sensors(fitted=tuple(found), period_s=on_host(period), periods=periods)


def _with_axis(suite: Suite) -> Suite:
    return jax.tree.map(lambda x: np.asarray(x)[None], suite)


def _names(scenario: Scenario, others: dict[str, Sequence[str]]) -> tuple[tuple[str, ...], ...]:
    """Names of the sensors of each member."""
    named = [member.name for member in scenario.members]
    for name in others:
        if name not in named:
            hint = did_you_mean(name, named)
            raise InputError.of(f"there is no vehicle '{name}'", given=name, allowed=one_of(named), suggestion=hint)
    pairs = zip(named, scenario.vehicles, strict=True)
    return tuple(tuple(others.get(name, vehicle.sensors)) for name, vehicle in pairs)


def switch_on(sensors: Sensors, state: WorldState) -> Sensed:
    """All sensors switched on: their constant errors are drawn from the mission's randomness, each vehicle's own."""
    return Sensed(
        states=tuple(jax.vmap(begin)(fitted.suite, _keys(fitted, state)) for fitted in sensors.fitted),
        bodies=tuple(_rows(fitted, state).vehicle.body for fitted in sensors.fitted),
    )


def sense(sensors: Sensors, sensed: Sensed, state: WorldState) -> tuple[Sensed, tuple[Readings, ...]]:
    """What all sensors read now: for each of ``sensors.fitted``, leading axis n.

    To be called once after the steps of every period that `fit_sensors` was told: the world's clock tells which sensors
    are due. The specific force is that of the change of velocity since the last call in the attitude between both, as
    an IMU that sums up its samples gives it; what happened within the period is averaged. Height and wind are those
    that the world looked up last.
    """
    tick = state.clock.tick // sensors.periods
    states, bodies, readings = [], [], []
    for fitted, before, last in zip(sensors.fitted, sensed.states, sensed.bodies, strict=True):
        rows = _rows(fitted, state)
        truth = jax.vmap(partial(truth_of, sensors.period_s))(last, rows)
        after, reading = jax.vmap(read, in_axes=(0, 0, 0, 0, None))(
            fitted.suite, before, truth, _keys(fitted, state), tick
        )
        states.append(after)
        bodies.append(rows.vehicle.body)
        readings.append(reading)
    return Sensed(states=tuple(states), bodies=tuple(bodies)), tuple(readings)


def by_group(sensors: Sensors, world: World, readings: Sequence[Readings]) -> tuple[Readings | None, ...]:
    """Readings of every group with leading axis U; None for a group without sensors.

    What some vehicles of a group have and others lack reads zero for these, is never fresh and never valid.
    """
    return tuple(
        _of_group(
            group.size, [(f.local, r) for f, r in zip(sensors.fitted, readings, strict=True) if f.group == number]
        )
        for number, group in enumerate(world.groups)
    )


def _of_group(size: int, found: list[tuple[tuple[int, ...], Readings]]) -> Readings | None:
    if not found:
        return None
    if found[0][0] == tuple(range(size)):
        return found[0][1]

    def spread(name: str) -> jax.Array | None:
        parts = [(local, getattr(own, name)) for local, own in found if getattr(own, name) is not None]
        if not parts:
            return None
        whole = jnp.zeros((size, *parts[0][1].shape[1:]), parts[0][1].dtype)
        for local, values in parts:
            whole = whole.at[np.asarray(local)].set(values)
        return whole

    return Readings(**{field.name: spread(field.name) for field in fields(Readings)})


def truth_of(period_s: jax.Array, last: RigidState, now: GroupState) -> Truth:
    """What the sensors of one vehicle measure ``period_s`` [] after ``last``; arguments are its rows of the group's."""
    body = now.vehicle.body
    sign = jnp.where(jnp.sum(last.quaternion * body.quaternion) < 0.0, -1.0, 1.0)
    between = normalise(last.quaternion + sign * body.quaternion)
    acceleration = (body.velocity_m_s - last.velocity_m_s) / period_s
    force = acceleration + jnp.array([0.0, 0.0, GRAVITY_M_S2])
    return Truth(
        position_m=body.position_m,
        velocity_m_s=body.velocity_m_s,
        quaternion=body.quaternion,
        angular_velocity_rad_s=body.angular_velocity_rad_s,
        specific_force_m_s2=rotate_inverse(between, force),
        air_velocity_m_s=rotate_inverse(body.quaternion, body.velocity_m_s - now.around.wind_m_s),
        height_m=height_above(now.around.ground, body.position_m),
    )


def height_above(ground: Plane, position_m: jax.Array) -> jax.Array:
    """Height [] of a place [3] above a plane, along the vertical."""
    away = position_m - ground.point_m
    normal = ground.normal
    return away[2] + (normal[0] * away[0] + normal[1] * away[1]) / normal[2]


def _keys(fitted: Fitted, state: WorldState) -> jax.Array:
    """Keys [n] of the vehicles' sensors."""
    own = randomness.consumer(state.key, "navigation sensors")
    return jax.vmap(partial(jax.random.fold_in, own))(jnp.asarray(fitted.member))


def _rows(fitted: Fitted, state: WorldState) -> GroupState:
    """The vehicles' rows [n] of their group's state, its detector left out."""
    group = replace(state.groups[fitted.group], counter=None)
    size = group.active.shape[0]
    if fitted.local == tuple(range(size)):
        return group
    index = np.asarray(fitted.local)
    return jax.tree.map(lambda x: jnp.take(x, index, axis=0), group)
