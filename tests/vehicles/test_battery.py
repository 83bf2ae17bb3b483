"""The lithium-polymer battery: voltage by charge and load."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.config.vehicle_checks import CELL_FULL_V
from swarmsim.vehicles.battery import open_circuit_voltage, under_load
from swarmsim.vehicles.multirotor import rotor_speeds
from tests.flights import params_of

PACK = params_of("x500").battery
CAPACITY = 74.0 * 3600


def test_a_cell_has_the_voltages_of_chen_and_rincon_mora():
    cells = np.array([float(open_circuit_voltage(PACK, jnp.float32(s))) / 4 for s in (0.0, 0.1, 0.5, 1.0)])
    np.testing.assert_allclose(cells, [2.654, 3.6738, 3.8034, 4.103], atol=2e-3)
    charge = jnp.linspace(0.0, 1.0, 101)
    assert (np.diff(np.asarray(jax.vmap(lambda s: open_circuit_voltage(PACK, s))(charge))) > 0).all()


def test_checks_of_vehicles_know_a_full_cell():
    assert float(open_circuit_voltage(PACK, jnp.ones(()))) / float(PACK.cells) == pytest.approx(CELL_FULL_V, abs=0.01)


@given(st.floats(0.0, 0.98), st.floats(0.0, 1500.0))
def test_what_arrives_and_what_is_lost_make_up_what_is_drawn(used, power):
    voltage, drawn = under_load(PACK, jnp.float32(used * CAPACITY), jnp.float32(power))
    current = power / float(voltage)
    assert float(drawn) == pytest.approx(power + current**2 * 0.0136, rel=2e-3, abs=1e-3)


def test_a_load_beyond_the_pack_holds_half_the_voltage():
    voltage, drawn = under_load(PACK, jnp.float32(0.0), jnp.float32(1e6))
    assert float(voltage) == pytest.approx(0.5 * 4 * 4.103, rel=0.02)
    assert np.isfinite(float(drawn))


def test_a_low_battery_takes_thrust():
    params = params_of("x500")
    run = lambda volts: rotor_speeds(params, jnp.zeros(4), jnp.full(4, 2e3), jnp.float32(volts), 10.0)  # noqa: E731
    np.testing.assert_allclose(run(16.8), 1000.0, rtol=1e-5)
    np.testing.assert_allclose(run(14.0), 1000.0 * 14 / 16, rtol=1e-5)


def test_a_quick_discharge_leaves_less():
    """Energy at the terminals until the cells are spent, at 1 C and at 10 C."""

    def usable(power):
        def step(energy, _):
            _, drawn = under_load(PACK, energy, jnp.float32(power))
            return energy + drawn, (energy < CAPACITY) * power

        steps = int(1.2 * CAPACITY / power)
        return float(jnp.sum(jax.lax.scan(step, jnp.float32(0.0), None, length=steps)[1]))

    assert 0.97 < usable(74.0) / CAPACITY < 1.0
    assert 0.80 < usable(740.0) / CAPACITY < 0.96
