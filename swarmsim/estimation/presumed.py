"""What a mission presumes of the world when it estimates sources: its knowledge as arrays."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np

from swarmsim.config.mission import Knowledge, Localisation
from swarmsim.estimation.starts import Places, places_of
from swarmsim.pytree import on_host, pytree, static
from swarmsim.radiation.coarse import coarse
from swarmsim.radiation.detector import AIR, Detector
from swarmsim.site import Site

LINES = 8  # of a nuclide, to which neighbours are put together
BLIND_STD = 0.5  # of the logarithm of a window's rate where walls are not known: half of it may be missing
BLIND_SHARE = 0.25  # of the windows that say something by themselves then: neighbours look through the same walls


@pytree
class Presumed:
    """What a mission presumes of the world when it estimates sources."""

    site: Site  # with the materials that occur in it alone
    detectors: tuple[Detector, ...]  # with few lines for each nuclide
    material_std: jax.Array  # [U] of ln(true over presumed length) in each uncertain material
    background_std: jax.Array  # [] of a window's ln(background over the level)
    model_std: jax.Array  # [] of a window's ln(true over modelled rate)
    spectrum_std: jax.Array  # [] of ln(true over modelled rate) of a region beside that
    learning_rate: jax.Array  # [] how often the log likelihood counts in the posterior of a place
    log_activity: jax.Array  # [] of a source, in Bq
    log_activity_std: jax.Array  # []
    pose_std_m: jax.Array  # [] of measured places
    geometry_std_m: jax.Array  # [] by which all measured places are off from the site's geometry alike; 0: exact
    common_std: jax.Array  # [] of ln(true over modelled rate) of all windows alike: sensitivity, walls not known
    ground_share: jax.Array  # [] of the nominal background, which falls with height
    nuclides: jax.Array  # [N] bool, in question
    places: Places  # where sources are looked for first
    height_m: jax.Array  # [] prior of a source's height above ground
    height_std_m: jax.Array  # []
    uncertain: tuple[int, ...] = static()  # numbers of the U materials whose thickness is not known exactly


def presume(
    site: Site,
    detectors: tuple[Detector, ...],
    spec: Localisation,
    knowledge: Knowledge,
    ground_share: float,
    areas_m: Sequence[np.ndarray],
) -> Presumed:
    """What a mission with that ``knowledge`` presumes (host).

    Args:
        site: the true site, of which the knowledge leaves out what is not known.
        detectors: the true models.
        spec: of the estimate.
        knowledge: of the world.
        ground_share: of the nominal background, which comes from the ground.
        areas_m: in which sources are sought, convex polygons with corners [V, 2], counter-clockwise.
    """
    known = _known_site(site, knowledge)
    exact, blind = knowledge.site == "exact", knowledge.site not in ("exact", "geometry")
    used = _materials_of(known)
    names = tuple(known.material_names[i] for i in used)
    new = np.zeros(len(known.material_names), np.int32)
    new[used] = np.arange(len(used))
    known = replace(
        known,
        material_names=names,
        wall_kg_m3=None if known.wall_kg_m3 is None else on_host(np.asarray(known.wall_kg_m3)[used]),
        ground_material=new[int(known.ground_material)],
        obstacles=replace(known.obstacles, material=new[np.asarray(known.obstacles.material)]),
    )
    ground = names[int(known.ground_material)]
    # the standard deviation of a uniform distribution over +- share
    std = knowledge.thickness_share / 3.0**0.5 if knowledge.site == "geometry" else 0.0
    uncertain = tuple(i for i, name in enumerate(names) if std > 0.0 and name not in (AIR, ground))
    nuclides = detectors[0].nuclide_names
    chosen = [knowledge.nuclides == "unknown" or name in knowledge.nuclides for name in nuclides]
    model = max(knowledge.model_std, BLIND_STD) if blind else knowledge.model_std
    return Presumed(
        site=known,
        detectors=tuple(coarse(d, LINES, names) for d in detectors),
        material_std=on_host([std] * len(uncertain)),
        background_std=on_host(knowledge.background_std),
        model_std=on_host(model),
        spectrum_std=on_host(knowledge.spectrum_std),
        learning_rate=on_host(knowledge.learning_rate * (BLIND_SHARE if blind else 1.0)),
        log_activity=on_host(np.log(1e6 * knowledge.activity_mbq)),
        log_activity_std=on_host(np.log(knowledge.activity_factor)),
        pose_std_m=on_host(knowledge.pose_std_m),
        geometry_std_m=on_host(0.0 if exact else knowledge.geometry_std_m),
        common_std=on_host(np.hypot(knowledge.sensitivity_std, BLIND_STD if blind else 0.0)),
        ground_share=on_host(ground_share),
        nuclides=on_host(chosen, bool),
        places=places_of(known, areas_m, spec.grid_m, spec.presumed_height_m),
        height_m=on_host(spec.presumed_height_m),
        height_std_m=on_host(spec.height_std_m),
        uncertain=uncertain,
    )


def _known_site(site: Site, knowledge: Knowledge) -> Site:
    """The site without what is not known of it."""
    if knowledge.site in ("exact", "geometry"):
        return site
    boxes = site.obstacles
    nothing = replace(
        jax.tree.map(lambda x: on_host(np.asarray(x)[:1], np.asarray(x).dtype), boxes),
        half_extent_m=on_host(np.zeros((1, 3))),
        wall_m=on_host(np.zeros(1)),
    )
    site = replace(site, obstacles=nothing)
    if knowledge.site == "terrain":
        return site
    terrain = np.asarray(site.terrain_m)
    return replace(site, terrain_m=on_host(np.full_like(terrain, terrain.mean())), above=None)


def _materials_of(site: Site) -> list[int]:
    """Numbers of the materials that rays can cross."""
    solid = np.asarray(site.obstacles.half_extent_m)[:, 0] > 0.0
    used = set(np.asarray(site.obstacles.material)[solid].tolist()) | {int(site.ground_material)}
    return sorted(used | {site.material_names.index(AIR)})
