"""Scenes of trimesh as parts."""

from typing import Any

import numpy as np

from swarmsim.site.mesh_parts import NO_COLOUR, Bytes, Part, RawMesh

PIXELS_MAX = 1 << 28
"""Pixels of all textures: four of 8192 x 8192."""
TEXTURE_MAX = 1024  # pixels of a side that are kept


def parts_of(scene: Any) -> RawMesh:
    """The triangles of a scene of trimesh; its file says no unit and no axis."""
    import trimesh

    _shrink_images(scene)
    parts, lines = [], 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh):
            lines += 1
            continue
        material = getattr(getattr(mesh.visual, "material", None), "name", None)
        names = tuple(dict.fromkeys(str(n) for n in (material, name, node) if n))
        vertices = trimesh.transform_points(np.asarray(mesh.vertices, np.float64), transform)
        parts.append(Part(names, vertices, np.asarray(mesh.faces, np.int64), _colours(mesh)))
    return RawMesh(parts, None, None, lines)


def _shrink_images(scene: Any) -> None:
    """Make the textures small enough to be looked up for every part; leave out those too large to be opened.

    A triangle gets one colour, and trimesh copies the whole texture for every part.
    """
    left = PIXELS_MAX
    seen: dict[int, bool] = {}
    for mesh in scene.geometry.values():
        material = getattr(mesh.visual, "material", None)
        for field in ("image", "baseColorTexture"):
            image = getattr(material, field, None)
            if image is None:
                continue
            if id(image) not in seen:
                pixels = image.size[0] * image.size[1]
                seen[id(image)] = pixels <= left
                if pixels <= left:
                    left -= pixels
                    try:
                        image.thumbnail((TEXTURE_MAX, TEXTURE_MAX))
                    except Exception:  # what Pillow raises for a damaged picture depends on its format
                        seen[id(image)] = False
            if not seen[id(image)]:
                setattr(material, field, None)


def _colours(mesh: Any) -> Bytes:
    visual = mesh.visual
    if visual.kind is None:
        return np.tile(np.array(NO_COLOUR, np.uint8), (len(mesh.faces), 1))
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        if visual.uv is None or image is None or len(visual.uv) != len(mesh.vertices):
            return np.tile(np.asarray(material.main_color, np.uint8), (len(mesh.faces), 1))
        visual = visual.to_color()
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors)[mesh.faces].mean(axis=1).astype(np.uint8)
    return np.asarray(visual.face_colors, np.uint8)
