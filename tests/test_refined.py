"""The refined stream: off by default, never above the closed form, and the run says what it did."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ALONE, loop, motions

from taojax.audit.evaluate import evaluate
from taojax.config import Config, StreamConfig, from_toml, replace, to_toml
from taojax.core.cost import Branch
from taojax.core.refine import refined_cost, refined_costs
from taojax.files.records import read_run
from taojax.runtime.explain import explain
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.score import check_refinement, score
from taojax.runtime.stream import cost_params, replay

SMALL = StreamConfig(window=8, branches=6, association="rank", refine=True)
TERMS = ("tao_rank_geom", "tao_rank_vel", "tao_rank_sim")


@pytest.fixture(scope="module")
def both():
    """Closed form and refined records of one noisy drive."""
    rng, places, queries = np.random.default_rng(11), loop(60), loop(40)
    away = np.linalg.norm(queries[:, None, :2] - places[None, :, :2], axis=2)
    rows = np.exp(-away / 10) + rng.normal(0, 0.3, away.shape)
    index = np.argsort(-rows, axis=1)[:, :6].astype(np.int32)
    similarity = np.clip(np.take_along_axis(rows, index, 1), -1, 1).astype(np.float32)
    odometry = motions(queries) + rng.normal(0, 0.05, (40, 3))
    frames = Frame(*map(jnp.asarray, (odometry.astype(np.float32), index, similarity)))
    tables = map_tables(places)
    run = lambda config: replay(config, tables, frames)[1]
    closed = replace(Config(stream=SMALL), {"refine": False}).stream
    return run(closed), run(SMALL), lambda config: run(config.stream)


def test_refinement_is_off_by_default():
    assert StreamConfig().refine is False
    assert "refine = false" in to_toml(Config())


def test_the_refined_cost_is_never_above_the_closed_form(both):
    closed, refined, _ = both
    a, b = (np.asarray(r.signals["tao_rank"]) for r in (closed, refined))
    assert (b <= a * (1 + 1e-5)).all()
    assert (b < 0.99 * a).mean() > 0.1
    np.testing.assert_allclose(b, sum(np.asarray(refined.signals[n]) for n in TERMS), rtol=1e-5)
    np.testing.assert_array_equal(refined.signals["tao"], refined.signals["tao_rank"])
    for name in ("top1", "entropy", "velocity", "sue"):
        np.testing.assert_array_equal(refined.signals[name], closed.signals[name])


def test_branches_at_once_are_each_branch_alone(rng):
    p = np.cumsum(rng.normal(1, 0.5, (8, 2)), axis=0).astype(np.float32)
    q = (p[:, None] + rng.normal(0, 6, (8, 5, 2))).astype(np.float32)
    has = rng.random((8, 5)) < 0.8
    branches = Branch(jnp.asarray(q), jnp.full((8, 5), 0.5), jnp.asarray(has))
    params, weight = cost_params(SMALL, map_tables(loop(60))), jnp.full(8, 0.125)
    got = jax.jit(refined_costs)(params, jnp.asarray(p), branches, weight)
    for k in range(5):
        branch = jax.tree.map(lambda leaf, k=k: leaf[:, k], branches)
        alone = jax.jit(refined_cost)(params, jnp.asarray(p), branch, weight)
        np.testing.assert_allclose(got.total[k], alone.total, rtol=1e-4)
        np.testing.assert_allclose(got.T_map_odom[k], alone.T_map_odom, rtol=1e-2, atol=1e-2)
        np.testing.assert_array_equal(got.is_inlier[:, k], alone.is_inlier)


def test_the_note_says_how_often_and_how_much(both):
    _, refined, run = both
    said = check_refinement(Config(stream=SMALL), refined, run)
    assert "lower in" in said
    assert "fault" not in said
    same = check_refinement(Config(stream=SMALL), both[0], run)
    assert "lower in 0% of the frames, the same in the others" in same


def test_a_rise_is_called_a_fault(both):
    closed, refined, _ = both
    said = check_refinement(Config(stream=SMALL), closed, lambda _: refined)
    assert "which is a fault" in said


def test_a_refined_run_says_so_and_is_explained(data_folder, tmp_path):
    config = tmp_path / "config.toml"
    config.write_text(to_toml(Config(stream=SMALL)))
    assert from_toml(config).stream.refine is True
    manifest = score(data_folder, tmp_path / "run", from_toml(config))
    assert any("refinement is on" in note for note in manifest["notes"])
    run = read_run(tmp_path / "run")
    assert explain(tmp_path / "run", run, 30).gap <= 1.0
    terms = sum(run.signals[f"tao_rank_{name}"] for name in ("geom", "vel", "sim"))
    np.testing.assert_allclose(terms, run.signals["tao_rank"], rtol=1e-5)


def test_the_report_shows_the_check(data_folder, tmp_path):
    score(data_folder, tmp_path / "run", Config(stream=SMALL))
    manifest = json.loads((tmp_path / "run/manifest.json").read_text())
    (note,) = (n for n in manifest["notes"] if "refinement is on" in n)
    evaluate(tmp_path / "run", data_folder / "truth", Config())
    assert note in (tmp_path / "run/report.html").read_text()


def test_a_robot_that_does_not_refine_loads_no_solver():
    code = "import sys, taojax.runtime.stream; sys.exit('optimistix' in sys.modules)"
    env = {**os.environ, **ALONE}
    assert subprocess.run([sys.executable, "-c", code], env=env).returncode == 0
