"""Houses with thin walls drawn as strangers draw them: as one mesh, as boxes that overlap or meet, with either side."""

from dataclasses import dataclass

import numpy as np
import trimesh

WAYS = ("one mesh", "overlapping boxes", "meeting boxes", "either side", "no underside", "mixed winding")


@dataclass
class House:
    """Walls as boxes along their own axes and openings through them, turned and moved; all in m."""

    solids: list[tuple[np.ndarray, np.ndarray]]  # lower and upper corner [3] of walls, roof
    holes: list[tuple[np.ndarray, np.ndarray]]  # the same of doors and windows
    size: tuple[float, float]
    wall: float
    door: tuple[float, float, float]  # middle along the south wall, width, height
    yaw: float
    at: tuple[float, float]
    way: str
    room: tuple[float, float]  # a place inside
    roofed: bool
    said: str = ""

    def cells(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Lines along each axis, and which cells [nx, ny, nz] between them are matter."""
        both = np.array([corner for box in (*self.solids, *self.holes) for corner in box])
        lines = [np.unique(np.round(both[:, k], 6)) for k in range(3)]
        full = np.zeros([len(own) - 1 for own in lines], bool)
        for boxes, value in ((self.solids, True), (self.holes, False)):
            for low, high in boxes:
                window = tuple(
                    slice(np.searchsorted(own, low[k] - 1e-6), np.searchsorted(own, high[k] - 1e-6))
                    for k, own in enumerate(lines)
                )
                full[window] = value
        return lines, full

    def drawn_m3(self) -> float:
        """Matter that is drawn."""
        lines, full = self.cells()
        dx, dy, dz = (np.diff(own) for own in lines)
        return float((full * dx[:, None, None] * dy[:, None] * dz).sum())

    def place(self, xy) -> np.ndarray:
        """``xy`` [..., 2] of the house's own axes in the scene."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.asarray(xy) @ np.array([[c, s], [-s, c]]) + self.at

    def outline(self) -> trimesh.Trimesh:
        """The surface of the matter: closed, without faces inside."""
        lines, full = self.cells()
        padded = np.pad(full, 1)
        corners, faces = [], []
        for axis in range(3):
            change = np.diff(padded.astype(int), axis=axis)
            inner = tuple(slice(None) if k == axis else slice(1, -1) for k in range(3))
            for cell in np.argwhere(change[inner]):
                sign = change[inner][tuple(cell)]
                one, other = (k for k in range(3) if k != axis)
                quad = []
                for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    point = np.empty(3)
                    point[axis] = lines[axis][cell[axis]]
                    point[one], point[other] = lines[one][cell[one] + u], lines[other][cell[other] + v]
                    quad.append(point)
                start = len(corners)
                corners += quad
                # The cross product of the other two axes points along +x and +z, but along -y.
                outwards = (sign < 0) == (axis != 1)
                order = (0, 1, 2, 3) if outwards else (3, 2, 1, 0)
                a, b, c, d = (start + k for k in order)
                faces += [[a, b, c], [a, c, d]]
        return trimesh.Trimesh(np.array(corners), faces, process=False)

    def boxes(self) -> trimesh.Trimesh:
        """Each wall as boxes around its openings, all in one mesh."""
        return trimesh.util.concatenate(
            [_block(*piece) for solid in self.solids for piece in _without(solid, self.holes)]
        )

    def mesh(self, rng: np.random.Generator) -> trimesh.Trimesh:
        """The house as it is drawn, in the scene."""
        mesh = self.boxes() if self.way in ("overlapping boxes", "meeting boxes") else self.outline()
        if self.way == "either side":
            mesh = trimesh.Trimesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:, ::-1]]), process=False)
        if self.way == "no underside":
            mesh.update_faces(~(mesh.triangles[..., 2] < 1e-6).all(axis=1))
        if self.way == "mixed winding":
            turned = rng.uniform(size=len(mesh.faces)) < 0.5
            mesh.faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
        turn = trimesh.transformations.rotation_matrix(self.yaw, [0, 0, 1])
        return mesh.apply_transform(turn).apply_translation((*self.at, 0.0))


def _block(low, high) -> trimesh.Trimesh:
    return trimesh.creation.box(np.subtract(high, low)).apply_translation(0.5 * np.add(low, high))


