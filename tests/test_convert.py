"""`taojax convert`: flags, plain folders, odometry and views from files, one-command audits."""

import json
import subprocess
import sys

import foreign
import numpy as np
import pytest
from conftest import motions, write_folder

from taojax.cli import main
from taojax.datasets.trajectory import integrate
from taojax.files.tables import read_table
from taojax.runtime.observations import load_observations

SETS = ("sthereo", "kri", "mulran", "complex-urban", "robotcar", "vivid", "folder", "files")
FLAGS = ["--window", "6", "--branches", "5", "--association", "rank", "--no-progress"]
"""Rank compiles in a fraction of the time; what is tested does not depend on it."""


@pytest.fixture
def drives(tmp_path):
    """Two folders of one drive each; the query knows its odometry."""
    mapped = foreign.plain(tmp_path / "monday")
    return mapped, foreign.plain(tmp_path / "tuesday", left_m=1.0, n=40, odometry=True)


def convert(*words):
    return main(["convert", *map(str, words)])


def line_of(capsys, code, *words):
    """Run a command that must fail with one line; return the line."""
    try:
        got = main(list(map(str, words)))
    except SystemExit as stop:
        got = stop.code
    captured = capsys.readouterr().err.strip()
    assert got == code, captured
    return captured


def table(path, spec):
    return np.stack(list(read_table(path, spec).values()), axis=1)


def test_help_of_every_set_shows_an_example_and_imports_nothing_heavy():
    code = (
        "import sys\nfrom taojax.cli import main\n"
        f"for words in [[], *([name] for name in {SETS!r})]:\n"
        "    try:\n        main(['convert', *words, '--help'])\n"
        "    except SystemExit as stop:\n        assert not stop.code\n"
        "print([m for m in sys.modules if m in ('jax', 'numpy', 'pandas', 'matplotlib')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for name in SETS:
        assert f"Example: taojax convert {name}" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ([], ["--map-descriptors", "--query-descriptors", "--simulate-descriptors"]),
        (["--query-descriptors", "q.npy"], ["--query-descriptors", "--map-descriptors"]),
        (
            ["--simulate-descriptors", "--map-descriptors", "m.npy"],
            ["--simulate-descriptors", "--map-descriptors"],
        ),
        (["--simulate-descriptors", "--spacing-m", "2", "--map-frames", "9"], ["--spacing-m"]),
        (["--simulate-descriptors", "--spacing-m", "-2"], ["--spacing-m"]),
        (["--simulate-descriptors", "--map-frames", "0"], ["--map-frames"]),
        (["--simulate-descriptors", "--gate-s", "0"], ["--gate-s"]),
        (["--simulate-descriptors", "--least-matched", "50"], ["--least-matched"]),
        (["--simulate-descriptors", "--seed", "-1"], ["--seed"]),
        (["--simulate-descriptors", "--odometry-kind", "tum"], ["--odometry"]),
        (["--simulate-descriptors", "--topic", "/odom"], ["--topic", "--odometry"]),
    ],
)
def test_flags_that_contradict_or_lack_are_exit_2(words, names, tmp_path, capsys):
    foreign.sthereo(tmp_path / "a")
    pair = tmp_path / "a", tmp_path / "a", tmp_path / "out"
    line = line_of(capsys, 2, "convert", "sthereo", *pair, *words)
    assert all(name in line for name in names)
    assert "\n" not in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [(), ("nuscenes", "a", "b", "c"), ("sthereo", "a")])
def test_an_unknown_set_or_a_missing_place_is_exit_2(words, capsys):
    line_of(capsys, 2, "convert", *words)


