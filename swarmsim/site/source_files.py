"""Source files of sites: the formats that can be read, and the checks before a file is opened."""

import os
import re
from pathlib import Path, PurePath

from swarmsim.config.errors import InputError
from swarmsim.config.names import did_you_mean, one_of
from swarmsim.config.site import SiteSpec

MESH_SUFFIXES = (".dae", ".glb", ".obj", ".stl")
TIFF_SUFFIXES = (".tif", ".tiff")
SUFFIXES = (*MESH_SUFFIXES, *TIFF_SUFFIXES)
MAX_FILE_MB: float = SiteSpec.model_fields["max_file_mb"].default


def check_file(path: Path, max_file_mb: float) -> None:
    """Raise `InputError` for a file that is missing, empty, too large or of an unknown format."""
    if path.exists() and not path.is_file():
        raise InputError.of("is not a regular file", file=path, suggestion="give a mesh or an elevation model")
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*") if p.suffix.lower() in SUFFIXES)
        raise InputError.of("there is no such file", file=path, suggestion=did_you_mean(path.name, beside))
    if path.suffix.lower() not in SUFFIXES:
        raise InputError.of(
            f"'{path.suffix}' files cannot be read as a site", file=path, allowed=one_of(SUFFIXES),
            suggestion="export the site as .glb or .dae",
        )  # fmt: skip
    size = path.stat().st_size
    if size == 0:
        raise InputError.of("the file is empty", file=path, suggestion="export or download it again")
    if size > max_file_mb * 1e6:
        raise InputError.of(
            f"the file has {size / 1e6:.0f} MB", file=path, allowed=f"at most {max_file_mb:g} MB (max_file_mb)",
            suggestion="decimate the mesh (100,000 triangles are plenty for a site), or raise max_file_mb "
            f"(--set max_file_mb={size / 1e6 + 1:.0f})",
        )  # fmt: skip


def material_files(source: Path) -> list[Path]:
    """The files beside an OBJ file that describe its materials and exist."""
    if source.suffix.lower() != ".obj":
        return []
    text = source.read_text(encoding="utf-8", errors="replace")
    named = [PurePath(name.strip().replace("\\", "/")).name for name in re.findall(r"^mtllib[ \t]+(.+)$", text, re.M)]
    # os.path: a name may be longer than any file's, at which Path.is_file raises.
    return [source.parent / name for name in dict.fromkeys(named) if os.path.isfile(source.parent / name)]
