"""The standard atmosphere against the tables of ICAO Doc 7488 and US Standard Atmosphere 1976 (equal below 32 km)."""

import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.sensors.atmosphere import EARTH_RADIUS_M, air_at

# geometric altitude m, temperature K, pressure Pa, density kg/m3
TABLE = [
    (-1000.0, 294.651, 113931.0, 1.3470),
    (0.0, 288.150, 101325.0, 1.2250),
    (500.0, 284.900, 95461.0, 1.1673),
    (1000.0, 281.651, 89876.0, 1.1117),
    (2000.0, 275.154, 79501.0, 1.0066),
    (5000.0, 255.676, 54048.0, 0.73643),
    (10_000.0, 223.252, 26500.0, 0.41351),
    (11_019.07, 216.650, 22632.0, 0.36392),  # 11 km geopotential
    (20_063.12, 216.650, 5474.9, 0.088035),  # 20 km
]
DAY = {"sea_level_pressure_pa": jnp.float32(101_325.0), "sea_level_temperature_k": jnp.float32(288.15)}


@pytest.mark.parametrize(("altitude_m", "temperature_k", "pressure_pa", "density_kg_m3"), TABLE)
def test_the_published_table(altitude_m: float, temperature_k: float, pressure_pa: float, density_kg_m3: float) -> None:
    air = air_at(jnp.float32(altitude_m), **DAY)
    assert float(air.temperature_k) == pytest.approx(temperature_k, abs=2e-3)
    assert float(air.pressure_pa) == pytest.approx(pressure_pa, rel=5e-5)
    assert float(air.density_kg_m3) == pytest.approx(density_kg_m3, rel=1e-4)


def test_float32_keeps_a_millimetre_or_so_of_height() -> None:
    """Against the same formula in float64, 0 to 3 km: 0.05 Pa are 4 mm at sea level."""
    altitude = np.linspace(0.0, 3000.0, 3001)
    height = EARTH_RADIUS_M * altitude / (EARTH_RADIUS_M + altitude)
    exact = 101_325.0 * (1.0 - 0.0065 * height / 288.15) ** (9.80665 / (287.05287 * 0.0065))
    single = np.asarray(air_at(jnp.asarray(altitude, jnp.float32), **DAY).pressure_pa, np.float64)
    assert np.abs(single - exact).max() < 0.05


def test_another_day() -> None:
    day = {"sea_level_pressure_pa": jnp.float32(99_000.0), "sea_level_temperature_k": jnp.float32(303.0)}
    air = air_at(jnp.float32(0.0), **day)
    assert (float(air.pressure_pa), float(air.temperature_k)) == (99_000.0, 303.0)
    warm = air_at(jnp.float32(1000.0), **(DAY | {"sea_level_temperature_k": jnp.float32(303.15)}))
    assert float(warm.pressure_pa) > float(air_at(jnp.float32(1000.0), **DAY).pressure_pa)  # warm air is thick
