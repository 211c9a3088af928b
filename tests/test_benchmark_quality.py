"""The leaderboard on a tiny world: what it measures, compares and writes."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks import __main__, quality, sets
from benchmarks.entrants import ORACLES, oracle_levels
from taojax.config import AuditConfig, Config, StreamConfig
from taojax.datasets.simulate import WorldConfig

ENTRANTS = ("tao", "topological", "top1", *ORACLES)
TINY = WorldConfig(n_map=220, n_query=160, dimension=32, offset_m=4.0, odometry_scale=0.0)


def _config() -> Config:
    stream = StreamConfig(window=5, branches=8, association="rank")
    return Config(stream=stream, audit=AuditConfig(n_bootstrap=20, block_frames=10))


@pytest.fixture(scope="module")
def tiny() -> sets.DataSet:
    made = sets.simulated(TINY, 3, "default", name="tiny/3", column="tiny")
    # Coarse steps of 25 m: radii to match.
    return dataclasses.replace(made, r_in_m=30.0, r_out_m=40.0)


@pytest.fixture(scope="module")
def rows(tiny) -> list[quality.Row]:
    return quality.leaderboard(tiny, _config(), names=ENTRANTS)


def test_the_oracle_of_alignment_knows_where_a_simulated_frame_was_seen(tiny):
    offset = np.hypot(*(tiny.seen_m - tiny.truth_m).T)
    assert offset.max() > 1.0
    assert offset.max() < 10.0
    assert tiny.rows.shape == (160, len(tiny.map_poses))
    best = np.take_along_axis(tiny.rows, tiny.index[:, :1], axis=1)
    np.testing.assert_allclose(best, tiny.similarity[:, :1], atol=1e-6)


def test_every_entrant_has_one_row_with_an_interval_about_its_value(rows):
    assert [row["entrant"] for row in rows] == ["tao", "top1", "topological", *ORACLES]
    for row in rows:
        assert row["n_in"] > 0
        assert row["n_out"] > 0
        assert row["data"] == "simulated"
        assert 0.0 <= row["far_at_95"] <= 1.0
        assert {"far", "frr", "far_95", "frr_95"} <= set(row)
        assert row["auroc_lo"] <= row["auroc_hi"]


def test_the_difference_to_the_best_rival_is_zero_for_that_rival_and_paired_for_others(rows):
    rivals = {row["entrant"]: row["auroc_test"] for row in rows if row["kind"] == "rival"}
    best = max(rivals, key=rivals.__getitem__)
    for row in rows:
        assert row["rival"] == best
        gap = row["auroc_test"] - rivals[best]
        assert row["auroc_minus_rival"] == pytest.approx(gap)
        if row["entrant"] == best:
            assert row["auroc_minus_rival_lo"] == row["auroc_minus_rival_hi"] == 0.0


def test_all_files_are_written_and_the_table_holds_every_entrant(rows, tmp_path):
    quality.write(tmp_path / "out", rows)
    text = (tmp_path / "out/leaderboard.md").read_text()
    for name in ENTRANTS:
        assert text.count(name) >= 3
    with open(tmp_path / "out/leaderboard.csv", newline="") as file:
        read = list(csv.DictReader(file))
    assert [row["entrant"] for row in read] == [row["entrant"] for row in rows]
    assert float(read[0]["auroc"]) == pytest.approx(rows[0]["auroc"], rel=1e-5)
    assert (tmp_path / "out/leaderboard.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "out/leaderboard.svg").read_bytes()


def test_a_set_with_one_class_gets_no_invented_number(rows):
    measured = ("auroc", "far", "frr", "rival")
    bare = [{k: v for k, v in row.items() if not k.startswith(measured)} for row in rows]
    assert "n/a" in quality.to_markdown(bare)


def test_absent_recordings_are_named_and_left_out(tmp_path, capsys):
    kept = sets.recipes(tmp_path, quick=True)
    said = capsys.readouterr().out
    for name in (*sets.REAL, "kaist_routes", "robotcar_vo"):
        assert f"skipped {name}" in said
    assert all(recipe.name.startswith(("simulated/", "range/")) for recipe in kept)
    assert len([r for r in sets.recipes(tmp_path, quick=False) if "simulated/h3" in r.name]) == 5


def test_noiseless_simulated_odometry_leads_back_to_the_poses(rng):
    poses = np.cumsum(rng.normal(0, 1, (30, 3)), axis=0)
    still = WorldConfig(
        odometry_m=0.0, odometry_rad=0.0, odometry_scale=0.0, odometry_yaw_rad_per_m=0.0
    )
    x, y, theta = poses[0]
    for dx, dy, turn in sets.simulated_odometry(poses, still, 0)[1:]:
        x += np.cos(theta) * dx - np.sin(theta) * dy
        y += np.sin(theta) * dx + np.cos(theta) * dy
        theta += turn
    np.testing.assert_allclose([x, y], poses[-1, :2], atol=1e-9)


def test_an_oracle_of_separate_levels_is_nearly_perfect(rng):
    label = np.repeat(["in_map", "map_out", "in_map", "map_out"], 50)
    top1 = np.where(label == "map_out", 0.7, 0.3) + rng.normal(0, 0.02, 200)
    log_odds = oracle_levels(top1, label)
    assert np.median(log_odds[label == "map_out"]) > 3.0
    assert np.median(log_odds[label == "in_map"]) < -3.0


def test_a_folder_that_holds_something_is_refused(tmp_path, capsys):
    (tmp_path / "old.txt").write_text("kept")
    assert __main__.main(["quality", "--out", str(tmp_path), "--data", str(Path())]) == 3
    assert "choose another --out" in capsys.readouterr().err
