"""The command line: exit codes, one-line errors, and every file of the contract."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

from taojax.cli import main
from taojax.files.records import signal_names
from taojax.files.specs import column_names

FLAGS = ["--window", "6", "--branches", "5", "--association", "rank", "--no-progress"]
"""Rank compiles in a fraction of the time; what is tested does not depend on it."""
VERBS = (
    "audit", "score", "evaluate", "simulate", "kidnap", "sweep", "bench", "export", "convert",
    "describe", "inspect",
    "compare", "doctor", "rerun",
    "closures", "explain", "graph", "view", "watch",
)  # fmt: skip


def fails(capsys, code, *words):
    """Run a command that must fail with one line; return the line."""
    try:
        got = main(list(words))
    except SystemExit as stop:
        got = stop.code
    captured = capsys.readouterr()
    assert got == code, captured.err
    assert "Traceback" not in captured.err
    return captured.err.strip()


@pytest.mark.parametrize("verb", VERBS)
def test_help_shows_an_example_and_imports_neither_jax_nor_equinox(verb):
    code = (
        "import sys\nfrom taojax.cli import main\n"
        f"try:\n    main([{verb!r}, '--help'])\n"
        "except SystemExit as stop:\n    assert not stop.code\n"
        "print([m for m in sys.modules if m in ('jax', 'equinox', 'pandas', 'matplotlib')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert f"Example: taojax {verb}" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, taojax; print([m for m in sys.modules if m in ('jax', 'pandas')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_score_seals_a_run_with_every_column(data_folder, tmp_path):
    out = tmp_path / "run"
    assert main(["score", str(data_folder), "--out", str(out), *FLAGS]) == 0
    assert {path.name for path in out.iterdir()} == {
        "manifest.json",
        "config.toml",
        "map_poses.csv",
        "odometry.csv",
        "retrievals.npz",
        "signals.csv",
        "delayed.csv",
        "decisions.csv",
        "detector.toml",
    }
    lines = (out / "signals.csv").read_text().splitlines()
    header = ["frame", "t_s", "status", "map_index", "x_m", "y_m", "theta_rad", *signal_names()]
    assert lines[0].split(",")[: len(header)] == header
    assert all(name.startswith("now_") for name in lines[0].split(",")[len(header) :])
    assert len(lines) == 51
    for name, spec in (("signals", "signals"), ("delayed", "delayed"), ("decisions", "verdicts")):
        rows = (out / f"{name}.csv").read_text().splitlines()
        assert tuple(rows[0].split(",")) == column_names(spec)
        assert len(rows) == 51
    with np.load(out / "retrievals.npz") as arrays:
        assert arrays["index"].shape == arrays["similarity"].shape == (50, 100)


def test_config_of_a_run_runs_again_to_the_same_seal(data_folder, tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    assert main(["score", str(data_folder), "--out", str(a), *FLAGS]) == 0
    again = ["--config", str(a / "config.toml"), "--no-progress"]
    assert main(["score", str(data_folder), "--out", str(b), *again]) == 0
    assert (a / "signals.csv").read_bytes() == (b / "signals.csv").read_bytes()


def test_flags_win_over_the_config_file(data_folder, tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("seed = 3\n[stream]\nwindow = 9\nbranches = 4\n")
    words = ["--config", str(path), "--window", "7", "--no-progress"]
    assert main(["score", str(data_folder), "--out", str(tmp_path / "run"), *words]) == 0
    text = (tmp_path / "run" / "config.toml").read_text()
    assert "window = 7" in text
    assert "branches = 4" in text
    assert "seed = 3" in text


def test_audit_leaves_every_file_of_the_contract(data_folder, tmp_path, capfd):
    out = tmp_path / "run"
    words = ["--out", str(out), "--r-in", "3", "--r-out", "6", *FLAGS]
    assert main(["audit", str(data_folder), *words]) == 0
    for name in (
        "manifest.json", "config.toml", "map_poses.csv", "retrievals.npz", "signals.csv",
        "delayed.csv", "decisions.csv", "detector.toml", "calibration.toml",
        "labels.csv", "verdicts.csv", "metrics.csv", "tables/recall.csv", "tables/micro.csv",
        "tables/verdicts.csv", "tables/risk_coverage.csv", "report.html",
    ):  # fmt: skip
        assert (out / name).stat().st_size > 0, name
    assert any((out / "figures").glob("*.png"))
    assert any((out / "figures").glob("*.svg"))
    rows = (out / "metrics.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == [
        *signal_names(), "probability_wrong_now", "probability_wrong", "single_view",
        "joint_features", "fused",
    ]  # fmt: skip
    assert "r_in_m = 3.0" in (out / "config.toml").read_text()
    page = (out / "report.html").read_text()
    assert "<script src" not in page
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_a_calibration_file_carries_the_verdicts_to_run_time(data_folder, tmp_path, capfd):
    audited, scored = tmp_path / "audited", tmp_path / "scored"
    words = ["--out", str(audited), "--r-in", "3", "--r-out", "6", *FLAGS]
    assert main(["audit", str(data_folder), *words]) == 0
    carried = ["--calibration", str(audited / "calibration.toml"), "--out", str(scored), *FLAGS]
    assert main(["score", str(data_folder), *carried]) == 0
    judged = [row.split(",") for row in (audited / "verdicts.csv").read_text().splitlines()[1:]]
    decided = [row.split(",") for row in (scored / "decisions.csv").read_text().splitlines()[1:]]
    assert [row[1] for row in decided] == [row[1] for row in judged]
    assert [float(r[3]) for r in decided] == pytest.approx([float(r[3]) for r in judged], abs=1e-6)
    assert [row[8] for row in decided] == [row[8] for row in judged]
    assert "next:   taojax closures" in capfd.readouterr().err
    truth = str(data_folder)
    assert main(["evaluate", str(scored), "--truth", truth, "--r-in", "3", "--r-out", "6"]) == 0
    (tmp_path / "truth.tum").write_text("0 1 2 0 0 0 0 1\n")
    assert main(["evaluate", str(scored), "--truth", str(tmp_path / "truth.tum")]) == 3
    want = f"`taojax convert files {data_folder} --query-poses {tmp_path}/truth.tum`"
    assert want in capfd.readouterr().err
    said = re.sub(r"<[^>]*>", "", (scored / "report.html").read_text())
    n_accepted = sum(row[1] == "accept" for row in decided)
    first = re.search(
        r"Decided at run time.* (\d+) were accepted at the right place and (\d+) at a wrong", said
    )
    assert first is not None
    assert int(first[1]) + int(first[2]) == n_accepted
    # The judge, who knows this place, is now asked first.
    assert main(["closures", str(scored)]) == 0
    assert "verdicts of verdicts.csv on 50 frames" in capfd.readouterr().out
    raw = bytearray((scored / "decisions.csv").read_bytes())
    raw[-3] ^= 1
    (scored / "decisions.csv").write_bytes(raw)
    assert main(["evaluate", str(scored), "--truth", truth]) == 3
    assert "decisions.csv: seal broken" in capfd.readouterr().err


def test_a_calibration_of_the_first_version_is_exit_3_with_one_line(data_folder, tmp_path, capsys):
    old = tmp_path / "old.toml"
    old.write_text('columns = ["tao"]\nmean = [0.5]\nscale = [1.0]\nweight = [1.0]\nbias = 0.0\n'
                   'threshold = 0.5\nnote = "made up"\n')  # fmt: skip
    out = tmp_path / "run"
    words = ["--calibration", str(old), "--out", str(out)]
    for line in (
        fails(capsys, 3, "score", str(data_folder), *words),
        fails(capsys, 3, "watch", str(data_folder), *words[:2]),
    ):
        assert "old.toml: is a calibration of taojax 0.1.0" in line
        assert "\n" not in line
    assert not out.exists()


def test_a_broken_seal_is_exit_3_with_one_line(data_folder, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["score", str(data_folder), "--out", str(out), *FLAGS]) == 0
    capsys.readouterr()
    raw = bytearray((out / "signals.csv").read_bytes())
    raw[-9] ^= 1
    (out / "signals.csv").write_bytes(raw)
    truth = str(data_folder / "truth")
    line = fails(capsys, 3, "evaluate", str(out), "--truth", truth)
    assert "seal broken" in line
    assert "\n" not in line


def test_a_taken_out_is_exit_3_and_nothing_is_lost(data_folder, tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("keep")
    for verb in ("score", "audit"):
        line = fails(capsys, 3, verb, str(data_folder), "--out", str(tmp_path / "run"), *FLAGS)
        assert "already holds" in line
    assert (tmp_path / "run" / "mine.txt").read_text() == "keep"


def test_bad_input_is_exit_3_with_one_line(data_folder, tmp_path, capsys):
    (data_folder / "map/poses.csv").write_text("t_s,x_m\n")
    line = fails(capsys, 3, "score", str(data_folder), "--out", str(tmp_path / "run"))
    assert line.startswith("taojax: ")
    assert "poses.csv" in line
    assert "\n" not in line
    assert not (tmp_path / "run").exists()


def test_a_bad_config_file_is_exit_3(data_folder, tmp_path, capsys):
    (tmp_path / "c.toml").write_text("[stream]\nwindow = 1\n")
    line = fails(capsys, 3, "score", str(data_folder), "--config", str(tmp_path / "c.toml"))
    assert "c.toml" in line
    assert "window" in line


@pytest.mark.parametrize(
    "words",
    [
        ("score",),
        ("fly",),
        ("score", "x", "--window", "2"),
        ("score", "x", "--window", "many"),
        ("score", "x", "--association", "best"),
        ("audit", "x", "--scenario", "h3"),
        ("audit", "x", "--r-in", "-4"),
        ("audit", "x", "--max-wrong", "1"),
        ("score", "x", "--lag", "-1"),
        ("watch", "x", "--max-wrong", "0"),
    ],
)
def test_usage_errors_are_exit_2(words, data_folder, capsys):
    fails(capsys, 2, *(str(data_folder) if word == "x" else word for word in words))


@pytest.mark.parametrize("verb", ["audit", "score"])
def test_all_that_a_folder_lacks_is_named_at_once(verb, tmp_path, capsys):
    line = fails(capsys, 3, verb, str(tmp_path), "--out", str(tmp_path / "run"))
    wanted = ["map/poses.csv", "query/odometry.csv", "map/descriptors.npy"]
    assert all(name in line for name in wanted)
    assert ("truth/query_poses.csv" in line) == (verb == "audit")


def test_auditing_without_truth_says_what_to_do(data_folder, tmp_path, capsys):
    (data_folder / "truth/query_poses.csv").unlink()
    line = fails(capsys, 3, "audit", str(data_folder), "--out", str(tmp_path / "run"))
    assert "query_poses.csv" in line
    assert "taojax score" in line


def test_a_surprise_is_exit_1(data_folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("taojax.runtime.score.score", lambda *a, **k: 1 / 0)
    assert main(["score", str(data_folder), "--out", str(tmp_path / "run")]) == 1
    assert "internal error" in capsys.readouterr().err


def test_an_interrupt_is_exit_130(data_folder, tmp_path, monkeypatch):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("taojax.runtime.score.score", stop)
    assert main(["score", str(data_folder), "--out", str(tmp_path / "run")]) == 130


def test_simulate_writes_a_folder_that_scores(tmp_path):
    world = tmp_path / "world"
    assert main(["simulate", str(world), "--scenario", "h3"]) == 0
    assert main(["score", str(world), "--out", str(tmp_path / "run"), *FLAGS]) == 0
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert any("simulated" in note for note in manifest["notes"])


def test_a_reader_that_has_seen_enough_is_no_error(data_folder):
    words = [sys.executable, "-c", "from taojax.cli import main; raise SystemExit(main())"]
    words += ["inspect", str(data_folder), "--no-progress"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        child.stdout.close()
        assert child.stderr.read() == b""
    assert child.returncode == 0
