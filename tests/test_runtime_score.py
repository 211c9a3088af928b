"""Odd but legal data folders: finite numbers and a status on every frame."""

import jax.numpy as jnp
import numpy as np
from conftest import table, write_folder
from judged import made_up

from taojax.config import Config, StreamConfig, VerdictConfig, replace
from taojax.files import records
from taojax.files.specs import column_names
from taojax.risk import MapFacts, read_calibration, shipped
from taojax.runtime import hindsight
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.observations import load_observations
from taojax.runtime.score import candidates, score, verdicts
from taojax.runtime.watch import load_map

SMALL = Config(
    stream=StreamConfig(window=6, branches=5),
    verdict=VerdictConfig(lag=4, window_frames=4),
)


def scored(folder, out):
    score(folder, out, SMALL)
    run = records.read_run(out)
    statuses = {"warming_up", "ok", "degenerate", "no_candidates"}
    assert set(run.signals["status"]) <= statuses
    for name in records.signal_names():
        assert np.isfinite(run.signals[name].astype(float)).all(), name
    for name in column_names("delayed"):
        assert np.isfinite(run.delayed[name]).all(), name
    for name in shipped().now.columns:
        assert np.isfinite(run.signals[name]).all(), name
    for name in ("probability_wrong", "probability_wrong_now"):
        assert np.isfinite(run.decisions[name]).all(), name
    return run


def test_a_program_is_told_what_score_seals(rng, tmp_path):
    folder = write_folder(tmp_path / "data", rng)
    sealed = scored(folder, tmp_path / "run").decisions
    known = load_observations(folder)
    tables = map_tables(known.map_xyt, SMALL.stream, known.descriptors[0])
    frames = Frame(*(jnp.asarray(part) for part in (known.odometry, *candidates(known))))
    found = verdicts(SMALL, tables, frames)
    assert found.keys() == sealed.keys()
    for name, values in found.items():
        if values.dtype == object:
            assert values.tolist() == sealed[name].tolist(), name
        else:
            np.testing.assert_allclose(values, sealed[name], rtol=1e-6, atol=1e-8, err_msg=name)


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
    folder = write_folder(tmp_path / "data", rng)
    seen = load_map(folder, SMALL.stream).facts
    notes = {}
    for name, facts in (("same", seen), ("foreign", MapFacts("ab12", "", 2.0, 0.9)), ("old", None)):
        score(folder, tmp_path / name, SMALL, calibration=made_up(fitted_on=facts))
        notes[name] = records.read_manifest(tmp_path / name)["notes"]
    assert notes["same"] == []
    assert len(notes["old"]) == 1
    assert "ships with taojax" in notes["old"][0]
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


def test_without_a_calibration_the_shipped_one_decides_and_the_seal_says_so(rng, tmp_path):
    run = scored(write_folder(tmp_path / "data", rng), tmp_path / "run")
    assert len(run.manifest["notes"]) == 1
    assert run.manifest["notes"][0].startswith(
        "decisions.csv is decided with the calibration that ships with taojax"
    )
    assert {"decisions.csv", "detector.toml", "delayed.csv"} <= set(run.manifest["sha256"])
    assert read_calibration(tmp_path / "run/detector.toml").final.levels.tolist() == (
        shipped().final.levels.tolist()
    )
    assert set(run.decisions["verdict"][:2]) == {"abstain"}
    assert "accept" in run.decisions["verdict"]


def test_without_hindsight_both_verdicts_are_one(rng, tmp_path):
    folder = write_folder(tmp_path / "data", rng)
    score(folder, tmp_path / "run", replace(SMALL, {"lag": 0}))
    run = records.read_run(tmp_path / "run")
    for name in ("verdict", "probability_wrong"):
        np.testing.assert_array_equal(run.decisions[name], run.decisions[f"{name}_now"])
    said = [reason.replace("now_", "") for reason in run.decisions["reason_now"]]
    assert run.decisions["reason"].tolist() == said
    np.testing.assert_array_equal(run.decisions["x_m"], run.decisions["x_now_m"])
    for name in hindsight.FEATURES:
        np.testing.assert_array_equal(run.delayed[name], run.signals[f"now_{name}"])


def test_the_share_that_may_be_wrong_is_sealed_with_the_numbers(rng, tmp_path):
    folder = write_folder(tmp_path / "data", rng)
    score(folder, tmp_path / "run", replace(SMALL, {"max_wrong": 0.1}))
    sealed = read_calibration(tmp_path / "run/detector.toml")
    assert sealed.now.max_wrong == sealed.final.max_wrong == 0.1
    assert sealed.final.level == shipped().final.levels[3]
