"""Sites made by others."""

import numpy as np
import pytest
from yards import spec

from swarmsim.site.ground import named_ground
from swarmsim.site.importer import build
from swarmsim.site.meshes import read_mesh


def test_agriculture(shared_data):
    raw = build(shared_data / "agriculture" / "agriculture_world.dae", spec())
    assert raw.report["size_m"] == [120.0, 160.0]
    assert raw.report["area_m2"] == pytest.approx(19_200.0)
    assert raw.report["height_m"] == pytest.approx([-4.80, 13.34], abs=0.05)
    ground = [part for part in raw.report["parts"] if part["is"] == "ground"]
    assert [part["names"][0] for part in ground] == ["HEIGHT"]
    assert raw.terrain.max() < 1.8
    barn = raw.grid.cell_of(np.array([-1.5, 20.5]))
    assert raw.surface.ravel()[barn] > 12.0
    assert raw.report["filled_cells"] == raw.report["outside_cells"] == 0
    fine = raw.grid.refined(len(raw.clearance) // raw.grid.ny)
    panels = np.linalg.norm(fine.centres - [69.5, -25.8], axis=-1) < 0.5
    assert raw.clearance[panels].min() < 0.0
    assert 0.85 < raw.report["traversable_share"] < 0.99
    parts = read_mesh(shared_data / "agriculture" / "agriculture_world.dae", spec()).parts
    named = named_ground(raw.grid, next(part for part in parts if "Ground" in part.names).corners)
    # Without names, the foot of a sunk fence post is taken for ground in a few cells.
    gap = np.abs(named - raw.terrain)
    assert (gap > 0.01).mean() < 2e-4
    assert gap.max() < 0.5


def test_davosdorf(shared_data):
    raw = build(shared_data / "davosdorf" / "davosdorf.tif", spec(cell_m=10.0, orthophoto="davosdorf_color.tif"))
    assert raw.terrain.shape == (495, 559)
    assert raw.report["relief_m"] == pytest.approx(2843.078 - 1535.920, abs=0.01)
    assert raw.grid.origin == pytest.approx((-2790.0, -2470.0))
    assert raw.report["georeference"]["crs"] == "EPSG:21781"
    assert raw.boxes == []
    assert len(raw.mesh.triangles) <= 30_000
    assert len(np.unique(raw.mesh.colours, axis=0)) > 1000
