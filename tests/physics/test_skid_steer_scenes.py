"""The rover against MuJoCo C on slopes, at kerbs, ledges and walls; walls of random shapes; and how `analytic` ends."""

import dataclasses
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from swarmsim.config.vehicles import SkidSteer
from swarmsim.physics.rotations import rotation_matrix
from swarmsim.physics.skid_steer import rest_state
from swarmsim.site import sample
from swarmsim.vehicles.skid_steer import skid_steer_params
from tests.physics.mujoco_scenes import Rover, block, plane
from tests.physics.rovers import ENGINES, FILE, PARAMS, SPEC, STEP, drive, plane_site, step_site

pytestmark = pytest.mark.optimised

LYING = 60.0  # degrees


def tilt(quaternion, up=(0.0, 0.0, 1.0)):
    """Angle [n] (degrees) between the body's z axis and ``up``."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    return np.degrees(np.arccos(np.clip(axis @ np.asarray(up), -1.0, 1.0)))


@pytest.mark.parametrize("wheel", [2.5, 5.0])
@pytest.mark.parametrize("rise", [0.05, 0.1, 0.13, 0.15, 0.2, 0.25])
def test_a_kerb_is_passed_or_stops_it_as_in_mujoco_c(rise, wheel):
    """From 0.13 m on the chassis lands on the edge, and slides over it only with enough speed."""
    expected = Rover([plane(), block([1, -20, -1], [20, 20, rise])]).drive(np.full(4, wheel), 5.0)
    states = drive("mjx", np.full(4, wheel), 5.0, step_site(rise))
    end = states.body.position_m[-1]
    assert float(end[0]) == pytest.approx(expected[-1, 0], abs=0.06)
    assert float(end[2]) == pytest.approx(expected[-1, 2], abs=0.02)
    assert tilt(states.body.quaternion).max() == pytest.approx(tilt(expected[:, 3:]).max(), abs=2.0)


def test_a_kerb_of_0_3_m_is_not_passed():
    """In MuJoCo C the rover rears up and falls on its back; here the front wheels stand against the face."""
    expected = Rover([plane(), block([1, -20, -1], [20, 20, 0.3])]).drive(np.full(4, 5.0), 5.0)
    assert expected[-1, 0] < 1.0
    assert float(drive("mjx", np.full(4, 5.0), 5.0, step_site(0.3)).body.position_m[-1, 0]) < 1.0


@pytest.mark.parametrize("wheel", [2.5, 5.0, 9.0])
@pytest.mark.parametrize("rise", [0.1, 0.2, 0.3])
def test_it_drives_off_a_ledge_as_in_mujoco_c(rise, wheel):
    scene = Rover([plane(), block([-20, -20, -1], [1.1, 20, rise])], start=(0.0, 0.0, rise, 0.0))
    expected = scene.drive(np.full(4, wheel), 4.0)
    states = drive("mjx", np.full(4, wheel), 4.0, step_site(rise, -1.1, np.pi))
    np.testing.assert_allclose(states.body.position_m[-1], expected[-1, :3], atol=0.03)
    most = tilt(states.body.quaternion).max()
    assert most == pytest.approx(tilt(expected[:, 3:]).max(), abs=12.0)
    assert most < LYING


def test_random_kerbs_met_at_an_angle_end_as_in_mujoco_c():
    """Of 24 kerbs, headings and speeds, at most 4 end otherwise: a wheel is a disc here, and a sphere there."""
    rng = np.random.default_rng(5)
    different = 0
    for _ in range(24):
        rise, wheel, angle = rng.uniform([0.04, 2.0, -0.6], [0.2, 7.0, 0.6])
        scene = Rover([plane(), block([1.1, -30, -1], [30, 30, rise], angle)])
        expected = scene.drive(np.full(4, wheel), 3.0)[-1, :3]
        end = drive("mjx", np.full(4, wheel), 3.0, step_site(rise, 1.1, angle)).body.position_m[-1]
        different += np.linalg.norm(end - expected) > 0.15
    assert different <= 4


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("degrees", "friction", "heading"),
    [
        *((d, f, h) for d, f in ((15, 0.8), (25, 0.8), (35, 0.8), (25, 0.3), (35, 0.5)) for h in (0.0, 0.8, np.pi / 2)),
        *((54, 1.8, h) for h in (0.0, np.pi / 2, np.pi)),  # tips over the rear, the right and the front wheels
    ],
)
def test_a_parked_rover_holds_slides_or_tips_where_mujoco_c_does(degrees, friction, heading, engine):
    spec = SPEC.model_copy(update={"wheels": SPEC.wheels.model_copy(update={"friction": friction})})
    expected = Rover([plane()], start=(0, 0, 0, heading), slope_deg=(degrees, 0.0), spec=spec).drive(np.zeros(4), 1.5)
    params = dataclasses.replace(PARAMS, friction=jnp.full(4, friction, jnp.float32))
    rise = np.tan(np.radians(degrees))
    states = drive(engine, np.zeros(4), 1.5, plane_site((rise, 0.0)), params=params, yaw=heading)
    up = np.array([-np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])
    tipped = tilt(states.body.quaternion[-1], up) > LYING
    assert tipped == (tilt(expected[-1, 3:]) > LYING)
    if not tipped:
        moved = np.linalg.norm(expected[-1, :2] - expected[0, :2])
        found = float(jnp.linalg.norm(states.body.position_m[-1] - states.body.position_m[9]))
        assert found == pytest.approx(moved, rel=0.1, abs=0.05)


def straight(u, v):
    return -u


def convex(u, v):
    a, b = (u + v) / np.sqrt(2), (u - v) / np.sqrt(2)
    return np.where(np.minimum(a, b) > 0, -np.minimum(a, b), np.hypot(np.minimum(a, 0), np.minimum(b, 0)))


def concave(u, v):
    return np.minimum((v - u) / np.sqrt(2), (-v - u) / np.sqrt(2))


def walled(shape, angle, distance, cells=101, cell=0.25):
    """Level ground with a wall of ``shape`` whose foremost point is ``distance`` from the origin at ``angle``."""
    axis = (np.arange(cells) - cells // 2) * cell
    x, y = np.meshgrid(axis, axis)
    u = np.cos(angle) * x + np.sin(angle) * y - distance
    clearance = shape(u, np.cos(angle) * y - np.sin(angle) * x)
    return dataclasses.replace(plane_site(cells=cells, cell=cell), clearance_m=jnp.asarray(clearance, jnp.float32))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("shape", "deepest", "often"), [(straight, 0.005, 0), (concave, 0.005, 0), (convex, 0.025, 6)])
def test_random_walls_hold_at_up_to_2_m_s(engine, shape, deepest, often):
    """Of 24, no outline enters a straight wall or an inner corner; an outer corner enters it by 1 cm in at most 6."""
    rng = np.random.default_rng(7)
    sites = [walled(shape, a, d) for a, d in rng.uniform([-0.9, 1.5], [0.9, 2.5], (24, 2))]
    site = jax.tree.map(lambda *x: jnp.stack(x), *sites)
    command = np.repeat(rng.uniform(1.0, 10.0, (24, 1)) + rng.uniform(-1.0, 1.0, (24, 2)), 2, axis=1)[:, [0, 2, 1, 3]]
    corner = np.asarray(PARAMS.corner_m)[[0, 1, 3, 2, 0]]
    share = np.linspace(0.0, 1.0, 41)[:, None]
    outline = jnp.asarray(np.concatenate([a + share * (b - a) for a, b in pairwise(corner)]))

    @jax.jit
    @jax.vmap
    def depth(site, command):
        def one(state, _):
            state = STEP[engine](PARAMS, state, command, site)
            place = state.body.position_m[:2] + outline @ rotation_matrix(state.body.quaternion)[:2, :2].T
            return state, -jnp.min(sample(site.clearance_m, site, place))

        start = rest_state(PARAMS, site, jnp.zeros(2), jnp.zeros(()))
        return jnp.max(jax.lax.scan(one, start, None, length=800)[1])

    found = np.asarray(depth(site, jnp.asarray(command, jnp.float32)))
    assert (found > -0.1).sum() >= 12  # most reach the wall
    assert found.max() < deepest
    assert (found > 0.01).sum() <= often


def test_a_wall_stops_it_where_mujoco_c_stops_it():
    expected = Rover([plane()], walls=[block([2, -20, 0], [3, 20, 1])]).drive(np.full(4, 10.0), 3.0)
    end = drive("mjx", np.full(4, 10.0), 3.0, plane_site(wall_east_m=2.0)).body.position_m[-1]
    np.testing.assert_allclose(end, expected[-1, :3], atol=0.01)


@pytest.mark.parametrize("command", [(-12.5, 12.5, -12.5, 12.5), (12.5, -12.5, -12.5, 12.5), (12.5,) * 4])
def test_violent_slip_does_not_lift_it(command):
    states = drive("mjx", command, 3.0)
    assert float(states.body.position_m[:, 2].max() - states.body.position_m[0, 2]) < 0.006
    assert tilt(states.body.quaternion).max() < 2.0
    expected = Rover([plane()]).drive(command, 3.0)
    np.testing.assert_allclose(states.body.position_m[-1], expected[-1, :3], atol=0.05)


def test_a_fall_from_0_3_m_does_not_bounce_higher_than_in_mujoco_c():
    state = rest_state(PARAMS, plane_site(), jnp.zeros(2), 0.0)
    up = dataclasses.replace(state.body, position_m=state.body.position_m + jnp.array([0.0, 0.0, 0.3]))
    height = drive("mjx", np.zeros(4), 2.0, state=dataclasses.replace(state, body=up)).body.position_m[:, 2]
    landed = int(jnp.argmax(height < state.body.position_m[2]))
    assert float(height[landed:].max() - state.body.position_m[2]) < 0.01
    assert float(height[-1]) == pytest.approx(float(state.body.position_m[2]), abs=1e-3)


@pytest.mark.parametrize("rise", [0.05, 0.1])
def test_analytic_rolls_over_a_kerb_that_it_climbs(rise):
    states = drive("analytic", np.full(4, 5.0), 4.0, step_site(rise))
    assert float(states.body.position_m[-1, 0]) > 3.5
    assert float(states.body.position_m[-1, 2] - states.body.position_m[0, 2]) == pytest.approx(rise, abs=1e-3)
    assert float(jnp.abs(jnp.diff(states.body.position_m[:, 2])).max()) < 0.01  # no jump


@pytest.mark.parametrize("rise", [0.13, 0.2, 0.3])
def test_analytic_is_stopped_by_a_face_that_it_does_not_climb(rise):
    states = drive("analytic", np.full(4, 9.0), 3.0, step_site(rise))
    reach = np.sqrt(0.2**2 - max(0.2 - rise, 0.0) ** 2)
    np.testing.assert_allclose(states.body.position_m[-1, 0], 1.0 - 0.28 - reach, atol=0.01)
    assert tilt(states.body.quaternion).max() < 0.1


def test_analytic_ends_on_its_side_off_a_ledge_that_is_too_high():
    states = drive("analytic", np.full(4, 5.0), 3.0, step_site(0.2, -1.1, np.pi))
    assert tilt(states.body.quaternion[-1]) == pytest.approx(90.0, abs=0.1)
    assert float(jnp.abs(states.body.velocity_m_s[-1]).max()) == 0.0


def test_the_engines_agree_on_random_slopes():
    """Of 48 slopes up to 20 degrees, headings, speeds and turns, 3/4 end within 5 % of the way; all within 15 %."""
    rng = np.random.default_rng(3)
    low, high = [0.0, -np.pi, -6.0, -5.0], [np.tan(np.radians(20.0)), np.pi, 8.0, 5.0]
    rise, yaw, mean, half = rng.uniform(low, high, (48, 4)).T
    half = half * (rng.uniform(size=48) > 0.3)
    site = jax.tree.map(lambda *x: jnp.stack(x), *[plane_site((float(r), 0.0)) for r in rise])
    command = np.stack([mean - half, mean + half] * 2, axis=1)
    paths = {}
    for engine in ENGINES:

        def one(site, command, yaw, engine=engine):
            def step(state, _):
                state = STEP[engine](PARAMS, state, command, site)
                return state, jnp.append(state.body.position_m, state.body.angular_velocity_rad_s[2])

            return jax.lax.scan(step, rest_state(PARAMS, site, jnp.zeros(2), yaw), None, length=600)[1]

        paths[engine] = np.asarray(jax.jit(jax.vmap(one))(site, *(jnp.asarray(v, jnp.float32) for v in (command, yaw))))
    way = np.linalg.norm(np.diff(paths["mjx"][..., :3], axis=1), axis=-1).sum(axis=1)
    way += 0.3 * 0.005 * np.abs(paths["mjx"][..., 3]).sum(axis=1)  # a wheel goes further than the rover in a turn
    apart = np.linalg.norm(paths["mjx"][:, -1, :3] - paths["analytic"][:, -1, :3], axis=-1) / (way + 0.1)
    assert (apart < 0.05).sum() >= 30, np.sort(apart)
    assert apart.max() < 0.2, np.sort(apart)


TURN, AHEAD = (-4.0, 4.0, -4.0, 4.0), (6.0,) * 4


@pytest.mark.parametrize(
    ("name", "command", "rise"),
    [
        ("jackal", TURN, 0.0),
        ("jackal", AHEAD, 0.05),
        ("jackal", AHEAD, 0.08),
        ("husky", TURN, 0.0),
        ("husky", AHEAD, 0.08),
    ],
)
def test_a_published_rover_moves_as_in_mujoco_c(name, command, rise):
    """It turns on the spot within 2 % and passes a kerb of half of its wheel radius; one of 8 cm stops the Jackal."""
    spec = SkidSteer(**yaml.safe_load((FILE.parent / f"{name}.yaml").read_text()))
    geoms = [plane(), block([1, -20, -1], [20, 20, rise])] if rise else [plane()]
    expected = Rover(geoms, spec=spec).drive(command, 3.0)[-1]
    site = step_site(rise) if rise else plane_site()
    end = jax.tree.map(lambda x: x[-1], drive("mjx", command, 3.0, site, skid_steer_params(spec)).body)
    np.testing.assert_allclose(end.position_m, expected[:3], atol=0.03)
    heading = np.array([expected[3], *expected[4:7]]) @ np.asarray(end.quaternion)
    assert 2.0 * np.degrees(np.arccos(min(1.0, abs(heading)))) < 4.0
