"""Closures as files: a strict g2o reader, a strict TUM reader, and evo where it is installed."""

import dataclasses
import json
import os
import re
import shutil
import subprocess

import numpy as np
import pytest
from conftest import write_folder
from judged import made_up, seal

from taojax.cli import main
from taojax.errors import InputError
from taojax.files import pose_graph_io, records
from taojax.files.tables import read_table, table_text
from taojax.risk import to_toml

FLAGS = ["--window", "6", "--branches", "5", "--lag", "4", "--no-progress"]


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """A run with verdicts of both kinds, its data folder and the calibration behind them."""
    folder = tmp_path_factory.mktemp("closures")
    data = write_folder(folder / "data", np.random.default_rng(3))
    assert main(["score", str(data), "--out", str(folder / "first"), *FLAGS]) == 0
    level = np.quantile(records.read_run(folder / "first").delayed["place"], 0.7)
    (folder / "calibration.toml").write_text(to_toml(made_up("place", middle=level)))
    words = ["--out", str(folder / "run"), "--calibration", str(folder / "calibration.toml")]
    assert main(["score", str(data), *words, *FLAGS]) == 0
    assert main(["closures", str(folder / "run")]) == 0
    return folder


@pytest.fixture(scope="module")
def run(scored):
    return scored / "run"


@pytest.fixture(scope="module")
def verdict(run):
    return records.read_run(run).decisions["verdict"]


def judged(scored, folder, seal=None):
    """Copy the run and give it the verdicts of a judge, who accepts every answer."""
    shutil.copytree(scored / "first", folder)
    sealed = records.read_manifest(folder)["seal"]
    (folder / "audit.json").write_text(json.dumps({"run_seal": seal or sealed}))
    table = records.read_run(folder).decisions
    everything = {"verdict": np.full(50, "accept"), "reason": np.full(50, "made up")}
    (folder / "verdicts.csv").write_text(table_text("verdicts", table | everything))
    shutil.copy(scored / "calibration.toml", folder)
    return folder


def read_g2o(path):
    """Read vertices and edges; anything that is not the format fails."""
    vertices, edges = {}, []
    for line in path.read_text().splitlines():
        tag, *cells = line.split(" ")
        if tag == "VERTEX_SE2":
            number, *pose = cells
            assert int(number) not in vertices
            assert len(pose) == 3
            vertices[int(number)] = np.array(pose, float)
            continue
        assert tag == "EDGE_SE2"
        assert len(cells) == 2 + 3 + 6
        values = np.array(cells[2:], float)
        upper = np.zeros((3, 3))
        upper[np.triu_indices(3)] = values[3:]
        information = upper + upper.T - np.diag(np.diag(upper))
        assert (np.linalg.eigvalsh(information) > 0).all()
        edges.append((int(cells[0]), int(cells[1]), values[:3], information))
    for a, b, *_ in edges:
        assert a in vertices
        assert b in vertices
        assert a != b
    assert all(np.isfinite(pose).all() for pose in vertices.values())
    return vertices, edges


def matrix(pose):
    x, y, theta = pose
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, x], [s, c, y], [0, 0, 1]])


def test_the_graph_holds_map_query_frames_odometry_and_the_accepted_closures(run, verdict):
    vertices, edges = read_g2o(run / "closures.g2o")
    n_map, n_query = 60, 50
    assert sorted(vertices) == list(range(n_map + n_query))
    in_map = [e for e in edges if e[1] < n_map]
    driven = [e for e in edges if e[0] >= n_map]
    closed = [e for e in edges if e[0] < n_map <= e[1]]
    assert [e[:2] for e in in_map] == [(i, i + 1) for i in range(n_map - 1)]
    assert [e[:2] for e in driven] == [(n_map + t - 1, n_map + t) for t in range(1, n_query)]
    assert [e[1] - n_map for e in closed] == np.flatnonzero(verdict == "accept").tolist()
    assert len(closed) > 10


