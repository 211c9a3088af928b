"""Odd but legal data folders: finite numbers and a status on every frame."""

import numpy as np
from conftest import table, write_folder

from taojax import records
from taojax.config import Config, StreamConfig
from taojax.detector import Detector, MapFacts
from taojax.runtime.score import score
from taojax.runtime.watch import load_map

SMALL = Config(stream=StreamConfig(window=6, branches=5, joint_window=8, joint_seeds=3))


def scored(folder, out):
    score(folder, out, SMALL)
    run = records.read_run(out)
    statuses = {"warming_up", "ok", "degenerate", "no_candidates", "lost"}
    assert set(run.signals["status"]) <= statuses
    for name in records.signal_names():
        assert np.isfinite(run.signals[name].astype(float)).all(), name
    return run


def test_twelve_map_frames_and_unnormalised_descriptors(rng, tmp_path):
    folder = write_folder(tmp_path / "data", rng, n_map=12)
    plain = scored(folder, tmp_path / "plain")
    for side, factor in (("map", 1e6), ("query", 1e-6)):
        path = folder / side / "descriptors.npy"
        np.save(path, np.load(path) * np.float32(factor))
    scaled = scored(folder, tmp_path / "scaled")
    top1 = [run.signals["top1"].astype(float) for run in (plain, scaled)]
    np.testing.assert_allclose(*top1, atol=1e-5)
    assert (plain.index[:, 12:] == -1).all()


def test_a_calibration_of_another_map_is_noted_in_the_seal(rng, tmp_path):
    folder, one = write_folder(tmp_path / "data", rng), np.ones(1)
    seen = load_map(folder, SMALL.stream).facts
    notes = {}
    for name, facts in (("same", seen), ("foreign", MapFacts("ab12", "", 2.0, 0.9)), ("old", None)):
        made_up = Detector(("tao",), one, one, one, 0.0, 0.5, "made up", facts)
        score(folder, tmp_path / name, SMALL, detector=made_up)
        notes[name] = records.read_manifest(tmp_path / name)["notes"]
    assert notes["same"] == notes["old"] == []
    assert len(notes["foreign"]) == 1
    assert "fitted on another map (spacing 2 m" in notes["foreign"][0]


def test_constant_descriptors_and_a_robot_that_never_moves(rng, tmp_path):
    folder = write_folder(tmp_path / "data", rng)
    for side, n in (("map", 60), ("query", 50)):
        np.save(folder / side / "descriptors.npy", np.ones((n, 4), np.float32))
    still = np.c_[np.arange(50), np.zeros((50, 3))]
    table(folder / "query/odometry.csv", "t_s,dx_m,dy_m,dtheta_rad", still)
    run = scored(folder, tmp_path / "run")
    np.testing.assert_allclose(run.signals["top1"].astype(float), 0.0, atol=1e-6)


def test_lists_without_any_candidate_have_no_pose(rng, tmp_path):
    folder = write_folder(tmp_path / "data", rng)
    arrays = {"index": np.full((50, 7), -1, np.int32), "similarity": np.zeros((50, 7), np.float32)}
    np.savez(folder / "query/retrievals.npz", **arrays)
    run = scored(folder, tmp_path / "run")
    assert set(run.signals["status"][2:]) == {"no_candidates"}
    assert (run.signals["map_index"] == -1).all()
    assert np.isnan(run.signals["x_m"].astype(float)).all()


def test_an_acceptance_at_run_time_needs_a_status_of_ok_and_a_fresh_frame(rng, tmp_path):
    from taojax.verdicts import decide

    one = np.ones(1)
    detector = Detector(("tao",), 0 * one, one, one, 0.0, 0.5, "made up")
    got = decide(
        detector,
        {
            "frame": np.arange(4),
            "status": np.array(["ok", "lost", "ok", "ok"], dtype=object),
            "tao": np.array([-1.0, -1.0, 1.0, -1.0]),
            "stale": np.array([0.0, 0.0, 1.0, 1.0]),
        },
    )
    assert got["verdict"].tolist() == ["accept", "abstain", "reject", "abstain"]
