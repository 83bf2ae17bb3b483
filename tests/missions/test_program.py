"""Missions as programs: overlapping phases, users' policies, other values without compiling, teams of every kind."""

import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim

FIELD = """
name: {name}
site: meadows
engine: analytic
timing: {{decision_period_s: 0.5}}
sources: [{{nuclide: Co-60, position_m: [-200, 60], height_m: 0.5, activity_mbq: 2000}}]
vehicles:
{vehicles}
phases:
{phases}
"""
UAVS = "  - {name: uav, type: tarot_t650, position_m: [-190, 40], formation: {count: 2, columns: 2, spacing_m: 8}}"
CLIMB = '''
import jax.numpy as jnp
import swarmsim


class Climb:
    """Climb to a height, and remember how often it was asked."""

    class Settings(swarmsim.PolicySettings):
        height_m: float = 5.0

    period_s = 0.1

    def start(self, task, key):
        return jnp.zeros(())

    def act(self, task, memory, view, key):
        target = jnp.append(task.home_m, view.position_m[2] - view.height_m + task.settings.height_m)
        return memory + 1.0, swarmsim.go_to(target)

    def done(self, task, memory, view):
        return jnp.abs(view.height_m - task.settings.height_m) < 0.3
'''

SENSING = '''
import jax.numpy as jnp
import swarmsim


class Level:
    """Climb to a height by the barometer, and remember what was read."""

    senses = ("barometer", "gnss", "imu")

    def start(self, task, key):
        return {"ground_pa": jnp.zeros(()), "messages": jnp.zeros(()), "force": jnp.zeros(()), "calls": jnp.zeros(())}

    def act(self, task, memory, view, key):
        read = view.sensors
        ground = jnp.where((memory["ground_pa"] == 0.0) & read.barometer_fresh, read.pressure_pa, memory["ground_pa"])
        climbed = jnp.where(ground > 0.0, (ground - read.pressure_pa) / 11.5, 0.0)
        memory = {
            "ground_pa": ground,
            "messages": memory["messages"] + read.gnss_fresh,
            "force": memory["force"] + jnp.where(read.imu_fresh, read.accel_m_s2[2], 0.0),
            "calls": memory["calls"] + read.imu_fresh,
        }
        return memory, swarmsim.fly_velocity(jnp.array([0.0, 0.0, 0.7]) * jnp.clip(6.0 - climbed, -1.0, 1.0))
'''


