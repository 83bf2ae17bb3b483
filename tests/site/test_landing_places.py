"""Where one can land on a site clear of what stands there."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from yards import make_site

from swarmsim.site import nearest
from swarmsim.site.landing_places import landing_places

SIZE, CELL = 41, 0.5


def site_with(surface, terrain=None):
    """A site of 41 x 41 cells of 0.5 m around the origin."""
    ground = np.zeros((SIZE, SIZE), np.float32) if terrain is None else terrain
    made = make_site(terrain=ground, cell=CELL, origin=(-10.0, -10.0))
    return replace(made, surface_m=np.asarray(surface, np.float32) + ground)


def post(row, column, height=2.0):
    surface = np.zeros((SIZE, SIZE))
    surface[row, column] = height
    return surface


def test_beside_a_post_the_nearest_place_leads_away_from_it():
    (east, north), over = landing_places(site_with(post(20, 20)), keep_m=2.0, border_m=0.0)
    assert (east[20, 22], abs(north[20, 22])) == (2.0, 0.5)  # 2.06 m from the post
    assert (east[20, 26], north[20, 26]) == (3.0, 0.0)  # clear already
    assert np.hypot(east[20, 20], north[20, 20]) > 2.0
    assert (over[20, 20], over[20, 30], over[20, 31]) == (2.0, 2.0, 0.0)  # 2 m, and 3 m in which it stops


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 1000), keep=st.floats(0.6, 2.5), border=st.floats(0.0, 3.0))
def test_every_place_is_clear_and_none_is_nearer(seed, keep, border):
    draw = np.random.default_rng(seed)
    surface = np.where(draw.random((SIZE, SIZE)) < 0.01, 3.0, 0.0)
    (east, north), _ = landing_places(site_with(surface), keep_m=keep, border_m=border)
    x = -10.0 + CELL * np.arange(SIZE)
    stands = np.stack(np.nonzero(surface)[::-1], -1) * CELL - 10.0
    centres = np.stack(np.meshgrid(x, x), -1)
    free = np.ones((SIZE, SIZE), bool)
    if len(stands):
        free = np.linalg.norm(centres[:, :, None] - stands, axis=-1).min(-1) > keep
    rim = int(np.ceil(border / CELL))
    inner = np.zeros((SIZE, SIZE), bool)
    inner[rim : SIZE - rim, rim : SIZE - rim] = True
    free &= inner
    if not free.any():
        np.testing.assert_array_equal(east, centres[..., 0])
        return
    found = np.linalg.norm(np.stack([east, north], -1) - centres, axis=-1)
    best = np.linalg.norm(centres[:, :, None] - centres[free], axis=-1).min(-1)
    np.testing.assert_allclose(found, best, atol=1e-5)
    column, row = np.rint((east + 10.0) / CELL).astype(int), np.rint((north + 10.0) / CELL).astype(int)
    assert free[row, column].all()


def test_a_steep_bank_is_no_place_to_land():
    x = -10.0 + CELL * np.arange(SIZE)
    terrain = np.tile(np.clip(x, 0.0, 4.0) * 0.5, (SIZE, 1)).astype(np.float32)  # 27 degrees from x = 0 to 4
    (east, _), _ = landing_places(site_with(np.zeros((SIZE, SIZE)), terrain), keep_m=0.6, border_m=0.0)
    assert not ((east > 0.3) & (east < 3.7)).any()
    assert (east[:, 0] == -10.0).all()


def test_the_nearest_cell_is_read():
    raster = np.arange(SIZE * SIZE, dtype=np.float32).reshape(SIZE, SIZE)
    site = site_with(np.zeros((SIZE, SIZE)))
    for x, y, cell in [(-10.0, -10.0, 0), (-9.76, -10.2, 0), (-9.74, -10.0, 1), (50.0, 50.0, SIZE * SIZE - 1)]:
        assert int(nearest(raster, site, np.array([x, y], np.float32))) == cell
