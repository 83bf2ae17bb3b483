"""Many vehicles at once as operations on scalars: `over_vehicles` in place of `jax.vmap`."""

from swarmsim.scalars.over_vehicles import LAYOUTS, Layout, over_vehicles

__all__ = ["LAYOUTS", "Layout", "over_vehicles"]
