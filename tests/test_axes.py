"""What a configuration calls an axis of a sweep is one: `vmap` gives what a loop gives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop, motions

from taojax.config import StreamConfig
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.stream import replay

BASE = StreamConfig(window=8, branches=12)
PLACES = loop(60)

AXES = {
    "lambda_velocity": (0.0, 0.2),
    "gamma_similarity": (0.0, 30.0),
    "tau_masks": (0.0, 2.0),
    "delta_spacings": (0.5, 1.5, 6.0),
    "mask_deltas": (0.5, 1.0),
    "memory_frames": (2.0, 80.0),
    "kappa_spacings": (0.0, 40.0),
    "entropy_temperature": (0.01, 0.5),
    "eps": (1e-3, 1e3),
}
VARIANTS = [{}, *({name: value} for name, values in AXES.items() for value in values)]


@pytest.fixture(scope="module")
def swept():
    """Records of every variant from one vmap on one map, and from a loop of own maps."""
    rng, queries = np.random.default_rng(3), loop(40)
    away = np.linalg.norm(queries[:, None, :2] - PLACES[None, :, :2], axis=2)
    rows = np.exp(-away / 10) + rng.normal(0, 0.25, away.shape)
    index = np.argsort(-rows, axis=1)[:, :12].astype(np.int32)
    index[::7, 3:], index[9] = -1, -1
    similarity = np.clip(np.take_along_axis(rows, np.maximum(index, 0), 1), 0, 1)
    frames = Frame(
        jnp.asarray(motions(queries), jnp.float32),
        jnp.asarray(index),
        jnp.asarray(np.where(index < 0, 0, similarity), jnp.float32),
    )
    configs = [dataclasses.replace(BASE, **changes) for changes in VARIANTS]
    stacked = jax.tree.map(lambda *x: jnp.asarray(x, jnp.float32), *configs)
    tables = map_tables(PLACES, BASE)
    together = jax.vmap(lambda config: replay(config, tables, frames)[1])(stacked)
    alone = [replay(config, map_tables(PLACES, config), frames)[1] for config in configs]
    return jax.tree.map(np.asarray, (together, alone))


def test_every_field_that_is_no_shape_is_tried():
    free = {f.name for f in dataclasses.fields(BASE) if not f.metadata.get("static", False)}
    assert free == set(AXES)


@pytest.mark.parametrize("n", range(len(VARIANTS)), ids=map(str, VARIANTS))
def test_vmap_over_a_setting_gives_what_a_loop_gives(n, swept):
    together, alone = swept
    for name, column in alone[n].signals.items():
        rtol = 1e-2 if name in ("a_aniso", "c_geom") else 1e-3
        got = together.signals[name][n]
        np.testing.assert_allclose(got, column, rtol=rtol, atol=1e-3, err_msg=name)
    np.testing.assert_allclose(together.pose[n], alone[n].pose, atol=1e-2)
    for name in ("status", "map_index", "has_pose"):
        np.testing.assert_array_equal(getattr(together, name)[n], getattr(alone[n], name))


@pytest.mark.parametrize("name", AXES)
def test_every_axis_matters(name, swept):
    _, alone = swept
    default = alone[0].signals.table
    for changes, records in zip(VARIANTS, alone, strict=True):
        if name in changes:
            assert np.abs(records.signals.table - default).max() > 1e-3


def test_the_map_knows_no_setting():
    a, b = map_tables(PLACES), map_tables(PLACES, dataclasses.replace(BASE, delta_spacings=0.7))
    jax.tree.map(np.testing.assert_array_equal, a, b)
