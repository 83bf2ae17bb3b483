"""The kinds of configuration and the model of each: a new nuclide, vehicle … is one new file of its kind."""

from typing import Any

from swarmsim.config.files import KINDS
from swarmsim.config.mission import Mission
from swarmsim.config.radiation import Detector, Material, Nuclide
from swarmsim.config.sensors import Sensor
from swarmsim.config.site import SiteSpec
from swarmsim.config.vehicles import Vehicle

MODELS: dict[str, Any] = {
    "vehicles": Vehicle,
    "sites": SiteSpec,
    "missions": Mission,
    "detectors": Detector,
    "sensors": Sensor,
    "nuclides": Nuclide,
    "materials": Material,
}
assert tuple(MODELS) == KINDS


def kind_of_model(cls: Any) -> str | None:
    """The kind whose model ``cls`` is (a vehicle class counts as a vehicle), or None."""
    for kind, model in MODELS.items():
        if model is cls or cls in getattr(model, "__args__", ()) or cls in getattr(_inner(model), "__args__", ()):
            return kind
    return None


def _inner(model: Any) -> Any:
    """What stands inside ``Annotated[…]``."""
    return getattr(model, "__origin__", model)
