"""Route progress: what the folder holds, what a match matrix means, what one dimension breaks."""

import dataclasses
import tomllib

import numpy as np
import pytest

from benchmarks import progress as benchmark
from taojax.audit.judgement import judge
from taojax.audit.labels import read_truth
from taojax.config import AuditConfig, Config, StreamConfig
from taojax.datasets.progress import (
    ProgressConfig,
    Route,
    along,
    retained,
    route_of_matches,
    route_of_shares,
    write_progress,
)
from taojax.errors import ConfigError, InputError
from taojax.files.records import read_run, signal_names
from taojax.runtime.observations import load_observations
from taojax.runtime.score import score

EXACT = ProgressConfig(scale_bias=0.0, step_noise=0.0)


def drives(n_map=120, n_query=120, noise=0.5, dim=24):
    """Two drives along one route whose places look a little like their neighbours."""
    rng = np.random.default_rng(5)
    places = rng.normal(size=(n_map + 4, dim))
    places = np.sum([places[k : k + n_map] for k in range(5)], axis=0)
    at = np.round(np.linspace(0, n_map - 1, n_query)).astype(int)
    query = places[at] + noise * rng.normal(size=(n_query, dim)) * np.sqrt(5.0)
    return route_of_shares(places.astype(np.float32), query.astype(np.float32))


def stripes(n_map, pairs):
    matches = np.zeros((n_map, len(pairs)), dtype=bool)
    for query, rows in enumerate(pairs):
        matches[list(rows), query] = True
    return matches


def matched(n_map, pairs):
    return route_of_matches(
        np.ones((n_map, 2), np.float32), np.ones((len(pairs), 2), np.float32), stripes(n_map, pairs)
    )


def test_the_folder_is_one_that_the_loader_accepts_and_says_what_was_simulated(tmp_path):
    route = drives()
    write_progress(tmp_path / "data", route, ProgressConfig(n_anchors=60), seed=4)
    seen = load_observations(tmp_path / "data")
    assert seen.notes[0] == (
        "simulated odometry: true progress with a scale bias of 5% and 10% noise per step, seed 4"
    )
    assert any("one row of the map" in note for note in seen.notes)
    assert any(note.startswith("sparse map: ") for note in seen.notes)
    assert not seen.map_xyt[:, 1:].any()
    assert len(seen.odometry) == 120
    assert not seen.odometry[:, 1:].any()
    kept = retained(route, ProgressConfig(n_anchors=60))
    np.testing.assert_array_equal(seen.map_xyt[:, 0], kept)
    assert seen.descriptors is not None
    np.testing.assert_array_equal(seen.descriptors[0], route.map_views[kept])


def test_each_half_of_the_queries_leaves_the_map_and_comes_back(tmp_path):
    route = drives()
    rows = retained(route, ProgressConfig())
    gap = np.abs(route.query_rows[:, None] - rows[None]).min(axis=1) > 5
    for half in (gap[:60], gap[60:]):
        assert half.any()
        assert not half[0]
        assert not half[-1]
        assert int(np.abs(np.diff(half.astype(int))).sum()) == 2


def test_the_same_seed_gives_the_same_odometry_and_another_seed_another():
    progress = np.arange(50.0)
    first = along(progress, ProgressConfig(), 1)
    np.testing.assert_array_equal(first, along(progress, ProgressConfig(), 1))
    assert np.abs(first - along(progress, ProgressConfig(), 2)).max() > 0.01


def test_simulated_odometry_has_the_stated_bias_and_noise():
    forward = along(np.arange(20_001.0) * 3.0, ProgressConfig(), 0)[1:, 0] / 3.0
    assert forward.mean() == pytest.approx(1.05, abs=0.003)
    assert forward.std() == pytest.approx(0.10, abs=0.003)
    still = along(np.full(5, 7.0), ProgressConfig(), 0)
    assert not still.any()


def test_odometry_without_error_leads_back_to_the_truth_also_backwards():
    progress = np.array([4.0, 5.0, 7.0, 6.5, 2.0])
    np.testing.assert_allclose(4.0 + np.cumsum(along(progress, EXACT, 0)[:, 0]), progress)


def test_the_length_of_a_row_scales_every_position(tmp_path):
    route = drives()
    for name, row_m in (("rows", 1.0), ("metres", 5.0)):
        write_progress(tmp_path / name, route, ProgressConfig(row_m=row_m))
    rows, metres = (load_observations(tmp_path / name) for name in ("rows", "metres"))
    np.testing.assert_allclose(metres.map_xyt, 5.0 * rows.map_xyt)
    np.testing.assert_allclose(metres.odometry, 5.0 * rows.odometry, rtol=1e-6)
    assert any("5 m per row of the map" in note for note in metres.notes)
    truths = [read_truth(tmp_path / name / "truth", 120).xy_m for name in ("rows", "metres")]
    np.testing.assert_allclose(truths[1], 5.0 * truths[0])


def test_drives_of_unequal_length_meet_at_both_ends():
    route = drives(n_map=100, n_query=151)
    assert route.query_rows[0] == 0.0
    assert route.query_rows[-1] == 99.0
    assert len(route.query_rows) == 151


