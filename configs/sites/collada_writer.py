"""COLLADA 1.4.1 writer for triangles with named, coloured materials, in metres, z up. Its output is deterministic."""

from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]


def write_collada(
    path: Path, parts: Mapping[tuple[str, str], NDArray[np.float64]], colours: Mapping[str, Colour]
) -> None:
    """Write ``parts``, triangles [t, 3, 3] in m by (geometry, material), with the materials' ``colours`` (0 to 1)."""
    used = sorted({material for _, material in parts})
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">',
        "<asset><created>2000-01-01T00:00:00</created><modified>2000-01-01T00:00:00</modified>",
        '<unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>',
        "<library_effects>",
        *(_effect(name, colours[name]) for name in used),
        "</library_effects>",
        "<library_materials>",
        *(f'<material id="{m}" name={quoteattr(m)}><instance_effect url="#{m}-effect"/></material>' for m in used),
        "</library_materials>",
        "<library_geometries>",
        *(_geometry(f"g{i}", *key, triangles) for i, (key, triangles) in enumerate(parts.items())),
        "</library_geometries>",
        '<library_visual_scenes><visual_scene id="scene">',
        *(_node(f"g{i}", *key) for i, key in enumerate(parts)),
        "</visual_scene></library_visual_scenes>",
        '<scene><instance_visual_scene url="#scene"/></scene>',
        "</COLLADA>",
    ]
    path.write_bytes("\n".join(lines).encode() + b"\n")


def _effect(name: str, colour: Colour) -> str:
    shade = " ".join(f"{c:g}" for c in (*colour, 1.0))
    return (
        f'<effect id="{name}-effect"><profile_COMMON><technique sid="common"><lambert><diffuse><color>{shade}</color>'
        "</diffuse></lambert></technique></profile_COMMON></effect>"
    )


def _geometry(key: str, name: str, material: str, triangles: NDArray[np.float64]) -> str:
    points, index = np.unique(np.round(triangles.reshape(-1, 3), 3) + 0.0, axis=0, return_inverse=True)
    numbers = " ".join(f"{value:.3f}".rstrip("0").rstrip(".") for value in points.ravel())
    corners = " ".join(map(str, index.ravel()))
    return (
        f'<geometry id="{key}" name={quoteattr(name)}><mesh><source id="{key}p"><float_array id="{key}a" '
        f'count="{points.size}">{numbers}</float_array><technique_common><accessor source="#{key}a" '
        f'count="{len(points)}" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>'
        f'<param name="Z" type="float"/></accessor></technique_common></source><vertices id="{key}v">'
        f'<input semantic="POSITION" source="#{key}p"/></vertices><triangles material={quoteattr(material)} '
        f'count="{len(triangles)}"><input semantic="VERTEX" source="#{key}v" offset="0"/><p>{corners}</p></triangles>'
        "</mesh></geometry>"
    )


def _node(key: str, name: str, material: str) -> str:
    return (
        f'<node id="{key}n" name={quoteattr(name)}><instance_geometry url="#{key}"><bind_material><technique_common>'
        f'<instance_material symbol={quoteattr(material)} target="#{material}"/></technique_common></bind_material>'
        "</instance_geometry></node>"
    )
