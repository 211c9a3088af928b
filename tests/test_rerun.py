"""A sealed run can be made again: across processes, threads and devices, and by `taojax rerun`."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import ALONE, write_folder
from judged import made_up

from taojax.cli import main, rerun
from taojax.config import Config, StreamConfig, VerdictConfig, to_toml
from taojax.files import records
from taojax.risk import to_toml as calibration_toml
from taojax.runtime.score import score

SMALL = Config(
    stream=StreamConfig(window=6, branches=5),
    verdict=VerdictConfig(lag=4, window_frames=4),
)

PROCESSES = {
    "another process": {},
    "one thread": {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "ONE_CORE": "1"},
    "eight devices": {"XLA_FLAGS": "--xla_force_host_platform_device_count=8"},
}

SCORE = """
import os, sys
from pathlib import Path
if os.environ.get("ONE_CORE") and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax

from taojax.config import from_toml
from taojax.runtime.score import score
data, out, config = map(Path, sys.argv[1:])
score(data, out, from_toml(config))
print(jax.device_count(), len(os.sched_getaffinity(0)))
"""

PATIENCE_S = 600
"""For a machine that does other things too."""


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A data folder `data`, its sealed run `run`, and a calibration that can decide."""
    home = tmp_path_factory.mktemp("home")
    write_folder(home / "data", np.random.default_rng(5))
    score(home / "data", home / "run", SMALL)
    (home / "calibration.toml").write_text(calibration_toml(made_up("place", middle=-9.0)))
    return home


@pytest.fixture
def copy(home, tmp_path):
    """A copy of the sealed run, to be forged."""
    return shutil.copytree(home / "run", tmp_path / "run")


