"""A mission stepped by hand: what its record has, against the frames that it is made of."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim
from swarmsim.control.commands import multirotor_command
from swarmsim.results.hand_stepped import BY_HAND
from swarmsim.results.names import RECORDING, SUMMARY

TEAM = (
    "engine=analytic",
    "wind.speed_m_s=0",
    "vehicles=[{name: uav, type: tarot_t650, position_m: [-74, -42]}]",
    "sources.0.position_m=[-70, -42]",
    "phases=[{name: wait, who: uav, policy: hold, time_limit_s: 10}]",
)
TICKS, DROPPED = 600, 350


@pytest.fixture(scope="module")
def simulation() -> swarmsim.Simulation:
    return swarmsim.build(swarmsim.load("recon", TEAM))


@pytest.fixture(scope="module")
def flown(simulation: swarmsim.Simulation) -> tuple[swarmsim.WorldState, swarmsim.Frame]:
    """Climb for 3.5 s, then stop the rotors."""
    world, state = simulation.world, simulation.reset(seed=3)
    rotors = world.groups[0].params.rotor_spin.shape[-1]
    up = multirotor_command(swarmsim.go_to(jnp.array([-74.0, -42.0, 12.0])), rotors)
    off = multirotor_command(swarmsim.RotorSpeedCommand(rotor_speed_rad_s=jnp.zeros(rotors)), rotors)

    def tick(state: swarmsim.WorldState, number: jax.Array) -> tuple[swarmsim.WorldState, swarmsim.Frame]:
        command = jax.tree.map(lambda a, b: jnp.where(number < DROPPED, a, b)[None], up, off)
        state, _ = swarmsim.step(world, state, (command,))
        return state, swarmsim.observe(world, state)

    return jax.jit(lambda state: jax.lax.scan(tick, state, jnp.arange(TICKS)))(state)


@pytest.fixture(scope="module")
def record(simulation: swarmsim.Simulation, flown: tuple) -> swarmsim.MissionRecord:
    return swarmsim.record_steps(simulation, flown[1], seed=3)


@pytest.mark.slow
def test_the_track_is_what_was_observed(record: swarmsim.MissionRecord, flown: tuple) -> None:
    (vehicle,) = record.vehicles
    state = flown[0].groups[0].vehicle
    np.testing.assert_allclose(vehicle.time_s, 0.01 * np.arange(1, TICKS + 1), rtol=1e-5)
    np.testing.assert_array_equal(vehicle.position_m[-1], state.body.position_m[0])
    np.testing.assert_array_equal(vehicle.quaternion[-1], state.body.quaternion[0])
    assert vehicle.energy_wh[-1] == pytest.approx(float(state.energy_j[0]) / 3600.0)
    assert vehicle.position_m[:, 2].max() > 5.0
    (phase,) = record.phases
    assert (phase.name, phase.vehicles, phase.in_time) == (BY_HAND, (0,), True)
    assert (phase.start_s, phase.end_s) == pytest.approx((0.01, 6.0))


def test_the_drop_is_a_crash_at_its_time(record: swarmsim.MissionRecord) -> None:
    (vehicle,), (event,) = record.vehicles, record.events
    assert vehicle.crashed
    assert (event.vehicle, event.kind) == ("uav", "crash")
    top = vehicle.position_m[DROPPED - 1]
    low = vehicle.time_s[np.argmax(vehicle.position_m[:, 2] - vehicle.position_m[0, 2] < 0.2 * top[2])]
    assert DROPPED * 0.01 < event.time_s < 6.0
    assert low < event.time_s


def test_samples_are_the_exposures_that_ended_in_flight(record: swarmsim.MissionRecord, flown: tuple) -> None:
    reading = flown[1].groups[0].reading
    new = np.asarray(reading.fresh & reading.valid)
    samples = record.samples
    assert len(samples.time_s) == new.sum() > 30
    np.testing.assert_array_equal(samples.counts, np.asarray(reading.counts)[new])
    np.testing.assert_array_equal(samples.time_s, np.asarray(reading.time_s)[new])
    assert set(samples.phase) == {BY_HAND}
    assert samples.time_s.max() <= record.events[0].time_s + 0.1  # a lost vehicle measures no more


def test_frames_need_not_be_of_every_tick(simulation: swarmsim.Simulation, record, flown: tuple) -> None:
    seldom = swarmsim.record_steps(simulation, jax.tree.map(lambda x: x[2::5], flown[1]), seed=3)
    mean = seldom.samples.counts.mean(), record.samples.counts.mean()
    assert mean[0] == pytest.approx(mean[1], rel=0.05)
    assert len(seldom.samples.time_s) >= len(record.samples.time_s) - 1
    assert len(seldom.vehicles[0].time_s) == TICKS // 5


def test_the_truth_is_recorded_and_nothing_was_sought(record: swarmsim.MissionRecord) -> None:
    assert [source.activity_mbq for source in record.sources] == pytest.approx([170.0])
    np.testing.assert_allclose(record.sources[0].position_m[:2], [-70.0, -42.0])
    assert (record.sought, record.map, record.estimate) == ("nothing", None, None)


def test_it_is_a_run_like_any_other(simulation: swarmsim.Simulation, record, tmp_path: Path) -> None:
    summary = swarmsim.write_run(simulation, [record], tmp_path / "by_hand")
    assert summary["vehicles"][0]["state"] == "crashed"
    assert summary["phases"][BY_HAND]["measurements"] == len(record.samples.time_s)
    assert {SUMMARY, RECORDING} <= {path.name for path in (tmp_path / "by_hand").iterdir()}
    figures = {path.stem for path in (tmp_path / "by_hand" / "figures").glob("*.png")}
    assert figures == {"trajectories", "measurements_by_hand"}


def test_frames_of_several_missions_are_refused(simulation: swarmsim.Simulation, flown: tuple) -> None:
    several = jax.tree.map(lambda x: jnp.stack([x, x]), flown[1])
    with pytest.raises(ValueError, match=r"stacked over time.*\(2, 600\)"):
        swarmsim.record_steps(simulation, several, seed=3)
