"""Lithium-polymer battery of a multirotor: voltage by charge and load, and what a load draws from it."""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree


@pytree
class BatteryParams:
    """A pack of cells in series; every leaf may be swept."""

    capacity_j: jax.Array  # [] J at the cells' open-circuit voltage
    cells: jax.Array  # [] in series
    resistance_ohm: jax.Array  # [] of the pack


def open_circuit_voltage(params: BatteryParams, charge: jax.Array) -> jax.Array:
    """Voltage [] V of the resting pack at a ``charge`` [] from 0 to 1.

    Chen and Rincon-Mora, "Accurate electrical battery model capable of predicting runtime and I-V performance" (IEEE
    Transactions on Energy Conversion 21(2), 2006), their polymer cell: 4.10 V full, 3.77 V at half charge.
    """
    s = jnp.clip(charge, 0.0, 1.0)
    cell = -1.031 * jnp.exp(-35.0 * s) + 3.685 + s * (0.2156 + s * (-0.1178 + 0.3201 * s))
    return params.cells * cell


def under_load(params: BatteryParams, energy_j: jax.Array, power_w: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Voltage [] V at the terminals while ``power_w`` [] is drawn, and the power [] W that this costs the cells.

    ``energy_j`` [] has been drawn from the cells. What the resistance takes is lost, so that a quick discharge leaves
    less to use; a load beyond what the pack can give, V^2 / 4 R, holds it at half its voltage.
    """
    open_v = open_circuit_voltage(params, 1.0 - energy_j / params.capacity_j)
    root = jnp.sqrt(jnp.maximum(open_v * open_v - 4.0 * params.resistance_ohm * power_w, 1e-4 * open_v * open_v))
    voltage = 0.5 * (open_v + root)
    current = power_w / voltage
    return voltage, open_v * current
