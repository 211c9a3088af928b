"""Commands that were stopped go on when they are repeated."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import write_folder

from taojax.cli import kidnap, main
from taojax.cli.common import score_apart
from taojax.cli.resume import BEGUN, claimed, is_sealed
from taojax.config import Config, StreamConfig
from taojax.errors import InputError
from taojax.files import records

CONFIG = Config(stream=StreamConfig(window=3, branches=4, association="rank"))
FLAGS = ["--window", "3", "--branches", "4", "--association", "rank", "--no-progress"]


@pytest.fixture(scope="module")
def audited(tmp_path_factory):
    """A data folder, and an audit of it that took its time."""
    folder = tmp_path_factory.mktemp("resume")
    write_folder(folder / "data", np.random.default_rng(3))
    words = ["audit", str(folder / "data"), "--out", str(folder / "run"), *FLAGS]
    assert main(words) == 0
    return folder


def written(folder):
    """When the sealed files of a run were written, by name."""
    names = [*records.read_manifest(folder)["sha256"], "manifest.json"]
    paths = [folder / name for name in names if not name.startswith(records.INPUTS)]
    return {path.name: path.stat().st_mtime_ns for path in paths}


def test_an_audit_stopped_while_it_judges_is_finished_by_the_same_command(audited, tmp_path):
    run = shutil.copytree(audited / "run", tmp_path / "run")
    for name in ("report.html", "metrics.csv"):
        (run / name).unlink()
    before = written(run)
    assert main(["audit", str(audited / "data"), "--out", str(run), *FLAGS]) == 0
    assert written(run) == before
    assert (run / "metrics.csv").read_bytes() == (audited / "run/metrics.csv").read_bytes()
    assert (run / "report.html").is_file()


def test_a_finished_audit_is_not_made_again(audited, capsys):
    words = ["audit", str(audited / "data"), "--out", str(audited / "run"), *FLAGS]
    assert main(words) == 3
    assert "already holds files" in capsys.readouterr().err


@pytest.mark.parametrize("change", ["settings", "data", "code", "signals"])
def test_only_the_very_same_run_is_gone_on_with(change, audited, tmp_path, monkeypatch):
    run = shutil.copytree(audited / "run", tmp_path / "run")
    data = shutil.copytree(audited / "data", tmp_path / "data")
    assert is_sealed(run, data, CONFIG)
    config = CONFIG
    if change == "settings":
        config = dataclasses.replace(CONFIG, seed=1)
    elif change == "data":
        np.save(data / "map/descriptors.npy", np.ones((60, 4), np.float32))
    elif change == "code":
        monkeypatch.setattr(records, "code_digest", lambda: "other")
    else:
        with (run / "signals.csv").open("a") as file:
            file.write("\n")
    assert not is_sealed(run, data, config)


def test_a_claimed_folder_is_gone_on_with_by_the_same_command_alone(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt), claimed(out, "kidnap 4 trials"):
        stop(out / "part")
    assert (out / BEGUN).is_file()
    with pytest.raises(InputError, match="another command began"), claimed(out, "kidnap 5 trials"):
        pytest.fail("went on")
    with claimed(out, "kidnap 4 trials"):
        assert (out / "part").read_text() == "1"
    assert not (out / BEGUN).exists()
    with pytest.raises(InputError, match="already holds"), claimed(out, "kidnap 4 trials"):
        pytest.fail("went on")


def stop(path: Path) -> None:
    path.write_text("1")
    raise KeyboardInterrupt


def test_two_cannot_fill_one_folder(tmp_path):
    with claimed(tmp_path / "out", "audit"):
        with (
            pytest.raises(InputError, match="another process"),
            claimed(tmp_path / "out", "audit"),
        ):
            pytest.fail("went on")
        assert (tmp_path / "out" / BEGUN).is_file()


def test_a_command_that_fails_at_once_leaves_no_folder(tmp_path):
    with pytest.raises(InputError), claimed(tmp_path / "out", "audit"):
        raise InputError("no such data")
    assert list(tmp_path.iterdir()) == []


def test_a_kidnap_stopped_between_its_runs_keeps_those_that_are_sealed(
    tmp_path, monkeypatch, capsys
):
    # Long enough for logs to calibrate on and logs to test on that share no frame.
    data = write_folder(tmp_path / "data", np.random.default_rng(3), n_query=400)
    out = tmp_path / "out"
    words = ["kidnap", str(data), "--out", str(out), "--trials", "2", "--basin", "2"]
    words += ["--rival-trials", "0", "--r-in", "5", *FLAGS]

    def score_but_the_last(jobs, config, **more):
        score_apart(list(jobs)[:-1], config, **more)
        raise KeyboardInterrupt

    monkeypatch.setattr(kidnap, "score_apart", score_but_the_last)
    assert main(words) == 130
    monkeypatch.undo()
    before = written(out / "trials-0")
    capsys.readouterr()
    assert main(words) == 0
    assert written(out / "trials-0") == before
    assert f"{out / 'trials-0'} is sealed already" in capsys.readouterr().err
    assert (out / "report.html").is_file()
    assert not (out / BEGUN).exists()
