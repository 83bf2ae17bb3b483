"""Normal equations on an accelerator, with a thread for each window.

Compiled by XLA, the columns of all windows and their products pass through memory several times at each step, thousands
of numbers for each window. A thread reads what its window was counted with, and writes what it has to say of the
unknowns that windows share. Its own ones are eliminated in registers, and once more when the step of the others is
known: that costs less than to keep what they are eliminated with.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.estimation.forward import Problem, Rates, lengthened
from swarmsim.estimation.normal_equations import (
    Linearised,
    Others,
    Sums,
    Unknowns,
    linearised,
    nothing_told,
    own_step,
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


def sums_by_threads(
    problem: Problem,
    source: Rates,
    change: jax.Array,
    others: Others,
    where: jax.Array,
    u: Unknowns,
    platform: str | None = None,
) -> Sums:
    """`sums_of` at ``u``, with the rates of the source at ``where`` [3] `lengthened` by ``change`` [U].

    ``platform`` is that of `swarmsim.scalars.over_vehicles`.
    """
    size = nothing_told(problem, u).push.shape[0]
    upper = np.triu_indices(size)

    def one(window: _Window, shared: _Shared) -> Sums:
        here, model, u = _of_one(problem, window, shared)
        found = sums_of(here, model, u)
        return replace(found, whole=found.whole[upper])

    every = over_vehicles(one, (_AXES, None), small=LARGEST, beside=True, platform=platform)(
        *_arguments(problem, source, change, others, where, u)
    )
    sums: Sums = jax.tree.map(lambda x: jnp.sum(x, axis=0), every)
    place = np.zeros((size, size), np.int32)
    place[upper] = np.arange(len(upper[0]))
    return replace(sums, whole=sums.whole[np.maximum(place, place.T)])


def own_steps_by_threads(
    problem: Problem,
    source: Rates,
    change: jax.Array,
    others: Others,
    where: jax.Array,
    u: Unknowns,
    step: jax.Array,
    platform: str | None = None,
) -> jax.Array:
    """`own_step` [2, n] at ``u`` by the ``step`` [P] of what windows share; the rest as of `sums_by_threads`."""

    def one(window: _Window, shared: _Shared, step: jax.Array) -> jax.Array:
        here, model, u = _of_one(problem, window, shared)
        return own_step(here, model, u, step)[:, 0]

    every = over_vehicles(one, (_AXES, None, None), small=LARGEST, beside=True, platform=platform)(
        *_arguments(problem, source, change, others, where, u), step
    )
    return jnp.swapaxes(every, 0, 1)


_AXES: Any = _Window(problem=0, source=0, others=1, own=1)  # type: ignore[arg-type]


def _arguments(
    problem: Problem, source: Rates, change: jax.Array, others: Others, where: jax.Array, u: Unknowns
) -> tuple[_Window, _Shared]:
    own = jnp.stack([u.background, u.gain])
    stds = (problem.background_std, problem.model_std, problem.tail)
    shared = replace(u, background=jnp.zeros(()), gain=jnp.zeros(()))
    return (
        _Window(problem=_rows(problem), source=source, others=others, own=own),
        _Shared(stds=stds, where=where, unknowns=shared, change=change),
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
