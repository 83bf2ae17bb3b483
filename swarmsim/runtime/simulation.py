"""A scenario built at its site: rolled out as whole missions, or stepped by hand."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from swarmsim import randomness
from swarmsim.config.errors import InputError, Problem, raise_if_any
from swarmsim.config.family import CAN_VARY, canonical, ends_of
from swarmsim.config.files import SHOWN
from swarmsim.config.mission import SEED_END
from swarmsim.config.scenario import Scenario
from swarmsim.config.site_checks import check_site
from swarmsim.config.values import ORIGIN, with_values
from swarmsim.families.draw import Drawer, Draws, with_given
from swarmsim.missions.knowledge import Conclusion
from swarmsim.missions.plan import Plan
from swarmsim.missions.plan_build import build_plan, listens
from swarmsim.missions.state import MissionState
from swarmsim.runtime.batch import Batch, Spread, filled, layout_for
from swarmsim.runtime.clock import Clock
from swarmsim.runtime.mission_run import MissionRun, Segment
from swarmsim.runtime.progress import Progress, SilentProgress
from swarmsim.scalars import Layout
from swarmsim.site import SiteModel
from swarmsim.world.build import build_world
from swarmsim.world.model import World
from swarmsim.world.state import WorldState
from swarmsim.world.step import reset


@dataclass(frozen=True)
class MissionBatch:
    """B missions as they were flown."""

    seeds: np.ndarray  # [B]
    worlds: Spread
    plans: Spread
    end: MissionState  # [B, …] at the end, its clock left out
    segments: tuple[Segment, ...]
    conclusion: Conclusion | None  # [B, …]; None where the mission estimates no source
    clock: Clock
    draws: Draws  # what differs between them besides their seeds

    @property
    def simulated_s(self) -> float:
        """Simulated seconds of all missions."""
        return float(np.sum(np.asarray(self.end.over_s)[: len(self.seeds)]))


class Simulation:
    """A scenario built at its site.

    ``world`` and ``plan`` are one mission's, for use with the pure functions of `swarmsim.world.step`; of a family
    (`vary` of the mission) those of the scenario's own seed. Roll out as often as you like, with whatever values: what
    has been compiled is kept, also for other simulations that differ from this one in values only.
    """

    def __init__(self, scenario: Scenario, site_model: SiteModel):
        """Build the arrays; nothing is compiled yet.

        Raises `InputError` where periods, detectors and vehicles do not go together, or nothing can be drawn.
        """
        self.scenario, self.site_model = scenario, site_model
        self._drawer = Drawer(scenario, site_model)
        seed = scenario.mission.seed
        self.draws = self._drawer.draw([seed])
        self.world, self.plan = self._drawn(seed, {path: value for path, (value,) in self.draws.values.items()})
        self._batches: dict[int, Batch] = {}
        self.clock = Clock()

    def reset(self, seed: int) -> WorldState:
        """One mission's world at its start, to be stepped by hand with `swarmsim.step`: every vehicle is active."""
        return reset(self.world, jax.random.key(seed))

    def draw(self, seeds: int | Sequence[int] | np.ndarray) -> Draws:
        """What the missions ``seeds`` of a family draw; ``values`` of it can be changed and given to `rollout`."""
        return self._drawer.draw(_numbers(seeds))

    def world_of(self, seed: int) -> World:
        """The world of the mission ``seed`` of a family, to be stepped by hand; of the shapes of ``world``."""
        world, plan = self._drawn(seed, {path: value for path, (value,) in self.draw(seed).values.items()})
        self._check_alike((world, plan), self.draws.values)
        return world

    def check_family(self) -> None:
        """Build the mission at the ends of every distribution, one at a time; raises `InputError` where that fails."""
        own = {path: value for path, (value,) in self.draws.values.items()}
        first = {varied.key: varied for varied in reversed(self.scenario.family)}
        problems: list[Problem] = []
        for key, varied in first.items():
            for value in ends_of(varied):
                try:
                    built = _built(with_values(self.scenario, own | {varied.path: value}), self.site_model)
                    self._check_alike(built, [key])
                except InputError as error:
                    told, place = error.problems[0], ("vary", key, varied.distribution.kind)
                    hints = {"allowed": told.allowed or CAN_VARY, "suggestion": told.suggestion}
                    message = f"draws a value with which the mission is wrong: {told.message}"
                    problems.append(self.scenario.problem(place, message, given=str(value), **hints))
                    break
        raise_if_any(problems)

    def rollout(
        self,
        seeds: int | Sequence[int] | np.ndarray,
        values: Mapping[str, Sequence[Any]] | None = None,
        progress: Progress | None = None,
    ) -> MissionBatch:
        """Run the missions of ``seeds`` to their end, in one batch.

        Args:
            seeds: a number, or a sequence of B.
            values: for each path of the scenario (``"sources.0.activity_mbq"``) a value for each of the B missions,
                in the stead of what a family draws there.
            progress: is told how far the missions are.

        Raises:
            InputError: a path or a value is wrong, or changes more than values (a count, a policy, a period).
        """
        tell = progress or SilentProgress()
        numbers = _numbers(seeds)
        padded = filled(numbers)
        batch = self._batches.setdefault(len(padded), Batch(len(padded), self.clock))
        self.clock.reset()
        layout = layout_for(self.world.vehicles * batch.missions // batch.shards)
        draws = self._given(self.draw(numbers), values or {})
        worlds, plans = self._spread(batch, draws, layout, tuple(values or ()))
        run = MissionRun(batch, worlds, plans, self.plan, tell)
        keys = batch.put(randomness.mission_keys(padded))
        end, segments = run.fly(keys)
        return MissionBatch(
            seeds=numbers,
            worlds=worlds,
            plans=plans,
            end=end,
            segments=tuple(segments),
            conclusion=run.conclude(end),
            clock=self.clock.copy(),
            draws=draws,
        )

    def alone(self, seed: int) -> "tuple[Draws, Batch, Spread, Spread]":
        """One mission's draws, and what its programs work on: for a host that runs them one by one."""
        draws = self.draw(seed)
        batch = self._batches.setdefault(1, Batch(1, self.clock))
        return draws, batch, *self._spread(batch, draws, layout_for(self.world.vehicles))

    def _given(self, draws: Draws, values: Mapping[str, Sequence[Any]]) -> Draws:
        """The draws with ``values`` in their stead."""
        missions = len(draws.seeds)
        if not isinstance(values, Mapping):
            allowed = 'a value for each mission by path: {"wind.speed_m_s": [1.0, 2.0]}'
            raise InputError.of("are no values", path="values", given=repr(values)[:SHOWN], allowed=allowed)
        for path, each in values.items():
            single = isinstance(each, str | bytes | Mapping) or np.ndim(np.asarray(each, object)) == 0
            if single or len(each) != missions:
                given = repr(each)[:SHOWN] if single else f"{len(each)} values"
                raise InputError.of(
                    "needs a value for each mission", path=str(path), given=given, allowed=f"a list of {missions}"
                )
            self._check_defined(str(path))
        scenario = self.scenario
        named = {canonical(scenario.document, path, scenario.mission_file): each for path, each in values.items()}
        return with_given(draws, named)

    def _check_defined(self, path: str) -> None:
        """Raise `InputError` for a value in a definition that the mission does not hold, but the library."""
        section, *where = path.split(".")
        there: Any = self.scenario.document.data.get("definitions")
        for step in where[:2]:
            there = there.get(step) if isinstance(there, Mapping) else None
        if section == "definitions" and there is None and len(where) > 2:
            hint = f'set it once when the mission is loaded: swarmsim.load(mission, ["{path}=…"])'
            what = f"is in no definition of the mission: values are those of the library's {where[1]}"
            raise InputError.of(what, path=path, suggestion=hint)

    def _drawn(self, seed: int, row: Mapping[str, Any], given: Sequence[str] = ()) -> tuple[World, Plan]:
        """World and plan of a mission with these values; raises `InputError`, which tells the seed, for wrong ones."""
        scenario = self.scenario
        if not row:
            return _built(scenario, self.site_model)
        try:
            scenario = with_values(scenario, row)
            if self.scenario.family:
                raise_if_any(check_site(scenario, self.site_model))
            return _built(scenario, self.site_model)
        except InputError as error:
            if not self.scenario.family:
                raise
            raise InputError(self._drawn_so(problem, seed, given) for problem in error.problems) from None

    def _drawn_so(self, problem: Problem, seed: int, given: Sequence[str]) -> Problem:
        """What is wrong with the mission of a seed; told where the distribution stands that drew it, or as given."""
        told = replace(problem, message=f"{problem.message} (in the mission of seed {seed})")
        if problem.file != ORIGIN:
            return told
        path = f"{problem.path}."
        if any(path.startswith(f"{own}.") or f"{own}.".startswith(path) for own in given):
            return replace(told, file="values")
        family = self.scenario.family
        about = [v for v in family if path.startswith(f"{v.path}.") or f"{v.path}.".startswith(path)]
        if not about:
            return told
        varied = max(about, key=lambda v: len(v.path))  # the number of sources is about all that is wrong with one
        place = ("vary", varied.key, varied.distribution.kind)
        message = f"draws a value with which the mission is wrong: {told.message}"
        hints = {"given": told.given, "allowed": told.allowed, "suggestion": told.suggestion}
        return self.scenario.problem(place, message, **hints)

    def _spread(
        self, batch: Batch, draws: Draws, layout: Layout, given: Sequence[str] = ()
    ) -> tuple[Spread, Spread]:  # fmt: skip
        """World and plan of every mission; the values of the paths ``given`` were not drawn."""
        values = draws.values
        if not values:
            return batch.spread([replace(self.world, layout=layout)]), batch.spread([self.plan])
        built: dict[tuple[Any, ...], tuple[World, Plan]] = {}
        pairs = []
        for seed, row in zip(draws.seeds, zip(*values.values(), strict=True), strict=True):
            key = tuple(map(repr, row))
            if key not in built:
                built[key] = self._drawn(seed, dict(zip(values, row, strict=True)), given)
                self._check_alike(built[key], values)
            pairs.append(built[key])
        worlds = [replace(world, layout=layout) for world, _ in pairs]
        return batch.spread(worlds), batch.spread([plan for _, plan in pairs])

    def _check_alike(self, built: tuple[World, Plan], values: Iterable[str]) -> None:
        """Refuse what would need another program: other sizes, or other static choices."""
        for own, other in zip((self.world, self.plan), built, strict=True):
            leaves, structure = jax.tree.flatten(own)
            others, other_structure = jax.tree.flatten(other)
            if str(structure) != str(other_structure) or [*map(np.shape, leaves)] != [*map(np.shape, others)]:
                raise InputError.of(
                    "changes more than a value (a number of things, a policy, a period, a size): missions of one batch "
                    "must agree in those",
                    path=", ".join(values),
                    suggestion="roll out a simulation of its own for each",
                )


def _numbers(seeds: Any) -> np.ndarray:
    """Seeds [B] as int64; raises `InputError` for what are none."""
    try:
        numbers = np.atleast_1d(np.asarray(seeds))
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    whole = np.issubdtype(numbers.dtype, np.integer) and numbers.ndim == 1 and numbers.size > 0
    if not whole or numbers.min() < 0 or numbers.max() >= SEED_END:
        allowed = f"a whole number from 0 to {SEED_END - 1}, or a list of at least one"
        raise InputError.of("are no seeds", path="seeds", given=repr(seeds)[:SHOWN], allowed=allowed)
    return numbers.astype(np.int64)


def _built(scenario: Scenario, site_model: SiteModel) -> tuple[World, Plan]:
    mates = scenario.mission.radio.mates if listens(scenario) else 0
    world = build_world(scenario, site_model, mates)
    return world, build_plan(scenario, site_model, world)


__all__ = ["MissionBatch", "Simulation"]
