"""From knowledge to setpoints: coverage of an area, routes over ground, and the paths that vehicles follow."""

from swarmsim.policies.registry import find, names, register

__all__ = ["find", "names", "register"]
