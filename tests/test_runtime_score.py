"""Odd but legal data folders: finite numbers and a status on every frame."""

import numpy as np
from conftest import table, write_folder

from taojax import records
from taojax.config import Config, StreamConfig
from taojax.runtime.score import score

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
    from taojax.detector import Detector
    from taojax.runtime.score import decide

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
