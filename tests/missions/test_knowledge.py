"""What a mission knows before it has measured anything."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim
from swarmsim.missions import knowledge
from swarmsim.missions.begin import begin_mission
from swarmsim.runtime.fingerprint import fingerprint


@pytest.mark.slow
@pytest.mark.parametrize(
    "values",
    [[], ["knowledge.nuclides=[Cs-137, Co-60]", "knowledge.site=terrain", "localisation.sources_max=2"]],
    ids=["walls of unknown thickness", "no walls, two sources at most"],
)
def test_what_is_known_before_has_the_shapes_of_what_a_survey_tells(values: list[str]) -> None:
    """A loop carries it, and a mission goes on from it: it must be of the same kind leaf for leaf."""
    simulation = swarmsim.build(swarmsim.load("recon", ["engine=analytic", *values]))
    world, plan, key = simulation.world, simulation.plan, jax.random.key(0)
    mission, _ = jax.eval_shape(lambda: begin_mission(key, world, plan))

    def told(windows: object) -> object:
        measurements = knowledge.gathered(world, plan, windows, key)
        return knowledge.survey(knowledge.premises_of(plan), measurements, None, jnp.asarray(True))

    found = jax.eval_shape(told, mission.windows)
    assert jax.tree.structure(found) == jax.tree.structure(mission.survey)
    kinds = [[(x.shape, x.dtype) for x in jax.tree.leaves(tree)] for tree in (found, mission.survey)]
    assert kinds[0] == kinds[1]


def kind_of_estimate(values: list[str]) -> str:
    """What tells one program of the estimate from another, of `recon` with some values set."""
    simulation = swarmsim.build(swarmsim.load("recon", values))
    world, plan, key = simulation.world, simulation.plan, jax.random.key(0)
    mission, _ = jax.eval_shape(lambda: begin_mission(key, world, plan))
    measurements = jax.eval_shape(lambda windows: knowledge.gathered(world, plan, windows, key), mission.windows)
    whole = (knowledge.premises_of(plan), measurements, mission.survey)
    shapes = [(np.shape(x), str(x.dtype)) for x in jax.tree.leaves(whole)]
    return fingerprint((jax.tree.structure(whole), shapes))


def test_missions_that_fly_otherwise_estimate_by_the_same_program() -> None:
    """The estimate takes longer to compile than all else; only what it depends on may ask for another."""
    as_it_is = kind_of_estimate([])
    others = [
        ["engine=analytic", "timing.physics_steps=5", "wind.speed_m_s=0"],
        ["phases.0.time_limit_s=300", "phases.1.time_limit_s=900", "phases.1.settings.laps=1"],
        ["phases.0.settings.altitude_m=12", "sources.0.nuclide=Cs-137", "knowledge.nuclides=[Cs-137, Co-60]"],
        ["vehicles.0.type=dji_f550", "vehicles.1.type=dji_f550", "vehicles.2.type=dji_f550"],
    ]
    for values in others:
        assert kind_of_estimate(values) == as_it_is, values
    assert kind_of_estimate(["localisation.sources_max=2"]) != as_it_is
