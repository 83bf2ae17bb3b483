"""Failsafes: the fence, the wind, the battery and the link, each an event, and what the autopilot then does."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmsim
from swarmsim.config.errors import InputError
from swarmsim.control.commands import fly_velocity, go_to
from swarmsim.world import events
from swarmsim.world.failsafes import ADRIFT_S, CLIMB_OVER_M_S, LAND, LEASH_M, SEARCH_S, failing, no_rescue, rescue_of
from swarmsim.world.judge import record_events
from tests.world.worlds import BUILDING, airborne, begin, fly, happened, row, with_group, world

COUNT = 4
RULES = {
    "fence": {"margin_m": 4.0, "ceiling_m": 30.0},
    "link": {"action": "return", "range_m": 90.0, "after_s": 1.0},
    "return_clearance_m": 5.0,
}
# compiled as a whole: piece by piece, each operation is a program of its own
RESCUE, FAILING, RECORDED = jax.jit(rescue_of), jax.jit(failing), jax.jit(record_events, static_argnums=1)


@pytest.fixture(scope="module")
def place():
    made = world(row("uav", "x500", COUNT, (-20.0, -15.0), spacing_m=9.0), failsafes=RULES,
                 sample_period_s={"nai_1p5x1p5": 1.0})  # fmt: skip
    return made, begin(made, jax.random.key(5))


def at(made, first):
    """All hover 8 m above their pads, but the first is at ``first``."""
    pads = np.asarray(made.groups[0].start_m)
    places = np.concatenate([pads, np.full((COUNT, 1), 8.0)], -1)
    places[0] = first
    return places


def go(places, velocity):
    """The first flies at a velocity, the others stay."""
    stay = jax.vmap(go_to)(jnp.asarray(places, jnp.float32))
    moves = jax.vmap(fly_velocity)(jnp.tile(jnp.asarray(velocity, jnp.float32), (COUNT, 1)))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[:1], b[1:]]), moves, stay)


@pytest.mark.slow
@pytest.mark.parametrize("heading_deg", [0, 90, 180, 270, 37])
def test_a_vehicle_that_flies_on_to_the_border_returns_and_lands_at_home(place, heading_deg):
    made, start = place
    heading = np.radians(heading_deg)
    velocity = 6.0 * np.array([np.cos(heading), np.sin(heading), 0.0])
    places = at(made, [0.0, -14.0 if heading_deg not in (90, 270) else 0.0, 8.0])
    state, tracks = fly(made, airborne(made, start, places), (go(places, velocity),), 45.0)
    assert "fence" in happened(state)[0]
    assert not happened(state)[0] & set(events.LOSSES)
    assert happened(state)[1:] == [set()] * (COUNT - 1)
    way = tracks[0].position_m[:, 0]
    assert np.abs(way[:, 0]).max() < 40.0 - 4.0 + 0.3
    assert np.abs(way[:, 1]).max() < 30.0 - 4.0 + 0.3
    home = np.asarray(made.groups[0].start_m)[0]
    np.testing.assert_allclose(way[-1, :2], home, atol=0.3)
    assert way[-1, 2] < 0.3
    assert not bool(state.groups[0].active[0])  # it has landed, and rests


@pytest.mark.slow
def test_the_ceiling_is_a_fence_too(place):
    made, start = place
    places = at(made, [0.0, -14.0, 20.0])
    state, tracks = fly(made, airborne(made, start, places), (go(places, [0.0, 0.0, 2.5]),), 6.0)
    assert happened(state)[0] == {"fence"}
    assert tracks[0].position_m[:, 0, 2].max() < 30.2


@pytest.mark.slow
def test_a_low_battery_returns_above_everything_that_stands(place):
    made, start = place
    places = at(made, [36.0 - 20.0, 0.0, 3.0])
    up = airborne(made, start, places)
    vehicle = up.groups[0].vehicle
    used = vehicle.energy_j.at[0].set(0.86 * float(made.groups[0].limits.battery_j[0]))
    state, tracks = fly(
        made, with_group(up, 0, vehicle=replace(vehicle, energy_j=used)), (go(places, [0, 0, 0]),), 50.0
    )
    assert "battery_low" in happened(state)[0]
    way = tracks[0].position_m[:, 0]
    away = np.linalg.norm(way[:, :2] - np.asarray(made.groups[0].start_m)[0], axis=-1)
    moving = (away > 2.0) & (away < away[0] - 2.0)
    assert way[moving, 2].min() > 6.0 + 3.5  # the house is 6 m high
    assert away[-1] < 0.3
    assert way[-1, 2] < 0.3


def test_a_lost_link_returns_only_after_its_time(place):
    made, start = place
    made = replace(made, failsafes=replace(made.failsafes, link_range_m=jnp.float32(25.0)))
    home = np.asarray(made.groups[0].start_m)[0]
    places = at(made, [home[0] + 24.0, home[1] + 1.0, 8.0])
    state, _ = fly(made, airborne(made, start, places), (go(places, [2.0, 0.0, 0.0]),), 1.2)
    assert happened(state)[0] == set()
    state, tracks = fly(made, state, (go(places, [2.0, 0.0, 0.0]),), 12.0)
    assert happened(state)[0] == {"link_lost"}
    assert np.linalg.norm(tracks[0].position_m[-1, 0, :2] - home) < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("speed", [7.0, 15.0])
def test_too_strong_a_wind_makes_it_land_where_it_is(speed):
    team = row("uav", "x500", COUNT, (-20.0, -15.0), spacing_m=9.0)
    made = world(team, blocks=(), sample_period_s={"nai_1p5x1p5": 1.0}, failsafes={"wind": {"after_s": 2.0}},
                 wind={"speed_m_s": speed, "from_deg": 270.0})  # fmt: skip
    start = begin(made, jax.random.key(5))
    places = at(made, [-20.0, -15.0, 8.0])
    state, tracks = fly(made, airborne(made, start, places), (go(places, [0, 0, 0]),), 20.0)
    if speed == 7.0:
        assert happened(state) == [set()] * COUNT
        return
    assert all("wind" in kinds and not kinds & set(events.LOSSES) for kinds in happened(state))
    low = tracks[0].position_m[-1]
    assert (low[:, 2] < 0.3).all()
    assert np.abs(tracks[0].velocity_m_s[-1]).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["analytic", "mjx"])
def test_one_that_has_to_land_goes_where_nothing_stands(engine):
    """Over the house, beside its wall, over open ground, and at the fence."""
    made = world(row("uav", "x500", COUNT, (-20.0, -15.0), spacing_m=9.0), sample_period_s={"nai_1p5x1p5": 1.0},
                 failsafes={"battery": {"action": "land"}, "landing_clearance_m": 2.5}, engine=engine)  # fmt: skip
    places = np.array([[23.0, 2.0, 12.0], [31.0, -4.0, 3.0], [-10.0, 5.0, 8.0], [39.5, 20.0, 8.0]])
    up = airborne(made, begin(made, jax.random.key(5)), places)
    vehicle = up.groups[0].vehicle
    used = vehicle.energy_j.at[:].set(0.86 * made.groups[0].limits.battery_j)
    up = with_group(up, 0, vehicle=replace(vehicle, energy_j=used))
    state, tracks = fly(made, up, (go(places, [0, 0, 0]),), 30.0)
    assert happened(state) == [{"battery_low"}] * COUNT
    end = tracks[0].position_m[-1]
    assert (end[:, 2] < 0.3).all()
    radius, (west, south, east, north) = 0.386, BUILDING
    away = np.hypot(np.clip(end[:, 0], west, east) - end[:, 0], np.clip(end[:, 1], south, north) - end[:, 1])
    assert away.min() > 2.5 + radius - 0.3
    assert np.linalg.norm(end[2, :2] - places[2, :2]) < 0.3  # where it was
    assert end[3, 0] < 40.0 - LEASH_M + 0.3
    assert not state.groups[0].active.any()


def test_two_that_have_to_land_from_over_one_house_take_a_place_each():
    """The same place beyond the house's north end is the nearest one for both."""
    made = world(row("uav", "x500", COUNT, (-20.0, -15.0), spacing_m=9.0), sample_period_s={"nai_1p5x1p5": 1.0},
                 failsafes={"battery": {"action": "land"}})  # fmt: skip
    places = np.array([[25.0, 9.0, 9.0], [25.0, 6.0, 9.0], [-10.0, 5.0, 8.0], [-20.0, 0.0, 8.0]])
    up = airborne(made, begin(made, jax.random.key(5)), places)
    vehicle = up.groups[0].vehicle
    up = with_group(up, 0, vehicle=replace(vehicle, energy_j=0.86 * jnp.asarray(made.groups[0].limits.battery_j)))
    state, tracks = fly(made, up, (go(places, [0, 0, 0]),), 40.0)
    assert happened(state) == [{"battery_low"}] * COUNT
    end = tracks[0].position_m[-1]
    assert (end[:, 2] < 0.3).all()
    apart = np.linalg.norm(end[:, None, :2] - end[None, :, :2], axis=-1)[np.triu_indices(COUNT, 1)]
    assert apart.min() > 2 * 0.386


