"""The map's look-up tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop

from taojax.core.anchors import look_up
from taojax.runtime.maps import map_tables

M = 60


def test_look_up_finds_the_nearest_anchor_within_a_cell(rng):
    grid = map_tables(loop(M)).places.grid
    xy = rng.uniform(-60, 60, (200, 2)).astype(np.float32)
    got = np.asarray(look_up(grid, jnp.asarray(xy)))
    distance = np.linalg.norm(xy[:, None] - np.asarray(grid.xy)[None], axis=-1)
    found = got >= 0
    # The cell's centre is at most half a diagonal away, so the answer is off by at most one.
    slack = float(grid.cell_m) * 1.5
    assert (distance[found, got[found]] <= distance[found].min(axis=1) + slack).all()
    assert found.mean() > 0.3


def test_positions_far_outside_the_grid_have_no_anchor():
    grid = map_tables(loop(M)).places.grid
    far = jnp.array([[1e30, 0.0], [-1e9, 1e9], [0.0, 4e4]])
    np.testing.assert_array_equal(look_up(grid, far), [-1, -1, -1])


@pytest.mark.parametrize("n", [3, 4, 12])
def test_tiny_and_coincident_maps_have_tables(n):
    for poses in (loop(n), np.zeros((n, 3))):
        tables = map_tables(poses)
        assert tables.places.grid.neighbour.shape == (min(12, n), n)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tables))
