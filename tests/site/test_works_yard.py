"""Facts of the shipped site that missions rely on."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from yards import MATERIALS

from swarmsim import site as sites
from swarmsim.config.files import find
from swarmsim.policies.routes import at_centres
from swarmsim.site import load_site, sample
from swarmsim.site.importer import build
from tests.generator_scripts import script

works_yard = script("sites/works_yard/generate.py")
FOLDER = Path(find("sites", "works_yard")).parent
SOURCE = np.array([12.0, 4.0])
path_lengths = jax.jit(sites.path_lengths)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        return load_site("works_yard", MATERIALS)


def test_mesh_is_what_the_script_draws(tmp_path):
    works_yard.write(tmp_path / "again.dae")
    drawn = (tmp_path / "again.dae").read_bytes()
    assert drawn == (FOLDER / "works_yard.dae").read_bytes()
    assert len(drawn) < 300_000


def test_solids_of_the_mesh_face_outwards():
    for (name, material), corners in works_yard.parts().items():
        if material in ("grass", "meadow", "gravel", "asphalt", "paving"):
            assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()
        elif not name.endswith(("_windows", "_gables", "_fence")) and material != "roof_felt":
            about = corners - corners.reshape(-1, 3).mean(axis=0)
            assert np.linalg.det(about).sum() / 6 > 0, name


def test_area_relief_and_buildings(model):
    assert model.report["area_m2"] == pytest.approx(164 * 128)
    assert 4.0 < model.report["relief_m"] < 6.5
    assert 9.0 < model.report["slope_max_deg"] < 13.0
    assert model.report["warnings"] == []
    o = model.site.obstacles
    names = np.array(MATERIALS)[np.asarray(o.material)]
    size = 2 * np.asarray(o.half_extent_m)
    buildings = (np.asarray(o.wall_m) >= 0.2) & np.isin(names, ["brick", "concrete"]) & (size[:, 2] > 3.0)
    assert buildings.sum() >= 6
    assert set(names) == {"brick", "concrete", "steel", "wood", "vegetation"}
    assert len(names) < 200


def test_free_air_at_20_m(model):
    site = model.site
    assert float(jnp.max(site.surface_m - site.terrain_m)) < 20.0 - 5.0  # the obstacle clearance of the missions


def test_rover_reaches_the_container_from_its_start_and_drives_around_it(model):
    site = model.site
    free = np.asarray(at_centres(site.clearance_m, site.terrain_m.shape)) > 0.6
    label, _ = ndimage.label(free & np.isfinite(np.asarray(site.cost)))

    def at(xy):
        column, row = np.rint((np.array(xy) - np.asarray(site.origin_m)) / float(site.cell_m)).astype(int)
        return label[row, column]

    start = at((-62.0, -10.0))
    assert start > 0
    angles = np.radians(np.arange(0, 360, 15))
    ring = [at(SOURCE + 5.0 * np.array([np.cos(a), np.sin(a)])) for a in angles]
    assert all(component == start for component in ring)
    for x, y in [(-60, -45), (-60, -5), (-60, 35), (60, 28), (30, -20), (-70, 55)]:
        assert at((x, y)) == start
    assert at(SOURCE) == 0
    for pad in [(-60, -45), (-60, -5), (-60, 35)]:
        assert float(sample(site.clearance_m, site, jnp.array(pad, jnp.float32))) > 5.0


def test_container_shields_sideways_and_is_open_above(model):
    site = model.site
    ground = float(sample(site.terrain_m, site, jnp.asarray(SOURCE, jnp.float32)))
    source = jnp.array([*SOURCE, ground + 1.0], jnp.float32)
    steel = MATERIALS.index("steel")
    up = path_lengths(site, source, source + jnp.array([2.0, -1.0, 19.0]))
    np.testing.assert_allclose(np.delete(up, MATERIALS.index("air")), 0.0, atol=1e-5)
    side = path_lengths(site, source, source + jnp.array([4.0, 0.0, -0.4]))
    assert float(side[steel]) == pytest.approx(0.004, rel=0.02)
    west = path_lengths(site, source, source + jnp.array([-30.0, 0.0, 0.5]))
    assert float(west[MATERIALS.index("brick")]) == pytest.approx(2 * 0.36, rel=0.05)


def test_a_site_is_built_once(own_cache, monkeypatch):
    built = []
    monkeypatch.setattr("swarmsim.site.importer.build", lambda *given: built.append(given) or build(*given))
    first, again = (load_site("works_yard", MATERIALS) for _ in range(2))
    assert len(built) == 1
    np.testing.assert_array_equal(again.site.terrain_m, first.site.terrain_m)
    np.testing.assert_array_equal(again.site.obstacles.centre_m, first.site.obstacles.centre_m)


def test_rays_of_many_positions_in_one_call(model):
    positions = jax.random.uniform(jax.random.key(0), (64, 3), minval=-60.0, maxval=60.0) * jnp.array(
        [1, 1, 0]
    ) + jnp.array([0, 0, 25.0])
    source = jnp.array([12.0, 4.0, 1.0])
    found = jax.jit(jax.vmap(lambda p: path_lengths(model.site, source, p)))(positions)
    np.testing.assert_allclose(found.sum(axis=1), jnp.linalg.norm(positions - source, axis=1), rtol=1e-4)
