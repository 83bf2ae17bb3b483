"""One multirotor on its path: reference, control, wind and physics for one tick, and what has happened to it since."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from swarmsim.control.multirotor import ControlMemory, Setpoint, control
from swarmsim.missions import events
from swarmsim.physics.contact import Plane
from swarmsim.physics.multirotor import Step
from swarmsim.physics.wind import GustState, gust_step, gust_velocity, steady_wind
from swarmsim.policies.path import Path, reference
from swarmsim.pytree import pytree
from swarmsim.site import Site, sample, sample_with_gradient
from swarmsim.vehicles.multirotor import MultirotorParams
from swarmsim.vehicles.state import MultirotorState

START_SPEED_M_S = 0.3  # a reference at rest at the start of its path sets out at this speed
LAG_M = 1.0  # the reference waits for a vehicle that is further behind than this
LANDED_SPEED_M_S = 0.15
LANDED_HEIGHT_M = 0.1
TILT_LIMIT_COSINE = 0.3  # about 72 degrees: beyond it near the ground a multirotor has tipped over
TIP_HEIGHT_M = 1.0
LANDING_PATH_M = 1.0  # within this rest of its path a vehicle that stands on the ground has landed
OBSTACLE_HEIGHT_M = 0.4  # a surface this far above the terrain is an obstacle, not ground


@pytree
class Flight:
    """A multirotor under way."""

    vehicle: MultirotorState
    memory: ControlMemory
    gust: GustState
    progress_m: jax.Array  # [] arc length of the reference along the path
    event_time_s: jax.Array  # [kinds] first time of each kind of event, inf where there was none


@pytree
class Traffic:
    """What the other vehicles ask of this one."""

    hold: jax.Array  # [] bool: wait, another has the right of way
    push_m: jax.Array  # [3] displacement of the reference away from it, ENU
    collided: jax.Array  # [] bool


@pytree
class Air:
    """Wind of the mission."""

    speed_m_s: jax.Array  # [] at 20 ft above ground
    from_rad: jax.Array  # [] bearing that it blows from, clockwise from north
    gusts: jax.Array  # [] 1 with Dryden gusts, 0 without


Guide = Callable[[jax.Array, jax.Array], tuple[Setpoint, jax.Array]]


def ground_below(site: Site, position_m: jax.Array) -> Plane:
    """Tangent plane of the terrain below a position [3]."""
    height, slope = sample_with_gradient(site.terrain_m, site, position_m[:2])
    normal = jnp.append(-slope, 1.0)
    return Plane(point_m=jnp.append(position_m[:2], height), normal=normal / jnp.linalg.norm(normal))


def follow(
    path: Path, progress_m: jax.Array, position_m: jax.Array, traffic: Traffic, yaw_rad: jax.Array, dt: float
) -> tuple[Setpoint, jax.Array]:
    """Setpoint on the path and the progress after ``dt``: the reference waits for traffic and for a vehicle behind."""
    here = reference(path, progress_m, START_SPEED_M_S)
    lag = jnp.sqrt(jnp.sum((here.position_m - position_m) ** 2))
    pace = jnp.where(traffic.hold, 0.0, jnp.clip(2.0 - lag / LAG_M, 0.0, 1.0))
    setpoint = Setpoint(
        position_m=here.position_m + traffic.push_m,
        velocity_m_s=pace * here.velocity_m_s,
        acceleration_m_s2=jnp.zeros(3),
        yaw_rad=yaw_rad,
    )
    return setpoint, jnp.minimum(progress_m + pace * here.speed_m_s * dt, path.length_m)


def fly_tick(
    params: MultirotorParams,
    flight: Flight,
    guide: Guide,
    air: Air,
    site: Site,
    gust_key: jax.Array,
    *,
    step: Step,
    periods: int,
    substeps: int,
    dt: float,
) -> Flight:
    """Fly for one tick of ``periods`` control periods, each of ``substeps`` physics steps of ``dt`` s.

    The wind and the tangent plane of the ground are those where the tick starts: it is short (about 0.1 s) against the
    time in which either changes.

    Args:
        params: of this UAV.
        flight: at the start of the tick.
        guide: from progress and position to the setpoint and the progress one control period later.
        air: wind of the mission.
        site: terrain to stand on.
        gust_key: [] randomness of the gusts in this tick.
        step: physics of the chosen engine.
        periods, substeps, dt: see above.
    """
    armed = events.under_way(flight.event_time_s)
    body = flight.vehicle.body
    ground = ground_below(site, body.position_m)
    height = jnp.maximum(body.position_m[2] - ground.point_m[2], 0.0)
    gust, wind = _wind(flight.gust, air, gust_key, height, body.velocity_m_s, periods * substeps * dt)

    def control_period(
        carry: tuple[MultirotorState, ControlMemory, jax.Array], _: None
    ) -> tuple[tuple[MultirotorState, ControlMemory, jax.Array], None]:
        vehicle, memory, progress = carry
        setpoint, progress = guide(progress, vehicle.body.position_m)
        command, memory = control(params, memory, vehicle, setpoint, substeps * dt)
        command = jnp.where(armed, command, 0.0)
        for _substep in range(substeps):
            vehicle = step(params, vehicle, command, wind, ground)
        return (vehicle, memory, progress), None

    start = (flight.vehicle, flight.memory, flight.progress_m)
    vehicle, memory, progress = jax.lax.scan(control_period, start, None, length=periods)[0]
    return replace(flight, vehicle=vehicle, memory=memory, gust=gust, progress_m=progress)


def _wind(
    gust: GustState, air: Air, key: jax.Array, height: jax.Array, velocity: jax.Array, dt: float
) -> tuple[GustState, jax.Array]:
    """Gust filters after ``dt`` and the air's velocity [3] at a height above ground."""
    steady = steady_wind(air.speed_m_s, air.from_rad, height)
    airspeed = jnp.linalg.norm(velocity - steady)
    gust = gust_step(key, gust, speed_m_s=air.speed_m_s, height_m=height, airspeed_m_s=airspeed, dt=dt)
    return gust, steady + air.gusts * gust_velocity(gust, air.speed_m_s, air.from_rad, height)