@pytest.mark.parametrize(("late_s", "climb"), [(10.0, CLIMB_OVER_M_S), (SEARCH_S + 1.0, -0.6)])
def test_on_its_way_to_a_clear_place_it_climbs_first_but_not_for_ever(late_s, climb):
    """2 m up, 0.5 m from the house of 6 m."""
    made = world(row("uav", "x500", 1, (0.0, 0.0)))
    times = np.full(len(events.KINDS), np.inf, np.float32)
    times[events.KINDS.index("wind")] = 5.0
    position = jnp.array([BUILDING[0] - 0.5, 0.0, 2.0])
    found = RESCUE(
        made.failsafes, replace(no_rescue(), takes_over=jnp.array(True), position_m=position), jnp.asarray(times),
        jnp.float32(5.0 + late_s), position, jnp.float32(1.8), jnp.zeros(3), made.site, jnp.zeros(2),
    )  # fmt: skip
    assert made.failsafes.action[events.FAILSAFES.index("wind")] == LAND
    assert float(found.velocity_m_s[2]) == pytest.approx(climb)
    if climb > 0.0:
        np.testing.assert_allclose(found.position_m[:2], position[:2])  # and only then to the side


@pytest.mark.parametrize(
    ("takes_over", "carried_s", "kept"), [(True, 21.0, True), (False, 21.0, False), (True, 9.0, False)]
)
def test_only_one_in_a_failsafe_that_was_adrift_counts_as_carried_in_calmer_air(takes_over, carried_s, kept):
    """A wind failsafe after 60 s must not set in because of a gust of 21 s."""
    rules = world(row("uav", "x500", 1, (0.0, 0.0)), failsafes={"wind": {"after_s": 60.0}}).failsafes
    before = replace(no_rescue(), takes_over=jnp.array(takes_over), carried_s=jnp.float32(carried_s))
    found, after = FAILING(
        rules, before, position_m=jnp.array([0.0, 0.0, 5.0]), velocity_m_s=jnp.zeros(3), brake_m_s2=jnp.float32(4.0),
        above_m=jnp.float32(5.0), carried_m_s=jnp.float32(0.0), charge=jnp.float32(1.0), home_m=jnp.zeros(2), dt=0.05,
    )  # fmt: skip
    assert float(after.carried_s) == pytest.approx(carried_s + 0.05 if kept else 0.0)
    assert not found.any()


