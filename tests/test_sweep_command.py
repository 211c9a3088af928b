"""`taojax sweep`: files, exit codes, going on after an interrupt, and the wall."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import table, write_folder

from taojax.cli import main
from taojax.errors import InputError
from taojax.runtime import sweep

SMALL_GRID = """
association = ["rank"]
lambda_velocity = [0.0, 1.0]
gamma_similarity = [1.0, 10.0]
"""
FLAGS = ("--window", "6", "--branches", "5", "--no-progress", "--r-in", "3", "--r-out", "6")


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
    real, computed = sweep.evaluate, []

    def stops_after(n):
        def evaluate(signals, units, *, batch):
            for members, values in real(signals, units, batch=batch):
                if len(computed) == n:
                    raise KeyboardInterrupt
                computed.append((members, values.copy()))
                yield members, values

        return evaluate

    monkeypatch.setattr(sweep, "evaluate", stops_after(2))
    line = fails(capsys, 130, *words)
    assert "run the same command again to continue" in line
    parts = {p.name: p.stat().st_mtime_ns for p in (out / "parts").glob("*.npz")}
    assert len(parts) == 2
    (out / "parts" / "000099.npz").write_bytes(b"damaged")

    other = words_of(world, out)  # another grid in the same folder
    assert "another grid" in fails(capsys, 3, *other, "--no-judge")
    assert "another configuration" in fails(capsys, 3, *words, "--seed", "4")
    assert {n: (out / "parts" / n).stat().st_mtime_ns for n in parts} == parts

    monkeypatch.setattr(sweep, "evaluate", stops_after(99))
    assert main(words) == 0
    assert len(computed) == 4
    assert sorted(n for members, _ in computed for n in members) == list(range(8))
    with np.load(out / "signals.npz") as sealed:
        for members, values in computed:
            np.testing.assert_array_equal(sealed["tao"][list(members)], values)


def test_changed_input_is_another_sweep(world, tmp_path):
    key = {"input data": "a", "grid": "b"}
    sweep.begin(tmp_path / "run", key)
    sweep.begin(tmp_path / "run", key)
    with pytest.raises(InputError, match="another input data"):
        sweep.begin(tmp_path / "run", {"input data": "c", "grid": "b"})


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


def test_ctrl_c_reaches_the_child_and_leaves_exit_130(world, tmp_path):
    grid = f"association = ['rank']\nlambda_velocity = {[n / 500 for n in range(2500)]}\n"
    (tmp_path / "grid.toml").write_text(grid)
    out = tmp_path / "run"
    # A shell that runs the tests in the background ignores interrupts, and so would the child.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        child = subprocess.Popen(
            [sys.executable, "-m", "taojax", *words_of(world, out)],
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        signal.signal(signal.SIGINT, before)
    until = time.monotonic() + 200
    while not list((out / "parts").glob("*.npz")) and time.monotonic() < until:
        time.sleep(0.05)
    os.kill(child.pid, signal.SIGINT)
    _, err = child.communicate(timeout=120)
    assert child.returncode == 130, err
    assert err.count("run the same command again to continue") == 1
    assert "Traceback" not in err
    assert json.loads((out / "parts" / "key.json").read_text())["grid"]
    assert list((out / "parts").glob("*.npz"))
