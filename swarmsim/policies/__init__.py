"""From knowledge to setpoints: coverage of an area, routes over ground, and the paths that vehicles follow."""

from swarmsim.policies.registry import get, names, register

__all__ = ["get", "names", "register"]