def _without(solid, holes) -> list[tuple[np.ndarray, np.ndarray]]:
    """A box less ``holes``, as boxes."""
    left = [solid]
    for hole_low, hole_high in holes:
        cut = []
        for low, high in left:
            if not (np.maximum(low, hole_low) < np.minimum(high, hole_high) - 1e-9).all():
                cut.append((low, high))
                continue
            low, high = low.copy(), high.copy()
            for k in range(3):
                if low[k] < hole_low[k] - 1e-9:
                    upper = high.copy()
                    upper[k] = hole_low[k]
                    cut.append((low.copy(), upper))
                    low[k] = hole_low[k]
                if high[k] > hole_high[k] + 1e-9:
                    lower = low.copy()
                    lower[k] = hole_high[k]
                    cut.append((lower, high.copy()))
                    high[k] = hole_high[k]
        left = cut
    return left


def draw_house(rng: np.random.Generator, way: str | None = None) -> House:
    """A house with a door in its south wall; with a roof, a lintel, windows, inner walls or a wing, or without."""
    way = way or WAYS[rng.integers(len(WAYS))]
    sx, sy = (float(np.round(rng.uniform(8.0, 16.0), 2)) for _ in range(2))
    wall, tall = float(np.round(rng.uniform(0.08, 0.6), 2)), float(np.round(rng.uniform(2.4, 4.0), 1))
    corner = wall if way == "meeting boxes" else 0.0
    solids, holes = [], []

    def add(to, x0, x1, y0, y1, z0, z1):
        to.append((np.array([x0, y0, z0], float), np.array([x1, y1, z1], float)))

    wing = rng.uniform() < 0.3
    cx, cy = 0.5 * sx, 0.5 * sy
    add(solids, 0, sx, 0, wall, 0, tall)
    add(solids, 0, wall, corner, sy - corner, 0, tall)
    if wing:  # L: the north-east quarter is missing
        add(solids, sx - wall, sx, corner, cy - corner, 0, tall)
        add(solids, 0, cx, sy - wall, sy, 0, tall)
        add(solids, cx - wall, cx, cy - wall, sy - corner, 0, tall)
        add(solids, cx if way == "meeting boxes" else cx - wall, sx, cy - wall, cy, 0, tall)
    else:
        add(solids, sx - wall, sx, corner, sy - corner, 0, tall)
        add(solids, 0, sx, sy - wall, sy, 0, tall)
    width = float(np.round(rng.uniform(1.0, 2.5), 2))
    lintel = rng.uniform() < 0.5
    high = 2.1 if lintel else tall
    middle = float(np.round(rng.uniform(wall + 0.5 * width + 0.3, cx - 0.5 * width - 0.6), 2))
    add(holes, middle - 0.5 * width, middle + 0.5 * width, 0.0, wall, 0.0, high)
    if rng.uniform() < 0.4:
        for x in (cx + 0.6, cx + 1.9):
            add(holes, x, x + 0.9, 0.0, wall, 0.9, 2.0)
        add(holes, 0.0, wall, 0.3 * sy, 0.3 * sy + 1.2, 0.9, 2.0)
    if rng.uniform() < 0.4 and not wing:
        begin = wall if way == "meeting boxes" else 0.5 * wall
        add(solids, cx, cx + 0.12, begin, 0.7 * sy, 0, tall)
    roofed = bool(rng.uniform() < 0.5)
    if roofed:
        low = tall if way == "meeting boxes" else tall - 0.05
        eaves = float(rng.choice([0.0, 0.3]))
        add(solids, -eaves, (cx if wing else sx) + eaves, -eaves, sy + eaves, low, tall + 0.2)
        if wing:
            first = cx + eaves if way == "meeting boxes" else cx - wall
            add(solids, first, sx + eaves, -eaves, cy + eaves, low, tall + 0.2)
    yaw = float(rng.choice([0.0, rng.uniform(-np.pi, np.pi)]))
    at = tuple(float(v) for v in rng.uniform(-6.0, 6.0, 2))
    said = f"{way}, {sx}x{sy}, wall {wall}, door {width}" + "".join(
        word
        for word, on in (
            (", roof", roofed),
            (", L", wing),
            (", lintel", lintel),
            (f", {len(holes) - 1} windows", len(holes) > 1),
        )
        if on
    )
    return House(
        solids,
        holes,
        (sx, sy),
        wall,
        (middle, width, high),
        yaw,
        at,
        way,
        (0.5 * (wall + cx), 0.5 * cy + 0.5),
        roofed,
        said,
    )
