"""Killed, without room, read-only, taken: one line, and no half run that passes for sealed."""

import os
from pathlib import Path

import pytest

from benchmarks import __main__
from benchmarks import reliability_faults as faults
from taojax import cli
from taojax.errors import InputError
from taojax.files.records import read_run, refuse_if_taken


def test_a_killed_writer_leaves_whole_runs_only():
    found = faults.kills_while_sealing(3)
    assert found["sealing: half sealed"] == 0
    assert found["sealing: whole runs"] >= found["sealing: kills"] == 3


def test_a_sealed_run_reads_and_is_never_written_twice(tmp_path):
    faults.write_one(tmp_path / "run")
    read_run(tmp_path / "run")
    with pytest.raises(InputError, match="choose a new --out"):
        faults.write_one(tmp_path / "run")


def test_an_interrupted_sweep_keeps_its_finished_parts(tmp_path):
    data = faults.make_data(tmp_path / "data")
    n, kept, code = faults.resumes(data, tmp_path / "sweep")
    assert (n > 0, kept, code) == (True, n, 0)


def test_of_two_with_one_out_one_wins(tmp_path):
    data = faults.make_data(tmp_path / "data")
    assert faults.taken_together(data, tmp_path / "run") == [0, 3]


def score(data, out, capsys):
    code = cli.main([str(w) for w in faults.JOBS[0].words(data, out)])
    return code, capsys.readouterr().err.strip().splitlines()


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    def full(handle):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="cannot be written"):
        faults.write_one(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path, capsys):
    data = faults.make_data(tmp_path / "data")
    code, lines = score(data, Path("/proc/nowhere"), capsys)
    assert (code, len(lines)) == (3, 1)
    assert "cannot be written" in lines[0]


@pytest.mark.parametrize("out", ["/proc/nowhere", "/proc/a/b", "{}/file/run", "{}/" + "x" * 300])
def test_an_out_that_cannot_be_written_is_known_before_the_work(out, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="cannot be written"):
        refuse_if_taken(Path(out.format(tmp_path)))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_asking_whether_an_out_is_free_leaves_nothing(tmp_path):
    (tmp_path / "empty").mkdir()
    for name in ("empty", "new", "a/b/c"):
        refuse_if_taken(tmp_path / name)
    assert [path.name for path in tmp_path.rglob("*")] == ["empty"]


@pytest.mark.parametrize("only", ["nonsense", "faults,nonsense", "faults,"])
def test_a_section_that_there_is_not_is_one_line_of_usage(only, tmp_path, capsys):
    assert __main__.main(["reliability", "--only", only, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "fuzz, numbers, faults, stream" in said.err
    assert not (tmp_path / "out").exists()
