"""Motion of a multirotor in the air, in both engines, against closed forms and MuJoCo C."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from swarmsim.config.errors import InputError
from swarmsim.control.commands import PositionCommand
from swarmsim.physics.multirotor import check_time_step, longest_time_step, make_multirotor_step, step_loads
from swarmsim.scalars import over_vehicles
from swarmsim.vehicles.multirotor import battery_power, multirotor_mjcf
from tests.flights import (
    CALM,
    DT,
    ENGINES,
    GRAVITY,
    PLAIN,
    airborne,
    angle_deg,
    attitude,
    fly,
    fly_controlled,
    hover_speed,
    params_of,
    plane,
    spec_of,
)

N = 400
STEPS = 50
TIME = DT * np.arange(1, N + 1)
engines = pytest.mark.parametrize("engine", ENGINES)


@engines
@pytest.mark.parametrize(("name", "speed"), [("tarot_t650", 3420.07 * 2 * np.pi / 60), ("x500", None)])
def test_hovers_at_its_hover_speed(engine, name, speed):
    params = params_of(name, PLAIN)
    speed = speed or hover_speed(params)
    states = fly(params, airborne(params, speed=speed), speed, steps=N, name=name, engine=engine)
    np.testing.assert_allclose(states.body.position_m[-1], [0, 0, 100.0], atol=2e-3)
    assert angle_deg(states.body.quaternion[-1], [1.0, 0, 0, 0]) < 1e-3


@engines
def test_falls_freely_without_motors_or_air(engine):
    params = replace(params_of(effects=PLAIN), drag_quadratic_kg_m=jnp.float32(0.0))
    states = fly(params, airborne(params), 0.0, steps=N, engine=engine)
    np.testing.assert_allclose(states.body.velocity_m_s[:, 2], -GRAVITY * TIME, rtol=1e-4)
    np.testing.assert_allclose(states.body.position_m[:, 2], 100 - GRAVITY * TIME**2 / 2, atol=1e-3)


@engines
def test_reaches_its_terminal_velocity(engine):
    params = params_of(effects=PLAIN)
    states = fly(params, airborne(params, height=400.0), 0.0, steps=4 * N, engine=engine)
    terminal = np.sqrt(3.5 * GRAVITY / 0.0995494)
    time = DT * np.arange(1, 4 * N + 1)
    expected = -terminal * np.tanh(GRAVITY * time / terminal)
    np.testing.assert_allclose(states.body.velocity_m_s[:, 2], expected, atol=0.03)
    assert states.body.velocity_m_s[-1, 2] == pytest.approx(-terminal, rel=2e-3)


def test_wind_carries_a_still_body():
    params = params_of(effects=PLAIN)
    speed = hover_speed(params)
    states = fly(params, airborne(params, speed=speed), speed, steps=N, wind=jnp.array([6.0, 0.0, 0.0]))
    # dv/dt = c (W - v)^2 / m from rest: W - v = W / (1 + c W t / m).
    left = 6.0 / (1 + 0.0995494 * 6.0 * TIME / 3.5)
    np.testing.assert_allclose(6.0 - states.body.velocity_m_s[:, 0], left, rtol=2e-3)


@engines
def test_thrust_step_follows_the_rotor_lag(engine):
    params = replace(params_of(effects=PLAIN), drag_quadratic_kg_m=jnp.float32(0.0))
    hover = hover_speed(params)
    target = 1.2 * hover
    states = fly(params, airborne(params, speed=hover), target, steps=N, engine=engine)
    tau = 0.03
    speed = target + (hover - target) * np.exp(-TIME / tau)
    np.testing.assert_allclose(states.rotor_speed_rad_s, np.repeat(speed[:, None], 4, 1), rtol=1e-5)
    # Velocity of the closed form: integral of g ((w / hover)^2 - 1).
    gap = (hover - target) / hover
    squares = (
        1.44 * TIME + 2 * 1.2 * gap * tau * (1 - np.exp(-TIME / tau)) + gap**2 * tau / 2 * (1 - np.exp(-2 * TIME / tau))
    )
    np.testing.assert_allclose(states.body.velocity_m_s[:, 2], GRAVITY * (squares - TIME), atol=3e-3)


@engines
def test_yaw_follows_the_torques_and_the_rotors_momentum(engine):
    params = params_of(effects=PLAIN)
    hover = hover_speed(params)
    spins = np.asarray(params.rotor_spin)
    command = hover * np.sqrt(1 - 0.1 * spins)  # clockwise rotors faster: the body turns counter-clockwise
    states = fly(params, airborne(params, speed=hover), command, steps=N, engine=engine)
    fine = np.linspace(0, TIME[-1], 40001)
    speeds = command + (hover - command) * np.exp(-fine[:, None] / 0.03)
    torque = -(spins * 0.0399 * 6.69191e-5 * speeds**2).sum(1)
    impulse = np.concatenate([[0.0], np.cumsum(0.5 * (torque[1:] + torque[:-1]) * np.diff(fine))])
    momentum = 2.0e-4 * (spins * (speeds - hover)).sum(1)
    expected = np.interp(TIME, fine, (impulse - momentum) / 0.18484375)
    found = states.body.angular_velocity_rad_s
    np.testing.assert_allclose(found[:, 2], expected, rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(found[:, :2], 0.0, atol=1e-4)
    assert found[-1, 2] > 1.0


@engines
@pytest.mark.parametrize("rotors", [0.0, 120.0])
def test_tumbling_keeps_momentum_and_energy(engine, rotors):
    """Torque-free tumbling, also with flywheels: two rotors that turn the same way and touch no air."""
    params = replace(
        params_of(effects=PLAIN),
        inertia_kg_m2=jnp.array([0.10, 0.14, 0.18]),
        thrust_coefficient_n_s2=jnp.float32(0.0),
        drag_quadratic_kg_m=jnp.float32(0.0),
        rotor_inertia_kg_m2=jnp.float32(1e-3),
        speed_min_rad_s=jnp.float32(0.0),
        time_constant_down_s=jnp.float32(1e9),
    )
    speeds = rotors * jnp.array([1.0, 1.0, 0.0, 0.0])
    start = airborne(params, speed=speeds, rate=(1.5, 0.4, -1.0))
    states = fly(params, start, jnp.maximum(speeds, 1e-6), steps=N, engine=engine)
    rate = states.body.angular_velocity_rad_s.astype(np.float64)
    flywheel = 1e-3 * (np.asarray(params.rotor_spin) * states.rotor_speed_rad_s).sum(1)
    momentum_body = rate * [0.10, 0.14, 0.18] + flywheel[:, None] * [0, 0, 1.0]
    momentum = np.einsum("nij,nj->ni", attitude(states.body.quaternion), momentum_body)
    drift = np.linalg.norm(momentum - momentum[0], axis=1) / np.linalg.norm(momentum[0])
    energy = 0.5 * (rate**2 * [0.10, 0.14, 0.18]).sum(1)
    assert drift.max() < 0.01
    assert np.abs(energy / energy[0] - 1).max() < 0.01
    assert angle_deg(states.body.quaternion[-1], [1.0, 0, 0, 0]) > 5.0  # it did tumble


@engines
def test_thirty_seconds_of_tumbling_keep_the_energy(engine):
    """Random principal moments (as of a real body: none above the sum of the others) and rates up to 20 rad/s."""
    draw = np.random.default_rng(3)
    count = 64
    parts = draw.uniform(0.01, 0.1, (count, 3))
    inertia = parts.sum(1, keepdims=True) - parts
    rate = draw.normal(size=(count, 3))
    rate *= np.geomspace(0.3, 20.0, count)[:, None] / np.linalg.norm(rate, axis=1, keepdims=True)
    still = params_of(effects=PLAIN)
    still = replace(still, thrust_coefficient_n_s2=jnp.float32(0.0), drag_quadratic_kg_m=jnp.float32(0.0))
    step = make_multirotor_step(engine, DT)

    def one(inertia, rate):
        params = replace(still, inertia_kg_m2=inertia)
        start = airborne(params, height=6000.0)
        start = replace(start, body=replace(start.body, angular_velocity_rad_s=rate))

        def hundred(state, _):
            tick = lambda s, _: (step(params, s, jnp.zeros(4), CALM, plane()), None)  # noqa: E731
            state, _ = jax.lax.scan(tick, state, None, length=100)
            return state, (state.body.angular_velocity_rad_s, state.body.quaternion)

        return jax.lax.scan(hundred, start, None, length=60)[1]

    rates, turns = jax.jit(over_vehicles(one))(jnp.asarray(inertia, jnp.float32), jnp.asarray(rate, jnp.float32))
    body = np.asarray(rates, float) * inertia[:, None]
    first = rate * inertia
    energy = (body * rates).sum(-1) / (first * rate).sum(-1)[:, None]
    assert np.abs(energy - 1.0).max() < 0.002
    momentum = np.einsum("bnij,bnj->bni", attitude(turns), body) - first[:, None]
    drift = np.linalg.norm(momentum, axis=-1).max(axis=1) / np.linalg.norm(first, axis=1)
    assert (drift < 1e-3 + 3e-5 * (rate**2).sum(1)).all()


def _turning_flight(time):
    """Figure of eight with a climb and a yaw: every axis moves."""
    a, w = 4.0, 0.8
    zero = 0.0 * time
    return PositionCommand(
        position_m=jnp.stack([a * jnp.sin(w * time), a * jnp.sin(2 * w * time) / 2, 50.0 + jnp.sin(w * time)]),
        velocity_m_s=w * jnp.stack([a * jnp.cos(w * time), a * jnp.cos(2 * w * time), jnp.cos(w * time)]),
        acceleration_m_s2=jnp.stack([zero, zero, zero]),
        yaw_rad=jnp.sin(0.5 * time),
    )


@pytest.mark.parametrize("name", ["tarot_t650", "x500"])
def test_engines_agree_on_ten_seconds_of_free_flight(name):
    params = params_of(name)
    start = airborne(params, height=50.0, speed=hover_speed(params))
    flown, _, commands = fly_controlled(params, _turning_flight, 10.0, state=start, wind=3.0, name=name)
    commands = np.repeat(commands, 2, axis=0)
    wind = jnp.array([2.0, 1.0, 0.2])
    both = [fly(params, start, commands, wind=wind, name=name, engine=engine) for engine in ENGINES]
    gap = np.linalg.norm(both[0].body.position_m - both[1].body.position_m, axis=1)
    turn = angle_deg(both[0].body.quaternion, both[1].body.quaternion)
    assert gap.max() < 0.01
    assert turn.max() < 0.1
    tilt = angle_deg(flown.body.quaternion, np.array([1.0, 0, 0, 0]))
    assert tilt.max() > 10.0  # a flight that tests something


def test_mjx_follows_mujoco_c_under_the_same_loads():
    """Five seconds; MuJoCo C integrates by Runge and Kutta's method what `step_loads` gives, held over each step."""
    spec, params = spec_of(), params_of()
    hover, steps, wind = hover_speed(params), 1000, jnp.array([3.0, 0.0, 0.0])
    time = DT * np.arange(steps)[:, None]
    commands = hover * (1 + 0.03 * np.sin(3 * time + np.array([0.0, 1.0, 2.0, 3.5])))
    start = airborne(params, speed=hover)
    states = fly(params, start, commands, wind=wind, engine="mjx")
    before = jax.tree.map(lambda first, rest: np.concatenate([np.asarray(first)[None], rest[:-1]]), start, states)
    found = jax.jit(jax.vmap(lambda state, command: step_loads(params, state, command, wind, plane(), DT)))
    loads = jax.tree.map(np.asarray, found(before, jnp.asarray(commands, jnp.float32)))
    model = mujoco.MjModel.from_xml_string(multirotor_mjcf(spec, DT))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    data, inertia = mujoco.MjData(model), np.array(spec.inertia_kg_m2)
    data.qpos[:] = [0, 0, 100, 1, 0, 0, 0]
    places, turns = [], []
    for force_n, torque_nm, momentum in zip(loads.force_n, loads.torque_nm, loads.rotor_momentum_nms, strict=True):
        rate = data.qvel[3:] + 0.5 * DT * torque_nm / inertia  # in the middle of the step
        torque_nm = torque_nm - np.cross(rate, [0.0, 0.0, momentum])
        torque_nm += 0.5 * DT * np.cross(rate, torque_nm)  # what MuJoCo is given does not turn with the body
        data.xfrc_applied[1] = [*force_n, *attitude(data.qpos[3:]) @ torque_nm]
        mujoco.mj_step(model, data)
        places.append(data.qpos[:3].copy())
        turns.append(data.qpos[3:].copy())
    assert np.linalg.norm(states.body.position_m - places, axis=1).max() < 2e-4
    assert angle_deg(states.body.quaternion, np.array(turns)).max() < 0.01
    assert angle_deg(np.array(turns), np.array([1.0, 0, 0, 0])).max() > 40.0


