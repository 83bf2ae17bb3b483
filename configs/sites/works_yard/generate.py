"""Generates the mesh of the site ``works_yard``: a fictitious industrial yard of 2.1 ha.

``python configs/sites/works_yard/generate.py [OUT.dae]`` writes the mesh, by default in place; its output is
deterministic. Sizes are those of common things (a 20 ft container: ISO 668; a roll-off skip of about 30 m3).
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the modules that the generators of sites share

from collada_writer import Colour, write_collada
from mesh_shapes import (
    Floats,
    Parts,
    Triangles,
    box,
    building,
    cylinder,
    ground_cells,
    joined,
    lowest_ground,
    merged,
    moved,
    polygon_prism,
    ribbon,
    scaled,
    tree,
)

MESH = Path(__file__).with_name("works_yard.dae")
HALF = (82.0, 64.0)  # m; half the size of the yard, a rectangle around the origin
SKIP = (12.0, 4.0)  # centre of the open-top container

COLOURS: dict[str, Colour] = {
    "grass": (0.47, 0.53, 0.36), "meadow": (0.56, 0.59, 0.41), "gravel": (0.68, 0.65, 0.58),
    "asphalt": (0.41, 0.42, 0.43), "paving": (0.60, 0.60, 0.58), "brick_red": (0.63, 0.42, 0.34),
    "brick_ochre": (0.74, 0.61, 0.45), "concrete_light": (0.77, 0.76, 0.72), "concrete_grey": (0.64, 0.65, 0.65),
    "roof_tiles": (0.52, 0.31, 0.25), "roof_slate": (0.36, 0.39, 0.43), "roof_felt": (0.45, 0.46, 0.47),
    "window": (0.30, 0.38, 0.44), "door": (0.35, 0.27, 0.22), "skip_steel": (0.80, 0.55, 0.18),
    "skip_floor": (0.42, 0.34, 0.26), "container_blue": (0.27, 0.41, 0.54), "container_rust": (0.61, 0.35, 0.25),
    "container_green": (0.35, 0.47, 0.38), "tank_steel": (0.74, 0.76, 0.78), "fence_steel": (0.52, 0.55, 0.56),
    "fence_wood": (0.55, 0.43, 0.31), "timber": (0.66, 0.52, 0.36), "bark": (0.38, 0.30, 0.23),
    "foliage_dark": (0.28, 0.39, 0.24), "foliage_light": (0.40, 0.49, 0.27), "hedge": (0.31, 0.42, 0.26),
}  # fmt: skip

# name, centre, length, width, yaw deg, height of the eaves, of the ridge above them (0 = flat), walls, roof
BUILDINGS: tuple[tuple[str, tuple[float, float], float, float, float, float, float, str, str], ...] = (
    ("middle_building", (-4.0, 4.0), 18.0, 12.0, 0.0, 6.0, 3.6, "brick_red", "roof_tiles"),
    ("office", (-18.0, 40.0), 26.0, 10.0, 0.0, 7.0, 0.0, "concrete_light", "roof_felt"),
    ("workshop", (20.0, 36.0), 16.0, 12.0, 90.0, 4.8, 2.8, "brick_ochre", "roof_slate"),
    ("warehouse", (-14.0, -42.0), 28.0, 16.0, 0.0, 9.8, 0.0, "concrete_grey", "roof_felt"),
    ("shed", (24.0, -36.0), 11.0, 7.0, 8.0, 3.2, 1.8, "brick_ochre", "roof_slate"),
    ("gatehouse", (-46.0, 6.0), 6.0, 4.5, 0.0, 3.2, 0.0, "concrete_light", "roof_felt"),
    ("villa", (66.0, 42.0), 13.0, 9.0, 18.0, 5.2, 3.2, "brick_red", "roof_tiles"),
    ("pump_house", (64.0, -28.0), 7.0, 5.0, -15.0, 3.6, 0.0, "concrete_grey", "roof_felt"),
)
# corners of the L-shaped laboratory on the plateau, counter-clockwise
LABORATORY = ((58.0, 4.0), (76.0, 4.0), (76.0, 11.0), (65.0, 11.0), (65.0, 22.0), (58.0, 22.0))

TREES = (
    (-48, 44, 9.5), (-42, 51, 11.0), (-35, 55, 8.0), (-50, 56, 7.0), (-38, 27, 6.5), (-46, -38, 10.0), (-40, -52, 11.5),
    (-50, -54, 8.0), (-37, -30, 6.0), (2, 24, 7.0), (6, 50, 9.0), (40, 56, 10.5), (50, 52, 8.5), (55, 58, 7.0),
    (77, 56, 9.0), (77, 30, 7.5), (50, 30, 6.0), (74, -12, 8.0), (60, -46, 10.5), (68, -52, 9.0), (75, -42, 11.0),
    (54, -56, 7.5), (8, -54, 8.5), (40, -56, 6.5),
)  # fmt: skip
# centre, length, yaw deg, height
HEDGES = ((-18.0, 31.0, 22.0, 0.0, 1.5), (-46.0, 22.0, 14.0, 90.0, 1.8), (64.0, 32.0, 16.0, 18.0, 1.4))
CONTAINERS = (
    (-33.0, 14.0, 0.0, "container_blue"), (-33.0, 17.2, 0.0, "container_rust"), (36.0, -48.0, 30.0, "container_green"),
    (43.0, -42.0, 34.0, "container_blue"), (34.0, 50.0, 90.0, "container_rust"), (14.0, -24.0, 0.0, "container_green"),
)  # fmt: skip


def _smooth(t: Floats) -> Floats:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def ground_height(xy: Floats) -> Floats:
    """Height [...] of the yard's ground at ``xy`` [..., 2]: a level yard, an eastern plateau with its ramp, swells."""
    x, y = xy[..., 0], xy[..., 1]
    plateau = 4.2 * _smooth((x - 27.0) / 32.0) * _smooth((y + 42.0) / 34.0)
    bank = -1.1 * _smooth((-34.0 - y) / 22.0) * _smooth((-22.0 - x) / 18.0)
    swell = 0.22 * np.sin(x / 13.0) * np.cos(y / 16.0 + 0.4) + 0.12 * np.sin((x + 2.0 * y) / 19.0)
    return plateau + bank + swell


