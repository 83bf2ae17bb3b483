"""Landing on a rover: what the policy commands in each situation, whole landings, and what is refused."""

import textwrap
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim
from swarmsim.config.load import load_named
from swarmsim.config.mission import Mission
from swarmsim.config.scenario import scenario_of
from swarmsim.policies.landing import LOST_S, Deck, LandOnRover
from swarmsim.scalars import over_vehicles
from swarmsim.vehicles.multirotor import multirotor_params
from swarmsim.world.radio import Heard
from tests.policies.sites import block_site
from tests.policies.views import task, view

KEY = jax.random.key(0)
ROVER, OTHER = 4, 7  # numbers in the mission
FOOT_M = 0.2289  # of the x500, below its centre of mass
HALF_M, DECK_M = (0.375, 0.21), 0.2  # of the deck, and its height over the rover's origin
SETTINGS = SimpleNamespace(
    altitude_m=4.0, speed_m_s=4.0, climb_speed_m_s=2.0, descent_speed_m_s=1.5, touchdown_speed_m_s=0.5,
    obstacle_clearance_m=5.0,
)  # fmt: skip
policy = LandOnRover()


def job(site=None):
    known = Deck(member=jnp.int32(ROVER), half_m=jnp.array(HALF_M), height_m=jnp.float32(DECK_M))
    made = task(params=multirotor_params(load_named("vehicles", "x500")), known=known)
    made = made.__class__(**{**vars(made), "settings": SETTINGS})
    return made if site is None else made.__class__(**{**vars(made), "site": site})


JOB = job()
act = jax.jit(lambda memory, seen: policy.act(JOB, memory, seen, KEY))


def heard(*senders, age_s=0.0):
    """Messages of ``senders``: number, position, velocity and heading of each; there is room for two."""
    rows = [*senders, (-1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)][:2]
    rows = [*rows, (-1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)][:2]
    member, position, velocity, yaw = (np.array(column) for column in zip(*rows, strict=True))
    return Heard(
        member=jnp.asarray(member, jnp.int32),
        position_m=jnp.asarray(position, jnp.float32),
        velocity_m_s=jnp.asarray(velocity, jnp.float32),
        yaw_rad=jnp.asarray(yaw, jnp.float32),
        count_rate_cps=jnp.zeros(2),
        age_s=jnp.float32(age_s),
        valid=jnp.asarray(member >= 0),
    )


def rover(east=0.0, speed=0.0, yaw=0.0):
    return (ROVER, (east, 0.0, -DECK_M), (speed, 0.0, 0.0), yaw)  # the deck is at height zero


def seen(at, message, time_s=1.0, **changes):
    """A view with the feet of the x500 at ``at`` over the deck's height."""
    place = (at[0], at[1], at[2] + FOOT_M)
    told = changes | {"height_m": max(at[2], 0.0), "time_s": np.float32(time_s)}
    made = view(place, **told)
    return made.__class__(**{**vars(made), "heard": message})


def start():
    return policy.start(JOB, KEY)


def test_it_waits_where_it_is_until_the_rover_is_heard():
    memory, command = act(start(), seen((5.0, 1.0, 0.0), heard()))
    _, command = act(memory, seen((5.3, 1.0, 0.1), heard((OTHER, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0))))
    np.testing.assert_allclose(command.position_m, [5.0, 1.0, FOOT_M], atol=1e-6)  # of its first view
    np.testing.assert_array_equal(command.velocity_m_s, 0.0)


def test_it_rises_before_it_flies_to_a_rover_that_is_away():
    for height, moves in ((0.0, False), (3.0, True)):
        _, command = act(start(), seen((5.0, 0.0, height), heard(rover())))
        assert float(command.velocity_m_s[2]) > 0.5
        assert bool(abs(command.position_m[0] - 5.0) > 0.5) == moves


def test_it_aims_at_where_the_rover_is_now_and_matches_its_velocity():
    _, command = act(start(), seen((0.3, 0.0, 4.0), heard(rover(east=0.0, speed=1.0), age_s=0.3)))
    np.testing.assert_allclose(command.position_m[:2], [0.3, 0.0], atol=1e-3)
    np.testing.assert_allclose(command.velocity_m_s[:2], [1.0, 0.0], atol=1e-5)


