"""The map's look-up tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop

from taojax.core.anchors import look_up
from taojax.runtime import maps
from taojax.runtime.maps import map_tables

M = 60


def nearest(xy, anchors):
    """Return each position's nearest anchor and its distance, by trying all."""
    away = np.linalg.norm(xy[:, None] - np.asarray(anchors)[None], axis=-1)
    return away.argmin(axis=1), away.min(axis=1)


def crossing():
    """Two roads that cross, one of them driven twice, a metre apart."""
    along = np.arange(-30.0, 30.0, 2.0)
    roads = [np.c_[along, 0 * along], np.c_[along[::-1] + 0.7, 0 * along + 1.0],
             np.c_[0 * along + 0.3, along]]  # fmt: skip
    xy = np.concatenate(roads)
    return np.c_[xy, np.zeros(len(xy))]


@pytest.mark.parametrize("poses", [loop(M), crossing()], ids=["loop", "crossing"])
@pytest.mark.parametrize("turn", [0.0, 0.4, 1.1])
def test_look_up_finds_the_nearest_anchor_however_the_map_lies(poses, turn, rng):
    c, s = np.cos(turn), np.sin(turn)
    poses = np.c_[poses[:, :2] @ np.array([[c, s], [-s, c]]), poses[:, 2] + turn]
    places = map_tables(poses).places
    grid, gap = places.grid, float(places.gap_m)
    xy = rng.uniform(-60, 60, (4000, 2)).astype(np.float32)
    found, squared = (np.asarray(part) for part in look_up(grid, *jnp.asarray(xy.T)))
    anchor, away = nearest(xy, grid.xy)
    is_near = away < 2.5 * gap
    assert 200 < is_near.sum() < 4000
    np.testing.assert_allclose(np.sqrt(squared[is_near]), away[is_near], atol=1e-3)
    assert (found[is_near] == anchor[is_near]).mean() > 0.99  # ties may fall either way


def test_a_map_wider_than_its_grid_finds_anchors_as_well(rng, monkeypatch):
    monkeypatch.setattr(maps, "MAX_CELLS", 12)
    places = map_tables(loop(M)).places
    grid, gap = places.grid, float(places.gap_m)
    assert float(grid.cell_m) > gap
    xy = (loop(M)[:, :2] + rng.normal(0.0, gap, (M, 2))).astype(np.float32)
    squared = np.asarray(look_up(grid, *jnp.asarray(xy.T))[1])
    away = nearest(xy, grid.xy)[1]
    assert (np.sqrt(squared) <= away + 1e-3).mean() > 0.95


def test_positions_far_outside_the_grid_have_no_anchor():
    grid = map_tables(loop(M)).places.grid
    far = jnp.array([[1e30, 0.0], [-1e9, 1e9], [0.0, 4e4]])
    assert np.isinf(look_up(grid, *far.T)[1]).all()


@pytest.mark.parametrize("n", [3, 4, 12])
def test_tiny_and_coincident_maps_have_tables(n):
    for poses in (loop(n), np.zeros((n, 3))):
        tables = map_tables(poses)
        assert tables.places.grid.neighbour.shape == (min(12, n), n)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tables))
