"""The true sources of a mission, from the points of its world; and what sources give 1 m away."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from swarmsim.radiation.dose import gamma_constant
from swarmsim.results.record import Estimate, Floats, GammaConstant, TrueSource, VehicleRecord, carried_m
from swarmsim.runtime.simulation import Simulation
from swarmsim.world.build import grouped
from swarmsim.world.model import World


def true_sources(simulation: Simulation, world: World, vehicles: Sequence[VehicleRecord]) -> tuple[TrueSource, ...]:
    """The sources of one mission's world, whatever values it was given; one without activity is not there.

    ``vehicles`` are those of the mission, which carried sources are on.
    """
    points, emission = world.sources, world.emission
    number, activity = np.asarray(emission.number), np.asarray(points.activity_bq, float)
    names = tuple(simulation.scenario.nuclides)
    found = []
    for k, spec in enumerate(simulation.scenario.mission.sources):
        rows = np.flatnonzero(number == k)
        total = float(activity[rows].sum())
        if total <= 0.0:
            continue
        place = np.asarray(points.position_m, float)[rows]
        own = partial(
            TrueSource, nuclide=names[int(points.nuclide[rows[0]])], activity_mbq=1e-6 * total, form=spec.form
        )
        if spec.form == "carried":
            carrier, start = _carrier(simulation, world, int(rows[0])), place[0]
            pose = vehicles[carrier].position_m[:1], vehicles[carrier].quaternion[:1]
            found.append(own(position_m=carried_m(*pose, start)[0], carrier=carrier, offset_m=start))
        elif spec.form == "point":
            found.append(own(position_m=place[0]))
        else:
            middle: Floats = activity[rows] @ place / total
            corners = np.asarray(emission.corners_m, float)[np.asarray(emission.corner_of) == k]
            found.append(own(position_m=middle, points_m=place, corners_m=corners))
    return tuple(found)


def _carrier(simulation: Simulation, world: World, point: int) -> int:
    """Number of the vehicle that carries a point: the last points are carried, in the order of their carriers."""
    assert world.emission.carrier is not None
    row = int(world.emission.carrier[point - len(world.emission.number)])
    return [number for members in grouped(simulation.scenario) for number in members][row]


def gamma_constants(simulation: Simulation, sources: tuple[Estimate | TrueSource, ...]) -> dict[str, GammaConstant]:
    """Gamma constants of the nuclides of ``sources``."""
    nuclides = {source.nuclide: simulation.scenario.nuclides[source.nuclide] for source in sources}
    return {
        name: GammaConstant(gamma_constant(nuclide), gamma_constant(nuclide, "air_kerma"))
        for name, nuclide in sorted(nuclides.items())
    }