def written(folder, name: str, vehicles: str, phases: str):
    path = folder / f"{name}.yaml"
    path.write_text(FIELD.format(name=name, vehicles=vehicles, phases=textwrap.indent(phases, "  ")), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def climbing(tmp_path_factory):
    folder = tmp_path_factory.mktemp("climb")
    (folder / "my.py").write_text(CLIMB, encoding="utf-8")
    phases = "- {name: up, who: uav, policy: 'my.py:Climb', settings: {height_m: 6}, time_limit_s: 20}"
    return swarmsim.build(swarmsim.load(written(folder, "climbing", UAVS, phases)))


@pytest.fixture(scope="module")
def together(climbing):
    return climbing.rollout([0, 3, 5])


@pytest.mark.slow
def test_a_users_policy_from_a_file_flies(climbing, together):
    for index in range(3):
        record = swarmsim.mission_record(climbing, together, index)
        (phase,) = record.phases
        assert phase.in_time
        for vehicle in record.vehicles:
            height = vehicle.position_m[-1, 2] - vehicle.position_m[0, 2]
            assert height == pytest.approx(6.0, abs=0.4)
        asked = np.asarray(together.end.phases[0].memory)[index]
        ticks = round(float(together.end.over_s[index]) / 0.5) * 50
        np.testing.assert_allclose(asked, np.ceil(ticks / 10), atol=6)  # each 0.1 s; the last segment runs to its end


def test_decision_periods_in_one_call_are_those_of_a_call_each(climbing, together, monkeypatch):
    monkeypatch.setattr("swarmsim.runtime.mission_run.AT_ONCE", 1)
    one_by_one = climbing.rollout([0, 3, 5])
    assert len(together.segments) < len(one_by_one.segments) == sum(s.periods for s in one_by_one.segments)
    assert sum(s.periods for s in together.segments) == len(one_by_one.segments)
    np.testing.assert_array_equal(together.end.over_s, one_by_one.end.over_s)
    for index in range(3):
        records = [swarmsim.mission_record(climbing, batch, index) for batch in (together, one_by_one)]
        for vehicle, other in zip(*(record.vehicles for record in records), strict=True):
            np.testing.assert_array_equal(vehicle.time_s, other.time_s)
            np.testing.assert_allclose(vehicle.position_m, other.position_m, atol=1e-4)
        np.testing.assert_array_equal(*(record.samples.time_s for record in records))
        np.testing.assert_array_equal(*(record.samples.counts for record in records))


@pytest.mark.slow
def test_a_policy_is_asked_at_its_period_and_told_of_each_reading_once(tmp_path):
    """Every tick; every third of them, which falls between judgements; and every second judgement."""
    (tmp_path / "my.py").write_text(LISTEN, encoding="utf-8")
    names = ["Tick", "Third", "Slow"]
    vehicles = "\n".join(
        f"  - {{name: {n}, type: tarot_t650, position_m: [-190, {40 + 9 * k}]}}" for k, n in enumerate(names)
    )
    phases = "\n".join(f"- {{name: p{n}, who: {n}, policy: 'my.py:{n}', time_limit_s: 2}}" for n in names)
    simulation = swarmsim.build(swarmsim.load(written(tmp_path, "listening", vehicles, phases)))
    batch = simulation.rollout(0)
    ticks = sum(s.of(0, s.log.time_s).size for s in batch.segments) * simulation.world.timing.log_ticks
    asked, fresh = (np.array([np.asarray(p.memory[k])[0, 0] for p in batch.end.phases]) for k in ("asked", "fresh"))
    np.testing.assert_array_equal(asked, [ticks, -(-ticks // 3), -(-ticks // 10)])
    exposures = ticks // simulation.world.groups[0].counter.ticks
    assert fresh[0] == exposures - 1  # the last one ended after the policy was asked for the last time


LISTEN = '''
import jax.numpy as jnp
import swarmsim


class Tick:
    """Stand, and remember how often it was asked, and how often a reading was fresh."""

    def start(self, task, key):
        return {"asked": jnp.zeros(()), "fresh": jnp.zeros(())}

    def act(self, task, memory, view, key):
        seen = {"asked": memory["asked"] + 1.0, "fresh": memory["fresh"] + view.reading.fresh}
        return seen, swarmsim.go_to(view.position_m)


class Third(Tick):
    period_s = 0.03


class Slow(Tick):
    period_s = 0.1
'''


def test_other_values_and_seeds_compile_nothing(climbing):
    climbing.rollout([0, 1, 2])
    values = {
        "sources.0.activity_mbq": [100.0, 2000.0, 3000.0],
        "wind.speed_m_s": [0.0, 3.0, 6.0],
        "phases.up.settings.height_m": [4.0, 5.0, 7.0],
    }
    batch = climbing.rollout([7, 8, 9], values=values)
    assert not batch.clock.compiled
    records = [swarmsim.mission_record(climbing, batch, index) for index in range(3)]
    assert [r.sources[0].activity_mbq for r in records] == pytest.approx([100.0, 2000.0, 3000.0])
    for record, height in zip(records, (4.0, 5.0, 7.0), strict=True):
        track = record.vehicles[0].position_m[:, 2]
        assert track[-1] - track[0] == pytest.approx(height, abs=0.5)
    # another simulation that differs in values only finds the programs of the first
    other = swarmsim.build(
        swarmsim.load(
            climbing.scenario.mission_file, ["wind.speed_m_s=4", "definitions.vehicles.tarot_t650.mass_kg=3.6"]
        )
    )
    assert not other.rollout([1, 2, 3]).clock.compiled


def test_values_that_change_more_than_values_are_refused(climbing):
    with pytest.raises(swarmsim.InputError, match="a value for each mission"):
        climbing.rollout([0, 1], values={"wind.speed_m_s": [1.0]})
    with pytest.raises(swarmsim.InputError, match="changes more than a value"):
        climbing.rollout([0], values={"timing.judge_period_s": [0.02]})
    with pytest.raises(swarmsim.InputError, match="no field"):
        climbing.rollout([0], values={"wind.sped_m_s": [1.0]})


WEST, SOUTH, EAST, NORTH = AREA = (-180.0, 30.0, -140.0, 60.0)  # m


@pytest.fixture(scope="module")
def overlapping(tmp_path_factory):
    """The record of a mission whose UAVs cover an area while a rover drives out and back."""
    vehicles = UAVS + "\n  - {name: rover, type: orpheus, position_m: [-150, 60]}"
    corners = f"[[{WEST}, {SOUTH}], [{EAST}, {SOUTH}], [{EAST}, {NORTH}], [{WEST}, {NORTH}]]"
    phases = f"""
- {{name: fly, who: uav, policy: parallel_lines, time_limit_s: 120,
   settings: {{altitude_m: 12, speed_m_s: 6, line_spacing_m: 6, area_m: {corners}}}}}
- {{name: drive, who: rover, policy: waypoints, start: {{at_s: 4}}, time_limit_s: 60,
   settings: {{points: [[-145, 66]], speed_m_s: 1.0}}}}
- {{name: back, who: rover, policy: waypoints, start: {{after: drive, delay_s: 2}}, time_limit_s: 60,
   settings: {{points: [[-150, 60]], speed_m_s: 1.0}}}}
"""
    folder = tmp_path_factory.mktemp("overlap")
    simulation = swarmsim.build(swarmsim.load(written(folder, "overlap", vehicles, phases)))
    return swarmsim.mission_record(simulation, simulation.rollout(3), 0)


def test_phases_overlap_and_follow_one_another(overlapping):
    record = overlapping
    fly, drive, back = record.phases
    assert all(phase.in_time for phase in record.phases)
    assert fly.start_s == 0.0
    assert drive.start_s == 4.0
    assert drive.start_s < fly.end_s  # the rover set out while the UAVs still flew
    assert drive.end_s + 2.0 <= back.start_s <= drive.end_s + 2.5
    rover = record.vehicles[2]
    np.testing.assert_allclose(rover.position_m[-1, :2], [-150.0, 60.0], atol=0.5)
    for uav in record.vehicles[:2]:
        assert np.linalg.norm(uav.position_m[-1] - uav.position_m[0]) < 0.6  # home again


def test_an_area_of_the_users_is_covered_and_nothing_else(overlapping):
    assert not any(vehicle.crashed for vehicle in overlapping.vehicles)
    flown = [vehicle.position_m for vehicle in overlapping.vehicles[:2]]
    places = np.concatenate([place[place[:, 2] > place[:, 2].max() - 3.0] for place in flown])
    homes = np.array([place[0, :2] for place in flown])
    low, high = np.minimum(homes.min(axis=0), AREA[:2]), np.maximum(homes.max(axis=0), AREA[2:])
    assert np.all((places[:, :2] > low - 4.0) & (places[:, :2] < high + 4.0))
    across = np.stack(np.meshgrid(np.arange(WEST + 2, EAST, 4.0), np.arange(SOUTH + 2, NORTH, 4.0)), axis=-1)
    gaps = np.linalg.norm(across[..., None, :] - places[:, :2], axis=-1).min(axis=-1)
    assert gaps.max() < 4.0  # half the spacing, and half a metre of wind


TEAMS = {
    "T650 with x500": "  - {name: a, type: tarot_t650, position_m: [-190, 40]}\n"
    "  - {name: b, type: x500, position_m: [-180, 40]}",
    "several rovers": "  - {name: a, type: orpheus, position_m: [-190, 40]}\n"
    "  - {name: b, type: orpheus, position_m: [-180, 40]}",
    "UAVs and rovers": "  - {name: a, type: x500, position_m: [-190, 40]}\n"
    "  - {name: b, type: orpheus, position_m: [-180, 40]}\n  - {name: c, type: dji_f550, position_m: [-170, 40]}",
}


@pytest.mark.slow
@pytest.mark.parametrize("team", TEAMS)
def test_every_team_moves(team, tmp_path):
    (tmp_path / "my.py").write_text(MOVE, encoding="utf-8")
    phases = "- {name: move, who: all, policy: 'my.py:Move', time_limit_s: 4}"
    simulation = swarmsim.build(swarmsim.load(written(tmp_path, "team", TEAMS[team], phases)))
    record = swarmsim.mission_record(simulation, simulation.rollout(0), 0)
    assert not any(vehicle.crashed for vehicle in record.vehicles)
    for vehicle in record.vehicles:
        moved = vehicle.position_m[-1] - vehicle.position_m[0]
        assert moved[2 if vehicle.kind == "multirotor" else 0] > 1.0, vehicle.name
        assert np.any(record.samples.vehicle == record.vehicles.index(vehicle))


MOVE = '''
import jax.numpy as jnp
import swarmsim


class Move:
    """Up, or ahead."""

    def start(self, task, key):
        return ()

    def act(self, task, memory, view, key):
        if hasattr(task.params, "rotor_spin"):
            return memory, swarmsim.fly_velocity(jnp.array([0.0, 0.0, 1.0]))
        return memory, swarmsim.DriveCommand(speed_m_s=jnp.float32(1.0), yaw_rate_rad_s=jnp.zeros(()))
'''


@pytest.mark.slow
def test_a_vehicle_without_a_detector_flies(tmp_path):
    bare = (
        "  - {name: a, type: bare, position_m: [-190, 40]}\n  - {name: b, type: tarot_t650, position_m: [-180, 40]}\n"
        "definitions: {vehicles: {bare: {extends: x500}}}"
    )
    (tmp_path / "my.py").write_text(MOVE, encoding="utf-8")
    (tmp_path / "configs" / "vehicles").mkdir(parents=True)
    spec = swarmsim.load("mixed").vehicles[2].model_dump(mode="json", exclude_none=True)
    spec.pop("detector")
    spec["sources"] = {key: text for key, text in spec["sources"].items() if not key.startswith("detector")}
    import yaml

    (tmp_path / "configs" / "vehicles" / "bare.yaml").write_text(yaml.safe_dump(spec | {"name": "bare"}))
    folder = tmp_path / "configs" / "missions"
    folder.mkdir()
    (folder / "my.py").write_text(MOVE, encoding="utf-8")
    phases = "- {name: move, who: all, policy: 'my.py:Move', time_limit_s: 3}"
    path = written(folder, "bare_team", bare.split("\ndefinitions")[0], phases)
    simulation = swarmsim.build(swarmsim.load(path))
    record = swarmsim.mission_record(simulation, simulation.rollout(0), 0)
    assert set(record.samples.vehicle) == {1}
    assert all(vehicle.position_m[-1, 2] - vehicle.position_m[0, 2] > 1.0 for vehicle in record.vehicles)


@pytest.mark.slow
def test_stepping_by_hand_scans_and_batches(climbing):
    world = climbing.world
    missions, ticks = 3, 100

    def fly(key):
        state = swarmsim.reset(world, key)
        (group,) = state.groups
        above = group.vehicle.body.position_m + jnp.array([0.0, 0.0, 3.0])
        command = swarmsim.PositionCommand(
            position_m=above,
            velocity_m_s=jnp.zeros((2, 3)),
            acceleration_m_s2=jnp.zeros((2, 3)),
            yaw_rad=jnp.zeros(2),
            hold_position=jnp.ones(2),
        )

        def tick(state, _):
            state, (reading,) = swarmsim.step(world, state, (command,))
            return state, reading.fresh

        return jax.lax.scan(tick, state, None, length=ticks)

    state, fresh = jax.jit(jax.vmap(fly))(jax.vmap(jax.random.key)(jnp.arange(missions)))
    rise = state.groups[0].vehicle.body.position_m[..., 2]
    start = swarmsim.reset(world, jax.random.key(0)).groups[0].vehicle.body.position_m[:, 2]
    assert np.all(np.asarray(rise) - np.asarray(start) > 0.5)
    assert fresh.shape == (missions, ticks, 2)
    np.testing.assert_array_equal(np.asarray(fresh).sum(axis=1), ticks // 9)  # a sample each 0.09 s


@pytest.mark.slow
def test_a_policy_reads_the_sensors_that_it_says_it_senses(tmp_path):
    """Two UAVs climb by their barometers; messages of the receiver come at its rate, each reading is fresh once."""
    (tmp_path / "my.py").write_text(SENSING, encoding="utf-8")
    phases = "- {name: up, who: uav, policy: 'my.py:Level', time_limit_s: 20}"
    simulation = swarmsim.build(swarmsim.load(written(tmp_path, "sensing", UAVS, phases)))
    assert simulation.plan.sensors is not None
    batch = simulation.rollout(range(2))
    memory = jax.tree.map(np.asarray, batch.end.phases[0].memory)
    assert memory["calls"] == pytest.approx(20.0 / 0.05, abs=12)  # each judging period
    assert memory["messages"] == pytest.approx(5 * 20.0, abs=4)
    np.testing.assert_allclose(memory["force"] / memory["calls"], 9.81, atol=0.3)
    assert len(set(memory["ground_pa"].ravel().tolist())) == 4  # every vehicle of every mission has its own errors
    for vehicle in swarmsim.mission_record(simulation, batch, 0).vehicles:
        assert vehicle.position_m[-1, 2] - vehicle.position_m[0, 2] == pytest.approx(6.0, abs=2.0)


def test_a_mission_that_reads_no_sensor_carries_none(climbing, together):
    assert climbing.plan.sensors is None
    assert together.end.sensing is None


@pytest.mark.parametrize(
    ("senses", "told"),
    [
        ("airspeed", "reads airspeed, and the vehicle type 'tarot_t650' carries none"),
        ("gps", "senses 'gps', which is no kind of sensor"),
    ],
)
def test_a_policy_that_senses_what_is_not_carried_is_told(tmp_path, senses, told):
    (tmp_path / "my.py").write_text(SENSING.replace('"barometer"', f'"{senses}"'), encoding="utf-8")
    phases = "- {name: up, who: uav, policy: 'my.py:Level', time_limit_s: 20}"
    with pytest.raises(swarmsim.InputError, match=told):
        swarmsim.load(written(tmp_path, "sensing", UAVS, phases))
