"""A mission as data: its phases with their policies, and what the mission knows and presumes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from swarmsim.estimation import LocalisationParams, MappingParams, Presumed
from swarmsim.estimation.nodes import Span
from swarmsim.missions.asked import Asked
from swarmsim.policies import registry
from swarmsim.pytree import pytree, static
from swarmsim.radiation.detector import Detector
from swarmsim.site import Site
from swarmsim.world.sensing import Sensors


@dataclass(frozen=True)
class PolicyReference:
    """A policy by its name; the digest of its source tells programs of an edited file apart.

    Where the mission's file lies is not in it: a copy of the mission flies by the same programs.
    """

    reference: str  # a name, ``package.module:object``, or the absolute path of a file: ``/…/file.py:object``
    digest: str

    @property
    def object(self) -> Any:
        """The policy, or the planner; a user's says what fails in it."""
        policy = registry.find(self.reference)
        return policy if registry.is_shipped(self.reference) else Asked(self.reference, policy)


@jax.tree_util.register_pytree_node_class
class Values:
    """Numbers of a policy's settings under their names, as traced arrays; texts and missing values are static."""

    def __init__(self, numbers: Mapping[str, Any], others: Mapping[str, Any]):
        """Hold ``numbers`` (arrays) and ``others`` (anything that compares equal to itself)."""
        self.__dict__.update(_numbers=dict(numbers), _others=dict(others))

    def __getattr__(self, name: str) -> Any:
        """The setting of that name."""
        for held in ("_numbers", "_others"):
            if name in self.__dict__.get(held, {}):
                return self.__dict__[held][name]
        raise AttributeError(f"there is no setting '{name}'; there are {', '.join(self.names())}")

    def names(self) -> list[str]:
        """Names of all settings."""
        return [*self.__dict__["_numbers"], *self.__dict__["_others"]]

    def tree_flatten(self) -> tuple[tuple[Any, ...], Any]:
        """Arrays, and what is static."""
        numbers, others = self.__dict__["_numbers"], self.__dict__["_others"]
        return tuple(numbers.values()), (tuple(numbers), tuple(others.items()))

    @classmethod
    def tree_unflatten(cls, static_part: Any, arrays: tuple[Any, ...]) -> "Values":
        """The inverse of `tree_flatten`."""
        names, others = static_part
        return cls(dict(zip(names, arrays, strict=True)), dict(others))

    @classmethod
    def of(cls, settings: Any) -> "Values":
        """The settings of a validated model."""
        numbers, others = {}, {}
        for name, value in vars(settings).items():
            array = None if isinstance(value, str) or value is None else np.asarray(value)
            if array is not None and array.dtype.kind in "fiub":
                numbers[name] = array.astype(np.float32)
            else:
                others[name] = value
        return cls(numbers, others)


@dataclass(frozen=True)
class Place:
    """Which of a group's vehicles take part in a phase."""

    group: int  # number of the group
    local: tuple[int, ...]  # their places in the group
    rank: tuple[int, ...]  # their places in the phase


@dataclass(frozen=True)
class Trigger:
    """What starts or ends a phase: ``at`` a time, ``after`` another phase, or ``when`` a hotspot is found."""

    kind: str
    phase: int = -1  # of `after`


@pytree
class Phase:
    """One phase: M vehicles follow a policy."""

    task: Any  # of the planner, or what the policy knows of the scenario; None without
    settings: Values
    target_m: jax.Array  # [2] a given place to go to, world; zero otherwise
    start_s: jax.Array  # [] time of `at`, or the delay
    end_s: jax.Array  # [] the same of the end
    time_limit_s: jax.Array  # [] after its start
    home_m: jax.Array  # [M, 2] where its vehicles started the mission, world
    yaw_rad: jax.Array  # [M] their heading then
    name: str = static()
    policy: PolicyReference = static()
    places: tuple[Place, ...] = static()
    start: Trigger = static()
    end: Trigger | None = static()
    target: str = static()  # source | hotspot | point | none

    @property
    def size(self) -> int:
        """Number of vehicles."""
        return sum(len(place.local) for place in self.places)

    @property
    def plans(self) -> bool:
        """Whether a planner gives its vehicles paths."""
        return hasattr(self.policy.object, "plan")


@pytree
class Plan:
    """What the mission is to do, and what it knows: never the truth, but what was presumed of it."""

    site: Site
    detectors: tuple[Detector, ...]  # of the team, by model: what `Measurements.detector` indexes
    mapping: MappingParams | None
    localisation: LocalisationParams | None
    presumed: Presumed | None  # for the estimate
    spectrum_radius_m: jax.Array  # [] spectra are taken within this distance of the estimate
    confidence_min: jax.Array  # [] of the identification, to replace the presumed nuclide
    phases: tuple[Phase, ...]
    sensors: Sensors | None  # navigation sensors, for policies that sense; None if none does
    per_window: tuple[int, ...] = static()  # for each group: samples in a window of the estimate
    windows: tuple[int, ...] = static()  # for each group: windows that its vehicles can fill
    kept: tuple[int, ...] = static()  # for each group: windows of each vehicle that the estimate uses
    spans: tuple[Span, ...] = static()  # of the estimate's windows: which rows which detector model measured
    bin_cells: int = static()  # side of a bin of the team's belief, in cells of the map
    spectrometer: int = static()  # detector model whose spectra are identified; -1 for none
    trail: int = static(default=0)  # decision periods in which the places of carried sources are kept for the spectra

    @property
    def estimates(self) -> bool:
        """Whether the sources are estimated."""
        return self.mapping is not None and self.localisation is not None

    @property
    def asks(self) -> bool:
        """Whether a phase asks for the source."""
        return any(phase.target == "source" for phase in self.phases)

    def asked(self, phases: Sequence[Any]) -> Any:
        """Whether [...] one of the phases that ask for the source has begun, by their states."""
        asked = [
            np.isfinite(np.asarray(state.asked_s))
            for phase, state in zip(self.phases, phases, strict=True)
            if phase.target == "source"
        ]
        return np.any(asked, axis=0)