def test_of_several_matches_the_smoothest_drive_is_taken():
    route = matched(30, [[3], [4], [5, 28], [6, 27], [7], [8, 9, 10], [11]])
    np.testing.assert_array_equal(route.query_rows, [3, 4, 5, 6, 7, 9, 11])
    assert route.notes[0].startswith("truth from a match matrix: 3 of 7 queries")


def test_queries_without_a_match_are_interpolated_inside_and_left_out_at_the_ends():
    route = matched(30, [[], [4], [], [6], [7], [], []])
    np.testing.assert_array_equal(route.query_rows, [4, 5, 6, 7])
    assert len(route.query_views) == 4
    assert "1 queries without a match lie between their neighbours" in route.notes
    assert "3 queries before the first or after the last match are left out" in route.notes


def test_a_match_matrix_of_another_shape_or_without_matches_is_refused():
    views = np.ones((4, 2), np.float32), np.ones((3, 2), np.float32)
    with pytest.raises(InputError, match=r"shape \(3, 4\).*one row per map frame"):
        route_of_matches(*views, np.ones((3, 4), dtype=bool))
    with pytest.raises(InputError, match="0 queries have a match"):
        route_of_matches(*views, np.zeros((4, 3), dtype=bool))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"row_m": 0.0}, "row_m must be positive"),
        ({"n_anchors": 2}, "n_anchors must be at least 3"),
        ({"deleted": ((0.5, 0.4),)}, "shares that rise"),
    ],
)
def test_impossible_settings_are_refused(settings, said):
    with pytest.raises(ConfigError, match=said):
        ProgressConfig(**settings)


def test_stretches_that_delete_the_map_are_refused(tmp_path):
    with pytest.raises(InputError, match="leave 1 of 120 anchors"):
        write_progress(tmp_path / "data", drives(), ProgressConfig(deleted=((0.0, 0.995),)))
    assert not (tmp_path / "data").exists()


# In one dimension every window is straight: what could degenerate there.


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The same route scored at two lengths of a row."""
    folder = tmp_path_factory.mktemp("progress")
    stream = StreamConfig(window=8, branches=20)
    found = {}
    for row_m in (1.0, 5.0):
        audit = AuditConfig(r_in_m=2 * row_m, r_out_m=5 * row_m, n_bootstrap=10)
        config = Config(stream=stream, audit=audit)
        data = folder / f"data{row_m:g}"
        write_progress(data, drives(), ProgressConfig(row_m=row_m))
        score(data, folder / f"run{row_m:g}", config)
        truth = read_truth(data / "truth", 120)
        found[row_m] = judge(read_run(folder / f"run{row_m:g}"), truth, config)
    return found


def test_straight_windows_are_neither_degenerate_nor_without_an_answer(runs):
    for judgement in runs.values():
        status = judgement.signals["status"]
        assert set(status[:2]) == {"warming_up"}
        assert not set(status[2:]) & {"degenerate", "no_candidates"}
        for name in signal_names():
            assert np.isfinite(np.asarray(judgement.signals[name], float)).all()
        assert set(judgement.verdicts["verdict"]) >= {"accept", "reject"}


def test_on_a_line_the_volume_of_a_window_is_zero_and_says_nothing(runs):
    signals = runs[1.0].signals
    assert not np.asarray(signals["c_geom"], float).any()
    assert np.ptp(np.asarray(signals["h_proxy"], float)) == 0.0


def test_answers_stay_on_the_line_and_head_along_it(runs):
    signals = runs[1.0].signals
    known = np.isfinite(signals["x_m"])
    assert known.sum() > 100
    np.testing.assert_allclose(signals["y_m"][known], 0.0, atol=1e-3)
    np.testing.assert_allclose(np.sin(signals["theta_rad"][known]), 0.0, atol=1e-4)


def test_the_unit_of_a_row_changes_no_verdict_and_no_dimensionless_signal(runs):
    rows, metres = runs[1.0], runs[5.0]
    np.testing.assert_array_equal(rows.label, metres.label)
    np.testing.assert_array_equal(rows.verdicts["verdict"], metres.verdicts["verdict"])
    for name in ("tao", "now_cost", "now_vote", "now_off_map"):
        np.testing.assert_allclose(rows.signals[name], metres.signals[name], atol=1e-4)


def test_aligned_evidence_tells_the_deleted_stretches_of_a_line(runs):
    table = runs[1.0].metrics
    auroc = dict(zip(table["signal"], table["auroc"], strict=True))
    assert auroc["tao"] > 0.9


def test_the_match_matrix_of_the_real_traverse_gives_a_drive_that_runs_forward(shared):
    route = benchmark.RECIPES[2].make(shared / "brisbane_event")
    assert len(route.query_rows) == 641
    assert (np.diff(route.query_rows) >= 0).all()
    assert (route.query_rows[0], route.query_rows[-1]) == (11.0, 723.0)


def test_a_route_may_be_memory_mapped(tmp_path):
    np.save(tmp_path / "views.npy", drives().map_views)
    views = np.load(tmp_path / "views.npy", mmap_mode="r")
    route = dataclasses.replace(drives(), map_views=views)
    assert isinstance(route, Route)
    write_progress(tmp_path / "data", route, ProgressConfig())
    notes = tomllib.loads((tmp_path / "data/about.toml").read_text())["notes"]
    assert notes[-1] == "truth: the same share of both drives is taken for the same place"