def _ground() -> Parts:
    xs = np.unique(np.append(np.linspace(-HALF[0], HALF[0], 42), [-30.0, 30.0, -54.0, 27.0]))
    ys = np.unique(np.append(np.linspace(-HALF[1], HALF[1], 33), [-14.0, -6.0, 28.0, -26.0]))
    xy = np.stack(np.meshgrid(xs, ys), axis=-1)
    x, y = np.moveaxis(0.25 * (xy[:-1, :-1] + xy[:-1, 1:] + xy[1:, 1:] + xy[1:, :-1]), -1, 0)
    road = (y > -14.0) & (y < -6.0)
    yard = (x > -30.0) & (x < 30.0) & (y > -26.0) & (y < 28.0)
    use = np.select([road, yard & (x > -12.0), yard, x < -54.0], ["asphalt", "paving", "gravel", "meadow"], "grass")
    return ground_cells(xy, ground_height, use)


def _level(centre: tuple[float, float], length: float, width: float, yaw: float) -> float:
    return lowest_ground(ground_height, centre, length, width, yaw)


def _buildings() -> Parts:
    parts: Parts = {}
    for name, centre, length, width, yaw, eaves, ridge, wall, cover in BUILDINGS:
        place = (*centre, _level(centre, length, width, yaw))
        parts |= building(name, (length, width, eaves, ridge), place, yaw, (wall, cover))
    outline = np.array(LABORATORY)
    base = float(ground_height(outline).min())
    parts["laboratory", "concrete_light"] = polygon_prism(outline, base, base + 6.5)
    parts["laboratory_roof", "roof_felt"] = polygon_prism(outline, base + 6.53, base + 6.53)
    return parts


