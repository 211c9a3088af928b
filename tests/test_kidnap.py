"""Spliced kidnap logs: what the generator promises, and the command on top of it."""

import contextlib
import csv
import dataclasses
import io
import itertools
import json

import numpy as np
import pytest
from conftest import loop, motions, table

from taojax.audit.recovery import LEAST_FRAMES
from taojax.cli import main
from taojax.datasets.kidnap import (
    LEVELS,
    TRIAL_FRAMES,
    WINDOW_FRAMES,
    Plan,
    Source,
    cut_rows,
    far_m,
    folder_source,
    in_map,
    make_logs,
    noisy_odometry,
    world_source,
    write_logs,
)
from taojax.datasets.simulate import WorldConfig
from taojax.datasets.trajectory import motions as true_motions
from taojax.errors import InputError
from taojax.files.tables import read_table
from taojax.runtime.observations import load_observations


def small_source(n=200, n_map=220):
    """A loop of 500 m or so; of the query, frames 60..79 lie far off the map."""
    poses = loop(n_map, 80.0)
    query = loop(n, 80.0)
    query[60:80, :2] *= 1.6
    stamp = np.arange(n) * 0.5
    rng = np.random.default_rng(3)
    codes = rng.normal(size=(n_map, 8)).astype(np.float32)
    return Source(
        map_poses=np.c_[np.arange(n_map), poses].astype(float),
        query_poses=np.c_[stamp, query],
        seen_m=None,
        map_views=codes,
        query_views=(codes[np.linspace(0, n_map - 1, n).astype(int)],),
        notes=("made up",),
    )


def write_source(folder, source):
    pose = "t_s,x_m,y_m,theta_rad"
    table(folder / "map/poses.csv", pose, source.map_poses)
    table(folder / "truth/query_poses.csv", pose, source.query_poses)
    stamp, odometry = source.query_poses[:, :1], motions(source.query_poses[:, 1:])
    table(folder / "query/odometry.csv", "t_s,dx_m,dy_m,dtheta_rad", np.c_[stamp, odometry])
    np.save(folder / "map/descriptors.npy", source.map_views)
    np.save(folder / "query/descriptors.npy", source.query_views[0])
    return folder


PLAN = Plan(n_trials=20)


@pytest.fixture(scope="module")
def source():
    return small_source()


@pytest.fixture(scope="module")
def logs(source):
    return make_logs(source, PLAN, seed=5)


def test_stretches_are_consecutive_in_map_frames_of_the_stated_length(source, logs):
    inside = in_map(source, PLAN.r_in_m)
    assert not inside.all()
    for log in logs:
        assert len(log.rows) == TRIAL_FRAMES
        assert inside[log.rows].all()
        edges = np.r_[0, log.kidnaps, TRIAL_FRAMES]
        for a, b in itertools.pairwise(edges):
            assert (np.diff(log.rows[a:b]) == 1).all()
        lengths = np.diff(edges)[:-1]
        assert ((lengths >= PLAN.stretch[0]) & (lengths <= PLAN.stretch[1])).all()


def test_a_kidnap_carries_the_robot_far_away(source, logs):
    place = source.query_poses[:, 1:3]
    for log in logs:
        gap = place[log.rows[log.kidnaps]] - place[log.rows[log.kidnaps - 1]]
        assert (np.hypot(*gap.T) >= far_m(source)).all()
        assert len(log.kidnaps) >= 3


def test_odometry_at_the_jump_is_the_step_that_belonged_to_the_frame(source, logs):
    true = true_motions(source.query_poses[:, 1:])
    for log in (log for log in logs if log.drift == "low"):
        rows = log.rows[log.kidnaps]
        assert (rows >= 1).all()
        step = np.hypot(*true[rows, :2].T)
        np.testing.assert_allclose(log.step_m, step)
        error = log.odometry[log.kidnaps] - true[rows]
        # Noise of one step: a few per cent of its length, nothing of the jump's size.
        assert np.abs(error[:, :2]).max() < 0.25 * step.max()
        assert (log.odometry[0] == 0).all()


def test_every_level_gets_the_same_kidnaps_and_levels_take_turns(logs):
    assert [log.drift for log in logs[:3]] == list(LEVELS)
    for start in range(0, len(logs), 3):
        one, *others = logs[start : start + 3]
        for other in others:
            np.testing.assert_array_equal(one.rows, other.rows)
            assert not np.array_equal(one.odometry, other.odometry)
            assert one.split == other.split


def test_calibration_logs_do_not_count_and_enough_others_are_made(logs):
    low = [log for log in logs if log.drift == "low"]
    assert [log.split == "calibration" for log in low] == [i % 5 == 0 for i in range(len(low))]
    late = TRIAL_FRAMES - WINDOW_FRAMES
    counted = [(log.kidnaps <= late).sum() for log in low if log.split == "test"]
    assert sum(counted) >= PLAN.n_trials > sum(counted[:-1])
    # The wall lies between: the judge has its own number for what is too near to the end.
    assert WINDOW_FRAMES == LEAST_FRAMES


