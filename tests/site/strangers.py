"""Scenes as strangers bring them: thin walls, fences, gaps, slabs, holes, units, axes; each written as a file."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from yards import TO_X_UP, TO_Y_UP, block, write_collada

AXES = {"X": TO_X_UP, "Y": TO_Y_UP, "Z": np.eye(4)}


def sheet(start, end, low, high) -> trimesh.Trimesh:
    """An upright rectangle without thickness above the line from ``start`` to ``end`` [2]."""
    corners = np.array([[*start, low], [*end, low], [*end, high], [*start, high]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def rolling(size, pieces=24, relief=0.6, tilt=0.0) -> trimesh.Trimesh:
    """Gentle ground around the origin."""
    x, y = (np.linspace(-0.5 * s, 0.5 * s, pieces + 1) for s in size)
    points = np.stack(np.meshgrid(x, y), -1)
    height = tilt * points[..., 0] + relief * np.sin(points[..., 0] / 9.0) * np.cos(points[..., 1] / 7.0)
    index = np.arange(height.size).reshape(height.shape)
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return trimesh.Trimesh(np.column_stack([points.reshape(-1, 2), height.ravel()]), faces, process=False)


def height_of(ground: trimesh.Trimesh, xy) -> float:
    """Height of the ground's nearest vertex."""
    return float(ground.vertices[np.argmin(np.linalg.norm(ground.vertices[:, :2] - xy, axis=1)), 2])


@dataclass
class Stranger:
    """A scene in metres, z up, and how it is written."""

    meshes: dict[str, trimesh.Trimesh]
    unit_m: float = 1.0
    up: str = "Z"
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    suffix: str = "obj"
    names: dict[str, str] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """The file, named ``stranger`` and by its format."""
        path = folder / f"stranger.{self.suffix}"
        turn = AXES["Y" if self.suffix == "glb" else self.up]
        scaled = (
            np.diag([1.0 / self.unit_m] * 3 + [1.0]) @ turn @ trimesh.transformations.translation_matrix(self.shift_m)
        )
        written = {name: mesh.copy().apply_transform(scaled) for name, mesh in self.meshes.items()}
        if self.suffix == "dae":
            write_collada(
                path,
                {(name, name): mesh.triangles for name, mesh in written.items()},
                dict.fromkeys(written, (0.5, 0.5, 0.5)),
            )
            text = path.read_text().replace('name="meter" meter="1"', f'name="own" meter="{self.unit_m}"')
            path.write_text(text.replace("Z_UP", f"{self.up}_UP"))
        elif self.suffix == "obj":
            _write_obj(path, written)
        else:
            scene = trimesh.Scene()
            for name, mesh in written.items():
                scene.add_geometry(mesh, geom_name=name)
            scene.export(path)
        return path

    def fields(self) -> dict[str, Any]:
        """What a user must say of the file, since its format does not."""
        if self.suffix in ("glb", "dae"):
            return {}
        said: dict[str, Any] = {} if self.unit_m == 1.0 else {"unit_m": self.unit_m}
        return said | ({} if self.up == "Z" else {"up_axis": self.up})


def _write_obj(path: Path, meshes: dict[str, trimesh.Trimesh]) -> None:
    """Text with as many digits as the numbers have."""
    lines, first = [], 1
    for name, mesh in meshes.items():
        lines += [f"o {name}", f"usemtl {name}"]
        lines += ["v " + " ".join(repr(float(value)) for value in vertex) for vertex in mesh.vertices]
        lines += ["f " + " ".join(str(first + int(k)) for k in face) for face in mesh.faces]
        first += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n")