def test_a_closure_leads_from_its_map_pose_to_the_answered_pose(run):
    vertices, edges = read_g2o(run / "closures.g2o")
    sealed = records.read_run(run)
    for a, b, motion, information in edges:
        if not a < 60 <= b:
            continue
        t = b - 60
        assert a == sealed.delayed["map_index"][t]
        want = [sealed.delayed[c][t] for c in ("x_m", "y_m", "theta_rad")]
        np.testing.assert_allclose(matrix(vertices[a]) @ matrix(motion), matrix(want), atol=1e-6)
        np.testing.assert_allclose(vertices[b], want, atol=1e-6)
        # Of the posterior within its place, turned from the map into the axes of the pose.
        held = [sealed.delayed[c][t] for c in ("var_x_m2", "cov_xy_m2", "var_y_m2")]
        c, s = np.cos(want[2]), np.sin(want[2])
        turn = np.array([[c, s], [-s, c]])
        precision = np.zeros((3, 3))
        precision[:2, :2] = np.linalg.inv(
            turn @ np.array([[held[0], held[1]], [held[1], held[2]]]) @ turn.T
        )
        precision[2, 2] = (6 / 3.0) ** 2
        np.testing.assert_allclose(information, precision, rtol=1e-6, atol=1e-6)


def test_the_table_of_closures_says_when_and_where_and_how_surely(run, verdict):
    found, sealed = read_table(run / "closures.csv", "closure_list"), records.read_run(run)
    rows = np.flatnonzero(verdict == "accept")
    assert found["frame"].tolist() == rows.tolist()
    named = sealed.decisions["map_index"][rows].astype(int)
    assert found["map_index"].tolist() == named.tolist()
    np.testing.assert_allclose(found["t_s"], sealed.signals["t_s"][rows])
    np.testing.assert_allclose(found["map_t_s"], sealed.map_poses["t_s"][named])
    for name in ("x_m", "y_m", "theta_rad", "probability_wrong"):
        np.testing.assert_allclose(found[name], sealed.decisions[name][rows], rtol=1e-6)
    # What the graph's edge holds, turned back into the axes of the map.
    _, edges = read_g2o(run / "closures.g2o")
    closed = {b - 60: information for a, b, _, information in edges if a < 60 <= b}
    for k, t in enumerate(rows.tolist()):
        own = np.linalg.inv(closed[t])
        turn = matrix([0, 0, found["theta_rad"][k]])
        there = turn @ own @ turn.T
        want = [found[name][k] for name in ("var_x_m2", "var_y_m2", "cov_xy_m2", "var_theta_rad2")]
        got = [there[0, 0], there[1, 1], there[0, 1], there[2, 2]]
        np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-6)


def test_stamps_of_the_map_keep_their_digits(run):
    sealed = records.read_run(run)
    unix = sealed.map_poses | {"t_s": 1628226000.25 + np.arange(60) * 0.5}
    verdicts = pose_graph_io.read_verdicts(run, sealed)
    made = pose_graph_io.build_graph(run, sealed, verdicts)
    text = pose_graph_io.closure_text(made, dataclasses.replace(sealed, map_poses=unix), verdicts)
    rows = [line.split(",") for line in text.splitlines()[1:]]
    assert len(rows) > 10
    assert all(float(row[3]) == unix["t_s"][int(row[2])] for row in rows)


def test_the_maps_own_edges_keep_it_as_it_is(run):
    vertices, edges = read_g2o(run / "closures.g2o")
    for a, b, motion, _ in edges[:59]:
        np.testing.assert_allclose(
            matrix(vertices[a]) @ matrix(motion), matrix(vertices[b]), atol=1e-5
        )


def test_rejected_closures_lie_in_a_file_of_their_own(run, verdict):
    _, edges = read_g2o(run / "rejected.g2o")
    closed = {b - 60 for a, b, *_ in edges if a < 60 <= b}
    assert closed <= set(np.flatnonzero(verdict == "reject").tolist())


def test_the_trajectory_holds_the_accepted_poses_and_full_stamps(run, verdict):
    table = read_table(run / "trajectory.tum", "tum")
    sealed = records.read_run(run)
    rows = np.flatnonzero(verdict == "accept")
    np.testing.assert_array_equal(table["t_s"], sealed.signals["t_s"][rows])
    np.testing.assert_allclose(table["x_m"], sealed.delayed["x_m"][rows], atol=1e-6)
    theta = 2 * np.arctan2(table["qz"], table["qw"])
    want = sealed.delayed["theta_rad"][rows]
    np.testing.assert_allclose(np.cos(theta - want), 1.0, atol=1e-9)


