"""Frictional contact of a body on four wheels: MuJoCo's convex problem, solved by a fixed number of Newton steps.

MuJoCo's primal problem with elliptic friction cones (MuJoCo documentation, "Computation") is: minimise over the
acceleration a

    1/2 a' M a - a' f + sum over the contacts of s(J a - aref).

In coordinates scaled by the friction, s is half a stiffness times the squared distance to a cone (see `Contacts`), with
three cases: inside the cone there is no force, in the opposite (polar) cone the contact sticks, and between them it
slides.

Newton's method needs many steps here, because the cost of sliding has nearly a kink where the slip changes its sign.
The primal-dual linearisation of Chan, Golub and Mulet (SIAM J. Sci. Comput. 20(6), 1999, for total variation) does not:
the direction d of the friction force is an unknown of its own with the equation |slip| d = slip. No line search is
needed.

The derivative is that of the iterations. That of the exact solution, which takes one linear solve, differs from it by
several percent, up to 20 %, where a wheel is at the border of sticking and they have not converged. Each linear solve
is differentiated implicitly. There are no data-dependent loops and no calls of a linear algebra library.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.pytree import pytree

NEWTON_ITERATIONS = 6
"""Mean error of the velocities after a 5 ms step on gentle bumps: 0.3 mm/s with 3 iterations, 0.08 with 4, 0.025 with
5; `mjx.solve` with 4 iterations of 6 line search steps: 0.7."""

Accelerations = tuple[jax.Array, jax.Array, jax.Array]  # linear [3], angular [3], of the wheels [4]; or forces

_SLIP_MIN_SQUARED = 1e-12  # (m/s^2)^2: no slip has a direction too, so that derivatives stay finite
_ROLLING = np.array([0.0, 1.0, 0.0], np.float32)  # row of the rolling direction


@pytree
class Contacts:
    """A body and its wheels with one contact under each wheel.

    The residual of a contact is u = ``axes`` x + ``moments`` z + ``rolling`` y (row 1 only) - ``reference`` with the
    linear and angular acceleration x and z of the body in its frame and the wheel accelerations y, in variables in
    which the mass matrix has no block that couples body and wheels. Rows are normal, rolling direction and side. The
    force is minus the gradient of 1/2 ``stiffness_kg`` distance(u, cone)^2 with the cone u0 >= ``opening`` |(u1, u2)|.
    """

    axes: jax.Array  # [4, 3, 3]
    moments: jax.Array  # [4, 3, 3] m
    rolling: jax.Array  # [4] m
    reference: jax.Array  # [4, 3] m/s^2
    stiffness_kg: jax.Array  # [4] zero for a wheel in the air
    opening: jax.Array  # [4]
    mass_kg: jax.Array  # []
    inertia_kg_m2: jax.Array  # [3, 3]
    wheel_inertia_kg_m2: jax.Array  # [4]
    force_n: jax.Array  # [3] body frame
    torque_nm: jax.Array  # [3] body frame
    wheel_torque_nm: jax.Array  # [4]


@pytree
class _ConeCost:
    """Cost of the residuals and its linearisation."""

    gradient: jax.Array  # [4, 3]
    hessian: jax.Array  # [4, 3, 3]
    direction: jax.Array  # [4, 2] of the slip, unit
    inverse_slip: jax.Array  # [4] s^2/m
    sliding: jax.Array  # [4] bool


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def solve(contacts: Contacts, iterations: int = NEWTON_ITERATIONS) -> Accelerations:
    """Acceleration of body [3], [3] and wheels [4] that minimises the cost; starts from zero acceleration."""
    return _iterate(contacts, iterations, _solve_linear)


@solve.defjvp
def _solve_jvp(
    iterations: int, primals: tuple[Contacts], tangents: tuple[Contacts]
) -> tuple[Accelerations, Accelerations]:
    """That of the iterations; reverse mode stores the problem and repeats them."""
    solution = jax.checkpoint(lambda contacts: _iterate(contacts, iterations, _differentiable_solve_linear))
    return jax.jvp(solution, primals, tangents)


def _iterate(contacts: Contacts, iterations: int, solve_linear: Callable[..., Accelerations]) -> Accelerations:
    """`solve` with ``solve_linear``, a function like `_solve_linear`."""

    def newton(carry: tuple[Accelerations, jax.Array, jax.Array], _: None) -> tuple[Any, None]:
        acceleration, residual, friction = carry
        cost = _cone_cost(contacts, residual, friction)
        step = solve_linear(contacts, cost.hessian, _imbalance(contacts, acceleration, cost.gradient))
        change = _residual_change(contacts, step)
        friction = _friction_direction(cost, friction, change[:, 1:])
        return (jax.tree.map(jnp.subtract, acceleration, step), residual - change, friction), None

    linear, angular, wheels = map(jnp.zeros_like, (contacts.force_n, contacts.torque_nm, contacts.wheel_torque_nm))
    friction = jnp.zeros_like(contacts.reference[:, 1:])
    carry = ((linear, angular, wheels), -contacts.reference, friction)
    return jax.lax.scan(newton, carry, None, length=iterations)[0][0]


def _cone_cost(contacts: Contacts, residual: jax.Array, friction: jax.Array) -> _ConeCost:
    """Cost of ``residual`` [4, 3]; ``friction`` [4, 2] is the friction's direction, an unknown of its own."""
    opening = contacts.opening
    normal, tangent = residual[:, 0], residual[:, 1:]
    slip_squared = jnp.maximum(tangent[:, 0] ** 2 + tangent[:, 1] ** 2, _SLIP_MIN_SQUARED)
    inverse_slip = jax.lax.rsqrt(slip_squared)
    slip = slip_squared * inverse_slip
    direction = tangent * inverse_slip[:, None]
    gap = normal - opening * slip
    sticking = opening * normal + slip <= 0.0
    sliding = (gap < 0.0) & ~sticking
    stick = jnp.where(sticking, contacts.stiffness_kg, 0.0)
    slide = jnp.where(sliding, contacts.stiffness_kg / (1.0 + opening * opening), 0.0)
    along = -slide * opening
    drag = stick + along * gap * inverse_slip  # friction over slip
    (e1, e2), (d1, d2) = direction.T, friction.T
    d1, d2 = jnp.where(sliding, d1, 0.0), jnp.where(sliding, d2, 0.0)
    n1, n2 = along * e1, along * e2
    t11 = drag * (1.0 - d1 * e1) - opening * n1 * e1
    t12 = -0.5 * drag * (d1 * e2 + d2 * e1) - opening * n1 * e2
    t22 = drag * (1.0 - d2 * e2) - opening * n2 * e2
    rows = ((stick + slide, n1, n2), (n1, t11, t12), (n2, t12, t22))
    return _ConeCost(
        gradient=jnp.concatenate([(stick * normal + slide * gap)[:, None], drag[:, None] * tangent], axis=-1),
        hessian=jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=1),
        direction=direction,
        inverse_slip=inverse_slip,
        sliding=sliding,
    )


