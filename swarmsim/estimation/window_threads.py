"""Normal equations on an accelerator, with a thread for each window.

Compiled by XLA, the columns of all windows and their products pass through memory several times at each step, thousands
of numbers for each window. A thread reads what its window was counted with, and writes what it has to say of the
unknowns that windows share. Its own ones are eliminated in registers, and once more when the step of the others is
known: that costs less than to keep what they are eliminated with.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation.forward import Problem, Rates, lengthened, silent
from swarmsim.estimation.normal_equations import (
    Linearised,
    Others,
    Sums,
    Unknowns,
    linearised,
    moved,
    nothing_told,
    own_step,
    shared_equations,
    step_of,
    sums_of,
)
from swarmsim.pytree import pytree
from swarmsim.scalars import over_vehicles

LARGEST = 512  # elements of what a thread takes apart: products of all columns


@pytree
class _Window:
    """What belongs to one window."""

    problem: tuple[jax.Array, ...]  # see `_rows`
    source: Rates  # of the source sought
    others: Others
    own: jax.Array  # [2] its unknowns


@pytree
class _Shared:
    """What windows share."""

    stds: tuple[jax.Array, ...]  # see `_of_one`
    where: jax.Array  # [3]
    unknowns: Unknowns  # but those of windows
    change: jax.Array  # [U] of the lengths, since the rates were computed


class Fit(NamedTuple):
    """All unknowns of a fit, and a source whose rates were computed for other lengths."""

    problem: Problem
    computed: Rates
    begun: jax.Array  # [U] those lengths
    others: Others
    where: jax.Array  # [3] the source
    u: Unknowns


def fitted_by_threads(
    problem: Problem,
    others: Others,
    where: jax.Array,
    begin: Callable[[jax.Array | int, Unknowns], tuple[Unknowns, Rates]],
    passes: Sequence[int],
    start: Unknowns,
) -> tuple[Unknowns, Rates, Sums]:
    """The unknowns after Gauss-Newton steps, the rates of the source at ``where`` [3] then, and what the windows tell.

    There are so many steps in each of the ``passes``; ``begin`` gives what one starts from, by its number.
    """
    Carry = tuple[Unknowns, Rates, jax.Array, Sums]

    def pass_(number: jax.Array | int, carry: Carry) -> Carry:
        u, source = begin(number, carry[0])
        at, count = partial(Fit, problem, source, carry[0].lengths, others, where), jnp.array(passes)[number]

        def look(done: jax.Array, carry: tuple[Unknowns, Sums]) -> tuple[Unknowns, Sums]:
            sums = sums_by_threads(at(carry[0]))
            return jax.lax.cond(done < count, lambda: _stepped(at(carry[0]), sums), lambda: carry[0]), sums

        # what the windows tell is a kernel that takes long to compile: the last look is one of the same loop
        u, sums = jax.lax.fori_loop(0, count + (number == len(passes) - 1), look, (u, carry[3]))
        return u, source, carry[0].lengths, sums

    first = (start, silent(problem), start.lengths, nothing_told(problem, start))
    u, source, begun, sums = jax.lax.fori_loop(0, len(passes), pass_, first)
    return u, lengthened(source, u.lengths - begun), sums


def _stepped(fit: Fit, sums: Sums) -> Unknowns:
    step = step_of(*shared_equations(fit.problem, sums, fit.u)[0])
    return moved(fit.u, step, own_steps_by_threads(fit, step))


def sums_by_threads(fit: Fit, platform: str | None = None) -> Sums:
    """`sums_of` the windows of a fit. ``platform`` is that of `swarmsim.scalars.over_vehicles`."""
    size = nothing_told(fit.problem, fit.u).push.shape[0]
    upper = np.triu_indices(size)

    def one(window: _Window, shared: _Shared) -> Sums:
        found = sums_of(*_of_one(fit.problem, window, shared))
        return replace(found, whole=found.whole[upper])

    every = over_vehicles(one, (_AXES, None), small=LARGEST, beside=True, platform=platform)(*_arguments(fit))
    sums: Sums = jax.tree.map(lambda x: jnp.sum(x, axis=0), every)
    place = np.zeros((size, size), np.int32)
    place[upper] = np.arange(len(upper[0]))
    return replace(sums, whole=sums.whole[np.maximum(place, place.T)])


def own_steps_by_threads(fit: Fit, step: jax.Array, platform: str | None = None) -> jax.Array:
    """`own_step` [2, n] of the windows of a fit, by the ``step`` [P] of what they share; see `sums_by_threads`."""

    def one(window: _Window, shared: _Shared, step: jax.Array) -> jax.Array:
        return own_step(*_of_one(fit.problem, window, shared), step)[:, 0]

    every = over_vehicles(one, (_AXES, None, None), small=LARGEST, beside=True, platform=platform)(
        *_arguments(fit), step
    )
    return jnp.swapaxes(every, 0, 1)


_AXES: Any = _Window(problem=0, source=0, others=1, own=1)  # type: ignore[arg-type]


def _arguments(fit: Fit) -> tuple[_Window, _Shared]:
    problem, u = fit.problem, fit.u
    own = jnp.stack([u.background, u.gain])
    stds = (problem.background_std, problem.model_std, problem.tail)
    shared = replace(u, background=jnp.zeros(()), gain=jnp.zeros(()))
    return (
        _Window(problem=_rows(problem), source=fit.computed, others=fit.others, own=own),
        _Shared(stds=stds, where=fit.where, unknowns=shared, change=u.lengths - fit.begun),
    )


def _rows(problem: Problem) -> tuple[jax.Array, ...]:
    m = problem.measurements
    assert m.rois is not None
    return (
        m.valid, m.rois, m.exposure_s, m.position_m, problem.background, problem.trust, problem.pose_std_m,
        problem.detector, problem.dead_s,
    )  # fmt: skip


def _of_one(problem: Problem, window: _Window, shared: _Shared) -> tuple[Problem, Linearised, Unknowns]:
    """The problem of one window, the model, and the unknowns."""
    bare = jax.tree.map(lambda _: np.zeros(1, np.float32), problem)
    valid, rois, exposure, position, background, trust, pose_std, detector, dead = (x[None] for x in window.problem)
    background_std, model_std, tail = shared.stds
    here = replace(
        bare,
        measurements=replace(bare.measurements, valid=valid, rois=rois, exposure_s=exposure, position_m=position),
        background=background, trust=trust, pose_std_m=pose_std, detector=detector, dead_s=dead,
        background_std=background_std, model_std=model_std, tail=tail,
    )  # fmt: skip
    u = replace(shared.unknowns, background=window.own[:1], gain=window.own[1:])
    source: Rates = jax.tree.map(lambda x: x[None], window.source)
    others: Others = jax.tree.map(lambda x: x[:, None], window.others)
    return here, linearised(here, lengthened(source, shared.change), others, shared.where, u), u
