"""A sweep equals the stream, goes on after an interrupt, and chooses on the calibration half."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop, motions, table, write_folder

from taojax.audit import sweep as judge_sweep
from taojax.audit.labels import TestSplit as HeldOut
from taojax.audit.labels import split_frames
from taojax.cli import main
from taojax.config import Config, StreamConfig
from taojax.errors import ConfigError
from taojax.runtime import grid as grids
from taojax.runtime import sweep_run
from taojax.runtime.maps import map_tables
from taojax.runtime.stream import Frame, replay
from taojax.runtime.sweep import evaluate, plan

GRID = """
association = ["rank", "joint"]
lambda_velocity = [0.0, 1.0]
gamma_similarity = [1.0, 50.0]
delta_spacings = [1.5, 3.0]
window = [4, 7]
branches = [3, 8]
joint_window = [15, 18]
joint_seeds = [2, 4]
"""
BASE = StreamConfig(window=7, branches=8, joint_window=18, joint_seeds=4)


def fails(capsys, code, *words):
    """Run a command that must fail with one line; return the line."""
    try:
        got = main(list(words))
    except SystemExit as stop:
        got = stop.code
    err = capsys.readouterr().err
    assert got == code, err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1
    return err.strip()


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

    return grids.parse(tomllib.loads(text))


def streamed(row, poses, frames):
    """The signal of a stream compiled for one row's own sizes."""
    own = {k: v for k, v in row.items() if k in grids.COLUMNS}
    config = dataclasses.replace(BASE, association=row["association"], **own)
    return np.asarray(replay(config, map_tables(poses, config), frames)[1].signals["tao"])


@pytest.fixture(scope="module")
def swept():
    poses, frames = frames_of(np.random.default_rng(5))
    rows = grids.expand(parsed(GRID), BASE)
    tables = map_tables(poses, BASE)
    found = {}
    for signals, units in plan(rows, BASE, tables, poses, frames):
        for members, values in evaluate(signals, units, batch=1):
            found |= dict(zip(members, values, strict=True))
    return rows, poses, frames, np.stack([found[n] for n in range(len(rows))])


@pytest.mark.parametrize("association", ["rank", "joint"])
def test_masking_gives_what_a_stream_of_that_size_gives(association, swept):
    rows, poses, frames, tao = swept
    mine = [n for n, row in enumerate(rows) if row["association"] == association]
    sizes = ("window", "branches", "joint_window", "joint_seeds")
    smallest = min(mine, key=lambda n: [rows[n].get(name, 0) for name in sizes])
    # The smallest sizes are masked most; a joint stream takes long to compile.
    for n in (smallest, mine[-2])[: 2 if association == "rank" else 1]:
        np.testing.assert_allclose(
            tao[n], streamed(rows[n], poses, frames), rtol=2e-4, atol=2e-5, err_msg=str(rows[n])
        )


def test_no_two_configurations_give_the_same_signal_by_accident(swept):
    rows, _, _, tao = swept
    rank = [n for n, row in enumerate(rows) if row["association"] == "rank"]
    assert len(np.unique(tao[rank].round(4), axis=0)) > 0.9 * len(rank)


def test_vmap_gives_what_the_loop_gives_with_a_last_batch_that_is_not_full(swept):
    rows, poses, frames, tao = swept
    for signals, units in plan(rows, BASE, map_tables(poses, BASE), poses, frames):
        part = units[:5]
        found = list(evaluate(signals, part, batch=3))
        assert [r for members, _ in found for r in members] == [r for u in part for r in u.rows]
        for members, values in found:
            np.testing.assert_allclose(values, tao[list(members)], rtol=2e-4, atol=2e-5)


def test_units_share_the_fit_of_gamma_and_branches(swept):
    rows, poses, frames, _ = swept
    (_, units), _ = plan(rows, BASE, map_tables(poses, BASE), poses, frames)
    assert len(units) == 8
    assert sorted(r for u in units for r in u.rows) == list(range(32))


def test_the_default_grid_holds_256_rank_configurations_and_the_defaults():
    rows = grids.expand(grids.DEFAULT, StreamConfig())
    assert sum(row["association"] == "rank" for row in rows) == 256
    defaults = [row for row in rows if row["is_default"]]
    assert [row["association"] for row in defaults] == ["rank", "joint"]
    assert all(row["is_in_grid"] for row in rows)
    assert parsed(grids.to_toml(grids.DEFAULT)) == grids.DEFAULT


