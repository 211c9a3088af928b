"""Explaining a frame: its path followed from the sealed files alone, equal to what was sealed."""

import csv
import dataclasses
import json
import shutil

import numpy as np
import pytest
from conftest import write_folder
from judged import made_up, seal

from taojax.cli import main
from taojax.cli.explain_page import ranges
from taojax.config import Config, StreamConfig, VerdictConfig
from taojax.errors import InputError
from taojax.files import records
from taojax.files.tables import POSE
from taojax.runtime.explain import explain
from taojax.runtime.score import score

SHAPE = {"window": 6, "branches": 5}
LAG = VerdictConfig(lag=4, window_frames=4)
CALIBRATION = made_up("place", middle=-9.0, gain=2.0)


def lost_folder(folder):
    """A data folder whose last ten frames look like nowhere."""
    rng = np.random.default_rng(5)
    write_folder(folder, rng)
    path = folder / "query/descriptors.npy"
    seen = np.load(path)
    seen[40:] = rng.normal(size=seen[40:].shape)
    np.save(path, seen)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explain")
    data = lost_folder(folder / "data")
    for name, association, lag in (
        ("joint",) * 2 + (4,),
        ("rank",) * 2 + (4,),
        ("causal", "joint", 0),
    ):
        verdict = dataclasses.replace(LAG, lag=lag)
        config = Config(stream=StreamConfig(**SHAPE, association=association), verdict=verdict)
        score(data, folder / name, config, calibration=CALIBRATION)
    # What explains a run must lie in the run.
    shutil.rmtree(data)
    return folder


@pytest.mark.parametrize("name", ["joint", "rank", "causal"])
@pytest.mark.parametrize("frame", [0, 2, 30, 41, 49])
def test_the_path_costs_what_was_sealed(name, frame, folder):
    run = records.read_run(folder / name)
    look = explain(folder / name, run, frame)
    assert look.gap <= 1.0
    window = look.window
    # A robot that has not moved has gathered nothing.
    assert window.weight.sum() == pytest.approx(float(window.frame[-1] > 0), abs=1e-5)
    assert (window.cost * window.weight).sum() == pytest.approx(
        run.delayed["cost"][frame], abs=1e-4
    )
    last = frame if name == "causal" else min(49, frame + 4)
    assert max(0, frame - 4) >= window.frame[0] >= frame - 20
    assert frame <= window.frame[-1] <= last
    assert (np.diff(window.frame) == 1).all()
    assert look.status == run.signals["status"][frame]
    if look.status == "ok":
        assert look.map_index == run.delayed["map_index"][frame]


def test_frames_disagree_where_the_lists_point_elsewhere(folder):
    run = records.read_run(folder / "joint")
    on, off = (explain(folder / "joint", run, frame) for frame in (25, 47))
    pairs = zip(on.window.frame, on.window.anchor, strict=True)
    assert all(anchor in run.index[frame] for frame, anchor in pairs)
    assert on.window.is_inlier.mean() > off.window.is_inlier.mean()
    assert np.median(off.window.cost) > np.median(on.window.cost)


def test_other_places_lie_apart_and_are_told_cheapest_first(folder):
    run = records.read_run(folder / "joint")
    cost, pose = explain(folder / "joint", run, 45).hypotheses
    assert len(cost) > 1
    assert (np.diff(cost[1:]) >= 0).all()
    np.testing.assert_allclose(pose[0], [run.delayed[n][45] for n in POSE], rtol=1e-6)
    gap = np.linalg.norm(pose[:, None, :2] - pose[None, :, :2], axis=2)
    apart = run.manifest["map_gap_m"] * VerdictConfig().place_gaps
    assert gap[~np.eye(len(cost), dtype=bool)].min() > apart


def test_no_frame_beyond_the_lag_is_looked_at(folder):
    run = records.read_run(folder / "joint")
    before = explain(folder / "joint", run, 20)
    run.index[26:] = -1
    run.similarity[26:] = np.nan
    after = explain(folder / "joint", run, 20)
    assert before.cost == after.cost


def test_a_trial_is_explained_from_its_own_start(tmp_path):
    data = lost_folder(tmp_path / "data")
    (data / "about.toml").write_text('notes = ["made up"]\ntrial_frames = 25\n')
    config = Config(stream=StreamConfig(**SHAPE, association="rank"), verdict=LAG)
    score(data, tmp_path / "run", config)
    run = records.read_run(tmp_path / "run")
    look = explain(tmp_path / "run", run, 27)
    assert look.gap <= 1.0
    assert look.window.frame[0] == 25