@pytest.fixture(scope="module")
def elsewhere(home, tmp_path_factory):
    """The same data scored in other processes, all at once: name -> (run, what it printed)."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "config.toml").write_text(to_toml(SMALL))
    children = {}
    for name, env in PROCESSES.items():
        words = [str(home / "data"), str(folder / name), str(folder / "config.toml")]
        children[name] = subprocess.Popen(
            [sys.executable, "-W", "error", "-c", SCORE, *words],
            env=os.environ | ALONE | env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    try:
        said = {name: child.communicate(timeout=PATIENCE_S)[0] for name, child in children.items()}
    finally:
        for child in children.values():
            child.kill()
    for name, child in children.items():
        assert child.returncode == 0, said[name]
    return {name: (folder / name, said[name].split()) for name in PROCESSES}


def forge(run, name=None, edit=None, **facts):
    """Change a file or facts of a run and seal it again, as somebody who knows the code would."""
    path = run / "manifest.json"
    manifest = json.loads(path.read_text()) | facts
    if name is not None:
        (run / name).write_bytes(edit((run / name).read_bytes()))
        manifest["sha256"][name] = records.digest_file(run / name)
    manifest["seal"] = records.seal_of(manifest)
    path.write_text(json.dumps(manifest))


def cell(row, column, change):
    """Return an edit of one cell of signals.csv; row 0 is the first frame."""

    def edit(raw):
        lines = raw.decode().splitlines()
        at = lines[0].split(",").index(column)
        cells = lines[row + 1].split(",")
        cells[at] = change(cells[at])
        lines[row + 1] = ",".join(cells)
        return ("\n".join(lines) + "\n").encode()

    return edit


def test_another_process_makes_the_same_bytes(home, elsewhere):
    run, _ = elsewhere["another process"]
    for name in (*records.SEALED, "manifest.json"):
        assert (run / name).read_bytes() == (home / "run" / name).read_bytes(), name


@pytest.mark.parametrize("name", ["one thread", "eight devices"])
def test_threads_and_devices_change_signals_by_no_more_than_the_tolerance(name, home, elsewhere):
    run, (n_devices, n_cores) = elsewhere[name]
    assert (n_devices, n_cores == "1") == (("1", True) if name == "one thread" else ("8", False))
    for file in ("signals.csv", "delayed.csv", "retrievals.npz", "map_poses.csv"):
        verdict = rerun._by_value(home / "run" / file, run / file)
        assert verdict.is_close, verdict.text


def test_a_rerun_gives_the_same_seal(home, capsys):
    assert main(["rerun", str(home / "run"), "--no-progress"]) == 0
    said = capsys.readouterr().out
    seal = records.read_manifest(home / "run")["seal"]
    assert f"seal  the same: {seal[:12]}" in said
    for name in records.SEALED:
        assert any(line.split()[0] == name and "same bytes" in line for line in said.splitlines())


def test_a_kept_rerun_is_a_run(home, tmp_path):
    out = tmp_path / "again"
    assert main(["rerun", str(home / "run"), "--out", str(out), "--no-progress"]) == 0
    assert records.read_run(out).manifest["seal"] == records.read_manifest(home / "run")["seal"]
    before = (out / "manifest.json").stat().st_mtime_ns
    assert main(["rerun", str(home / "run"), "--out", str(out), "--no-progress"]) == 3
    assert (out / "manifest.json").stat().st_mtime_ns == before


def test_a_run_with_verdicts_repeats_them(home, tmp_path, capsys):
    run = tmp_path / "decided"
    config = tmp_path / "c.toml"
    config.write_text(to_toml(SMALL))
    words = ["--calibration", str(home / "calibration.toml"), "--config", str(config)]
    words += ["--out", str(run), "--no-progress"]
    assert main(["score", str(home / "data"), *words]) == 0
    capsys.readouterr()
    assert main(["rerun", str(run), "--no-progress"]) == 0
    said = capsys.readouterr().out
    assert "decisions.csv   same bytes" in said
    assert "seal  the same" in said


def test_moved_data_are_asked_for_and_give_the_seal_but_for_their_place(home, tmp_path, capsys):
    away, run = tmp_path / "there", shutil.copytree(home / "run", tmp_path / "runs" / "run")
    shutil.copytree(home / "data", away)
    forge(run, dataset="gone", command="taojax score gone --config config.toml")
    assert main(["rerun", str(run), "--no-progress"]) == 3
    assert "not at 'gone' any more; name them with --data" in capsys.readouterr().err
    assert main(["rerun", str(run), "--data", str(away), "--no-progress"]) == 0
    assert "the same but for where the data lie" in capsys.readouterr().out


@pytest.mark.parametrize("place", ["runs/world", "runs/run/data", "runs/data/run"])
def test_data_beside_or_inside_the_run_are_found(place, home, tmp_path):
    run = shutil.copytree(home / "run", tmp_path / "runs" / "run")
    forge(run, dataset="world")
    shutil.copytree(home / "data", tmp_path / place)
    assert rerun._find(run, "world").resolve() == (tmp_path / place).resolve()


def change_odometry(data):
    path = data / "query/odometry.csv"
    path.write_text(path.read_text().replace("0.0", "0.1", 1))


def add_lists(data):
    np.savez(data / "query/retrievals.npz", index=np.zeros((45, 1), int), similarity=np.ones(1))


OTHER_DATA = {
    "an edited input": (change_odometry, "odometry.csv: sha256"),
    "a missing input": (
        lambda d: (d / "map/descriptors.npy").unlink(),
        "map/descriptors.npy: no such file",
    ),
    "an added list": (add_lists, "retrievals.npz: was not there when the run was sealed"),
    "an added note": (lambda d: (d / "about.toml").write_text("notes = []"), "about.toml: was not"),
    "no folder": (shutil.rmtree, "no such data folder"),
}


@pytest.mark.parametrize("case", OTHER_DATA)
def test_other_data_are_refused_by_name(case, home, tmp_path, capsys):
    data = shutil.copytree(home / "data", tmp_path / "data")
    spoil, said = OTHER_DATA[case]
    spoil(data)
    assert main(["rerun", str(home / "run"), "--data", str(data)]) == 3
    line = capsys.readouterr().err.strip()
    assert said in line
    assert "\n" not in line


def other_index(raw):
    import io

    with np.load(io.BytesIO(raw)) as arrays:
        index, similarity = arrays["index"].copy(), arrays["similarity"]
    index[7, 2] += 1
    held = io.BytesIO()
    np.savez_compressed(held, index=index, similarity=similarity)
    return held.getvalue()


FORGED = {
    "a signal": ("signals.csv", cell(9, "tao", lambda v: str(float(v) + 0.01)), "tao in 1 rows"),
    "a row number": ("signals.csv", cell(9, "map_index", lambda v: str(int(v) + 1)), "map_index"),
    "a status": ("signals.csv", cell(9, "status", lambda v: "degenerate"), "status in 1 rows"),
    "a blank pose": ("signals.csv", cell(9, "x_m", lambda v: ""), "x_m in 1 rows, first row 9"),
    "a stamp": ("signals.csv", cell(9, "t_s", lambda v: "9.0001"), "t_s in 1 rows, first row 9"),
    "a map pose": ("map_poses.csv", lambda raw: raw.replace(b"\n3.0,", b"\n3.5,"), "t_s in 1 rows"),
    "an answer": ("retrievals.npz", other_index, "index in 1 rows, first row 7"),
}


@pytest.mark.parametrize("what", FORGED)
def test_a_forged_run_with_a_fresh_seal_is_not_made_again(what, home, copy, capsys):
    name, edit, said = FORGED[what]
    forge(copy, name, edit)
    records.read_run(copy)  # the seal alone cannot tell
    assert main(["rerun", str(copy), "--data", str(home / "data"), "--no-progress"]) == 5
    told = capsys.readouterr()
    line = next(line for line in told.out.splitlines() if line.startswith(name))
    assert "differs" in line
    assert said in line
    assert f"not made again: {name}" in told.err


def test_last_bits_are_within_the_tolerance_that_is_named(home, copy, capsys):
    forge(copy, "signals.csv", cell(9, "tao", lambda v: str(float(v) * (1 + 1e-6))))
    assert main(["rerun", str(copy), "--data", str(home / "data"), "--no-progress"]) == 0
    said = capsys.readouterr().out
    assert "signals.csv     within tolerance (1e-05 of the column's largest" in said
    assert "in tao" in said


def test_other_code_and_versions_are_named(home, copy, capsys):
    versions = json.loads((copy / "manifest.json").read_text())["versions"] | {"jax": "0.1"}
    forge(copy, code="0" * 64, versions=versions)
    assert main(["rerun", str(copy), "--data", str(home / "data"), "--no-progress"]) == 0
    said = capsys.readouterr().out
    assert "signals.csv     same bytes" in said
    assert "seal  another" in said
    assert "code: 000000000000... then" in said
    assert "versions: jax 0.1 then" in said


NO_RUNS = {
    "a summary": ({"schema": records.SCHEMA, "scenarios": {}}, "holds several scenarios"),
    "a sweep": (
        {"schema": records.SCHEMA, "sha256": {"signals.npz": "0" * 64, "config.toml": "0" * 64}},
        "was not made by score",
    ),
    "a run of 0.1.0": (
        {"schema": 1, "sha256": {name: "0" * 64 for name in records.SEALED}},
        "was sealed by taojax 0.1.0, which had no final verdicts; score the data set again",
    ),
    "anything": ([], "is not the manifest of a run"),
}


@pytest.mark.parametrize("kind", NO_RUNS)
def test_other_folders_are_told_by_name(kind, tmp_path, capsys):
    manifest, said = NO_RUNS[kind]
    if isinstance(manifest, dict):
        manifest = manifest | {"seal": records.seal_of(manifest)}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    assert main(["rerun", str(tmp_path)]) == 3
    line = capsys.readouterr().err.strip()
    assert said in line
    assert "\n" not in line


def test_a_broken_seal_is_refused_before_anything_is_scored(copy, home, capsys):
    (copy / "signals.csv").write_text("frame\n")
    assert main(["rerun", str(copy), "--data", str(home / "data")]) == 3
    assert "signals.csv: seal broken" in capsys.readouterr().err


def tracks(n_ran, n=40):
    signal = np.r_[np.zeros(n_ran), np.full(n - n_ran, np.nan)]
    ours = records.SealedTrack(np.zeros(n), np.zeros((n, 3)), np.ones(n, bool))
    return {"tao_rank": ours} | ({"mht": ours._replace(signal=signal)} if n_ran else {})


@pytest.mark.parametrize(
    ("held", "length", "want"),
    [
        (None, None, None),
        (tracks(0), None, 0),
        (tracks(40), None, sys.maxsize),
        (tracks(20), 10, 2),
        (tracks(40), 10, 4),
    ],
)
def test_rivals_are_run_again_on_as_many_trials_as_before(held, length, want):
    run = records.Run({}, {}, {}, np.zeros(1), np.zeros(1), "", {"trial_frames": length}, held)
    assert rerun._rival_logs(run) == want
