"""Contact of wheels and chassis with the ground and with the vertical faces of its steps (`swarmsim.site.Steps`).

A wheel meets the ground below it and the edge or face of a step beside it. The nearer of the two is the contact that is
solved with friction; the other pushes by a spring and a damper, without friction. Where both carry load, a step so
keeps the wheel from sinking while the face stops it.
"""

import jax
import jax.numpy as jnp

from swarmsim.physics.rotations import to_body, to_world
from swarmsim.pytree import pytree
from swarmsim.site import Site, sample_with_gradient
from swarmsim.site.steps import StepAt, sample_steps
from swarmsim.vehicles.skid_steer import SkidSteerParams, tyre_sinkage
from swarmsim.vehicles.state import RigidState

DEEPEST_M = 0.15  # a point of the chassis that is deeper in the ground is beside a face, not on top of it
_FAR_M = 1e3


@pytree
class WheelGround:
    """What the four wheels meet."""

    distance_m: jax.Array  # [4] of the tyre from the nearer contact, < 0 in it
    normal: jax.Array  # [4, 3] unit, world
    radius_m: jax.Array  # [4] of the wheel towards that contact
    other_distance_m: jax.Array  # [4]
    other_normal: jax.Array  # [4, 3]
    step: StepAt  # at the hubs


def wheel_ground(params: SkidSteerParams, site: Site, rotation: jax.Array, hub_m: jax.Array) -> WheelGround:
    """Ground and steps at the wheels with centres ``hub_m`` [4, 3] (world); ``rotation`` [3, 3]: body to world."""
    radius = jnp.full(4, 1.0) * params.wheel_radius_m
    step = step_under(site, hub_m[:, :2])
    rises = step.rise_m > 0.0
    at_edge = step.low_m - jnp.sum(step.slope * step.to_high, axis=-1) * step.beyond_m + step.rise_m
    over = hub_m[:, 2] - at_edge
    below = over < 0.0
    on_top = rises & (step.beyond_m > 0.0) & ~below
    height = step.low_m + jnp.where(on_top, step.rise_m, 0.0)
    up = jax.lax.rsqrt(1.0 + jnp.sum(step.slope * step.slope, axis=-1, keepdims=True))
    normal = jnp.concatenate([-step.slope * up, up], axis=-1)
    distance = (hub_m[:, 2] - height) * normal[:, 2] - radius
    if site.steps is None:
        far = jnp.full(4, _FAR_M)
        return WheelGround(
            distance_m=distance, normal=normal, radius_m=radius, other_distance_m=far, other_normal=normal, step=step
        )
    before, above = -step.beyond_m, jnp.maximum(over, 0.0)
    half_width = 0.5 * params.wheel_width_m
    ahead = rotation[:2, 0] * jax.lax.rsqrt(jnp.sum(rotation[:2, 0] ** 2) + 1e-6)
    facing = jnp.sum(step.to_high * ahead, axis=-1) ** 2
    across = jnp.sqrt(
        radius**2 * facing + half_width**2 * (1.0 - facing)
    )  # half width of the wheel seen along the edge
    gap = jnp.sqrt(before * before + above * above + 1e-8)
    bound = gap * jax.lax.rsqrt((before / across) ** 2 + (above / radius) ** 2 + 1e-8)
    reach = jnp.where(below, across, bound)
    beside = jnp.where(below, before - across, gap - bound)
    edge_distance = jnp.where(rises & ~on_top, beside, _FAR_M)
    level = jnp.where(below, 1.0, before / gap)
    edge_normal = jnp.concatenate(
        [-step.to_high * level[:, None], jnp.where(below, 0.0, above / gap)[:, None]], axis=-1
    )
    nearer = edge_distance < distance
    return WheelGround(
        distance_m=jnp.where(nearer, edge_distance, distance),
        normal=jnp.where(nearer[:, None], edge_normal, normal),
        radius_m=jnp.where(nearer, reach, radius),
        other_distance_m=jnp.where(nearer, distance, edge_distance),
        other_normal=jnp.where(nearer[:, None], normal, edge_normal),
        step=step,
    )


def step_under(site: Site, xy: jax.Array) -> StepAt:
    """Ground at ``xy`` [n, 2] (m, world) with its steps; a site without steps has one level everywhere."""
    if site.steps is not None:
        return sample_steps(site.steps, site, xy)
    height, slope = sample_with_gradient(site.terrain_m, site, xy)
    none = jnp.zeros_like(height)
    return StepAt(low_m=height, slope=slope, beyond_m=none, to_high=jnp.zeros_like(slope), rise_m=none)


def spring_wrench(
    params: SkidSteerParams, body: RigidState, rotation: jax.Array, ground: WheelGround, stepped: bool
) -> tuple[jax.Array, jax.Array]:
    """Force [3] (N, world) and moment [3] (N m, body, about the centre of mass) of the contacts that are not solved.

    These are the farther contact of each wheel, the chassis' corners on the ground, and, where the site is ``stepped``,
    the chassis' lower edges on the edge of a step.
    """
    parts = [_hull_on_ground(params, body, rotation, ground)]
    if stepped:
        parts += [_other_contacts(params, body, rotation, ground), _hull_on_edge(params, body, rotation, ground)]
    arms, forces = (jnp.concatenate(items) for items in zip(*parts, strict=True))
    moment = jnp.sum(jnp.cross(arms, to_body(rotation, forces)), axis=0)
    return jnp.sum(forces, axis=0), moment


