"""What a policy is: a function from a vehicle's view and memory to a command, or a planner of paths.

Write a class with these methods, name it in a phase (``policy: my_file.py:MyPolicy``) or register it. All methods are
pure functions of JAX arrays: they are compiled, and batched over vehicles and missions.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import jax

from swarmsim.config.policies import PolicySettings
from swarmsim.config.scenario import Scenario
from swarmsim.policies.path import Path
from swarmsim.policies.view import Task, View
from swarmsim.pytree import pytree
from swarmsim.site import Site, SiteModel


class Policy(Protocol):
    """Decides for one vehicle. Optional attributes, with what holds without them:

    ``period_s`` between two calls of `act` (each control period) · ``vehicles``: kinds of vehicle that it can steer
    (all) · ``Settings``: a `PolicySettings` class (no settings) · ``listens``: whether it reads ``view.heard`` (no) ·
    ``senses``: kinds of navigation sensors that it reads in ``view.sensors``, such as ``("imu", "gnss")`` (none) ·
    ``done(task, memory, view) -> bool []``: whether the vehicle's part in the phase is over (never) ·
    ``task(assignment) -> pytree``: what it is to know of the scenario, made once on the host: ``task.known`` (nothing).
    """

    def start(self, task: Task, key: jax.Array) -> Any:
        """Memory at the beginning of the phase."""

    def act(self, task: Task, memory: Any, view: View, key: jax.Array) -> tuple[Any, Any]:
        """Memory and command (a class of `swarmsim.control.commands`) until the next call."""


@pytree
class Situation:
    """What a planner knows when it is asked; M vehicles of the phase."""

    position_m: jax.Array  # [M, 3] where they are, world
    target_m: jax.Array  # [2] estimated source, hotspot or given place, world; zero if the settings have no target
    found: jax.Array  # [] bool: there is a target


@dataclass(frozen=True)
class Assignment:
    """What a planner, or what a policy knows of the scenario, is built from, on the host."""

    scenario: Scenario
    settings: PolicySettings
    members: tuple[int, ...]  # numbers of the phase's vehicles in the mission
    site_model: SiteModel


class Planner(Protocol):
    """Gives paths to all vehicles of a phase, which then follow them. Optional attributes as of `Policy`.

    ``period_s``: asked again after that time (once, at the beginning of the phase).
    """

    def task(self, assignment: Assignment) -> Any:
        """What `plan` works on, as a pytree; its sizes are static. On the host, once for a mission."""

    def plan(self, task: Any, site: Site, situation: Situation) -> Path:
        """One path for each vehicle: `Path` with a leading axis M."""
