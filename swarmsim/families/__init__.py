"""Families of scenarios: values of a mission drawn from distributions, for every mission from its own seed."""

from swarmsim.families.draw import Draws, Drawer

__all__ = ["Drawer", "Draws"]