def _friction_direction(cost: _ConeCost, friction: jax.Array, change: jax.Array) -> jax.Array:
    """Direction [4, 2] of the friction after a step by -``change`` [4, 2]: |slip| d = slip linearised, |d| <= 1."""
    e, d = cost.direction, jnp.where(cost.sliding[:, None], friction, 0.0)
    turned = e - (change - d * jnp.sum(e * change, axis=-1, keepdims=True)) * cost.inverse_slip[:, None]
    limited = turned * jax.lax.rsqrt(jnp.maximum(jnp.sum(turned * turned, axis=-1, keepdims=True), 1.0))
    return jnp.where(cost.sliding[:, None], limited, 0.0)


def _residual_change(contacts: Contacts, change: Accelerations) -> jax.Array:
    """Change [4, 3] of the residuals with the accelerations."""
    linear, angular, wheels = change
    body = jnp.sum(contacts.axes * linear, axis=-1) + jnp.sum(contacts.moments * angular, axis=-1)
    return body + (contacts.rolling * wheels)[:, None] * _ROLLING


def _imbalance(contacts: Contacts, acceleration: Accelerations, gradient: jax.Array) -> Accelerations:
    """Inertial forces less the smooth ones and those of the contacts, which are minus ``gradient`` [4, 3]."""
    linear, angular, wheels = acceleration
    force, torque = _body_wrench(contacts, gradient)
    return (
        contacts.mass_kg * linear - contacts.force_n + force,
        jnp.sum(contacts.inertia_kg_m2 * angular, axis=-1) - contacts.torque_nm + torque,
        contacts.wheel_inertia_kg_m2 * wheels - contacts.wheel_torque_nm + contacts.rolling * gradient[:, 1],
    )