def test_evo_reads_the_trajectory(run, tmp_path):
    if not shutil.which("evo_traj"):
        pytest.skip("evo is not installed: python -m pip install evo")
    env = os.environ | {"HOME": str(tmp_path), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        ["evo_traj", "tum", str(run / "trajectory.tum"), "--full_check"],
        env=env, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    n = len((run / "trajectory.tum").read_text().splitlines())
    assert re.search(rf"nr\. of poses\s+{n}\b", done.stdout)
    assert "quaternions" in done.stdout
    assert "invalid" not in done.stdout.lower()


def graph(n=6, **changes):
    made = {
        "map_pose": np.zeros((3, 3)),
        "query_pose": np.zeros((n, 3)),
        "t_s": np.arange(n) + 1628226000.123456,
        "odometry": np.tile([1.0, 0.0, 0.0], (n, 1)),
        "is_start": np.arange(n) == 0,
        "pose": np.tile([5.0, 6.0, 0.5], (n, 1)),
        "map_index": np.ones(n, int),
        "verdict": np.array(["accept"] * n, dtype=object),
        "covariance": np.tile(np.diag([9.0, 9.0, 0.01]), (n, 1, 1)),
        "sigma_m": 3.0,
        "sigma_rad": 0.1,
        "spacing_m": 1.0,
    }
    return pose_graph_io.Graph(**(made | changes))


def test_unix_stamps_keep_their_digits_and_equal_ones_are_told_once():
    t_s = 1628226000.123456 + np.array([0.0, 0.1, 0.1, 0.2, 0.2, 0.3])
    lines = pose_graph_io.tum_text(graph(t_s=t_s)).splitlines()
    assert [float(line.split()[0]) for line in lines] == np.unique(t_s).tolist()


def test_between_accepted_frames_odometry_carries_on_and_each_trial_starts_alone():
    odometry = np.tile([1.0, 0.0, 0.0], (8, 1))
    known = np.full((8, 3), np.nan)
    known[2] = [10.0, 5.0, np.pi / 2]
    is_start = np.arange(8) % 4 == 0
    poses = pose_graph_io._chained(odometry, known, is_start)
    np.testing.assert_allclose(poses[:4, :2], [[10, 3], [10, 4], [10, 5], [10, 6]], atol=1e-12)
    np.testing.assert_allclose(poses[4:, :2], [[0, 0], [1, 0], [2, 0], [3, 0]], atol=1e-12)
    lines = pose_graph_io.g2o_text(graph(n=8, odometry=odometry, is_start=is_start), "accept")
    driven = [line.split()[1:3] for line in lines.splitlines() if line.startswith("EDGE")][2:8]
    assert ["6", "7"] not in driven
    assert len(driven) == 6


def test_the_covariance_of_a_closure_is_written_in_the_axes_of_its_pose(tmp_path):
    covariance = np.array([[4.0, 1.0, 0.1], [1.0, 2.0, 0.2], [0.1, 0.2, 0.3]])
    made = graph(covariance=np.tile(covariance, (6, 1, 1)))
    (tmp_path / "closures.g2o").write_text(pose_graph_io.g2o_text(made, "accept"))
    *_, information = read_g2o(tmp_path / "closures.g2o")[1][-1]
    turn = np.eye(3)
    turn[:2, :2] = matrix(made.pose[0])[:2, :2].T
    np.testing.assert_allclose(np.linalg.inv(information), turn @ covariance @ turn.T, rtol=1e-6)


def test_a_frame_without_pose_closes_nothing():
    made = graph(map_index=np.array([1, -1, 1, -1, 1, 1]))
    assert made.rows("accept").tolist() == [0, 2, 4, 5]
    assert len(pose_graph_io.tum_text(made).splitlines()) == 4


def fails(capsys, *words):
    assert main(list(words)) == 3
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    return line


def test_a_run_without_verdicts_says_what_to_do(tmp_path, capsys):
    run, _ = seal(tmp_path)
    assert "taojax evaluate" in fails(capsys, "closures", str(run))


@pytest.mark.parametrize("name", ["labels.csv", "verdicts.csv"])
@pytest.mark.parametrize("change", ["lost", "swapped"])
def test_tables_of_other_frames_are_refused_before_anything_is_written(
    name, change, scored, tmp_path, capsys
):
    folder, out = judged(scored, tmp_path / "run"), tmp_path / "elsewhere"
    labels = [f"{t},in_map,1.0,test" for t in range(50)]
    (folder / "labels.csv").write_text("\n".join(["frame,label,nearest_m,split", *labels]) + "\n")
    assert main(["closures", str(folder), "--out", str(tmp_path / "whole")]) == 0
    capsys.readouterr()
    head, *rows = (folder / name).read_text().splitlines()
    rows = rows[:-1] if change == "lost" else [rows[1], rows[0], *rows[2:]]
    (folder / name).write_text("\n".join([head, *rows]) + "\n")
    line = fails(capsys, "closures", str(folder), "--out", str(out))
    assert f"{name}: its frames are not the 50 of signals.csv" in line
    assert not out.exists()


def test_the_judge_who_knows_the_place_comes_first(scored, tmp_path, capsys):
    folder, out = judged(scored, tmp_path / "run"), tmp_path / "elsewhere"
    assert pose_graph_io.read_verdicts(folder, records.read_run(folder)).source == "verdicts.csv"
    assert main(["closures", str(folder), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "verdicts of verdicts.csv" in said
    # The first two frames have no answer that could close anything.
    assert "48 accepted closures" in said
    names = {path.name for path in out.iterdir()}
    assert names == {"closures.g2o", "closures.csv", "rejected.g2o", "trajectory.tum"}


def test_every_frame_is_counted_once(run, tmp_path, capsys):
    assert main(["closures", str(run), "--out", str(tmp_path)]) == 0
    lines = {line[:14].strip(): line[14:] for line in capsys.readouterr().out.splitlines()}
    counts = [
        int(word)
        for name in ("closures.g2o", "rejected.g2o", "left out")
        for word in lines[name].replace(",", "").split()
        if word.isdigit()
    ]
    assert len(counts) == 4
    assert sum(counts) == 50


def test_what_decided_is_sealed_with_its_decisions(run, tmp_path, capsys):
    sealed = pose_graph_io.read_verdicts(run, records.read_run(run))
    assert sealed.source == "decisions.csv"
    assert sealed.calibration.final.columns == ("place",)
    assert sealed.calibration.now.columns == ("now_place",)
    assert set(sealed.verdict) == {"accept", "reject", "abstain"}
    assert np.isfinite(sealed.probability).all()
    assert np.isnan(sealed.pose[:2]).all()
    assert np.isfinite(sealed.pose[2:]).all()
    assert np.isfinite(sealed.pose_now[2:]).all()
    assert (sealed.map_index[:2] == -1).all()
    broken = tmp_path / "run"
    shutil.copytree(run, broken)
    raw = (broken / "detector.toml").read_text()
    (broken / "detector.toml").write_text(raw.replace("bias = ", "bias = 1"))
    assert "detector.toml: seal broken" in fails(capsys, "closures", str(broken))


def test_verdicts_of_another_run_are_refused(scored, tmp_path):
    folder = judged(scored, tmp_path / "run", seal="0" * 64)
    with pytest.raises(InputError, match="another run"):
        pose_graph_io.read_verdicts(folder, records.read_run(folder))


def test_a_run_sealed_without_odometry_is_told_to_score_again(run, tmp_path):
    folder, _ = seal(tmp_path)
    verdicts, sealed = (
        pose_graph_io.read_verdicts(run, records.read_run(run)),
        records.read_run(folder),
    )
    with pytest.raises(InputError, match="score the data set again"):
        pose_graph_io.build_graph(folder, sealed, verdicts)


def test_another_share_of_wrong_ones_decides_again_and_another_lag_is_refused(
    scored, run, tmp_path, capsys
):
    counts = {}
    for share in ("0.01", "0.2"):
        words = ["--out", str(tmp_path / share), "--max-wrong", share, "--lag", "4"]
        assert main(["closures", str(run), *words]) == 0
        said = capsys.readouterr().out
        assert "decisions.csv, decided again," in said
        counts[share] = int(re.search(r"closures.g2o +(\d+) accepted", said)[1])
        again = scored / f"again{share}"
        words = ["--calibration", str(scored / "calibration.toml"), "--max-wrong", share]
        assert main(["score", str(scored / "data"), "--out", str(again), *words, *FLAGS]) == 0
        assert counts[share] == (records.read_run(again).decisions["verdict"] == "accept").sum()
    assert counts["0.01"] <= counts["0.2"]
    capsys.readouterr()
    assert main(["closures", str(run), "--lag", "7", "--out", str(tmp_path / "no")]) == 3
    assert "wait 4 frames; score the data again with --lag 7" in capsys.readouterr().err
    assert main(["closures", str(run), "--max-wrong", "1.5"]) == 2
    assert not (tmp_path / "no").exists()
