"""What a mission knows before it has measured anything."""

import jax
import pytest

import swarmsim
from swarmsim.missions import knowledge
from swarmsim.missions.begin import begin_mission


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
        return knowledge.survey(plan, *knowledge.gathered(world, plan, windows, key), None)

    found = jax.eval_shape(told, mission.windows)
    assert jax.tree.structure(found) == jax.tree.structure(mission.survey)
    kinds = [[(x.shape, x.dtype) for x in jax.tree.leaves(tree)] for tree in (found, mission.survey)]
    assert kinds[0] == kinds[1]