def _body_wrench(contacts: Contacts, force: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Force [3] and torque [3] on the body of the contacts' ``force`` [4, 3] along their rows."""
    axes, moments = contacts.axes * force[:, :, None], contacts.moments * force[:, :, None]
    return jnp.sum(axes, axis=(0, 1)), jnp.sum(moments, axis=(0, 1))


def _solve_linear(contacts: Contacts, hessian: jax.Array, right: Accelerations) -> Accelerations:
    """Solve (M + J' ``hessian`` J) a = ``right`` by blocks: each wheel, then the angular, then the linear part.

    ``hessian`` [4, 3, 3] is that of the contacts. A wheel appears in its own contact alone.
    """
    force, torque, wheel_torque = right
    rolling = contacts.rolling
    coupling = hessian[:, :, 1]
    inverse = 1.0 / (contacts.wheel_inertia_kg_m2 + rolling * rolling * coupling[:, 1])
    share = rolling * inverse
    reduced = hessian - (rolling * share)[:, None, None] * coupling[:, :, None] * coupling[:, None, :]
    wheel_force, wheel_moment = _body_wrench(contacts, coupling * (share * wheel_torque)[:, None])
    linear, angular = _solve_body(contacts, reduced, force - wheel_force, torque - wheel_moment)
    change = _residual_change(contacts, (linear, angular, jnp.zeros_like(wheel_torque)))
    return linear, angular, inverse * wheel_torque - share * jnp.sum(coupling * change, axis=-1)


@jax.custom_jvp
def _differentiable_solve_linear(contacts: Contacts, hessian: jax.Array, right: Accelerations) -> Accelerations:
    """`_solve_linear` with the derivative below; apart, so that no rule stands in the solver's loop itself."""
    return _solve_linear(contacts, hessian, right)


@_differentiable_solve_linear.defjvp
def _solve_linear_jvp(
    primals: tuple[Contacts, jax.Array, Accelerations], tangents: tuple[Contacts, jax.Array, Accelerations]
) -> tuple[Accelerations, Accelerations]:
    """Of A a = b: A da = db - dA a."""
    (contacts, hessian, right), (*change, right_change) = primals, tangents
    solution, zero = _solve_linear(contacts, hessian, right), jax.tree.map(jnp.zeros_like, right)

    def product(problem: Contacts, hessian: jax.Array) -> Accelerations:
        force = jnp.sum(hessian * _residual_change(problem, solution)[:, None, :], axis=-1)
        unloaded = replace(problem, force_n=zero[0], torque_nm=zero[1], wheel_torque_nm=zero[2])
        return _imbalance(unloaded, solution, force)

    _, product_change = jax.jvp(product, (contacts, hessian), tuple(change))
    return solution, _solve_linear(contacts, hessian, jax.tree.map(jnp.subtract, right_change, product_change))


def _solve_body(
    contacts: Contacts, hessian: jax.Array, force: jax.Array, torque: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Linear and angular acceleration [3], [3] of the body alone, its contacts having the ``hessian`` [4, 3, 3]."""
    axes, moments = contacts.axes, contacts.moments
    by_linear, by_angular = _rows_by(hessian, axes), _rows_by(hessian, moments)
    inverse = _inverse(_gram(axes, by_linear) + contacts.mass_kg * jnp.eye(3))
    mixed = _gram(moments, by_linear)
    across = _product(mixed, inverse)
    held = _gram(moments, by_angular) + contacts.inertia_kg_m2 - _product(across, mixed.T)
    angular = jnp.sum(_inverse(held) * (torque - jnp.sum(across * force, axis=-1)), axis=-1)
    return jnp.sum(inverse * force, axis=-1) - jnp.sum(across * angular[:, None], axis=0), angular


def _rows_by(hessian: jax.Array, b: jax.Array) -> jax.Array:
    """Product [4, 3, 3] of each contact's ``hessian`` with its rows ``b`` [4, 3, 3]."""
    first, second, third = (hessian[:, :, row, None] * b[:, None, row] for row in range(3))
    return first + second + third


def _gram(a: jax.Array, b: jax.Array) -> jax.Array:
    """Sum [3, 3] over contacts and rows of the outer products of ``a`` and ``b`` [4, 3, 3].

    Written as three products: a reduction over both axes makes the whole solver slower (on a CPU by a fifth).
    """
    first, second, third = (a[:, row, :, None] * b[:, row, None, :] for row in range(3))
    return jnp.sum(first + second + third, axis=0)


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix product [3, 3] as a sum: a dot of this size would be a kernel of its own."""
    return jnp.sum(a[:, :, None] * b, axis=1)


def _inverse(matrix: jax.Array) -> jax.Array:
    """Inverse [3, 3] of a symmetric matrix by its cofactors; rounding errors vanish with the next Newton step."""
    cofactors = jnp.cross(jnp.stack([matrix[1], matrix[2], matrix[0]]), jnp.stack([matrix[2], matrix[0], matrix[1]]))
    return cofactors / jnp.sum(matrix[0] * cofactors[0])
