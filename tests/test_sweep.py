"""A sweep equals the stream and chooses on the calibration half alone."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop, motions

from taojax.audit import sweep as judge_sweep
from taojax.audit.labels import TestSplit as HeldOut
from taojax.audit.labels import split_frames
from taojax.config import Config, StreamConfig, replace
from taojax.errors import ConfigError
from taojax.runtime import sweep
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.stream import replay
from taojax.runtime.sweep import evaluate, plan

GRID = """
association = ["rank", "joint"]
lambda_velocity = [1.0]
refine = [false, true]
gamma_similarity = [1.0, 50.0]
delta_spacings = [1.5, 3.0]
window = [4, 7]
branches = [3, 8]
evidence = [2.0, 6.0]
near_gaps = [1.0, 2.0]
"""
BASE = Config(stream=StreamConfig(window=7, branches=8))


def frames_of(rng, n=40, k=10):
    """A loop with noisy candidate lists, gaps in them, and two frames without any."""
    places, queries = loop(50), loop(n)
    gap = np.linalg.norm(queries[:, None, :2] - places[None, :, :2], axis=2)
    gap += rng.normal(0, 12.0, gap.shape)
    index = np.argsort(gap, axis=1)[:, :k]
    similarity = np.take_along_axis(np.clip(1 - gap / 80, 0, 1), index, axis=1)
    index[5:7] = -1
    index[::6, 4:] = -1
    index[::5, 1] = -1
    frames = Frame(
        jnp.asarray(motions(queries), jnp.float32),
        jnp.asarray(index, jnp.int32),
        jnp.asarray(np.where(index < 0, 0, similarity), jnp.float32),
    )
    return places, frames


def parsed(text):
    import tomllib

    return sweep.parse(tomllib.loads(text))


def streamed(row, poses, frames):
    """The signal of a stream compiled for one row's own sizes."""
    own = {k: v for k, v in row.items() if k in sweep.COLUMNS}
    config = replace(BASE, {"association": row["association"], **own})
    return np.asarray(replay(config, map_tables(poses), frames)[1].signals["tao"])


@pytest.fixture(scope="module")
def swept():
    poses, frames = frames_of(np.random.default_rng(5))
    rows = sweep.expand(parsed(GRID), BASE)
    tables = map_tables(poses)
    found = {}
    for signals, units in plan(rows, BASE, tables, frames):
        for members, values in evaluate(signals, units, batch=1):
            found |= dict(zip(members, values, strict=True))
    return rows, poses, frames, np.stack([found[n] for n in range(len(rows))])


@pytest.mark.parametrize("association", ["rank", "joint"])
def test_masking_gives_what_a_stream_of_that_size_gives(association, swept):
    rows, poses, frames, tao = swept
    mine = [n for n, row in enumerate(rows) if row["association"] == association]
    sizes = ("window", "branches")
    smallest = min(mine, key=lambda n: [rows[n].get(name, 0) for name in sizes])
    # The smallest sizes are masked most; a stream with the filter takes long to compile.
    for n in (smallest, mine[-2], mine[-3])[: 3 if association == "rank" else 1]:
        np.testing.assert_allclose(
            tao[n], streamed(rows[n], poses, frames), rtol=2e-4, atol=2e-5, err_msg=str(rows[n])
        )


def test_no_two_configurations_give_the_same_signal_by_accident(swept):
    rows, _, _, tao = swept
    rank = [n for n, row in enumerate(rows) if row["association"] == "rank"]
    assert len(np.unique(tao[rank].round(4), axis=0)) > 0.9 * len(rank)


def test_vmap_gives_what_the_loop_gives_with_a_last_batch_that_is_not_full(swept):
    rows, poses, frames, tao = swept
    for signals, units in plan(rows, BASE, map_tables(poses), frames):
        part = units[:5]
        found = list(evaluate(signals, part, batch=3))
        assert [r for members, _ in found for r in members] == [r for u in part for r in u.rows]
        for members, values in found:
            # Places tie in the first frames, where rounding may choose another.
            close = np.isclose(values, tao[list(members)], rtol=2e-4, atol=2e-5)
            assert close[:, 3:].all()
            assert close.mean() > 0.95


def test_units_share_the_fit_of_gamma_and_branches(swept):
    rows, poses, frames, _ = swept
    (_, closed), (_, refined), _ = plan(rows, BASE, map_tables(poses), frames)
    assert {u.arguments.config.refine for u in refined} == {True}
    units = [*closed, *refined]
    assert len(units) == 8
    assert sorted(r for u in units for r in u.rows) == list(range(32))


def test_the_default_grid_holds_256_rank_configurations_and_the_defaults():
    rows = sweep.expand(sweep.DEFAULT, Config())
    assert sum(row["association"] == "rank" for row in rows) == 256
    defaults = [row for row in rows if row["is_default"]]
    assert [row["association"] for row in defaults] == ["rank", "joint"]
    assert all(row["is_in_grid"] for row in rows)
    assert parsed(sweep.grid_to_toml(sweep.DEFAULT)) == sweep.DEFAULT


def test_own_settings_outside_the_product_are_added_for_comparison():
    rows = sweep.expand(parsed("lambda_velocity = [0, 0.1]"), Config())
    assert [(row["lambda_velocity"], row["is_in_grid"]) for row in rows] == [
        (0.0, True), (0.1, True), (1.0, False),
    ]  # fmt: skip