def draw(rng: np.random.Generator, size=(36.0, 28.0), tilt: float | None = None) -> dict[str, trimesh.Trimesh]:
    """Ground with a fence and a wall across it, each with a gap, a pen, a house, posts and a table."""
    ground = rolling(
        size, relief=float(rng.uniform(0.0, 0.8)), tilt=float(rng.uniform(-0.1, 0.1)) if tilt is None else tilt
    )
    meshes = {"terrain": ground}

    def along(name, start, end, thickness, high):
        """Panels of at most 2 m that follow the ground."""
        start, end = np.array(start), np.array(end)
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / 2.0)))
        for k in range(count):
            a, b = start + (end - start) * k / count, start + (end - start) * (k + 1) / count
            low = min(height_of(ground, a), height_of(ground, b)) - 0.3
            if thickness == 0.0:
                meshes[f"{name}{k}"] = sheet(a, b, low, low + 0.3 + high)
            else:
                yaw = float(np.arctan2(*(b - a)[::-1]))
                centre = (*(0.5 * (a + b)), low + 0.5 * (0.3 + high))
                meshes[f"{name}{k}"] = block((float(np.linalg.norm(b - a)), thickness, 0.3 + high), centre, yaw)

    half = 0.5 * np.array(size)
    lean = float(rng.uniform(-6.0, 6.0))
    x = float(rng.uniform(-0.4, 0.0) * half[0])
    gap, at = float(rng.uniform(0.2, 2.5)), float(rng.uniform(-0.5, 0.5) * half[1])
    share = (at + half[1]) / (2 * half[1])
    middle = np.array([x + lean * (2 * share - 1), at])
    way = np.array([2 * lean, 2 * half[1]]) / np.hypot(2 * lean, 2 * half[1])
    thin = float(rng.choice([0.0, 0.0, 0.02, 0.1, 0.2]))
    along("fence_wood_", (x - lean, -half[1]), middle - 0.5 * gap * way, thin, float(rng.uniform(0.4, 2.0)))
    along("fence_wood_b", middle + 0.5 * gap * way, (x + lean, half[1]), thin, float(rng.uniform(0.4, 2.0)))
    corner = np.array([rng.uniform(0.2, 0.6) * half[0], rng.uniform(-0.6, 0.0) * half[1]])
    long, turn = float(rng.uniform(4.0, 9.0)), float(rng.uniform(0.0, np.pi))
    side = long * np.array([np.cos(turn), np.sin(turn)])
    along("brick_wall", corner - 0.5 * side, corner + 0.5 * side, float(rng.choice([0.0, 0.05, 0.24])), 2.2)
    spot = np.array([rng.uniform(0.1, 0.6) * half[0], 0.6 * half[1]])
    meshes["house"] = block((5.0, 4.0, 4.0), (*spot, height_of(ground, spot) + 1.5), float(rng.uniform(0, 3)))
    for k in range(5):
        spot = rng.uniform(-0.9, 0.9, 2) * half
        thick = float(rng.uniform(0.04, 0.3))
        meshes[f"post{k}"] = block((thick, thick, 2.5), (*spot, height_of(ground, spot) + 1.0))
    return meshes


def with_slab(meshes: dict[str, trimesh.Trimesh], margin: float, below: float) -> dict[str, trimesh.Trimesh]:
    """A slab like Blender's flattened cube under the scene."""
    bounds = np.array([mesh.bounds for mesh in meshes.values()])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    size = (high - low)[:2] + 2 * margin
    centre = (*(0.5 * (low + high))[:2], low[2] - below - 0.25)
    return meshes | {"Cube": block((*size, 0.5), centre)}


def with_holes(
    meshes: dict[str, trimesh.Trimesh], share: float, rng: np.random.Generator
) -> dict[str, trimesh.Trimesh]:
    """The ground without about ``share`` of its faces."""
    ground = meshes["terrain"].copy()
    ground.update_faces(rng.uniform(size=len(ground.faces)) > share)
    return meshes | {"terrain": ground}


def scan(rng: np.random.Generator, size=(50.0, 40.0), step=0.25, noise=0.03, holes=0.08) -> trimesh.Trimesh:
    """One noisy sheet over ground, house, wall and trees, with holes, as photogrammetry gives it."""
    x, y = np.meshgrid(np.arange(-size[0] / 2, size[0] / 2, step), np.arange(-size[1] / 2, size[1] / 2, step))
    z = 0.5 * np.sin(x / 8.0) + np.where((np.abs(x - 6) < 4) & (np.abs(y - 5) < 3), 5.0, 0.0)
    z = np.maximum(z, np.where((np.abs(x + 8) < 0.3) & (np.abs(y) < 12), 2.0, -9.0))
    for at in rng.uniform(-0.4, 0.4, (4, 2)) * size:
        z = np.maximum(z, 4.0 - 1.5 * np.hypot(x - at[0], y - at[1]))
    z = z + noise * rng.standard_normal(z.shape)
    index = np.arange(z.size).reshape(z.shape)
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    mesh = trimesh.Trimesh(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), faces, process=False)
    middle = mesh.triangles_center[:, :2]
    keep = np.ones(len(faces), bool)
    count = int(holes * size[0] * size[1] / 3.0)
    for at in rng.uniform(-0.5, 0.5, (count, 2)) * size:
        keep &= np.linalg.norm(middle - at, axis=1) > 1.0
    mesh.update_faces(keep)
    return mesh
