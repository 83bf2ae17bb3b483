"""A mission in real time with a vehicle outside, against the same mission rolled out."""

import signal
from dataclasses import replace

import jax
import numpy as np
import pytest

import swarmsim
from swarmsim.runtime.live import LiveMission

SHORT = [
    "engine=analytic", "localisation=null", "identification=null",
    "phases=[{name: look, who: [uav1, uav2], policy: waypoints, "
    "settings: {points: [[-70, -42], [-66, -42]], speed_m_s: 4.0, altitude_m: 6.0}, time_limit_s: 60.0}, "
    "{name: drive, who: orpheus, policy: waypoints, settings: {points: [[-76, -50]], speed_m_s: 0.9}, "
    "start: {after: look}, time_limit_s: 60.0}]",
]  # fmt: skip


@pytest.fixture(scope="module")
def simulation():
    return swarmsim.build(swarmsim.load("recon", SHORT))


def flown(live, moved=lambda body: body, seconds=100.0):
    """The mission with the vehicle where ``moved`` says; times at which it was in a phase."""
    live.start()
    live.begin_phases()
    inside = []
    while live.time_s < seconds:
        step = live.step(moved(live.body()), 0.9)
        inside.append(step.in_phase)
        if step.begins:
            live.begin_phases()
        if step.over:
            break
    return np.array(inside)


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["uav2", "orpheus"])
def test_a_vehicle_that_is_where_the_simulation_has_it_flies_the_same_mission(simulation, vehicle):
    live = LiveMission(simulation, 3, vehicle)
    live.prepare()
    inside = flown(live)
    assert 0.0 < inside.mean() < 1.0
    records = [swarmsim.mission_record(simulation, b, 0) for b in (live.result(), simulation.rollout([3]))]
    ours, theirs = records
    for one, other in zip(ours.vehicles, theirs.vehicles, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.time_s, other.time_s)
        np.testing.assert_allclose(one.position_m, other.position_m, atol=2e-3)
    assert [p.name for p in ours.phases] == [p.name for p in theirs.phases]
    np.testing.assert_allclose([p.end_s for p in ours.phases], [p.end_s for p in theirs.phases], atol=0.06)


@pytest.mark.slow
def test_nothing_that_the_simulation_would_have_happen_to_it_happens(simulation):
    live = LiveMission(simulation, 3, "uav1")
    live.prepare()

    def buried(body):  # as a receiver with an error of its height may have it
        place = np.array([body.position_m[0], body.position_m[1], body.position_m[2] - 3.0 * (live.time_s > 5.0)])
        return replace(body, position_m=place.astype(np.float32), velocity_m_s=np.array([0, 0, -9.0], np.float32))

    flown(live, buried, seconds=10.0)
    times = np.asarray(live._mission.world.groups[live.seat.group].event_time_s)[0, live.seat.local]
    assert np.isinf(times).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(live.body()))


@pytest.mark.slow
def test_a_vehicle_that_leaves_lets_the_mission_go_on(simulation):
    live = LiveMission(simulation, 3, "uav1")
    live.prepare()
    live.start()
    live.begin_phases()
    for _ in range(40):
        live.step(live.body(), 0.9)
    live.leave()
    over, begun = False, []
    while not over:
        step = live.step(live.body(), 0.9)
        begun += step.begins
        if step.begins:
            live.begin_phases()
        over = step.over
        assert live.time_s < 150.0
    assert begun == ["drive"]


def test_ctrl_c_within_a_step_leaves_a_mission_that_can_be_written(simulation, monkeypatch):
    live = LiveMission(simulation, 3, "uav1")
    live.start()
    live.begin_phases()
    run = live._batch.run

    def interrupted(*arguments, **named):
        made = run(*arguments, **named)
        signal.raise_signal(signal.SIGINT)
        return made

    with monkeypatch.context() as patched:
        patched.setattr(live._batch, "run", interrupted)
        with pytest.raises(KeyboardInterrupt):
            live.step(live.body(), 0.9)
    assert np.isfinite(np.asarray(live.result().end.over_s)).all()


def test_an_unknown_vehicle_is_refused(simulation):
    with pytest.raises(swarmsim.InputError, match="uav1"):
        LiveMission(simulation, 0, "uav9")