BAD = {
    "speed = [1]": "unknown setting",
    "window = [2]": r"window must lie in \[3",
    "window = [4.5]": "whole numbers",
    "delta_spacings = [0.0]": "delta_spacings must lie",
    "delta_spacings = [nan]": "delta_spacings must lie",
    "delta_spacings = 3": "expected a list",
    "delta_spacings = []": "expected a list",
    "delta_spacings = [true]": "give a list of numbers",
    "refine = [1]": "give a list of true and false",
    'delta_spacings = ["a"]': "give a list of numbers",
    'association = ["best"]\nwindow = [4]': 'list of "rank" and "joint"',
    'association = ["joint"]\nlambda_velocity = [1]': "no effect on association joint",
    "[joint]\nwindow = [4]": "no setting window",
    "rank = 3": "expected a table",
    "": "names no setting",
    "window = [": "cannot be read as TOML",
    f"lambda_velocity = {list(range(400))}\ngamma_similarity = {list(range(400))}": "at most",
}


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_a_bad_grid_is_refused_with_the_reason(text, tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=BAD[text]) as caught:
        sweep.read_grid(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_flags_pin_a_setting_and_an_association():
    pinned = sweep.pin(parsed(GRID), {"window": 5, "branches": None}, "rank")
    assert list(pinned) == ["rank"]
    assert pinned["rank"]["window"] == (5,)
    assert pinned["rank"]["branches"] == (3, 8)
    with pytest.raises(ConfigError, match="sweeps rank only"):
        sweep.pin(pinned, {}, "joint")


# The judge.


def made_sweep(tao):
    """A sealed sweep in memory around some signals."""
    rows = sweep.expand(parsed(f"lambda_velocity = {list(range(len(tao)))}"), Config())
    grid = sweep.as_table(rows)
    return judge_sweep.SealedSweep(grid, tao, np.zeros((3, 2)), {"seal": "x"})


def judged(tao, label):
    return judge_sweep.judge(made_sweep(tao), label, Config(), gap_frames=10)


@pytest.fixture
def signals(rng):
    """Six signals of rising quality; in the test half the order is turned round."""
    label = np.array(["in_map", "map_out", "grey", "in_map"] * 50)
    is_out = (label == "map_out").astype(float)
    gain = np.arange(6)[:, None] * np.where(np.arange(200) < 100, 0.4, -0.4)[None]
    return gain * is_out[None] + rng.normal(size=(6, 200)), label


def test_the_choice_looks_at_the_calibration_half_alone(signals, rng):
    tao, label = signals
    found = judged(tao, label)
    auroc = found.table["auroc_calibration"]
    assert found.chosen == np.argmax(auroc)
    assert found.table["is_chosen"].sum() == 1
    for _ in range(3):
        shuffled, other = label.copy(), tao.copy()
        shuffled[100:] = rng.permutation(label[100:])
        other[:, 100:] = rng.normal(size=(6, 100))
        again = judged(other, shuffled)
        assert again.chosen == found.chosen
        np.testing.assert_array_equal(again.table["auroc_calibration"], auroc)
        np.testing.assert_array_equal(again.table["threshold"], found.table["threshold"])
        assert not np.array_equal(
            again.table["auroc_test"][found.chosen], found.table["auroc_test"][found.chosen]
        )


def test_the_test_half_is_read_for_the_choice_and_the_default_alone(signals, monkeypatch):
    tao, label = signals
    asked = []
    real = judge_sweep.test_row
    monkeypatch.setattr(judge_sweep, "test_row", lambda *a: asked.append(a[1]) or real(*a))
    found = judged(tao, label)
    default = int(np.flatnonzero(found.table["is_default"])[0])
    assert set(asked) == {str(found.chosen), str(default)}
    assert set(np.flatnonzero(~np.isnan(found.table["auroc_test"]))) == {found.chosen, default}
    assert "opened after the choice" in " ".join(found.sentences)
    assert "No other configuration" in found.sentences[-1]


def test_the_measuring_before_the_choice_refuses_the_test_half(signals):
    import jaxtyping

    tao, label = signals
    named = {str(n): s for n, s in enumerate(tao)}
    splits = split_frames(named, label, calibration_share=0.5, gap_frames=10)
    assert isinstance(splits.test, HeldOut)
    with pytest.raises(jaxtyping.TypeCheckError):
        judge_sweep.calibration_rows(splits.test, 3.0)


def test_ties_go_to_the_lower_far_and_then_to_the_earlier_row():
    rows = [
        {"auroc_calibration": 0.8, "far_at_95_calibration": 0.1},
        {"auroc_calibration": 0.9, "far_at_95_calibration": 0.3},
        {"auroc_calibration": 0.9, "far_at_95_calibration": 0.2},
        {"auroc_calibration": 0.9, "far_at_95_calibration": 0.2},
    ]
    assert list(judge_sweep.ranking(rows)) == [2, 3, 1, 0]


def test_one_class_in_the_calibration_half_makes_no_choice(signals):
    tao, label = signals
    label = label.copy()
    label[:100] = "in_map"
    found = judged(tao, label)
    assert found.chosen is None
    assert "No configuration is chosen" in found.sentences[0]
    assert np.isnan(found.table["auroc_calibration"]).all()
    assert not found.table["is_chosen"].any()
