"""What a configuration calls an axis of a sweep is one: `vmap` gives what a loop gives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop, motions

from taojax.config import Config, StreamConfig, replace
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.stream import replay

BASE = Config(stream=StreamConfig(window=8, branches=12))
PLACES = loop(60)

AXES = {
    "lambda_velocity": (0.0, 0.2),
    "gamma_similarity": (0.0, 30.0),
    "tau_masks": (0.0, 2.0),
    "delta_spacings": (0.5, 1.5, 6.0),
    "mask_deltas": (0.5, 1.0),
    "entropy_temperature": (0.01, 0.5),
    "eps": (1e-3, 1e3),
}
FILTER_AXES = {
    "evidence": (1.0, 9.0),
    "leave": (0.001, 0.3),
    "come_back": (0.01, 0.5),
    "start_off": (0.05, 0.8),
    "step_gaps": (2.5, 6.0),
    "reach_gaps": (0.05, 0.2),
    "place_gaps": (1.0, 9.0),
    "near_gaps": (0.5, 5.0),
    "drift": (0.0, 0.4),
}
VARIANTS = [{}, *({n: v} for n, values in (AXES | FILTER_AXES).items() for v in values)]


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
    configs = [replace(BASE, changes) for changes in VARIANTS]
    parts = [(config.stream, config.verdict) for config in configs]
    stacked = jax.tree.map(lambda *x: jnp.asarray(x, jnp.float32), *parts)
    tables = map_tables(PLACES)
    run = lambda stream, verdict: replay(Config(stream, verdict), tables, frames)[1]
    together = jax.vmap(run)(*stacked)
    alone = [replay(config, tables, frames)[1] for config in configs]
    return jax.tree.map(np.asarray, (together, alone))


def test_every_field_that_is_no_shape_is_tried():
    for part, tried in ((BASE.stream, AXES), (BASE.verdict, FILTER_AXES)):
        free = {f.name for f in dataclasses.fields(part) if not f.metadata.get("static", False)}
        # What the past says of an answer is asked after the stream.
        assert free - {"history_gaps"} == set(tried)


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


@pytest.mark.parametrize("name", [*AXES, *FILTER_AXES])
def test_every_axis_matters(name, swept):
    _, alone = swept
    default = alone[0].signals.table
    for changes, records in zip(VARIANTS, alone, strict=True):
        if name in changes:
            assert np.abs(records.signals.table - default).max() > 1e-3
