"""How large a site may be."""

from pathlib import Path

from swarmsim.config.errors import InputError
from swarmsim.config.site import SiteSpec

CELLS_MAX = 4_000_000
EXTENT_MAX_M, RELIEF_MAX_M = 200_000.0, 20_000.0  # float32 resolves 8 mm at 100 km, half of it; no relief is larger


def check_extent(sides_m: tuple[float, float], relief_m: float, path: Path) -> None:
    """Raise `InputError` for a site beyond `EXTENT_MAX_M` or `RELIEF_MAX_M`."""
    if max(sides_m) > EXTENT_MAX_M or relief_m > RELIEF_MAX_M:
        raise InputError.of(
            f"the site would be {sides_m[0]:.4g} m by {sides_m[1]:.4g} m, and {relief_m:.4g} m high: a simulation in "
            "single precision does not place a vehicle to a centimetre there", file=path, path="unit_m",
            allowed=f"sides of at most {EXTENT_MAX_M:g} m, a height of at most {RELIEF_MAX_M:g} m",
            suggestion="set unit_m (--unit) if the unit is wrong, or cut out a smaller piece",
        )  # fmt: skip


def check_cells(nx: int, ny: int, spec: SiteSpec, path: Path) -> None:
    """Raise `InputError` for a grid of fewer than 3 x 3 or more than `CELLS_MAX` cells."""
    if min(nx, ny) < 3 or nx * ny > CELLS_MAX:
        raise InputError.of(
            f"cells of {spec.cell_m:g} m give a grid of {nx} x {ny}", file=path, path="cell_m",
            allowed=f"at least 3 x 3 and at most {CELLS_MAX:,} cells",
            suggestion=f"choose {'smaller' if min(nx, ny) < 3 else 'larger'} cells: cell_m (--cell)",
        )  # fmt: skip