def _other_contacts(
    params: SkidSteerParams, body: RigidState, rotation: jax.Array, ground: WheelGround
) -> tuple[jax.Array, jax.Array]:
    """Arms [4, 3] (body) and forces [4, 3] (world) of the wheels' farther contacts."""
    approach = -jnp.sum(_velocity(body, rotation, params.wheel_position_m) * ground.other_normal, axis=-1)
    press = _press(params, -ground.other_distance_m, approach, tyre_stiffness(params))
    return params.wheel_position_m, press[:, None] * ground.other_normal


def tyre_stiffness(params: SkidSteerParams) -> jax.Array:
    """Load over sinkage [] (N/m) of one tyre, see `swarmsim.vehicles.skid_steer.tyre_sinkage`."""
    return 0.25 * params.mass_kg * params.gravity_m_s2 / tyre_sinkage(params)


def _hull_on_ground(
    params: SkidSteerParams, body: RigidState, rotation: jax.Array, ground: WheelGround
) -> tuple[jax.Array, jax.Array]:
    """Arms [8, 3] (body) and forces [8, 3] (world) of the chassis' corners on the ground of the wheel next to each."""
    (back, right, bottom), (front, left, top) = params.hull_m
    plan = jnp.stack([jnp.stack([x, y]) for x in (front, back) for y in (left, right)])
    arm = jnp.concatenate([jnp.append(plan, jnp.broadcast_to(z, (4, 1)), axis=-1) for z in (bottom, top)])
    step = jax.tree.map(lambda x: jnp.concatenate([x, x]), ground.step)
    offset = to_world(rotation, arm - jnp.concatenate([params.wheel_position_m] * 2))
    beyond = step.beyond_m + jnp.sum(offset[:, :2] * step.to_high, axis=-1)
    height = step.low_m + jnp.sum(offset[:, :2] * step.slope, axis=-1) + jnp.where(beyond > 0.0, step.rise_m, 0.0)
    up = jax.lax.rsqrt(1.0 + jnp.sum(step.slope * step.slope, axis=-1, keepdims=True))
    normal = jnp.concatenate([-step.slope * up, up], axis=-1)
    place = body.position_m[2] + jnp.sum(rotation[2] * arm, axis=-1)
    return arm, _rubbing(params, body, rotation, arm, (height - place) * normal[:, 2], normal)


def _hull_on_edge(
    params: SkidSteerParams, body: RigidState, rotation: jax.Array, ground: WheelGround
) -> tuple[jax.Array, jax.Array]:
    """Arms [4, 3] (body) and forces [4, 3] (world) of the chassis' left and right lower edges on edges of steps.

    Each wheel sees the step near it; the wheels of one side see the same one as a rule, so each counts by half.
    """
    step, hub = ground.step, params.wheel_position_m
    (back, right, bottom), (front, left, _) = params.hull_m
    side = jnp.stack([left, right, left, right]) - hub[:, 1]
    down = jnp.full(4, 1.0) * bottom - hub[:, 2]
    along = jnp.sum(step.to_high * rotation[:2, 0], axis=-1)
    start = step.beyond_m + side * jnp.sum(step.to_high * rotation[:2, 1], axis=-1)
    start = start + down * jnp.sum(step.to_high * rotation[:2, 2], axis=-1)
    crosses = jnp.abs(along) > 0.2
    x = hub[:, 0] - start / jnp.where(crosses, along, 1.0)
    touches = crosses & (step.rise_m > 0.0) & (x > back) & (x < front)
    arm = jnp.stack([jnp.clip(x, back, front), hub[:, 1] + side, hub[:, 2] + down], axis=-1)
    offset = to_world(rotation, arm - hub)
    top = step.low_m + jnp.sum(offset[:, :2] * step.slope, axis=-1) + step.rise_m
    place = body.position_m[2] + jnp.sum(rotation[2] * arm, axis=-1)
    depth = jnp.where(touches, (top - place) * rotation[2, 2], -1.0)
    normal = jnp.broadcast_to(rotation[:, 2], (4, 3))
    return arm, 0.5 * _rubbing(params, body, rotation, arm, depth, normal)


def _rubbing(
    params: SkidSteerParams, body: RigidState, rotation: jax.Array, arm: jax.Array, depth: jax.Array, normal: jax.Array
) -> jax.Array:
    """Forces [n, 3] (world) of chassis points at ``arm`` [n, 3] (body), ``depth`` [n] (m) deep along ``normal``."""
    velocity = _velocity(body, rotation, arm)
    away = jnp.sum(velocity * normal, axis=-1)
    press = jnp.where(depth < DEEPEST_M, _press(params, depth, -away, params.hull_stiffness_n_m), 0.0)
    slip = velocity - away[:, None] * normal
    speed = jnp.sqrt(jnp.sum(slip * slip, axis=-1) + 1e-8)
    drag = jnp.minimum(params.hull_friction * press / speed, params.hull_damping_n_s_m)
    return press[:, None] * normal - jnp.where(press > 0.0, drag, 0.0)[:, None] * slip


def _press(params: SkidSteerParams, depth: jax.Array, approach: jax.Array, stiffness: jax.Array) -> jax.Array:
    """Normal force [n] (N) of springs and dampers, which push only."""
    push = jnp.maximum(stiffness * depth + params.hull_damping_n_s_m * approach, 0.0)
    return jnp.where(depth > 0.0, push, 0.0)


def _velocity(body: RigidState, rotation: jax.Array, arm: jax.Array) -> jax.Array:
    """Velocity [n, 3] (m/s, world) of points ``arm`` [n, 3] (body)."""
    return body.velocity_m_s + to_world(rotation, jnp.cross(body.angular_velocity_rad_s, arm))