def test_it_comes_down_only_within_the_cone_and_climbs_out_of_it_near_the_deck():
    above = {"velocity_m_s": jnp.array([1.0, 0.0, 0.0])}
    memory, command = act(start(), seen((0.0, 0.0, 0.5), heard(rover(speed=1.0)), **above))
    assert bool(memory.descends)
    assert float(command.velocity_m_s[2]) < -0.3
    gone, command = act(memory, seen((0.0, 0.4, 0.5), heard(rover(speed=1.0)), **above))
    assert not bool(gone.descends)
    assert float(command.velocity_m_s[2]) > 1.0  # goes around
    still, _ = act(memory, seen((0.0, 0.05, 0.5), heard(rover(speed=1.0)), **above))
    assert bool(still.descends)
    fast, _ = act(start(), seen((0.0, 0.0, 0.5), heard(rover(speed=0.0)), **above))
    assert not bool(fast.descends)  # a metre per second over the deck is too much to begin with


def test_it_goes_around_when_the_rover_is_lost():
    memory, _ = act(start(), seen((0.0, 0.0, 0.5), heard(rover())))
    for later, lost in ((0.5 * LOST_S, False), (1.5 * LOST_S, True)):
        after, command = act(memory, seen((0.0, 0.0, 0.5), heard(), time_s=1.0 + later))
        assert bool(after.descends) != lost
        assert (float(command.velocity_m_s[2]) > 1.0) == lost


@pytest.mark.parametrize("at", [(0.1, 0.0, 0.2), (5.0, 0.0, 0.2)])
def test_it_does_not_come_down_on_another_vehicle(at):
    other = (OTHER, at, (0.0, 0.0, 0.0), 0.0)
    memory, _ = act(start(), seen((0.0, 0.0, 3.0), heard(rover(), other)))
    assert bool(memory.descends) == (at[0] > 1.0)


def test_it_stays_over_obstacles_and_does_not_come_down_among_them():
    narrow = block_site([(1.0, -5.0, 6.0, 5.0)], extent=(40.0, 40.0))  # a house of 6 m, 1 m east of the rover
    here = job(narrow)
    among = jax.jit(lambda memory, seen: policy.act(here, memory, seen, KEY))
    memory, _ = among(start(), seen((0.0, 0.0, 4.0), heard(rover(east=0.6))))
    assert not bool(memory.descends)
    _, command = among(start(), seen((12.0, 0.0, 4.0), heard(rover(east=-5.0))))
    assert float(command.velocity_m_s[2]) > 1.0  # the house is on its way


def test_its_feet_turn_along_the_deck_by_the_shorter_way():
    for yaw, wanted in ((0.4, 0.4), (np.pi + 0.4, 0.4), (-0.4, -0.4), (2.0, 2.0 - np.pi)):
        _, command = act(start(), seen((0.0, 0.0, 4.0), heard(rover(yaw=yaw))))
        assert float(command.yaw_rad) == pytest.approx(wanted, abs=1e-4)


def test_it_yields_in_flight_and_not_when_it_is_about_to_touch_down():
    wait = {"hold": True, "push_m": (0.0, 2.0, 0.0)}
    memory, _ = act(start(), seen((0.0, 0.0, 0.5), heard(rover())))
    low, _ = act(memory, seen((0.0, 0.0, 0.5), heard(rover()), **wait))
    assert bool(low.descends)
    high, command = act(memory, seen((0.0, 0.0, 3.0), heard(rover()), **wait))
    assert not bool(high.descends)
    np.testing.assert_allclose(command.position_m[:2], [0.0, 2.0], atol=1e-6)


def test_it_is_done_when_it_has_stood_on_the_deck():
    memory, done = start(), []
    for time_s in np.arange(1.0, 2.6, 0.25):
        memory, command = act(memory, seen((0.1, 0.0, 0.0), heard(rover()), time_s=time_s))
        done.append(bool(policy.done(JOB, memory, None)))
        assert float(command.velocity_m_s[2]) < -1.0  # pressed down, until the motors are off
    assert done == [False] * 4 + [True] * 3
    beside, _ = act(start(), seen((0.0, 0.6, -0.4), heard(rover())))
    assert not np.isfinite(beside.touched_s)  # on the ground beside the rover


