"""The steps of a mission, batched and compiled: every function of one mission becomes one of B missions here."""

from collections.abc import Callable
from typing import Any

import jax

from swarmsim.estimation import Measurements
from swarmsim.missions import knowledge
from swarmsim.missions.batching import Axes, batched, in_groups, missions_together, shards_of, spread
from swarmsim.missions.knowledge import AerialKnowledge, GroundKnowledge
from swarmsim.missions.measure import Log
from swarmsim.missions.simulation import Dynamics
from swarmsim.missions.stage import Clock, Stage
from swarmsim.missions.world import World


def batch_stage(
    name: str,
    function: Callable[..., Any],
    axes: Axes,
    missions: int,
    clock: Clock,
    *,
    in_step: bool = True,
    out_axes: Any = 0,
) -> Stage:
    """The compiled form for a number of missions of a function of one: ``axes`` tells which arguments are theirs.

    ``in_step`` missions are vmapped, else they run in groups of `missions_together`. Missions are spread over the
    devices where each gets as many, unless ``out_axes`` says that some results are common to all.
    """
    shards = shards_of(missions) if out_axes == 0 else 1
    if missions % shards:
        shards = 1
    if in_step:
        part = batched(function, axes, missions // shards, out_axes)
    else:
        part = in_groups(function, axes, missions_together())
    return Stage(name, spread(part, axes, shards), clock)


class Stages:
    """The steps of the mission for a batch of B missions; arrays of missions have the leading axis B."""

    def __init__(self, dynamics: Dynamics, missions: int, starts: int, per_window: int, clock: Clock):
        """Compile nothing yet.

        ``starts`` is the number of starting points of the estimate, ``per_window`` that of the UAVs' samples in one of
        its windows.
        """
        per_sample = dynamics.timing.rover_ticks

        def learn_from_air(world: World, counts: Measurements) -> AerialKnowledge:
            return knowledge.learn_from_air(world, counts, per_window, starts)

        def count_on_ground(key: jax.Array, world: World, log: Log) -> Measurements:
            return knowledge.count_on_ground(key, world, log, per_sample)

        def learn_from_ground(
            key: jax.Array, world: World, known: AerialKnowledge, air: Measurements, ground: Measurements
        ) -> GroundKnowledge:
            return knowledge.learn_from_ground(key, world, known, air, ground, per_window)

        def in_step(name: str, function: Callable[..., Any], axes: Axes) -> Stage:
            return batch_stage(name, function, axes, missions, clock)

        def in_turn(name: str, function: Callable[..., Any], axes: Axes) -> Stage:
            return batch_stage(name, function, axes, missions, clock, in_step=False)

        self.plan_survey = in_step("plan the survey", dynamics.plan_survey, (None,))
        self.ready_to_fly = in_step("take off", dynamics.ready_to_fly, (0, None))
        self.fly = in_step("fly", dynamics.fly, (0, None, 0, 0, None))
        self.count_from_air = in_turn("count from the air", knowledge.count_from_air, (0, None, 0))
        self.learn_from_air = in_turn("learn from the air", learn_from_air, (None, 0))
        self.plan_route = in_turn("plan the route", dynamics.plan_route, (None, 0, 0))
        self.ready_to_drive = in_step("set out", dynamics.ready_to_drive, (None, 0))
        self.drive = in_step("drive", dynamics.drive, (None, 0, 0, None))
        self.count_on_ground = in_turn("count on the ground", count_on_ground, (0, None, 0))
        self.learn_from_ground = in_turn("learn from the ground", learn_from_ground, (0, None, 0, 0, 0))
