"""A run folder comes back as pandas tables that say what its files say."""

import shutil
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from judged import evaluated, seal

import taojax
from taojax.audit.calibration import LOGISTIC
from taojax.config import Config, StreamConfig, VerdictConfig
from taojax.errors import InputError
from taojax.files import records
from taojax.files.results import SUMMARIES
from taojax.files.specs import column_names
from taojax.risk import read_calibration
from taojax.runtime.score import score

ANSWERED = ("probability_wrong_now", "probability_wrong")


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """A judged run and what the judge concluded."""
    run, done = evaluated(tmp_path_factory.mktemp("judged"))
    return run, done.judgement


@pytest.fixture
def spoilt(judged, tmp_path):
    """A copy of the run to break."""
    return shutil.copytree(judged[0], tmp_path / "run")


def test_a_judged_run_comes_back_whole(judged):
    folder, judgement = judged
    run = taojax.read_run(folder)
    for name in ("signals", "labels", "verdicts"):
        table = getattr(run, name)
        assert (table.index.name, *table.columns) == column_names(name)
        np.testing.assert_array_equal(table.index, np.arange(240))
    for name in records.signal_names():
        np.testing.assert_allclose(run.signals[name], judgement.signals[name], rtol=1e-8)
    np.testing.assert_array_equal(run.labels["label"], judgement.label)
    np.testing.assert_array_equal(run.verdicts["verdict"], judgement.verdicts["verdict"])
    assert list(run.metrics.index) == [*records.signal_names(), *ANSWERED, *LOGISTIC, "fused"]
    at = list(judgement.metrics["signal"]).index("tao")
    assert run.metrics.loc["tao", "auroc"] == pytest.approx(judgement.metrics["auroc"][at])
    assert np.isnan(run.metrics.loc["fused", "n_in"])
    assert tuple(run.tables) == SUMMARIES
    assert run.tables["counts"]["frames"].dtype == np.int64
    assert run.decisions is None


def test_the_tables_join_by_frame_and_count_as_the_judge_does(judged):
    run = taojax.read_run(str(judged[0]))
    # Both hold an answer: of the best branch of tao, and the final one.
    answer = [name for name in run.signals if name in run.verdicts]
    frames = run.signals.drop(columns=answer).join(run.labels).join(run.verdicts)
    assert len(frames) == 240
    test = frames[(frames["split"] == "test") & (frames["label"] != "grey")]
    counted = test["label"].value_counts()
    assert counted["in_map"] == run.metrics.loc["tao", "n_in_test"]
    assert counted["map_out"] == run.metrics.loc["tao", "n_out_test"]


def test_whole_numbers_are_whole_and_text_is_text(judged):
    run = taojax.read_run(judged[0])
    assert run.signals["map_index"].dtype == np.int64
    assert run.signals["tao"].dtype == float
    assert pd.api.types.is_string_dtype(run.signals["status"])
    assert len(run.map_poses) > run.signals["map_index"].max()


def test_a_run_without_a_judge_has_signals_only(tmp_path):
    run = taojax.read_run(seal(tmp_path)[0])
    assert len(run.signals) == 240
    assert run.labels is run.verdicts is run.metrics is run.decisions is None
    assert run.tables == {}


def test_the_judge_may_have_written_elsewhere(spoilt, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("labels.csv", "verdicts.csv", "metrics.csv", "audit.json"):
        (spoilt / name).rename(elsewhere / name)
    assert taojax.read_run(spoilt).labels is None
    run = taojax.read_run(spoilt, judged=elsewhere)
    assert len(run.labels) == 240
    assert run.tables == {}


def test_what_was_decided_at_run_time_comes_along(judged, data_folder, tmp_path):
    config = Config(
        stream=StreamConfig(window=6, branches=5, association="rank"),
        verdict=VerdictConfig(lag=4, window_frames=4),
    )
    score(
        data_folder,
        tmp_path / "out",
        config,
        calibration=read_calibration(judged[0] / "calibration.toml"),
    )
    run = taojax.read_run(tmp_path / "out")
    assert (run.decisions.index.name, *run.decisions.columns) == column_names("verdicts")
    assert len(run.decisions) == len(run.signals) == 50


def test_a_changed_byte_is_refused(spoilt):
    (spoilt / "signals.csv").write_text((spoilt / "signals.csv").read_text() + "\n")
    with pytest.raises(InputError, match="seal broken"):
        taojax.read_run(spoilt)


def test_a_folder_that_lost_a_table_is_refused(spoilt):
    (spoilt / "metrics.csv").unlink()
    with pytest.raises(InputError, match=r"metrics\.csv: no such file"):
        taojax.read_run(spoilt)


def test_the_judge_of_another_run_is_refused(judged, tmp_path):
    other, _ = seal(tmp_path, seed=8)
    with pytest.raises(InputError, match="another run"):
        taojax.read_run(other, judged=judged[0])


def test_a_folder_that_is_no_run_is_refused_and_runs_within_are_named(tmp_path):
    with pytest.raises(InputError, match=r"holds no run \(manifest\.json\); name another"):
        taojax.read_run(tmp_path)
    seal(tmp_path)
    with pytest.raises(InputError, match=r"holds no run \(manifest\.json\); name one: "):
        taojax.read_run(tmp_path)


def test_the_robots_names_load_no_pandas():
    code = (
        "import sys, taojax\ntaojax.StreamConfig, taojax.step, taojax.replay\n"
        "print('pandas' in sys.modules)\ntaojax.read_run\nprint('pandas' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