@pytest.mark.parametrize(("carried_s", "sinks"), [(5.0, False), (ADRIFT_S + 1.0, True)])
def test_one_that_is_adrift_beyond_the_fence_lands_there(carried_s, sinks):
    """3 m above open ground: it flies back as long as it can hope to."""
    made = world(row("uav", "x500", 1, (0.0, 0.0)))
    times = np.full(len(events.KINDS), np.inf, np.float32)
    times[events.KINDS.index("wind")] = 5.0
    position = jnp.array([float(made.failsafes.fence_high_m[0]) + 5.0, 20.0, 3.0])
    rescue = replace(
        no_rescue(), takes_over=jnp.array(True), position_m=position - 5.0, carried_s=jnp.float32(carried_s)
    )
    found = RESCUE(made.failsafes, rescue, jnp.asarray(times), jnp.float32(30.0), position, jnp.float32(2.8),
                      jnp.zeros(3), made.site, jnp.zeros(2))  # fmt: skip
    assert bool(found.velocity_m_s[2] < -0.5) == sinks
    assert float(found.position_m[0]) < float(made.failsafes.fence_high_m[0])


def test_a_clearance_beyond_its_bound_is_refused():
    with pytest.raises(InputError, match="landing_clearance_m"):
        swarmsim.load("recon", ["failsafes.landing_clearance_m=1e308"])


