"""Truth, labels and the two kinds of split."""

import ast
import dataclasses
from pathlib import Path

import numpy as np
import pytest

import taojax
from taojax.audit import calibration, labels, metrics
from taojax.audit.labels import read_truth
from taojax.errors import InputError
from taojax.risk import shipped

HEADER = "t_s,x_m,y_m,theta_rad\n"


def cut(n=20, gap=3, share=0.5):
    label = np.where(np.arange(n) % 4 == 3, "map_out", "in_map")
    signals = {name: np.arange(float(n)) for name in ("tao", *shipped().map_out.columns)}
    return labels.split_frames(signals, label, calibration_share=share, gap_frames=gap)


def test_nearest_distance_equals_brute_force_in_every_chunk(rng, monkeypatch):
    query, places = rng.normal(size=(37, 2)), rng.normal(size=(11, 2))
    monkeypatch.setattr(labels, "_CELLS", 50)
    want = np.linalg.norm(query[:, None] - places[None], axis=2).min(axis=1)
    np.testing.assert_allclose(labels.nearest_map_distance(query, places), want)


def test_both_radii_belong_to_the_nearer_label():
    got = labels.label_frames(np.array([0.0, 5.0, 5.01, 10.0, 10.01]), 5.0, 10.0)
    assert got.tolist() == ["in_map", "in_map", "grey", "grey", "map_out"]


def test_equal_radii_leave_no_grey_zone():
    got = labels.label_frames(np.array([9.0, 10.0, 10.5]), 10.0, 10.0)
    assert got.tolist() == ["in_map", "in_map", "map_out"]


def test_the_splitter_leaves_a_gap_of_one_window():
    splits = cut(n=21, gap=3)
    assert splits.name.tolist() == ["calibration"] * 10 + ["gap"] * 3 + ["test"] * 8
    assert splits.calibration.frame.tolist() == list(range(10))
    assert splits.test.frame.tolist() == list(range(13, 21))
    np.testing.assert_array_equal(splits.test.signals["tao"], splits.test.frame)


def test_a_run_shorter_than_the_gap_has_no_test_frames():
    splits = cut(n=5, gap=20)
    assert splits.test.frame.size == 0
    assert (splits.name != "test").all()


def test_fitting_functions_refuse_a_test_split():
    splits = cut()
    with pytest.raises(TypeError):
        calibration.fit(splits.test, shipped().map_out)
    with pytest.raises(TypeError):
        calibration.sigma_threshold(splits.test, "tao", 3.0)


def test_scoring_functions_refuse_a_calibration_split():
    with pytest.raises(TypeError):
        metrics.operate(cut().calibration, "tao", 1.0)


def test_the_two_splits_are_different_types_and_frozen():
    splits = cut()
    assert not isinstance(splits.test, labels.CalibrationSplit)
    assert not isinstance(splits.calibration, labels.TestSplit)
    with pytest.raises(dataclasses.FrozenInstanceError):
        splits.test.label = splits.calibration.label


def test_only_the_splitter_makes_splits():
    made = {}
    for path in Path(taojax.__file__).parent.rglob("*.py"):
        calls = [node.func for node in ast.walk(ast.parse(path.read_text()))
                 if isinstance(node, ast.Call)]  # fmt: skip
        named = {getattr(f, "id", getattr(f, "attr", "")) for f in calls}
        if hits := named & {"CalibrationSplit", "TestSplit"}:
            made[path.name] = hits
    assert made == {"labels.py": {"CalibrationSplit", "TestSplit"}}


def test_truth_is_read_from_the_folder_or_the_file(tmp_path):
    file = tmp_path / "query_poses.csv"
    file.write_text(HEADER + "0,1,2,0\n1,3,4,0\n2,5,6,0\n")
    for path in (tmp_path, file):
        truth = read_truth(path, 3)
        np.testing.assert_array_equal(truth.xy_m, [[1, 2], [3, 4], [5, 6]])


def test_truth_of_another_length_is_refused_by_both_counts(tmp_path):
    (tmp_path / "query_poses.csv").write_text(HEADER + "0,1,2,0\n1,3,4,0\n2,5,6,0\n")
    with pytest.raises(InputError, match="3 poses for a run of 4 frames"):
        read_truth(tmp_path, 4)


def test_missing_truth_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_truth(tmp_path / "truth", 3)