def test_flight_at_the_usual_step_is_that_of_mujoco_c_at_a_fortieth():
    """Gyroscopic torques included: MuJoCo C with a step of 0.125 ms and the rotors as flywheels of its own terms."""
    params = replace(
        params_of(effects=PLAIN), thrust_coefficient_n_s2=jnp.float32(0.0), drag_quadratic_kg_m=jnp.float32(0.0),
        inertia_kg_m2=jnp.array([0.10, 0.14, 0.18]),
    )  # fmt: skip
    rate, fine, moments = (2.0, -1.5, 3.0), DT / 40, np.array([0.10, 0.14, 0.18])
    states = fly(params, airborne(params, height=500.0, rate=rate), 0.0, steps=N)
    spec = spec_of().model_copy(update={"inertia_kg_m2": tuple(moments)})
    model = mujoco.MjModel.from_xml_string(multirotor_mjcf(spec, fine))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[3:] = [0, 0, 500, 1, 0, 0, 0], rate
    mujoco.mj_step(model, data, 40 * N)
    assert angle_deg(states.body.quaternion[-1], data.qpos[3:]) < 0.3  # after 7 rad; Euler's step of 5 ms: 6 degrees
    np.testing.assert_allclose(states.body.angular_velocity_rad_s[-1], data.qvel[3:], atol=0.02)


