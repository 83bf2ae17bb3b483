"""The sources of a scenario as points, built on the host."""

import numpy as np

from swarmsim.config.scenario import Scenario
from swarmsim.config.sources import points_of
from swarmsim.pytree import on_host
from swarmsim.radiation.detector import Source
from swarmsim.radiation.library import Library
from swarmsim.site import Site
from swarmsim.site.model import height_at
from swarmsim.world.emission import Emission


def build_sources(
    scenario: Scenario, site: Site, library: Library, groups: tuple[tuple[int, ...], ...]
) -> tuple[Source, Emission]:
    """The points of all sources of a checked scenario at the start of the mission (host).

    Without a source there is one point of no activity. A carried point has its ``position_m`` in the body frame of its
    carrier. ``groups`` are the numbers of the vehicles of each group.
    """
    row = {number: k for k, number in enumerate(n for members in groups for n in members)}
    names = {member.name: number for number, member in enumerate(scenario.members)}
    place, share, number, carrier = [], [], [], []
    corners, corner_of = [], []
    truths = scenario.mission.sources
    standing = [k for k, source in enumerate(truths) if source.form != "carried"]
    for k in standing:
        source = truths[k]
        xy, part = points_of(source)
        assert source.height_m is not None
        place.append(_above(site, xy, source.height_m))
        share.append(part)
        number.append(np.full(len(part), k))
        if source.form != "point":
            outline = np.array(source.corners_m, float)
            corners.append(_above(site, outline, source.height_m))
            corner_of.append(np.full(len(outline), k))
    for k, source in enumerate(truths):
        if source.on is not None:
            place.append(np.array([source.offset_m or (0.0, 0.0, 0.0)]))
            share.append(np.ones(1))
            number.append(np.array([k]))
            carrier.append(row[names[source.on]])
    if not truths:
        place, share, number = [_above(site, np.zeros((1, 2)), 0.0)], [np.zeros(1)], [np.zeros(1)]
    of = np.concatenate(number).astype(int)
    nuclide = np.array([library.nuclide_index(s.nuclide) for s in truths] or [0])[of]
    activity = np.array([1e6 * s.activity_mbq for s in truths] or [0.0])[of] * np.concatenate(share)
    points = Source(
        position_m=on_host(np.concatenate(place)), activity_bq=on_host(activity), nuclide=on_host(nuclide, np.int32)
    )
    return points, Emission(
        decay_1_s=on_host(np.array(library.decay_1_s)[nuclide]),
        number=on_host(of, np.int32),
        carrier=on_host(carrier, np.int32) if carrier else None,
        corners_m=on_host(np.concatenate(corners)) if corners else None,
        corner_of=on_host(np.concatenate(corner_of), np.int32) if corners else None,
    )


def _above(site: Site, xy: np.ndarray, height_m: float) -> np.ndarray:
    """Points [n, 3] that lie ``height_m`` above the terrain at ``xy`` [n, 2]."""
    return np.concatenate([xy, (height_m + height_at(site, xy))[:, None]], axis=1)