def test_no_threshold_has_seen_a_frame_that_it_is_tried_on(source, logs):
    seen = {
        split: set(np.concatenate([log.rows for log in logs if log.split == split]))
        for split in ("calibration", "test")
    }
    assert min(map(len, seen.values())) >= PLAN.stretch[0]
    assert not seen["calibration"] & seen["test"]
    sides = cut_rows(source, PLAN)
    for split, rows in seen.items():
        assert rows <= set(np.flatnonzero(sides[split]))
    np.testing.assert_array_equal(sides["calibration"] | sides["test"], in_map(source, PLAN.r_in_m))


def test_long_recordings_give_a_fifth_to_thresholds_and_short_ones_more(source):
    long = dataclasses.replace(source, query_poses=np.c_[np.arange(400), loop(400, 80.0)])
    for drive, share in ((long, 0.2), (source, 1 / 3)):
        sides = cut_rows(drive, PLAN)
        assert sides["calibration"].mean() == pytest.approx(
            share * in_map(drive, PLAN.r_in_m).mean(), abs=0.01
        )


def test_a_recording_with_one_place_for_thresholds_and_none_for_trials_is_refused():
    # A straight drive that is too short to be carried far away within one half of it.
    places = np.c_[np.linspace(0.0, 100.0, 120), np.zeros((120, 2))]
    poses = np.c_[np.arange(120.0), places]
    drive = dataclasses.replace(small_source(), map_poses=poses, query_poses=poses)
    assert cut_rows(drive, Plan(5, stretch=(20, 25)))
    with pytest.raises(InputError, match="not apart from those that thresholds are frozen on"):
        cut_rows(drive, Plan(5, stretch=(40, 45)))


def test_the_same_seed_gives_the_same_logs(source, logs):
    again, other = make_logs(source, PLAN, seed=5), make_logs(source, PLAN, seed=6)
    for a, b in zip(logs, again, strict=True):
        np.testing.assert_array_equal(a.rows, b.rows)
        np.testing.assert_array_equal(a.odometry, b.odometry)
    assert not np.array_equal(logs[-1].rows, other[-1].rows)


@pytest.mark.parametrize("level", LEVELS)
def test_drift_levels_are_reached(level, rng):
    """Root mean square end drift over many windows of straight driving, yaw kept apart."""
    drift, step_m, n = LEVELS[level], 2.0, 2000
    motion = np.zeros((WINDOW_FRAMES + 1, 3))
    motion[1:, 0] = step_m
    distance = WINDOW_FRAMES * step_m
    ends = np.array([
        (noisy_odometry(motion, drift, distance, rng) - motion).sum(axis=0) for _ in range(n)
    ])  # fmt: skip
    share = np.sqrt((ends[:, :2] ** 2).sum(axis=1).mean()) / distance
    yaw = np.degrees(np.sqrt((ends[:, 2] ** 2).mean()))
    np.testing.assert_allclose(share, drift.share, rtol=0.06)
    np.testing.assert_allclose(yaw, drift.yaw_deg, rtol=0.06)
    # The bias alone has half of the variance: the forward ends have two humps, one per sign.
    half = drift.share * distance / np.sqrt(2.0)
    np.testing.assert_allclose(np.abs(ends[:, 0]).mean(), half, rtol=0.15)


def test_the_white_part_grows_with_the_root_of_the_step(rng):
    motion = np.zeros((4001, 3))
    motion[1:, 0] = np.tile([1.0, 4.0], 2000)
    error = noisy_odometry(motion, LEVELS["low"], 50.0, rng) - motion
    short, long = error[1::2, 1], error[2::2, 1]
    np.testing.assert_allclose(long.std() / short.std(), 2.0, rtol=0.1)


def test_a_recording_without_enough_stretches_is_refused(source):
    with pytest.raises(InputError, match="no stretch of 300 in-map frames"):
        make_logs(source, Plan(5, stretch=(300, 320)), 0)


def test_a_folder_holds_the_trials_and_their_truth(source, logs, tmp_path):
    write_logs(source, logs, tmp_path / "data")
    seen = load_observations(tmp_path / "data")
    assert seen.trial_frames == TRIAL_FRAMES
    assert len(seen.t_s) == TRIAL_FRAMES * len(logs)
    np.testing.assert_allclose(np.diff(seen.t_s), 0.5)
    assert "made up" in seen.notes
    assert any("simulated odometry" in note for note in seen.notes)
    jumps = read_table(tmp_path / "data/truth/kidnaps.csv", "kidnaps")
    assert len(jumps["log"]) == sum(len(log.kidnaps) for log in logs)
    header = (tmp_path / "data/truth/kidnaps.csv").read_text().splitlines()[0]
    assert header.split(",")[:2] == ["log", "frame"]
    truth = read_table(tmp_path / "data/truth/query_poses.csv", "query_poses")
    rows = np.concatenate([log.rows for log in logs])
    np.testing.assert_allclose(truth["x_m"], source.query_poses[rows, 1], atol=1e-4)
    assert seen.descriptors is not None
    assert seen.descriptors[1].dtype == np.float16