@engines
def test_sweeps_need_no_new_compilation(engine):
    params = params_of(effects=PLAIN)
    step = make_multirotor_step(engine, DT)
    run = jax.jit(jax.vmap(step, in_axes=(0, None, None, None, None)))
    start = airborne(params, speed=hover_speed(params))
    command = jnp.full(4, hover_speed(params))

    def climb(masses):
        swept = jax.tree.map(lambda x: jnp.broadcast_to(x, (3, *x.shape)), params)
        swept = replace(swept, mass_kg=jnp.array(masses))
        return np.asarray(run(swept, start, command, CALM, plane()).body.velocity_m_s[:, 2]) / DT

    np.testing.assert_allclose(climb([1.75, 3.5, 7.0]), GRAVITY * np.array([1.0, 0.0, -0.5]), atol=2e-2)
    np.testing.assert_allclose(climb([3.5, 14.0, 3.5]), GRAVITY * np.array([0.0, -0.75, 0.0]), atol=2e-2)
    assert run._cache_size() == 1


@pytest.mark.slow
@engines
def test_gradients_are_finite_and_right(engine):
    params, ground = params_of(effects=PLAIN), plane()
    step = make_multirotor_step(engine, DT)
    hover = hover_speed(params)

    def height(mass, speed, start):
        swept = replace(params, mass_kg=mass)
        body = lambda state, _: (step(swept, state, jnp.full(4, speed), CALM, ground), None)  # noqa: E731
        return jax.lax.scan(body, start, None, length=STEPS)[0].body.position_m[2]

    gradient = jax.jit(jax.grad(height, argnums=(0, 1)))
    in_air = airborne(params, speed=hover)
    mass, speed = gradient(jnp.float32(3.5), jnp.float32(hover), in_air)
    # d(height)/d(mass) of a constant thrust: -(thrust / m^2) t^2 / 2.
    assert float(mass) == pytest.approx(-GRAVITY / 3.5 * (DT * STEPS) ** 2 / 2, rel=5e-3)
    assert float(speed) > 0.0
    on_ground = airborne(params, height=0.219)
    assert np.isfinite(gradient(jnp.float32(3.5), jnp.float32(100.0), on_ground)).all()


