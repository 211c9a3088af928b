"""One drive that is its own map: who knows what, the future, right and wrong, the graph."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop, motions, table

from taojax.audit import own_map as judge
from taojax.audit.graph import _laid
from taojax.cli import main
from taojax.config import Config, StreamConfig, VerdictConfig
from taojax.core.belief import combined, predict, read, uninformed, weigh
from taojax.datasets.own_map import write_own_map
from taojax.drive import known_frames
from taojax.errors import InputError
from taojax.files.pose_graph_io import build_graph, g2o_text, read_verdicts
from taojax.files.records import read_run
from taojax.files.tables import read_frames, read_table
from taojax.graph.answers import read_answers
from taojax.runtime import growing
from taojax.runtime.maps import map_tables
from taojax.runtime.observations import Observations, load_observations

HAS_GTSAM = importlib.util.find_spec("gtsam") is not None
needs_gtsam = pytest.mark.skipif(not HAS_GTSAM, reason="GTSAM is not installed")
CONFIG = Config(stream=StreamConfig(window=6, branches=5, association="rank"))
FLAGS = ["--window", "6", "--branches", "5", "--association", "rank", "--no-progress"]
"""Rank compiles in a fraction of the time; what is tested does not depend on it."""
N_LAP, N_LAPS, DIM, GAP_M = 84, 3, 16, 40.0


def write_drive(folder, rng, n_laps=N_LAPS, yaw_noise=0.004):
    """Write one drive of some laps, with odometry that drifts; return its true poses."""
    truth = np.tile(loop(N_LAP), (n_laps, 1))
    truth[:, :2] += rng.normal(0, 0.2, (len(truth), 2))
    odometry = motions(truth)
    odometry[1:] += rng.normal(0, 1, (len(truth) - 1, 3)) * [0.03, 0.03, yaw_noise]
    codes = np.tile(rng.normal(size=(N_LAP, DIM)), (n_laps, 1))
    t = np.arange(len(truth))
    table(folder / "query/odometry.csv", "t_s,dx_m,dy_m,dtheta_rad", np.c_[t, odometry])
    table(folder / "truth/query_poses.csv", "t_s,x_m,y_m,theta_rad", np.c_[t, truth])
    seen = codes + rng.normal(0, 0.3, codes.shape)
    np.save(folder / "query/descriptors.npy", seen.astype(np.float32))
    return truth


@pytest.fixture(scope="module")
def audited(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    write_drive(folder / "drive", np.random.default_rng(5))
    radii = ["--r-in", "5", "--r-out", "10"]
    flags = ["--self", "--gap-m", str(GAP_M), "--out", str(folder / "run"), *radii, *FLAGS]
    assert main(["audit", str(folder / "drive"), *flags]) == 0
    return folder


# What a frame knows


def test_a_frame_knows_what_lies_the_gap_behind_it():
    odometry = np.zeros((6, 3))
    odometry[:, 0] = [9.0, 1.0, 1.0, 0.0, 2.0, 1.0]  # row 0 does not count
    assert known_frames(odometry, 2.0).tolist() == [0, 0, 1, 1, 4, 4]
    assert known_frames(odometry, 100.0).tolist() == [0] * 6


def test_no_list_names_a_frame_that_its_block_does_not_know(audited):
    observations = load_observations(audited / "run/data", may_be_own=True)
    cut = growing.blocks(observations.odometry, GAP_M)
    known = known_frames(observations.odometry, GAP_M)
    index = read_run(audited / "run").index
    for block in cut:
        assert block.n_known <= known[block.first]
        assert index[block.first : block.end].max() < max(block.n_known, 0) or not block.n_known
    assert (index[: cut[1].first] == -1).all()
    assert (index[-1] >= 0).any()


def shortened(observations, n):
    descriptors = tuple(rows[:n] for rows in observations.descriptors)
    poses = {name: column[:n] for name, column in observations.map_poses.items()}
    return Observations(
        map_poses=poses, t_s=observations.t_s[:n], odometry=observations.odometry[:n],
        descriptors=descriptors, retrievals=None, notes=(), sha256={},
        own_gap_m=observations.own_gap_m,
    )  # fmt: skip


def replayed(observations):
    cut = growing.blocks(observations.odometry, GAP_M)
    lists = growing.candidates(observations, cut)
    return growing.replay_growing(CONFIG, observations, cut, lists)


def test_what_comes_after_the_lag_changes_no_bit(audited):
    whole = load_observations(audited / "run/data", may_be_own=True)
    n = 213
    a, b = replayed(whole), replayed(shortened(whole, n))
    for name, values in b.now.items():
        np.testing.assert_array_equal(a.now[name][:n], values, err_msg=name)
    for name, values in b.record.signals.items():
        np.testing.assert_array_equal(a.record.signals[name][:n], values, err_msg=name)
    final = n - CONFIG.verdict.lag
    for name, values in b.delayed.items():
        np.testing.assert_array_equal(a.delayed[name][:final], values[:final], err_msg=name)
    # And what comes within the lag does.
    assert any(
        not np.array_equal(a.delayed[name][final:n], values[final:])
        for name, values in b.delayed.items()
    )


def test_frames_that_know_nothing_are_answered_by_nobody(audited):
    verdicts = read_table(audited / "run/verdicts.csv", "verdicts")
    first = growing.blocks(load_observations(audited / "run/data", may_be_own=True).odometry, GAP_M)
    n = sum(block.end - block.first for block in first if not block.n_known)
    assert n > 0
    assert set(verdicts["verdict"][:n]) == {"abstain"}
    assert np.isnan(verdicts["x_m"][:n]).all()


def test_padding_changes_no_belief(rng):
    config = VerdictConfig()
    plain = map_tables(np.c_[loop(60)], None)
    more = growing.padded(plain)
    assert more.places.grid.xy.shape[0] == growing.LEAST_PADDED
    found = []
    for tables in (plain, more):
        places, m = tables.places, tables.places.grid.xy.shape[0]
        belief = uninformed(config, m, places.n_known)
        for motion, index in ((2.0, 7), (2.5, 8), (2.0, 9)):
            belief = predict(config, places, belief, jnp.array([motion, 0.1, 0.1]))
            belief = weigh(belief, jnp.array([index, -1]), jnp.array([2.0, 0.0]))
        backward = uninformed(config, m, places.n_known)
        both = combined(config, belief, backward, places.n_known)
        assert float(jnp.sum(belief.mass[:, 60:])) == 0.0
        found.append((both.mass[:, :60], both.off, read(config, places, both, jnp.zeros(3))))
    for a, b in zip(*(jax.tree.leaves(part) for part in found), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


# Right and wrong


def test_an_answer_moves_along_with_the_place_that_it_names():
    drive = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    truth = np.array([[5.0, 5.0, np.pi / 2], [5.0, 15.0, np.pi / 2]])
    pose = np.array([[12.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    got = judge.placed(pose, np.array([1, -1]), drive, truth)
    np.testing.assert_allclose(got[0], [5.0, 17.0, np.pi / 2])
    assert np.isnan(got[1]).all()


def test_the_nearest_place_is_among_those_that_are_known():
    odometry = np.tile([1.0, 0.0, 0.0], (4, 1))
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, 0.5]])
    got = judge.nearest_known(xy, odometry, 2.0)
    assert got.tolist() == [judge.NOWHERE_M, judge.NOWHERE_M, 2.0, 0.5]


def test_drift_makes_no_answer_wrong(audited):
    run = read_run(audited / "run")
    truth = read_table(audited / "run/data/truth/query_poses.csv", "query_poses")
    verdicts = read_table(audited / "run/verdicts.csv", "verdicts")
    accepted = (verdicts["verdict"] == "accept") & (np.arange(len(truth["x_m"])) > 130)
    assert accepted.sum() > 20
    last = np.flatnonzero(accepted)
    xy = np.c_[verdicts["x_m"], verdicts["y_m"]][last]
    away = np.hypot(*(xy - np.c_[truth["x_m"], truth["y_m"]][last]).T)
    # In odometry's own frame the answers lie elsewhere; relative to their places they are right.
    assert np.median(away) > 1.0
    table_ = read_table(audited / "run/tables/verdicts.csv", "verdict_table")
    assert table_["wrong_share"][list(table_["verdict"]).index("final")] <= 0.05
    labels = read_frames(audited / "run/labels.csv", "labels", len(truth["x_m"]))
    assert set(labels["label"][: N_LAP - 10]) == {"map_out"}
    assert (labels["label"][2 * N_LAP :] == "in_map").all()
    assert run.manifest["own_gap_m"] == GAP_M


# The graph


def test_closures_are_edges_between_two_frames_of_the_drive(audited, capsys):
    assert main(["closures", str(audited / "run")]) == 0
    assert "are the drive's frames" in capsys.readouterr().out
    lines = [line.split() for line in (audited / "run/closures.g2o").read_text().splitlines()]
    n = N_LAP * N_LAPS
    assert [int(line[1]) for line in lines if line[0] == "VERTEX_SE2"] == list(range(n))
    edges = np.array([line[1:] for line in lines if line[0] == "EDGE_SE2"], float)
    apart = edges[:, 1] - edges[:, 0]
    assert (apart == 1).sum() == n - 1
    run = read_run(audited / "run")
    graph = build_graph(audited / "run", run, read_verdicts(audited / "run", run))
    assert (apart > 1).sum() == len(graph.rows("accept")) > 20
    assert g2o_text(graph, "reject").count("VERTEX_SE2") == n


@needs_gtsam
def test_closures_bring_a_drive_back_to_itself_and_all_methods_are_told(audited, capsys):
    assert main(["graph", str(audited / "run")]) == 0
    said = capsys.readouterr().out
    assert "drifts as its odometry does" in said
    got = read_table(audited / "run/tables/graph.csv", "graph")
    row = {name: at for at, name in enumerate(got["method"])}
    assert len(row) == 11
    run = read_answers(audited / "run", read_run(audited / "run"))
    assert run.is_own
    truth = read_table(audited / "run/data/truth/query_poses.csv", "query_poses")
    xy = np.c_[truth["x_m"], truth["y_m"]]
    alone = np.hypot(*(_laid(run.map_pose[:, :2], xy) - xy).T)
    alone = float(np.sqrt(np.mean(alone[-100:] ** 2)))
    assert got["rmse_m"][row["ours"]] < 0.7 * alone
    assert got["off_share"][row["ours"]] <= got["off_share"][row["oracle"]] + 0.05


def test_a_path_that_floats_is_laid_on_the_truth(rng):
    truth = rng.normal(size=(30, 2)) * 10
    c, s = np.cos(0.7), np.sin(0.7)
    path = (truth - [3.0, 4.0]) @ np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(_laid(path, truth), truth, atol=1e-9)


# The folder


def test_two_drives_are_joined_and_the_folder_says_so(data_folder, tmp_path):
    notes = write_own_map(data_folder, tmp_path / "own", 30.0)
    assert any("two drives joined" in note for note in notes)
    found = load_observations(tmp_path / "own", may_be_own=True)
    assert len(found.odometry) == len(found.map_poses["t_s"]) == 60 + 50
    assert (np.diff(found.t_s) > 0).all()
    assert found.own_gap_m == 30.0


def fails(capsys, code, *words):
    assert main(list(words)) == code
    line = capsys.readouterr().err.strip().splitlines()[-1]
    return line


def test_what_cannot_be_is_refused_in_one_line(audited, data_folder, tmp_path, capsys):
    own = str(audited / "run/data")
    with pytest.raises(InputError, match="only audit, score"):
        load_observations(audited / "run/data")
    line = fails(capsys, 3, "explain", str(audited / "run"), "--frame", "100")
    assert "no single map explains" in line
    assert "--gap-m goes with --self" in fails(capsys, 2, "audit", own, "--gap-m", "3")
    assert "name it" in fails(capsys, 2, "audit", "--self")
    (data_folder / "truth/query_poses.csv").unlink()
    line = fails(capsys, 3, "audit", str(data_folder), "--self")
    assert "true poses" in line
    with pytest.raises(InputError, match="can only be joined"):
        write_own_map(data_folder, tmp_path / "x", 30.0)
    line = fails(capsys, 2, "convert", "self", own, str(tmp_path / "y"), "--gap-m", "-1")
    assert "must be positive" in line
    (data_folder / "about.toml").write_text("own_gap_m = -3\n")
    assert "own_gap_m is -3" in fails(capsys, 3, "score", str(data_folder))
