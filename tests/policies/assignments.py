"""What planners are built from: a scenario of one phase on a small site."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from swarmsim.config.mission import Mission
from swarmsim.config.scenario import scenario_of
from swarmsim.policies.protocol import Assignment, Situation
from swarmsim.site import Site


def assignment(policy: str, kind: str, homes: Any, site: Site, **settings: Any) -> Assignment:
    """The assignment of a phase of vehicles of one type (``tarot_t650``, ``orpheus``) that start at ``homes``."""
    members = [{"name": f"one{k}", "type": kind, "position_m": tuple(home)} for k, home in enumerate(homes)]
    mapping = {"cell_m": 2.0, "length_scale_m": 10.0, "hotspots_max": 2}
    mapping |= {"hotspot_separation_m": 10.0, "significance_sigma": 5.0}
    phase = {"name": "it", "who": "all", "policy": policy, "settings": settings, "time_limit_s": 600.0}
    mission = Mission(name="small", site="meadows", sources=(), vehicles=members, phases=[phase], mapping=mapping)
    scenario = scenario_of(mission)
    return Assignment(
        scenario=scenario,
        settings=scenario.settings[0],
        members=tuple(range(len(members))),
        site_model=SimpleNamespace(site=site),  # type: ignore[arg-type]
    )


def situation(position_m: Any, target_m: Any = None) -> Situation:
    """Vehicles at ``position_m`` [M, 2 or 3] (on the ground), and a target [2] if there is one."""
    position = np.asarray(position_m, np.float32)
    if position.shape[1] == 2:
        position = np.concatenate([position, np.zeros((len(position), 1), np.float32)], axis=1)
    target = (0.0, 0.0) if target_m is None else target_m
    return Situation(
        position_m=jnp.asarray(position),
        target_m=jnp.asarray(target, jnp.float32),
        found=jnp.array(target_m is not None),
    )
