"""Families of scenarios: values of a mission drawn from distributions, for every mission from its own seed."""

from swarmsim.families.draw import Drawer, Draws

__all__ = ["Drawer", "Draws"]