def test_a_fence_that_shuts_out_a_start_is_told():
    team = row("uav", "x500", 2, (-38.0, -15.0))
    with pytest.raises(InputError, match="starts outside the fence"):
        world(team, failsafes={"fence": {"margin_m": 3.0}})
    world(team, failsafes={"fence": {"margin_m": 1.0}})
    world(team, failsafes={"fence": {"action": "none", "margin_m": 3.0}})
    world(row("rover", "orpheus", 1, (-38.0, 0.0)), failsafes={"fence": {"margin_m": 3.0}})  # rovers have none


@pytest.mark.parametrize("slides", [True, False])
def test_one_that_has_landed_comes_to_rest_before_its_part_ends(place, slides):
    made, start = place
    g = start.groups[0]
    times = g.event_time_s.at[0, events.WIND].set(1.0)
    body = replace(g.vehicle.body, velocity_m_s=g.vehicle.body.velocity_m_s.at[0, 0].set(0.4 if slides else 0.0))
    one = jax.tree.map(
        lambda x: x[0], replace(g, event_time_s=times, vehicle=replace(g.vehicle, body=body), counter=None)
    )
    group = made.groups[0]
    params, limits = jax.tree.map(lambda x: x[0], (group.params, group.limits))
    after = RECORDED(made, group.kind, jnp.float32(2.0), params, limits, one, jnp.array(False))
    assert bool(after.active) is slides


def test_failsafes_can_be_switched_off():
    off = {kind: {"action": "none"} for kind in ("fence", "wind", "battery", "link")}
    made = world(
        row("uav", "x500", COUNT, (-20.0, -15.0), spacing_m=9.0), failsafes=off, sample_period_s={"nai_1p5x1p5": 1.0}
    )
    start = begin(made, jax.random.key(5))
    places = at(made, [30.0, -14.0, 8.0])
    state, tracks = fly(made, airborne(made, start, places), (go(places, [6.0, 0, 0]),), 4.0)
    assert happened(state) == [set()] * COUNT
    assert tracks[0].position_m[-1, 0, 0] > 45.0


@pytest.mark.parametrize(("carried_s", "speed", "lands"), [(3.0, 3.0, True), (3.0, 1.2, False), (1.0, 3.0, False)])
def test_what_the_wind_carries_to_the_fence_lands_in_time(carried_s, speed, lands):
    """20 m up and 15 m from the fence: at 3 m/s it would cross before it is down, at 1.2 m/s it would not."""
    rules = world(row("uav", "x500", 1, (0.0, 0.0))).failsafes
    east = float(rules.fence_high_m[0])
    found, after = FAILING(
        rules, replace(no_rescue(), carried_s=jnp.float32(carried_s)),
        position_m=jnp.array([east - 15.0, 0.0, 20.0]), velocity_m_s=jnp.array([speed, 0.0, 0.0]),
        brake_m_s2=jnp.float32(4.0), above_m=jnp.float32(20.0), carried_m_s=jnp.float32(speed),
        charge=jnp.float32(1.0), home_m=jnp.zeros(2), dt=0.05,
    )  # fmt: skip
    assert bool(found[events.FAILSAFES.index("wind")]) == lands
    assert not bool(found[events.FAILSAFES.index("fence")])
    assert float(after.carried_s) == pytest.approx(carried_s + 0.05)
