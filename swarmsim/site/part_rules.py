"""What the parts of a mesh are: ground, or obstacles of the material that the specification's rules say."""

from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmsim.config.errors import Problem, raise_if_any
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.site import ObstacleMaterial, SiteSpec
from swarmsim.site.columns import closed_volume
from swarmsim.site.drawn_walls import drawn_walls
from swarmsim.site.mesh_parts import Floats, Part
from swarmsim.site.obstacles import Box, boxes_of, components

Mask = NDArray[np.bool_]

AIR = "air"  # material of parts painted on others, such as windows, which get no box
BOXES_MAX = 1024  # the largest are kept: every ray is intersected with every box
NAMES_SHOWN = 40
AS_DRAWN = 3.0  # a wall that is drawn up to so many times as thick as its rule says is as thick as drawn
UNLIKE = 2.5  # factor of matter: a box around an ellipsoid has 1.9 times its matter, one around a gable roof 2.0 times
SMALL_M3 = 1.0
UNLIKE_SHOWN = 5
UNNAMED = "without a name"


@dataclass(frozen=True)
class Obstacles:
    """Obstacles of a mesh."""

    boxes: list[Box]
    materials: list[str]  # of each box
    passable: list[bool]  # whether a rover can pass each box
    stops: Mask  # [t] triangles that stop a rover
    unlike: dict[str, tuple[float, float]]  # matter imported and drawn, m3, of parts by name where they differ much


def matches(part: Part, pattern: str) -> bool:
    """Whether one of a part's names matches a pattern as in a shell, without case."""
    return any(fnmatchcase(name.casefold(), pattern.casefold()) for name in part.names)


def rule_of(part: Part, spec: SiteSpec) -> ObstacleMaterial | None:
    """The first rule of the specification that matches a part; None where the default applies."""
    return next((rule for rule in spec.obstacles if matches(part, rule.match)), None)


def _rule(part: Part, spec: SiteSpec) -> ObstacleMaterial:
    default = ObstacleMaterial(match="*", material=spec.default_material, wall_m=spec.default_wall_m)
    return rule_of(part, spec) or default


def check_patterns(parts: list[Part], spec: SiteSpec, path: Path) -> None:
    """Raise `InputError` for patterns of the specification that match nothing."""
    names = sorted({name for part in parts for name in part.names})
    shown = one_of(names[:NAMES_SHOWN]) + (f" … ({len(names)} names)" if len(names) > NAMES_SHOWN else "")
    given = [("ground", pattern) for pattern in spec.ground] + [("obstacles", rule.match) for rule in spec.obstacles]
    raise_if_any(
        [
            Problem(
                f"no mesh material or geometry matches '{pattern}' of '{key}'", file=str(path), path=key,
                given=pattern, allowed=shown, suggestion=did_you_mean(pattern, names),
            )
            for key, pattern in given
            if not any(matches(part, pattern) for part in parts)
        ]
    )  # fmt: skip


def find_obstacles(parts: list[Part], bare: Mask, spec: SiteSpec) -> Obstacles:
    """The obstacles among the triangles [t] of the parts that are not ``bare`` ground."""
    boxes: list[Box] = []
    names: list[str] = []
    passable: list[bool] = []
    unlike: dict[str, tuple[float, float]] = {}
    stops = ~bare
    start = 0
    for part in parts:
        span = slice(start, start + len(part.triangles))
        start = span.stop
        rule = _rule(part, spec)
        stops[span] &= not rule.traversable
        said = None if rule_of(part, spec) is None else rule.wall_m
        own = part.triangles[~bare[span]] if rule.material != AIR else part.triangles[:0]
        for piece in components(part.vertices, own) if len(own) else ():
            corners = part.vertices[own[piece]]
            walls = [_as_said(box, said) for box in drawn_walls(corners) or ()]
            found = walls or boxes_of(corners, rule.wall_m)
            if not walls and (both := _unlike(corners, found)):
                name = part.names[0] if part.names else UNNAMED
                before = unlike.get(name, (0.0, 0.0))
                unlike[name] = (before[0] + both[0], before[1] + both[1])
            boxes += found
            names += [rule.material] * len(found)
            passable += [rule.traversable] * len(found)
    return Obstacles(boxes, names, passable, stops, unlike)


def _as_said(box: Box, wall_m: float | None) -> Box:
    """A drawn wall with the matter that its rule says: sheets and planks are often drawn as thick as their frame.

    Half of it on either side. Where the rule is about as thick as the drawing, this is the truth.
    """
    if wall_m is None or 2.0 * min(box.half) <= AS_DRAWN * wall_m:
        return box
    return replace(box, wall=0.5 * wall_m)


def _unlike(corners: Floats, boxes: list[Box]) -> tuple[float, float] | None:
    """Matter of the ``boxes`` and of the closed component that they stand for, m3, where it differs by `UNLIKE`.

    Hollow boxes are as a rule says, and pieces of less than `SMALL_M3` are not looked at.
    """
    imported = sum(box.volume for box in boxes)
    if imported < SMALL_M3 or any(box.wall for box in boxes):
        return None
    drawn = closed_volume(corners)
    if drawn is None or imported / UNLIKE <= drawn <= imported * UNLIKE:
        return None
    return imported, drawn


def unlike_told(unlike: dict[str, tuple[float, float]]) -> list[str]:
    """A warning of the parts that boxes do not follow, those with most matter first."""
    if not unlike:
        return []
    worst = sorted(unlike.items(), key=lambda part: -abs(part[1][0] - part[1][1]))
    shown = ", ".join(
        f"{name} ({imported:.3g} m3 for {drawn:.3g} m3)" for name, (imported, drawn) in worst[:UNLIKE_SHOWN]
    )
    more = f" and {len(worst) - UNLIKE_SHOWN} more" if len(worst) > UNLIKE_SHOWN else ""
    return [
        f"boxes do not follow the shape of: {shown}{more}; radiation meets the matter of the boxes, and their insides "
        "are closed to rovers. Draw them as pieces that are boxes, such as one object for each wall, or say wall_m of "
        "what is hollow (obstacles)"
    ]


def described(parts: list[Part], bare: Mask, spec: SiteSpec) -> list[dict[str, Any]]:
    """What each part was taken for, as plain values: its names, triangles, ``is`` and whether a ``rule`` says so."""
    edges = np.cumsum([len(part.triangles) for part in parts])[:-1]
    found = []
    for part, mask in zip(parts, np.split(bare, edges), strict=True):
        ground = bool(mask.mean() > 0.5)
        found.append(
            {
                "names": list(part.names),
                "triangles": len(part.triangles),
                "is": "ground" if ground else _rule(part, spec).material,
                "rule": ground or rule_of(part, spec) is not None,
            }
        )
    return found


def unnamed_told(parts: list[dict[str, Any]], spec: SiteSpec) -> list[str]:
    """A warning of the obstacles that no rule names; ``parts`` as of `described`."""
    names = list(dict.fromkeys(part["names"][0] if part["names"] else UNNAMED for part in parts if not part["rule"]))
    if not names:
        return []
    shown = ", ".join(names[:NAMES_SHOWN]) + (
        f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
    )
    how = "solid" if spec.default_wall_m is None else f"in shells of {spec.default_wall_m:g} m"
    return [
        f"taken as {spec.default_material}, {how} (default_material, default_wall_m), since no rule names them: "
        f"{shown}. To say what they are, add to 'obstacles:' in site.yaml, e.g. "
        f"- {{match: '{names[0]}', material: steel, wall_m: 0.002}}"
    ]