def judge(
    params: MultirotorParams,
    limits: jax.Array,
    before: Flight,
    after: Flight,
    remaining_m: jax.Array,
    traffic: Traffic,
    site: Site,
    now_s: jax.Array,
) -> Flight:
    """The flight after a tick, with its events recorded; one that has finished stays where it is.

    Args:
        params: of the vehicle.
        limits: [3] collision radius (m), half height (m) and largest impact speed (m/s).
        before, after: flight at the start and the end of the tick.
        remaining_m: [] of its path.
        traffic: of the tick, for collisions.
        site, now_s: the place, and the time at the end of the tick.
    """
    body, was = after.vehicle.body, before.vehicle.body
    finite = jnp.all(jnp.isfinite(ravel_pytree(after.vehicle)[0]))
    radius, half_height, impact_speed = limits
    ground = ground_below(site, body.position_m)
    rest_height = -jnp.min(params.contact_position_m[:, 2])
    height = (body.position_m - ground.point_m) @ ground.normal - rest_height
    speed = jnp.maximum(jnp.linalg.norm(body.velocity_m_s), jnp.linalg.norm(was.velocity_m_s))
    low = height < LANDED_HEIGHT_M
    upright = 1.0 - 2.0 * (body.quaternion[1] ** 2 + body.quaternion[2] ** 2)
    ring = radius * jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    around = body.position_m[:2] + ring
    surface = sample(site.surface_m, site, around)
    obstacle = (surface - sample(site.terrain_m, site, around) > OBSTACLE_HEIGHT_M) & (
        body.position_m[2] - half_height < surface
    )
    landed = low & (remaining_m < LANDING_PATH_M) & (jnp.linalg.norm(body.velocity_m_s) < LANDED_SPEED_M_S)
    crash = (low & (speed > impact_speed)) | ((height < TIP_HEIGHT_M) & (upright < TILT_LIMIT_COSINE))
    empty = after.vehicle.energy_j > params.battery_capacity_j
    happened = jnp.stack([landed, crash, jnp.any(obstacle), traffic.collided, empty, jnp.array(False)])
    happened = jnp.where(finite, happened & ~(crash & (jnp.arange(len(happened)) == events.FINISHED)), False)
    happened = happened.at[events.NON_FINITE].set(~finite)
    times = events.record(before.event_time_s, happened, now_s)
    standing = jnp.isfinite(before.event_time_s[events.FINISHED]) | ~finite
    still = jax.tree.map(lambda old, new: jnp.where(standing, old, new), before, after)
    return replace(still, event_time_s=times)


def keep_apart(position_m: jax.Array, active: jax.Array, radius_m: jax.Array, separation_m: jax.Array) -> Traffic:
    """Right of way among U vehicles [U, 3], by rank: the later one waits and gives way sideways; `Traffic` with axis U.

    Vehicles ``active`` [U] closer than ``separation_m`` [] to an active one of lower index hold their progress and move
    their reference away from it, by what the distance lacks. Those closer than their ``radius_m`` [U] have collided.
    """
    count = position_m.shape[0]
    apart = position_m[:, None] - position_m[None]
    distance = jnp.sqrt(jnp.sum(apart**2, axis=-1) + 1e-9)
    pair = active[:, None] & active[None] & ~jnp.eye(count, dtype=bool)
    close = pair & (distance < separation_m) & jnp.tril(jnp.ones((count, count), bool), -1)
    push = jnp.where(close[..., None], (separation_m - distance)[..., None] * apart / distance[..., None], 0.0)
    collided = pair & (distance < radius_m[:, None] + radius_m[None])
    return Traffic(hold=jnp.any(close, axis=1), push_m=jnp.sum(push, axis=1), collided=jnp.any(collided, axis=1))
