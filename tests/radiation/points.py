"""Sources, paths and a mount for the radiation tests."""

import jax.numpy as jnp

from swarmsim.config.radiation import DetectorMount
from swarmsim.radiation import Detector, Source
from swarmsim.site import Crossed

MOUNT = DetectorMount(model="any", position_m=(0.0, 0.0, -0.1), axis=(0.0, 0.0, 2.0))


def point(detector: Detector, nuclide: str, activity_bq: float = 170e6, position=(0.0, 0.0, 0.0)) -> Source:
    """A source of the detector's ``nuclide``."""
    return Source(
        position_m=jnp.asarray(position, jnp.float32),
        activity_bq=jnp.float32(activity_bq),
        nuclide=jnp.int32(detector.nuclide_names.index(nuclide)),
    )


def through(detector: Detector, place: float = 0.5, **metres: float) -> Crossed:
    """A way through so many metres of each named material, at ``place`` between source and detector."""
    lengths = jnp.zeros(len(detector.material_names))
    for name, length in metres.items():
        lengths = lengths.at[detector.material_names.index(name)].set(length)
    return Crossed(length_m=lengths, place=jnp.full(len(detector.material_names), place))