@engines
def test_a_broken_vehicle_stays_alone(engine):
    params = params_of()
    step = jax.jit(jax.vmap(make_multirotor_step(engine, DT), in_axes=(None, 0, 0, None, None)))
    start = airborne(params, speed=hover_speed(params))
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (3, *x.shape)), start)
    commands = jnp.full((3, 4), 350.0)
    sound = step(params, batch, commands, CALM, plane())
    broken = step(params, batch, commands.at[1].set(jnp.nan), CALM, plane())
    assert np.isnan(broken.body.position_m[1]).any()
    for lane in (0, 2):
        for a, b in zip(jax.tree.leaves(sound), jax.tree.leaves(broken), strict=True):
            np.testing.assert_array_equal(a[lane], b[lane])


def test_ground_effect_lifts_near_the_ground():
    params = params_of()
    speed = hover_speed(params)
    low = fly(params, airborne(params, height=0.30, speed=speed), speed, steps=2)
    factor = 1 / (1 - (0.19 / (4 * 0.30)) ** 2)
    assert low.body.velocity_m_s[0, 2] / DT == pytest.approx(GRAVITY * (factor - 1), rel=1e-2)


def test_energy_is_power_times_time():
    """Of a battery without resistance; the power is that of `battery_power`, which has tests of its own."""
    params = params_of(effects=PLAIN)
    speed = hover_speed(params)
    states = fly(params, airborne(params, speed=speed), speed, steps=N)
    every = jnp.full(4, speed)
    power = float(battery_power(params, speed_before_rad_s=every, speed_after_rad_s=every, dt=DT))
    assert states.energy_j[-1] == pytest.approx(power * TIME[-1], rel=1e-4)


def test_a_pack_with_resistance_gives_more_than_arrives():
    params = params_of()
    speed = hover_speed(params)
    states = fly(params, airborne(params, speed=speed), speed, steps=N)
    every = jnp.full(4, speed)
    power = float(battery_power(params, speed_before_rad_s=every, speed_after_rad_s=every, dt=DT))
    current = power / states.voltage_v[-1]
    lost = 0.012 * current**2
    assert states.energy_j[-1] == pytest.approx((power + lost) * TIME[-1], rel=1e-3)
    assert states.voltage_v[-1] == pytest.approx(6 * 4.103 - 0.012 * current, rel=2e-3)


def test_bad_choices_are_refused():
    with pytest.raises(InputError, match="there is no engine 'bullet': choose one of mjx, analytic"):
        make_multirotor_step("bullet", DT)
    with pytest.raises(InputError, match=r"time step of 0\.02 s is too long for the feet of tarot_t650"):
        check_time_step(spec_of(), 0.02)
    assert longest_time_step(spec_of("x500")) > DT