def test_a_taken_out_is_exit_3_and_nothing_is_lost(drives, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("keep")
    words = "--map", drives[0], "--simulate-descriptors"
    line = line_of(capsys, 3, "convert", "folder", drives[1], tmp_path / "out", *words)
    assert "exists already" in line
    assert (tmp_path / "out/mine.txt").read_text() == "keep"


def test_two_drives_become_a_data_folder_with_the_odometry_of_the_query(drives, tmp_path, capsys):
    out = tmp_path / "out"
    assert convert("folder", drives[1], out, "--map", drives[0], "--simulate-descriptors") == 0
    assert "40 frames" in capsys.readouterr().err
    source, made = drives[1] / "odometry.csv", out / "query/odometry.csv"
    assert table(made, "query_odometry") == pytest.approx(table(source, "query_odometry"), abs=1e-5)
    shift = table(out / "map/poses.csv", "map_poses") - table(drives[0] / "poses.csv", "map_poses")
    assert np.ptp(shift, axis=0) == pytest.approx([0, 0, 0, 0], abs=1e-5)
    truth = table(out / "truth/query_poses.csv", "query_poses")
    own = table(drives[1] / "poses.csv", "map_poses") + shift[:1]
    assert truth == pytest.approx(own, abs=1e-5)
    notes = load_observations(out).notes
    assert "odometry from odometry.csv (steps)" in notes
    assert not any("simulated odometry" in note for note in notes)


def test_one_drive_alone_is_told_to_name_its_map(drives, tmp_path, capsys):
    words = drives[1], tmp_path / "out", "--simulate-descriptors"
    assert "--map" in line_of(capsys, 2, "convert", "folder", *words)


def test_thinning_joins_the_steps_between_the_frames_that_stay(drives, tmp_path):
    out = tmp_path / "out"
    few = "--query-frames", "14", "--map-frames", "30"
    words = "--map", drives[0], "--simulate-descriptors", *few
    assert convert("folder", drives[1], out, *words) == 0
    truth = table(out / "truth/query_poses.csv", "query_poses")
    assert len(truth) == 14
    assert load_observations(out).odometry == pytest.approx(motions(truth[:, 1:]), abs=1e-4)


def test_frames_by_metres_count_a_stop_once(tmp_path):
    folder = foreign.plain(tmp_path / "a")
    rows = [line.split(",") for line in (folder / "poses.csv").read_text().splitlines()]
    stop = [[f"{float(rows[30][0]) + 0.01 * k:.6f}", *rows[30][1:]] for k in range(40)]
    foreign.write(folder / "poses.csv", [*rows[1:30], *stop, *rows[31:]], header=",".join(rows[0]))
    words = "--map", folder, "--simulate-descriptors", "--spacing-m", "8"
    assert convert("folder", folder, tmp_path / "out", *words) == 0
    xy = table(tmp_path / "out/map/poses.csv", "map_poses")[:, 1:3]
    way = np.hypot(*np.diff(xy, axis=0).T)
    assert way.min() > 7.0
    assert way.max() < 14.0


def test_odometry_of_another_program_replaces_the_own(drives, tmp_path, capsys):
    t_s = foreign.stamps(600, 0.1)
    rows = [
        [f"{t:.6f}", f"{x:.6f}", f"{y:.6f}", "0", "0", "0",
         f"{np.sin(theta / 2):.9f}", f"{np.cos(theta / 2):.9f}"]
        for t, (x, y, theta) in zip(t_s, foreign.pose_at(t_s, 1.0), strict=True)
    ]  # fmt: skip
    foreign.write(tmp_path / "vo.txt", rows, separator=" ")
    words = "--map", drives[0], "--simulate-descriptors", "--odometry", tmp_path / "vo.txt"
    out = tmp_path / "out"
    assert convert("folder", drives[1], out, *words, "--odometry-kind", "tum") == 0
    assert "odometry from vo.txt (tum)" in capsys.readouterr().err
    truth = table(out / "truth/query_poses.csv", "query_poses")
    assert load_observations(out).odometry == pytest.approx(motions(truth[:, 1:]), abs=1e-3)


def test_a_data_folder_keeps_its_views_and_what_it_says_of_itself(tmp_path, rng):
    source, out = write_folder(tmp_path / "data", rng), tmp_path / "out"
    (source / "about.toml").write_text('notes = ["laser descriptors"]\n')
    assert convert("folder", source, out, "--query-frames", "20") == 0
    kept = np.round(np.linspace(0, 49, 20)).astype(int)
    for side, rows in (("map", slice(None)), ("query", kept)):
        own = np.load(source / side / "descriptors.npy")[rows]
        assert np.array_equal(np.load(out / side / "descriptors.npy"), own)
    assert "query: laser descriptors" in load_observations(out).notes


def test_the_descriptors_of_a_benchmark_folder_are_found_by_themselves(tmp_path, rng):
    source, t_s = tmp_path / "vpr", foreign.stamps(120, 0.5)
    views = {}
    for side in ("database", "queries"):
        places = foreign.pose_at(t_s)
        names = [
            f"images/{side}/@{x:.2f}@{y:.2f}@52@S@@@{row:05d}@@@@@@@.jpg"
            for row, (x, y, _) in enumerate(places)
        ]
        # The benchmark lists and describes images by name, not by time.
        order = sorted(range(120), key=names.__getitem__)
        foreign.write(source / f"{side}_images_paths.txt", [[names[row]] for row in order])
        views[side] = rng.normal(size=(120, 8)).astype(np.float32)
        np.save(source / f"{side}_descriptors.npy", views[side][order])
    assert convert("folder", source, tmp_path / "out") == 0
    for side, own in (("map", "database"), ("query", "queries")):
        made = np.load(tmp_path / "out" / side / "descriptors.npy")
        assert np.array_equal(made, views[own])


def test_retrieval_lists_of_a_frontend_come_along(drives, tmp_path):
    index = np.tile(np.arange(4, dtype=np.int32), (40, 1))
    similarity = np.tile(np.array([0.9, 0.8, 0.7, 0.6], np.float32), (40, 1))
    np.savez(tmp_path / "lists.npz", index=index, similarity=similarity)
    words = "--map", drives[0], "--map-descriptors", tmp_path / "lists.npz"
    assert convert("folder", drives[1], tmp_path / "out", *words) == 0
    assert np.array_equal(load_observations(tmp_path / "out").retrievals.index, index)


def test_sessions_of_two_places_are_refused(tmp_path, capsys):
    foreign.sthereo(tmp_path / "a")
    rows = [[row[0], f"{float(row[1]) + 450e3:.6f}", *row[2:]] for row in foreign.sthereo_rows()]
    foreign.sthereo(tmp_path / "b")
    foreign.write(tmp_path / "b/pose/global_pose.csv", rows)
    words = tmp_path / "a", tmp_path / "b", tmp_path / "out", "--simulate-descriptors"
    line = line_of(capsys, 3, "convert", "sthereo", *words)
    assert "450 km from the first map frame" in line
    assert "one UTM zone" in line


def test_too_few_frames_are_refused(drives, tmp_path, capsys):
    words = "--map", drives[0], "--simulate-descriptors", "--spacing-m", "200"
    line = line_of(capsys, 3, "convert", "folder", drives[1], tmp_path / "out", *words)
    assert "2 of the 60 map frames stay" in line


def test_simulated_parts_follow_the_seed(drives, tmp_path):
    words = "--map", drives[0], "--simulate-descriptors", "--seed"
    (drives[1] / "odometry.csv").unlink()
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert convert("folder", drives[1], tmp_path / name, *words, seed) == 0
    files = "query/odometry.csv", "query/descriptors.npy"
    read = {n: [(tmp_path / n / f).read_bytes() for f in files] for n in "abc"}
    assert read["a"] == read["b"]
    assert all(one != other for one, other in zip(read["a"], read["c"], strict=True))


def test_one_command_audits_a_plain_folder_with_simulated_views(drives, tmp_path, capfd):
    out = tmp_path / "run"
    words = ["--map", drives[0], "--simulate-descriptors", "--r-in", "3", "--out", out, *FLAGS]
    assert main(["audit", str(drives[1]), *map(str, words)]) == 0
    for name in ("data/truth/query_poses.csv", "manifest.json", "metrics.csv", "report.html"):
        assert (out / name).stat().st_size > 0, name
    assert not (out / "scored").exists()
    manifest = json.loads((out / "manifest.json").read_text())
    assert any("simulated descriptors" in note for note in manifest["notes"])
    assert "simulated descriptors" in (out / "report.html").read_text()


@pytest.mark.parametrize("words", [["--simulate-descriptors"], ["x", "--map", "y"]])
def test_flags_of_a_simulated_audit_that_lack_something_are_exit_2(words, capsys):
    line = line_of(capsys, 2, "audit", *words)
    assert "--simulate-descriptors" in line


ROBOTCAR = "robotcar_vo/2015_05_19_14_06_38", "robotcar_vo/2014_07_14_14_49_50"


def test_real_routes_convert_with_simulated_odometry_and_views(shared, tmp_path):
    words = shared / "kaist_routes", tmp_path / "out", "--simulate-descriptors"
    assert convert("folder", *words) == 0
    seen = load_observations(tmp_path / "out")
    assert (len(seen.map_xyt), len(seen.t_s)) == (2000, 1000)
    assert any("simulated odometry" in note for note in seen.notes)


def test_real_visual_odometry_comes_through(shared, tmp_path):
    query, mapped = (shared / name for name in ROBOTCAR)
    few = "--map-frames", "500", "--query-frames", "500"
    words = "--map", mapped, "--simulate-descriptors", *few
    assert convert("folder", query, tmp_path / "out", *words) == 0
    seen = load_observations(tmp_path / "out")
    assert (len(seen.map_xyt), len(seen.t_s)) == (500, 500)
    assert not any("simulated odometry" in note for note in seen.notes)
    driven = integrate(table(query / "odometry.csv", "query_odometry")[:, 1:])
    kept = np.round(np.linspace(0, len(driven) - 1, 500)).astype(int)
    assert seen.odometry == pytest.approx(motions(driven[kept]), abs=1e-2)
