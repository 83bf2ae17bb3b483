"""The ICAO Standard Atmosphere below 20 km, shifted to the pressure and temperature of a day.

ICAO Doc 7488/3 (1993), identical with ISO 2533:1975: a temperature gradient of -6.5 K/km up to a geopotential height of
11 km, constant temperature from there to 20 km.
"""

import jax
import jax.numpy as jnp

from swarmsim.pytree import pytree

GRAVITY_M_S2 = 9.80665
GAS_CONSTANT_J_KG_K = 287.05287
EARTH_RADIUS_M = 6_356_766.0
LAPSE_K_M = 0.0065
TROPOPAUSE_M = 11_000.0
_EXPONENT = GRAVITY_M_S2 / (GAS_CONSTANT_J_KG_K * LAPSE_K_M)  # 5.25588


@pytree
class Air:
    """Air at one height."""

    pressure_pa: jax.Array  # []
    temperature_k: jax.Array  # []

    @property
    def density_kg_m3(self) -> jax.Array:
        """Density [] of dry air."""
        return self.pressure_pa / (GAS_CONSTANT_J_KG_K * self.temperature_k)


def air_at(altitude_m: jax.Array, *, sea_level_pressure_pa: jax.Array, sea_level_temperature_k: jax.Array) -> Air:
    """Air [...] at ``altitude_m`` [...] above mean sea level.

    In float32 the pressure is known to about 0.05 Pa (4 mm of height): what a barometer resolves is twenty times that.
    """
    height = EARTH_RADIUS_M * altitude_m / (EARTH_RADIUS_M + altitude_m)  # geopotential
    low = jnp.minimum(height, TROPOPAUSE_M)
    temperature = sea_level_temperature_k - LAPSE_K_M * low
    above = jnp.maximum(height - TROPOPAUSE_M, 0.0)
    # log1p, because a power of a ratio near one loses digits in float32.
    exponent = _EXPONENT * jnp.log1p(-LAPSE_K_M * low / sea_level_temperature_k)
    pressure = sea_level_pressure_pa * jnp.exp(exponent - GRAVITY_M_S2 * above / (GAS_CONSTANT_J_KG_K * temperature))
    return Air(pressure_pa=pressure, temperature_k=jnp.broadcast_to(temperature, jnp.shape(pressure)))