def test_retrieval_lists_stay_lists(source, logs, tmp_path):
    index = np.arange(200 * 5, dtype=np.int32).reshape(200, 5) % 220
    similarity = np.tile(np.linspace(0.9, 0.1, 5, dtype=np.float32), (200, 1))
    lists = Source(source.map_poses, source.query_poses, None, None, (index, similarity), ())
    write_logs(lists, logs, tmp_path / "data")
    seen = load_observations(tmp_path / "data")
    assert seen.retrievals is not None
    np.testing.assert_array_equal(seen.retrievals.index[:160], index[logs[0].rows])


def test_a_folder_is_read_back_as_a_source(source, tmp_path):
    back = folder_source(write_source(tmp_path / "data", source))
    np.testing.assert_allclose(back.query_poses, source.query_poses, atol=1e-5)
    np.save(tmp_path / "data/query/descriptors.npy", source.query_views[0][:-1])
    with pytest.raises(InputError, match="199 rows"):
        folder_source(tmp_path / "data")


def test_the_place_seen_lies_within_the_cap_of_the_truth():
    config = WorldConfig(n_map=300, n_query=150, offset_cap_m=4.0)
    world = world_source(config, 0)
    assert world.seen_m is not None
    gap = np.hypot(*(world.query_poses[:, 1:3] - world.seen_m).T)
    assert gap.max() <= 4.0 + 0.01
    assert gap.mean() > 3.0


@pytest.mark.parametrize("body", ["0", "-3", "7", "2.0", '"x"', "true"])
def test_an_odd_trial_length_is_refused(body, tmp_path, source):
    folder = write_source(tmp_path / "data", source)
    (folder / "about.toml").write_text(f"trial_frames = {body}\n")
    if body == "true":
        with pytest.raises(InputError, match="trial_frames is True"):
            load_observations(folder)
        return
    with pytest.raises(InputError, match="trial_frames"):
        load_observations(folder)


FLAGS = ["--window", "6", "--branches", "5", "--r-in", "8", "--no-progress"]


@pytest.fixture(scope="module")
def done(tmp_path_factory, source):
    folder = tmp_path_factory.mktemp("kidnap")
    write_source(folder / "data", source)
    words = ["--trials", "4", "--rival-trials", "0", "--association", "rank", *FLAGS]
    words += ["--out", str(folder / "run")]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["kidnap", str(folder / "data"), *words]) == 0
    return folder / "run", said.getvalue()


def test_the_command_writes_every_file(done):
    out, said = done
    for name in (
        "manifest.json", "config.toml", "recovery.csv", "reentry.csv", "report.html",
        "tables/recovery.md", "tables/recovery.tex", "figures/recovery.png", "figures/recovery.svg",
        "figures/recovery.csv", "figures/example.png", "trials-0/signals.csv",
        "data/trials-0/truth/kidnaps.csv",
    ):  # fmt: skip
        assert (out / name).stat().st_size > 0, name
    assert "real views, simulated odometry" in said
    manifest = json.loads((out / "manifest.json").read_text())
    assert set(manifest["runs"]) == {"trials-0", "trials-1", "recorded"}
    assert "<script src" not in (out / "report.html").read_text()


def test_recovery_csv_begins_with_the_columns_of_the_contract(done):
    with (done[0] / "recovery.csv").open() as file:
        rows = list(csv.DictReader(file))
    head = "method,drift,trials,recovered,median_frames,p95_frames,median_m,p95_m"
    assert list(rows[0])[:9] == [*head.split(","), "wrong_accepted_frames"]
    assert None not in rows[0], "a cell holds a comma"
    keys = [(row["method"], row["drift"]) for row in rows]
    assert len(keys) == len(set(keys))
    kinds = ("now", "final", "tao", "tao_rank")
    assert {(kind, level) for kind in kinds for level in LEVELS} == set(keys)
    for row in rows:
        assert int(row["trials"]) >= 4
        assert 0.0 <= float(row["recovered"]) <= 1.0


def test_reentry_finds_the_one_return(done):
    with (done[0] / "reentry.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["trials"] for row in rows if row["method"] == "tao"] == ["1"]


def fails(capsys, code, *words):
    assert main(["kidnap", *words]) == code
    line = capsys.readouterr().err.strip()
    assert "Traceback" not in line
    return line


def test_bad_input_is_one_line_and_an_exit_code(tmp_path, source, capsys):
    folder = write_source(tmp_path / "data", source)
    out = ["--out", str(tmp_path / "run"), *FLAGS]
    assert "no such data folder" in fails(capsys, 3, str(tmp_path / "none"), *out)
    assert "--trials" in fails(capsys, 2, str(folder), "--trials", "0", *out)
    assert "--basin" in fails(capsys, 3, str(folder), "--basin", "60", *out)
    few = ["--r-in", "0.001", "--out", str(tmp_path / "run"), "--no-progress"]
    assert "--r-in" in fails(capsys, 3, str(folder), *few)
    (folder / "truth/query_poses.csv").unlink()
    assert "query_poses.csv" in fails(capsys, 3, str(folder), *out)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/x").write_text("x")
    assert "already holds" in fails(capsys, 3, str(folder), "--out", str(tmp_path / "taken"))
