"""The prepared map: anchors find themselves, similarities get their fixed scale."""

import jax.numpy as jnp
import numpy as np
import pytest

from taojax.core.anchors import look_up
from taojax.runtime.maps import map_tables, rescale


@pytest.mark.parametrize("spacing_m", [0.1, 1.0, 5.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_every_anchor_of_an_evenly_spaced_line_finds_itself(spacing_m, axis):
    poses = np.zeros((400, 3))
    poses[:, axis] = spacing_m * np.arange(400)
    tables = map_tables(poses)
    found, away = look_up(tables.places.grid, *jnp.asarray(poses[:, :2].T, jnp.float32))
    assert (away < 1e-6).all()
    np.testing.assert_array_equal(found, np.arange(400))


def test_every_anchor_of_a_lattice_finds_itself():
    x, y = np.meshgrid(np.arange(20.0), np.arange(15.0), indexing="ij")
    poses = np.c_[x.ravel(), y.ravel(), np.zeros(300)] * 2.0
    grid = map_tables(poses).places.grid
    np.testing.assert_array_equal(look_up(grid, *grid.xy.T)[0], np.arange(300))


def test_similarity_lies_on_a_line_from_background_to_a_strong_match_and_ends_there():
    scale = jnp.array([0.2, 0.6])
    got = rescale(scale, jnp.array([[-1.0, 0.2, 0.3], [0.5, 0.6, 0.9]]))
    np.testing.assert_allclose(got, [[0.0, 0.0, 0.25], [0.75, 1.0, 1.0]], atol=1e-6)
    assert np.isfinite(rescale(jnp.array([0.5, 0.5]), jnp.array([0.4, 0.5, 0.6]))).all()
