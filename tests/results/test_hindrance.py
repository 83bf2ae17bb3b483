"""What kept a rover from the source, as an answer's finding tells it."""

from types import SimpleNamespace

import numpy as np
import pytest

from swarmsim.results.answer import _hindrance
from swarmsim.results.finding import NO_SPECTRUM, NO_WAY, NOT_ASKED
from swarmsim.results.record import Event

LOST = Event(5.0, "orpheus", "vehicle", "collided with another vehicle")
DONE = Event(4.0, "orpheus", "finished", "had done its part of phase search")
OTHER = Event(3.0, "uav1", "crash", "hit the ground too fast, or tipped over")


@pytest.mark.parametrize(
    ("length_m", "asked", "events", "told"),
    [
        (20.0, True, [OTHER, DONE, LOST], f"{NO_SPECTRUM} (orpheus: collided with another vehicle)"),
        (20.0, True, [OTHER, DONE], None),
        (20.0, False, [OTHER, DONE], NOT_ASKED),
        (0.0, True, [LOST], NO_WAY),
    ],
)
def test_it_is_no_way_there_or_the_loss_of_one_that_was_sent(length_m, asked, events, told):
    phases = (SimpleNamespace(target="hotspot"), SimpleNamespace(target="source"))
    scenario = SimpleNamespace(
        members=(SimpleNamespace(name="uav1"), SimpleNamespace(name="orpheus")),
        vehicles=(SimpleNamespace(kind="multirotor"), SimpleNamespace(kind="skid_steer")),
        phase_members=((0,), (1,)),
        mission=SimpleNamespace(identification={} if asked else None),
    )
    path = SimpleNamespace(points_m=np.array([[[0.0, 0.0, 0.0], [length_m, 0.0, 0.0]]]))
    states = tuple(SimpleNamespace(path=path, began_s=np.float32(0.0)) for _ in phases)
    simulation = SimpleNamespace(plan=SimpleNamespace(phases=phases), scenario=scenario)
    assert _hindrance(simulation, SimpleNamespace(phases=states), events) == told
