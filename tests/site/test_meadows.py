"""Facts of the shipped site ``meadows`` that missions rely on."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from yards import MATERIALS

from swarmsim.config.files import find
from swarmsim.site import load_site, sample
from tests.generator_scripts import script

meadows = script("sites/meadows/generate.py")
FOLDER = Path(find("sites", "meadows")).parent


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        return load_site("meadows", MATERIALS)


def raster(model, name):
    return np.asarray(getattr(model.site, name), np.float64)


def test_mesh_is_what_the_script_generates(tmp_path):
    meadows.write(tmp_path / "again.dae")
    generated = (tmp_path / "again.dae").read_bytes()
    assert generated == (FOLDER / "meadows.dae").read_bytes()
    assert len(generated) < 150_000


def test_solids_of_the_mesh_face_outwards():
    for (name, _), corners in meadows.parts().items():
        if name == "ground":
            assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()
        elif not name.endswith("_gables"):
            about = corners - corners.reshape(-1, 3).mean(axis=0)
            assert np.linalg.det(about).sum() / 6 > 0, name


def test_size_relief_and_survey_area(model):
    assert model.site.terrain_m.shape == (200, 250)
    np.testing.assert_allclose(model.site.origin_m, [-249.0, -199.0], atol=1e-3)
    assert model.report["area_m2"] == pytest.approx(200_000.0)
    assert 3.0 < model.report["relief_m"] < 8.0
    assert model.report["slope_max_deg"] < 5.0
    assert model.report["warnings"] == []
    x, y = np.asarray(model.site.survey_area_m, np.float64).T
    assert 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) == pytest.approx(486.0 * 386.0)


def test_ground_is_the_formula(model):
    """The triangles of the ground follow its formula within 5 cm."""
    columns, rows = np.meshgrid(np.arange(250), np.arange(200))
    xy = np.stack([-249.0 + 2.0 * columns, -199.0 + 2.0 * rows], axis=-1)
    np.testing.assert_allclose(raster(model, "terrain_m"), meadows.ground_height(xy), atol=0.05)


def test_obstacles(model):
    o = model.site.obstacles
    names = np.array(MATERIALS)[np.asarray(o.material)]
    assert set(names) == {"brick", "wood", "vegetation"}
    assert len(names) < 120
    size = 2 * np.asarray(o.half_extent_m)
    walls = (np.asarray(o.wall_m) > 0.0) & (size[:, :2].min(axis=1) > 8.0) & (size[:, 2] > 4.0)
    np.testing.assert_allclose(np.sort(size[walls, 0]), [18.0, 26.0], atol=0.1)
    assert (raster(model, "surface_m") - raster(model, "terrain_m")).max() < 12.0


def test_open_field_has_room_for_a_fleet(model):
    """The field that the description names: no obstacle within 5 m."""
    x, y = np.meshgrid(np.arange(-240.0, -144.0), np.arange(0.0, 111.0))
    xy = jnp.asarray(np.stack([x, y], -1), jnp.float32)
    assert float(jnp.min(sample(model.site.clearance_m, model.site, xy))) > 5.0


def test_rover_reaches_every_field(model):
    """Fields are divided by hedges with gaps; 99 % of the free ground is one piece."""
    cost = raster(model, "cost")
    factor = len(raster(model, "clearance_m")) // len(cost)
    clear = raster(model, "clearance_m")[factor // 2 :: factor, factor // 2 :: factor]
    free = (clear > 1.0) & np.isfinite(cost)
    label, _ = ndimage.label(free)
    pieces = np.bincount(label.ravel())[1:]
    assert pieces.max() > 0.99 * free.sum()
    assert pieces.max() > 0.95 * free.size