def told(capsys, *words):
    assert main(["explain", *map(str, words), "--no-progress"]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("name", ["joint", "rank"])
def test_it_says_verdict_signals_branch_frames_and_margin_and_draws(name, folder, tmp_path, capsys):
    text = told(capsys, folder / name, "--frame", 47, "--out", tmp_path / "out")
    for label in (
        "verdict",
        "now",
        "decided by",
        "promise",
        "place",
        "window",
        "costs",
        "rival",
        "literal",
        "list",
        "margin",
    ):
        assert f"\n{label} " in text, label
    assert "decisions.csv" in text
    assert max(map(len, text.splitlines())) <= 92
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"frame_47.png", "frame_47.svg", "frame_47.csv"}
    with (tmp_path / "out/frame_47.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    kinds = [row["kind"] for row in rows]
    assert kinds.count("frame") >= 6
    assert kinds.count("place") >= 1
    assert kinds.count("candidate") == 60
    assert "47" in [row["number"] for row in rows if row["kind"] == "frame"]


def test_a_rejected_frame_and_an_accepted_one_say_so(folder, capsys, tmp_path):
    verdicts = (folder / "joint/decisions.csv").read_text().splitlines()[1:]
    said = {row.split(",")[1]: int(row.split(",")[0]) for row in verdicts}
    for verdict, words in (
        ("reject", "to be accepted it lacks log odds lower by"),
        ("accept", "would not have been accepted"),
    ):
        text = told(capsys, folder / "joint", "--frame", said[verdict], "--out", tmp_path)
        assert f"verdict     {verdict}" in text
        assert words in " ".join(text.split())


def test_pictures_lie_in_the_run_folder_where_nothing_else_is_said(folder, tmp_path, capsys):
    shutil.copytree(folder / "joint", tmp_path / "run")
    told(capsys, tmp_path / "run", "--frame", 0)
    assert (tmp_path / "run/explain/frame_0.png").stat().st_size > 0
    # The seal covers what was sealed, not what was added.
    records.read_run(tmp_path / "run")


def fails(capsys, code, *words):
    try:
        got = main(["explain", *map(str, words)])
    except SystemExit as stop:
        got = stop.code
    captured = capsys.readouterr()
    line = captured.err.strip()
    assert got == code
    assert captured.out == ""
    assert "\n" not in line
    return line


@pytest.mark.parametrize("frame", [-1, 50, 10**9])
def test_a_frame_out_of_range_is_exit_3_and_names_the_range(frame, folder, capsys):
    assert "0 to 49" in fails(capsys, 3, folder / "joint", "--frame", frame)


def test_a_broken_seal_is_exit_3(folder, tmp_path, capsys):
    shutil.copytree(folder / "joint", tmp_path / "run")
    path = tmp_path / "run/odometry.csv"
    raw = bytearray(path.read_bytes())
    raw[-5] ^= 1
    path.write_bytes(raw)
    line = fails(capsys, 3, tmp_path / "run", "--frame", 3)
    assert "odometry.csv: seal broken" in line


def test_a_run_of_an_older_version_says_what_is_missing(tmp_path, capsys):
    run, _ = seal(tmp_path)
    line = fails(capsys, 3, run, "--frame", 3)
    assert "map_scale, map_recall, trial_frames, odometry.csv" in line
    assert "taojax score" in line


def test_a_path_that_differs_is_exit_1_and_explains_nothing(folder, capsys, monkeypatch):
    run = records.read_run(folder / "joint")
    # A cost that no path has; the seal was checked before.
    run.delayed["cost"] += 1.0
    monkeypatch.setattr("taojax.files.records.read_run", lambda path: run)
    line = fails(capsys, 1, folder / "joint", "--frame", 10)
    assert "nothing can be explained" in line


def test_the_manifest_holds_what_the_map_said(folder):
    facts = json.loads((folder / "joint/manifest.json").read_text())
    assert facts["map_spacing_m"] > 0
    assert facts["map_scale"][0] < facts["map_scale"][1]
    assert 0 <= facts["map_recall"] <= 1
    assert facts["trial_frames"] is None
    assert facts["sha256"]["odometry.csv"] == facts["sha256"]["inputs/query/odometry.csv"]


def test_nothing_but_sealed_files_is_read(folder):
    with pytest.raises(InputError, match="0 to 49"):
        explain(folder / "joint", records.read_run(folder / "joint"), 50)


def test_ranges_are_short():
    assert ranges([0, 1, 2, 5, 7, 8]) == "0 to 2, 5, 7 to 8"
    assert ranges([]) == ""