def _skip() -> Parts:
    """A roll-off container without a lid: 6 x 2.4 x 2.2 m, walls of 4 mm, standing north to south."""
    wall, long, wide, tall = 0.004, 6.0, 2.4, 2.2
    inner = long - 2 * wall - 0.002  # a millimetre of air at the corners keeps the walls four pieces
    sides = [
        scaled(box(), wide, wall, tall) + np.array([0.0, 0.5 * (long - wall), 0.0]),
        scaled(box(), wide, wall, tall) - np.array([0.0, 0.5 * (long - wall), 0.0]),
        scaled(box(), wall, inner, tall) + np.array([0.5 * (wide - wall), 0.0, 0.0]),
        scaled(box(), wall, inner, tall) - np.array([0.5 * (wide - wall), 0.0, 0.0]),
    ]
    place = (*SKIP, _level(SKIP, wide, long, 0.0) + 0.05)
    floor = scaled(box(), wide - 0.1, long - 0.1, wall) + np.array([0.0, 0.0, 0.03])
    return {
        ("skip", "skip_steel"): moved(joined(sides), place, 0.0),
        ("skip_floor", "skip_floor"): moved(floor, place, 0.0),
    }


def _yard_things() -> Parts:
    parts: Parts = {}
    for i, (x, y, yaw, colour) in enumerate(CONTAINERS):
        place = (x, y, _level((x, y), 6.06, 2.44, yaw))
        parts[f"container_{i + 1}", colour] = moved(scaled(box(), 6.06, 2.44, 2.59), place, yaw)
    tank = (-36.0, -20.0, float(ground_height(np.array([-36.0, -20.0]))))
    parts["tank", "tank_steel"] = moved(cylinder(1.6, 4.2, 16), tank, 0.0)
    stacks = [(30.5, 18.0), (30.5, 21.0), (34.5, 19.5)]
    timber = [moved(scaled(box(), 3.2, 1.1, 1.3), (x, y, _level((x, y), 3.2, 1.1, 0.0)), 0.0) for x, y in stacks]
    parts["timber_stacks", "timber"] = joined(timber)
    blocks = [(x, 17.5) for x in (-8.0, -5.0, -2.0, 1.0)]
    barrier = [moved(scaled(box(), 2.2, 0.5, 0.9), (x, y, _level((x, y), 2.2, 0.5, 0.0)), 0.0) for x, y in blocks]
    parts["barriers", "concrete_grey"] = joined(barrier)
    return parts


def _fences() -> Parts:
    def along(*corners: tuple[float, float]) -> NDArray[np.float64]:
        runs = [np.linspace(a, b, max(2, int(np.hypot(b[0] - a[0], b[1] - a[1]) / 6.0))) for a, b in pairwise(corners)]
        line = np.concatenate([run[:-1] for run in runs] + [runs[-1][-1:]])
        return np.column_stack([line, ground_height(line)])

    return {
        ("south_wall", "brick_ochre"): ribbon(along((-44.0, -61.0), (34.0, -61.0)), 2.1, 0.25),
        ("north_wall", "concrete_grey"): ribbon(along((-30.0, 60.0), (28.0, 60.0)), 2.0, 0.2),
        ("east_fence", "fence_steel"): ribbon(along((79.5, -60.0), (79.5, 61.0)), 1.8, 0.0),
        ("south_fence", "fence_steel"): ribbon(along((36.0, -61.0), (79.0, -61.0)), 1.8, 0.0),
        ("garden_fence", "fence_wood"): ribbon(along((53.0, 36.0), (57.0, 53.0), (72.0, 58.0)), 1.2, 0.04),
    }


def _plants() -> Parts:
    trunks: list[Triangles] = []
    dark: list[Triangles] = []
    light: list[Triangles] = []
    for i, (x, y, height) in enumerate(TREES):
        foot = (float(x), float(y), float(ground_height(np.array([x, y], np.float64))) - 0.1)
        trunk, leaves = tree(height, 37.0 * i, foot)
        trunks.append(trunk)
        (dark if i % 2 else light).append(leaves)
    hedges = [moved(scaled(box(), n, 1.1, h), (x, y, _level((x, y), n, 1.1, a)), a) for x, y, n, a, h in HEDGES]
    return {
        ("tree_trunks", "bark"): joined(trunks),
        ("tree_crowns_dark", "foliage_dark"): joined(dark),
        ("tree_crowns_light", "foliage_light"): joined(light),
        ("hedges", "hedge"): joined(hedges),
    }


def parts() -> Parts:
    """Triangles [t, 3, 3] (ENU, m) of the yard by (geometry, material)."""
    return merged([_ground(), _buildings(), _skip(), _yard_things(), _fences(), _plants()])


def write(path: Path) -> None:
    """Write the yard as COLLADA."""
    write_collada(path, parts(), COLOURS)


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else MESH)
