import jax
import jax.numpy as jnp
import numpy as np

from swarmsim.config.load import load_named
from swarmsim.control.commands import DriveCommand, PositionCommand
from swarmsim.policies.hold import HoldPlace
from swarmsim.vehicles.multirotor import multirotor_params
from swarmsim.vehicles.skid_steer import skid_steer_params
from tests.policies.views import task, view

KEY = jax.random.key(0)
policy = HoldPlace()


def test_a_multirotor_stays_where_it_was_when_the_phase_began():
    job = task(params=multirotor_params(load_named("vehicles", "x500")))
    memory = policy.start(job, KEY)
    memory, first = policy.act(job, memory, view((1.0, 2.0, 3.0)), KEY)
    _, later = policy.act(job, memory, view((5.0, 2.0, 3.5)), KEY)
    for command in (first, later):
        assert isinstance(command, PositionCommand)
        np.testing.assert_array_equal(command.position_m, [1.0, 2.0, 3.0])
        np.testing.assert_array_equal(command.velocity_m_s, 0.0)
        assert float(command.yaw_rad) == np.float32(0.3)


def test_a_rover_stands():
    job = task(params=skid_steer_params(load_named("vehicles", "orpheus")))
    _, command = policy.act(job, policy.start(job, KEY), view((1.0, 2.0, 0.3)), KEY)
    assert isinstance(command, DriveCommand)
    assert (float(command.speed_m_s), float(command.yaw_rate_rad_s)) == (0.0, 0.0)


def test_vehicles_of_a_group_keep_their_own_places():
    job = task(params=multirotor_params(load_named("vehicles", "x500")))
    places = jnp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    memory = jnp.stack([policy.start(job, KEY)] * 2)

    def act(memory, place):
        return policy.act(job, memory, view(place), KEY)

    memory, command = jax.vmap(act)(memory, places)
    np.testing.assert_array_equal(command.position_m, places)
    np.testing.assert_array_equal(jax.vmap(act)(memory, places + 1.0)[1].position_m, places)