def test_own_settings_outside_the_product_are_added_for_comparison():
    rows = grids.expand(parsed("lambda_velocity = [0, 0.1]"), StreamConfig())
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
        grids.read_grid(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_flags_pin_a_setting_and_an_association():
    pinned = grids.pin(parsed(GRID), {"window": 5, "branches": None}, "rank")
    assert list(pinned) == ["rank"]
    assert pinned["rank"]["window"] == (5,)
    assert pinned["rank"]["branches"] == (3, 8)
    with pytest.raises(ConfigError, match="sweeps rank only"):
        grids.pin(pinned, {}, "joint")


# The judge.


def made_sweep(tao):
    """A sealed sweep in memory around some signals."""
    rows = grids.expand(parsed(f"lambda_velocity = {list(range(len(tao)))}"), StreamConfig())
    grid = grids.as_table(rows)
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


# The command.

SMALL_GRID = """
association = ["rank"]
lambda_velocity = [0.0, 1.0]
gamma_similarity = [1.0, 10.0]
"""
FLAGS = ("--window", "6", "--branches", "5", "--no-progress", "--r-in", "3", "--r-out", "6")


@pytest.fixture
def world(tmp_path, rng):
    """A small data folder; the robot leaves the map in both halves."""
    folder = write_folder(tmp_path / "data", rng)
    poses = np.loadtxt(folder / "truth/query_poses.csv", delimiter=",", skiprows=1)
    for a, b in ((10, 18), (38, 46)):
        poses[a:b, 1:3] *= 2.0
    table(folder / "truth/query_poses.csv", "t_s,x_m,y_m,theta_rad", poses)
    (tmp_path / "grid.toml").write_text(SMALL_GRID)
    (tmp_path / "more.toml").write_text(SMALL_GRID + "delta_spacings = [1.5, 3.0]\n")
    return folder


def words_of(world, out, grid="grid.toml"):
    return ["sweep", str(world), "--grid", str(world.parent / grid), "--out", str(out), *FLAGS]


def test_the_command_leaves_every_file_and_refuses_a_second_run(world, tmp_path, capfd):
    out = tmp_path / "run"
    assert main(words_of(world, out)) == 0
    said = capfd.readouterr().out
    assert "calibration half" in said
    assert "alone" in said
    for name in (
        "manifest.json", "config.toml", "grid.toml", "grid.csv", "map_poses.csv", "signals.npz",
        "sweep.csv", "audit.json", "tables/top.csv", "tables/top.md", "tables/top.tex",
        "figures/heat_rank.png", "figures/heat_rank.svg", "figures/heat_rank.csv",
        "figures/sensitivity_rank.png", "figures/sensitivity_rank.svg",
    ):  # fmt: skip
        assert (out / name).stat().st_size > 0, name
    assert not (out / "parts").exists()
    rows = (out / "sweep.csv").read_text().splitlines()
    assert len(rows) == 1 + 4
    assert main(words_of(world, out)) == 3
    assert "already holds a finished sweep" in capfd.readouterr().err
    # Stopped between sealing and judging: only the judge goes on.
    sealed = (out / "signals.npz").stat().st_mtime_ns
    (out / "sweep.csv").unlink()
    assert main(words_of(world, out)) == 0
    assert (out / "signals.npz").stat().st_mtime_ns == sealed
    assert (out / "sweep.csv").read_text().splitlines() == rows
    # A changed byte stops the judge.
    (out / "sweep.csv").unlink()
    raw = bytearray((out / "signals.npz").read_bytes())
    raw[-200] ^= 1
    (out / "signals.npz").write_bytes(raw)
    assert main(words_of(world, out)) == 3
    assert "seal broken" in capfd.readouterr().err


def test_an_interrupted_sweep_goes_on_without_computing_again(world, tmp_path, monkeypatch, capsys):
    out = tmp_path / "run"
    words = [*words_of(world, out, "more.toml"), "--no-judge"]
    real, computed = sweep_run.evaluate, []

    def stops_after(n):
        def evaluate(signals, units, *, batch):
            for members, values in real(signals, units, batch=batch):
                if len(computed) == n:
                    raise KeyboardInterrupt
                computed.append((members, values.copy()))
                yield members, values

        return evaluate

    monkeypatch.setattr(sweep_run, "evaluate", stops_after(2))
    line = fails(capsys, 130, *words)
    assert "run the same command again to continue" in line
    parts = {p.name: p.stat().st_mtime_ns for p in (out / "parts").glob("*.npz")}
    assert len(parts) == 2
    (out / "parts" / "000099.npz").write_bytes(b"damaged")

    other = words_of(world, out)  # another grid in the same folder
    assert "another grid" in fails(capsys, 3, *other, "--no-judge")
    assert "another configuration" in fails(capsys, 3, *words, "--seed", "4")
    assert {n: (out / "parts" / n).stat().st_mtime_ns for n in parts} == parts

    monkeypatch.setattr(sweep_run, "evaluate", stops_after(99))
    assert main(words) == 0
    assert len(computed) == 4
    assert sorted(n for members, _ in computed for n in members) == list(range(8))
    with np.load(out / "signals.npz") as sealed:
        for members, values in computed:
            np.testing.assert_array_equal(sealed["tao"][list(members)], values)


def test_changed_input_is_another_sweep(world, tmp_path):
    key = {"input data": "a", "grid": "b"}
    sweep_run.begin(tmp_path / "run", key)
    sweep_run.begin(tmp_path / "run", key)
    with pytest.raises(Exception, match="another input data"):
        sweep_run.begin(tmp_path / "run", {"input data": "c", "grid": "b"})


def test_bad_grids_and_taken_folders_are_exit_3(world, tmp_path, capsys):
    (tmp_path / "grid.toml").write_text("speed = [1]")
    line = fails(capsys, 3, *words_of(world, tmp_path / "run"))
    assert "grid.toml: unknown setting(s) speed" in line
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").write_text("keep")
    line = fails(capsys, 3, *words_of(world, tmp_path / "taken", "more.toml"))
    assert "already holds" in line
    (world / "truth/query_poses.csv").unlink()
    line = fails(capsys, 3, *words_of(world, tmp_path / "run", "more.toml"))
    assert "--no-judge" in line
    assert not (tmp_path / "run").exists()


def test_the_judge_is_never_loaded_while_scoring_and_truth_changes_no_signal(world, tmp_path):
    words = [*words_of(world, tmp_path / "a"), "--no-judge"]
    code = (
        "import sys; from taojax.cli import main\n"
        f"assert main({words!r}) == 0\n"
        "print('judged' if any(m.startswith('taojax.audit') for m in sys.modules) else 'apart')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "apart"
    (world / "truth/query_poses.csv").write_bytes(b"\xff\x00garbage")
    assert main([*words_of(world, tmp_path / "b"), "--no-judge"]) == 0
    for name in ("signals.npz", "grid.csv", "config.toml", "manifest.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_help_shows_an_example_and_imports_no_jax():
    code = (
        "import sys\nfrom taojax.cli import main\n"
        "try:\n    main(['sweep', '--help'])\nexcept SystemExit as stop:\n    assert not stop.code\n"
        "print([m for m in sys.modules if m in ('jax', 'equinox', 'pandas', 'matplotlib')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Example: taojax sweep" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


def test_ctrl_c_reaches_the_child_and_leaves_exit_130(world, tmp_path):
    grid = f"association = ['rank']\nlambda_velocity = {[n / 500 for n in range(2500)]}\n"
    (tmp_path / "grid.toml").write_text(grid)
    out = tmp_path / "run"
    child = subprocess.Popen(
        [sys.executable, "-m", "taojax", *words_of(world, out)], stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + 40
    while not list((out / "parts").glob("*.npz")) and time.monotonic() < until:
        time.sleep(0.05)
    os.kill(child.pid, signal.SIGINT)
    _, err = child.communicate(timeout=30)
    assert child.returncode == 130, err
    assert err.count("run the same command again to continue") == 1
    assert "Traceback" not in err
    assert json.loads((out / "parts" / "key.json").read_text())["grid"]
    assert list((out / "parts").glob("*.npz"))