def test_one_vehicle_or_many_as_scalars():
    """The operations on scalars, of which a GPU makes a kernel, give what one vehicle by itself gives."""
    at = [(5.0, 1.0, 3.0), (0.0, 0.1, 0.6), (0.1, 0.0, 0.01)]
    each = [seen(place, heard(rover(speed=0.2), age_s=0.1)) for place in at]
    memory, many = jax.tree.map(lambda x: jnp.stack([x] * 3), start()), jax.tree.map(lambda *x: jnp.stack(x), *each)
    mapped = over_vehicles(lambda m, s: policy.act(JOB, m, s, KEY), layout="scalars")
    found = jax.jit(mapped)(memory, many)
    for number, one in enumerate(each):
        expected = act(start(), one)
        jax.tree.map(lambda a, b, n=number: np.testing.assert_allclose(a[n], b, atol=2e-5), found, expected)


DRIVE = '''
import jax.numpy as jnp
import swarmsim


class Drive:
    """Drive at a speed and a yaw rate."""

    class Settings(swarmsim.PolicySettings):
        speed_m_s: float = 1.0
        yaw_rate_rad_s: float = 0.0

    vehicles = ("skid_steer",)

    def start(self, task, key):
        return ()

    def act(self, task, memory, view, key):
        settings = task.settings
        return (), swarmsim.DriveCommand(speed_m_s=settings.speed_m_s, yaw_rate_rad_s=settings.yaw_rate_rad_s)
'''
MISSION = """
name: ride
site: meadows
engine: analytic
timing: {decision_period_s: 0.5}
radio: {delay_s: 0.1, loss: 0.1}
sources: []
vehicles:
  - {name: rover, type: orpheus, position_m: [-200, 50], heading_deg: 90}
  - {name: uav, type: x500, position_m: [-206, 52]}
wind: {speed_m_s: 3.0, gusts: true}
phases:
  - {name: drive, who: rover, policy: 'my.py:Drive', time_limit_s: 20}
  - {name: land, who: uav, policy: land_on, settings: {rover: rover, speed_m_s: 4}, time_limit_s: 15}
"""
SPEEDS = [0.0, 1.0, 1.0, 1.0]
TURNS = [0.0, 0.0, 0.25, 0.0]
LOSSES = [0.1, 0.1, 0.1, 1.0]


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A rover at rest, one that drives ahead, one that drives a circle, and one that is never heard."""
    folder = tmp_path_factory.mktemp("landing")
    (folder / "my.py").write_text(DRIVE, encoding="utf-8")
    (folder / "ride.yaml").write_text(textwrap.dedent(MISSION), encoding="utf-8")
    simulation = swarmsim.build(swarmsim.load(folder / "ride.yaml"))
    values = {
        "phases.drive.settings.speed_m_s": SPEEDS,
        "phases.drive.settings.yaw_rate_rad_s": TURNS,
        "radio.loss": LOSSES,
    }
    batch = simulation.rollout(range(4), values=values)
    return simulation, [swarmsim.mission_record(simulation, batch, index) for index in range(4)]


@pytest.mark.slow
@pytest.mark.parametrize("index", range(3))
def test_it_lands_on_a_rover_and_is_carried_to_the_end_of_its_way(flown, index):
    simulation, records = flown
    record = records[index]
    carrier, uav = record.vehicles
    land = record.phase("land")
    assert land.in_time
    assert {event.kind for event in record.events if event.vehicle == "uav"} == {"finished"}
    deck = np.asarray(simulation.world.groups[0].limits.deck_m)[0]
    assert uav.time_s[-1] > land.end_s + 3.0  # the ride is recorded too
    place = np.stack([np.interp(uav.time_s, carrier.time_s, carrier.position_m[:, k]) for k in range(3)], -1)
    apart = (uav.position_m - place)[uav.time_s > land.end_s]
    assert np.linalg.norm(apart[:, :2], axis=1).max() < 0.2
    assert np.abs(apart[:, 2] - deck[2] - FOOT_M).max() < 0.05
    travelled = np.linalg.norm(np.diff(carrier.position_m[carrier.time_s > land.end_s], axis=0), axis=1).sum()
    assert travelled >= 0.9 * SPEEDS[index] * (carrier.time_s[-1] - land.end_s)
    power = np.diff(uav.energy_wh[uav.time_s > land.end_s])
    assert power.max() < 0.2 * np.diff(uav.energy_wh).max()  # its motors are off


@pytest.mark.slow
def test_without_the_rovers_broadcasts_it_stays_on_the_ground(flown):
    record = flown[1][3]
    uav = record.vehicles[1]
    assert not record.phase("land").in_time
    np.testing.assert_allclose(uav.position_m[-1], uav.position_m[0], atol=0.01)


def test_it_lands_in_a_loop_of_ones_own():
    """Under jit, vmap and scan, a point that moves as commanded: it lands from wherever it starts."""
    step_s, delay_s, speed = 0.05, 0.1, 1.0

    def fly(place):
        def tick(carry, time_s):
            memory, place, velocity = carry
            sent = time_s - delay_s
            message = heard((ROVER, (0.0, 0.0, -DECK_M), (speed, 0.0, 0.0), 0.0), age_s=delay_s)
            message = message.__class__(
                **{**vars(message), "position_m": message.position_m.at[0, 0].set(speed * sent)}
            )
            own = view(place + jnp.array([0.0, 0.0, FOOT_M]), velocity, time_s=time_s, height_m=place[2])
            memory, command = policy.act(JOB, memory, own.__class__(**{**vars(own), "heard": message}), KEY)
            velocity = command.velocity_m_s + command.position_m - own.position_m
            place = place + step_s * velocity
            place = place.at[2].set(jnp.maximum(place[2], 0.0))
            return (memory, place, velocity), (place - jnp.array([speed, 0.0, 0.0]) * (time_s + step_s), memory.landed)

        start_ = (policy.start(JOB, KEY), place, jnp.zeros(3))
        return jax.lax.scan(tick, start_, step_s * jnp.arange(600.0))[1]

    draw = np.random.default_rng(0)
    places = np.concatenate([draw.uniform(-15.0, 15.0, (16, 2)), draw.uniform(0.0, 8.0, (16, 1))], axis=1)
    apart, landed = jax.jit(jax.vmap(fly))(jnp.asarray(places, jnp.float32))
    assert landed[:, -1].all()
    first = np.argmax(landed, axis=1)
    level = np.linalg.norm(apart[..., :2], axis=-1)
    assert level[np.arange(16), first].max() < 0.1
    near = (level < 1.2) & ~np.asarray(landed)  # within reach of its rotors
    assert (level[near & (apart[..., 2] < 0.3)] < 0.2).all()  # low over the rover only above its deck


TEAM = [
    {"name": "uav", "type": "x500", "position_m": (0.0, 0.0)},
    {"name": "wide", "type": "tarot_t650", "position_m": (5.0, 0.0)},
    {"name": "rover", "type": "orpheus", "position_m": (0.0, 5.0)},
    {"name": "small", "type": "jackal", "position_m": (5.0, 5.0)},
]


@pytest.mark.parametrize(
    ("who", "settings", "fragments"),
    [
        (
            "uav",
            {"rover": "rower"},
            ["there is no vehicle 'rower' in the team", "rover, small", "did you mean 'rover'"],
        ),
        ("uav", {"rover": "wide"}, ["settings.rover: 'wide' is a multirotor", "rover, small"]),
        ("uav", {}, ["settings.rover: this field is missing"]),
        ("rover", {"rover": "small"}, ["the policy 'land_on' cannot command 'rover'"]),
        (
            "wide",
            {"rover": "small"},
            ["feet of the vehicle type 'tarot_t650' do not fit on the deck of 'small'", "0.31"],
        ),
        (["uav", "wide"], {"rover": "rover"}, ["one vehicle lands on 'rover', and 2 are to follow"]),
        ("uav", {"rover": "rover", "speed_m_s": 20.0}, ["is faster than the vehicle type 'x500' can fly"]),
        ("uav", {"rover": "rover"}, []),
    ],
)
def test_settings_that_do_not_suit_the_team_are_told(who, settings, fragments):
    phase = {"name": "land", "who": who, "policy": "land_on", "time_limit_s": 60.0, "settings": {"speed_m_s": 4.0}}
    phase["settings"] |= settings
    mission = Mission(name="small", site="meadows", sources=(), vehicles=TEAM, phases=[phase])
    if not fragments:
        assert scenario_of(mission).settings[0].rover == "rover"
        return
    with pytest.raises(swarmsim.InputError) as caught:
        scenario_of(mission)
    for fragment in fragments:
        assert fragment in str(caught.value)
