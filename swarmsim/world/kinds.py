"""The kinds of vehicle. A kind is one module with the functions of `Kind`; nothing else asks what a vehicle is."""

from typing import Any, Protocol

import jax

from swarmsim.physics.contact import Plane
from swarmsim.scalars import Layout
from swarmsim.site import Site
from swarmsim.world import multirotor, skid_steer
from swarmsim.world.failsafes import Rescue
from swarmsim.world.model import Limits


class Kind(Protocol):
    """Functions of one vehicle; parameters, states and commands are pytrees of the kind's own."""

    FLIES: bool
    """Whether it leaves the ground: it then has a wind, and keeps its distance in three dimensions."""

    def rest(self, params: Any, site: Site, start_m: jax.Array, yaw_rad: jax.Array) -> Any:
        """State at rest on the ground."""

    def control_start(self) -> Any:
        """Memory of the controller."""

    def full_command(self, params: Any, command: Any) -> Any:
        """What a policy returned, with every level (`swarmsim.control.commands`)."""

    def stay(self, params: Any, vehicle: Any) -> Any:
        """The command that keeps the vehicle where it is."""

    def jet(self, params: Any, vehicle: Any) -> tuple[jax.Array, jax.Array]:
        """Thrust [] N with which it blows at those below it, and the distance [] m of its opposite motors."""

    def rotors(self, params: Any) -> int:
        """How many rotors it has; of a kind that flies."""

    def tick(
        self, params: Any, vehicle: Any, control: Any, command: Any, armed: jax.Array, ground: Plane,
        wall: Plane, wind_m_s: jax.Array, motor_noise: jax.Array | None, site: Site, *, engine: str, dt: float,
        substeps: int, layout: Layout,
    ) -> tuple[Any, Any, jax.Array]:  # fmt: skip
        """Vehicle, controller and impact speed [] after one control period; ``layout`` is how it is mapped."""

    def rescued(self, command: Any, rescue: Rescue) -> Any:
        """The command, or what the autopilot does by itself; of a kind that flies, as are the next two."""

    def carried(self, params: Any, vehicle: Any, share: jax.Array) -> jax.Array:
        """Speed [] m/s at which the air carries it off although it does more than a ``share`` [] of what it can."""

    def landed(self, control: Any) -> jax.Array:
        """Whether [] it stands on the ground with its motors off."""

    def knocked(self, params: Any, vehicle: Any, velocity_m_s: jax.Array, spin_nms: jax.Array) -> Any:
        """The vehicle after a change of its velocity [3] and an angular impulse [3] N m s, both world."""

    def height(self, params: Any, vehicle: Any, ground: Plane) -> jax.Array:
        """Height [] of the lowest contact point above the ground."""

    def crashed(self, params: Any, vehicle: Any, height_m: jax.Array, impact_m_s: jax.Array, limits: Limits) -> Any:
        """Whether [] it tipped over or hit the ground too hard."""

    def obstructed(
        self, params: Any, vehicle: Any, wall: Plane, impact_m_s: jax.Array, limits: Limits, site: Site
    ) -> jax.Array:
        """Whether [] it hit an obstacle."""


KINDS: dict[str, Any] = {"multirotor": multirotor, "skid_steer": skid_steer}
