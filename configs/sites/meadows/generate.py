"""Generates the mesh of the site ``meadows``: fictitious farmland of 20 ha.

``python configs/sites/meadows/generate.py [OUT.dae]`` writes the mesh, by default in place; its output is
deterministic.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the modules that the generators of sites share

from collada_writer import Colour, write_collada
from mesh_shapes import (
    Floats,
    Parts,
    Triangles,
    building,
    cylinder,
    ground_cells,
    joined,
    lowest_ground,
    merged,
    moved,
    ribbon,
    tree,
)

MESH = Path(__file__).with_name("meadows.dae")
HALF = (250.0, 200.0)  # m; half the size of the site, a rectangle around the origin
SPACING = 12.5  # m, of the ground's grid
TRACK_V, TRACK_WIDTH = -30.0, 4.0  # m; the track runs west to east, `_bent` around y = TRACK_V
DRIVEWAY_X, DRIVEWAY_END_V = 60.0, 42.0  # m; from the track north to the barns

COLOURS: dict[str, Colour] = {
    "meadow": (0.56, 0.59, 0.41), "pasture": (0.47, 0.55, 0.36), "stubble": (0.70, 0.64, 0.45),
    "gravel": (0.68, 0.65, 0.58), "brick_ochre": (0.74, 0.61, 0.45), "boards": (0.48, 0.36, 0.27),
    "roof_tiles": (0.52, 0.31, 0.25), "roof_slate": (0.36, 0.39, 0.43), "door": (0.35, 0.27, 0.22),
    "bark": (0.38, 0.30, 0.23), "foliage_dark": (0.28, 0.39, 0.24), "foliage_light": (0.40, 0.49, 0.27),
    "hedge": (0.31, 0.42, 0.26), "hay": (0.80, 0.71, 0.43),
}  # fmt: skip

# name, centre, (length, width, height of the eaves, of the ridge above them), yaw deg, (walls, roof)
BARNS = (
    ("barn", (44.0, 58.0), (26.0, 13.0, 5.0, 4.0), 0.0, ("brick_ochre", "roof_tiles")),
    ("hay_barn", (80.0, 62.0), (18.0, 10.0, 4.2, 2.8), -90.0, ("boards", "roof_slate")),
)
# ends of each row of trees, and how many stand in it
TREE_ROWS = (
    ((-110.0, 128.0), (232.0, 116.0), 16),
    ((-136.0, -184.0), (-128.0, -56.0), 7),
    ((26.0, 82.0), (96.0, 84.0), 4),
)
# ends of each hedge
HEDGES = (((-112.0, -112.0), (140.0, -104.0)), ((152.0, -190.0), (158.0, -52.0)), ((-60.0, 2.0), (-66.0, 118.0)))
HEDGE_PIECE, HEDGE_GAP = 40.0, 8.0  # m; the gaps let a rover pass
BALES = ((186.0, 20.0), (204.0, 44.0), (172.0, 62.0), (222.0, 78.0), (190.0, 96.0), (128.0, 34.0))


def ground_height(xy: Floats) -> Floats:
    """Height [...] of the ground at ``xy`` [..., 2], in m: gentle swells of a few metres."""
    x, y = xy[..., 0], xy[..., 1]
    return (
        1.5 * np.sin(x / 72.0 + 0.6) * np.cos(y / 88.0)
        + 1.1 * np.sin((x - 1.4 * y) / 115.0)
        + 0.5 * np.cos((x + 2.0 * y) / 64.0)
    )


def _at(x: float, y: float) -> tuple[float, float, float]:
    """The point on the ground at x, y."""
    return x, y, float(ground_height(np.array([x, y])))


def _bent(v: Floats, x: Floats) -> Floats:
    """Northing y at grid coordinate ``v``: bends the track, and keeps the borders v = +/-200 straight."""
    return v + 14.0 * np.sin(x / 75.0) * (1.0 - (v / HALF[1]) ** 2)


def _ground() -> Parts:
    xs = np.linspace(-HALF[0], HALF[0], round(2 * HALF[0] / SPACING) + 1)
    vs = np.linspace(-HALF[1], HALF[1], round(2 * HALF[1] / SPACING) + 1)
    edges = np.array([-0.5, 0.5]) * TRACK_WIDTH
    xs = np.unique(np.append(xs, DRIVEWAY_X + edges))
    vs = np.unique(np.append(vs, [*(TRACK_V + edges), DRIVEWAY_END_V]))
    x, v = np.meshgrid(xs, vs)
    middle_x, middle_v = np.meshgrid(0.5 * (xs[1:] + xs[:-1]), 0.5 * (vs[1:] + vs[:-1]))
    track = np.abs(middle_v - TRACK_V) < 0.5 * TRACK_WIDTH
    on_driveway = np.abs(middle_x - DRIVEWAY_X) < 0.5 * TRACK_WIDTH
    driveway = on_driveway & (middle_v > TRACK_V) & (middle_v < DRIVEWAY_END_V)
    stubble = (middle_x > 106.0) & (middle_v > TRACK_V) & (middle_v < 112.0)
    pasture = (middle_v < -106.0) & (middle_x < 150.0)
    use = np.select([track | driveway, stubble, pasture], ["gravel", "stubble", "pasture"], "meadow")
    return ground_cells(np.stack([x, _bent(v, x)], axis=-1), ground_height, use)


def _barns() -> Parts:
    groups = []
    for name, centre, size, yaw, materials in BARNS:
        place = (*centre, lowest_ground(ground_height, centre, size[0], size[1], yaw))
        groups.append(building(name, size, place, yaw, materials, windows=False))
    return merged(groups)


def _trees() -> Parts:
    trunks: list[Triangles] = []
    crowns: tuple[list[Triangles], list[Triangles]] = ([], [])
    for row, (start, end, count) in enumerate(TREE_ROWS):
        for k, (x, y) in enumerate(np.linspace(start, end, count).tolist()):
            height = 7.0 + 4.5 * ((0.618034 * (k + 5 * row)) % 1.0)  # golden ratio: varied, without random numbers
            foot = _at(x, y)
            trunk, crown = tree(height, 37.0 * k, (*foot[:2], foot[2] - 0.1))
            trunks.append(trunk)
            crowns[k % 2].append(crown)
    return {
        ("tree_trunks", "bark"): joined(trunks),
        ("tree_crowns_dark", "foliage_dark"): joined(crowns[0]),
        ("tree_crowns_light", "foliage_light"): joined(crowns[1]),
    }


def _hedges() -> Parts:
    pieces: list[Triangles] = []
    for start, end in HEDGES:
        length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        count = int(length // HEDGE_PIECE)
        for k in range(count):
            shares = (np.array([k, k + 1]) * length + np.array([0.5, -0.5]) * HEDGE_GAP * count) / (count * length)
            xy = np.array(start) + np.linspace(shares[0], shares[1], 4)[:, None] * (np.array(end) - np.array(start))
            pieces.append(ribbon(np.column_stack([xy, ground_height(xy)]), 1.7, 1.4))
    return {("hedges", "hedge"): joined(pieces)}


def _bales() -> Parts:
    return {("bales", "hay"): joined([moved(cylinder(0.8, 1.3, 10), _at(x, y), 0.0) for x, y in BALES])}


def parts() -> Parts:
    """Triangles [t, 3, 3] (ENU, m) of the site by (geometry, material)."""
    return merged([_ground(), _barns(), _trees(), _hedges(), _bales()])


def write(path: Path) -> None:
    """Write the site as COLLADA."""
    write_collada(path, parts(), COLOURS)


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else MESH)
