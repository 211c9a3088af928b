"""The measure of recovery, on tracks made by hand."""

import numpy as np
import pytest

from taojax.audit.calibration import accepting_level
from taojax.audit.labels import read_trials
from taojax.audit.recovery import (
    Event,
    Outcome,
    Track,
    frames_to_recovery,
    jumps_to_events,
    outcome,
    quantile,
    recovered_within,
    recovery_row,
    reentries,
    wilson,
)
from taojax.errors import InputError

INF = float("inf")


def track(error, signal=None, may=None):
    error = np.asarray(error, float)
    signal = np.zeros(len(error)) if signal is None else np.asarray(signal, float)
    may = np.ones(len(error), bool) if may is None else np.asarray(may, bool)
    return Track(error, signal, may)


def line(n, step=2.0):
    return np.stack([step * np.arange(n), np.zeros(n)], axis=1)


def measured(some, event, threshold=1.0, stay=3, basin=10.0):
    where = line(len(some.error_m))
    return outcome(some, where, event, threshold, basin_m=basin, stay_frames=stay)


@pytest.mark.parametrize(
    ("right", "want"),
    [
        ("1111", 1),
        ("0111", 2),
        ("1101110", 4),
        ("11011", INF),
        ("000", INF),
        ("", INF),
        ("11", INF),
    ],
)
def test_recovery_is_the_first_frame_of_a_full_stay(right, want):
    assert frames_to_recovery(np.array([c == "1" for c in right], bool), 3) == want


def test_frames_count_from_the_first_frame_after_the_jump_and_metres_with_its_step():
    some = track([0, 0, 50, 50, 9, 9, 9, 9])
    got = measured(some, Event(2, 8, 1.5))
    assert got.frames == 3
    # The step into the first frame, then two of 2 m.
    assert got.metres == pytest.approx(1.5 + 2 * 2.0)


def test_the_basin_includes_its_edge_and_no_pose_is_outside():
    assert measured(track([10.0] * 3), Event(0, 3, 0.0)).frames == 1
    assert measured(track([10.1] * 3), Event(0, 3, 0.0)).frames == INF
    assert measured(track([INF] * 3), Event(0, 3, 0.0)).frames == INF


def test_a_trial_that_ends_before_the_stay_is_full_is_a_failure():
    some = track([50, 50, 0, 0, 0, 0, 0])
    assert measured(some, Event(0, 4, 0.0)).frames == INF
    assert measured(some, Event(0, 4, 0.0)).metres == INF
    assert measured(some, Event(0, 5, 0.0)).frames == 3


def test_wrong_accepted_frames_stop_at_the_next_jump():
    error, signal = [50] * 4 + [0] * 3 + [50] * 3, [0, 2, 0, 0, 0, 0, 0, 0, 0, 0]
    may = [True, True, True, False] + [True] * 6
    got = measured(track(error, signal, may), Event(0, 7, 0.0))
    # Frame 1 is above the threshold, frame 3 abstained; frames 7 to 9 belong to the next event.
    assert got.wrong_frames == 2
    assert got.notice_frames == 2
    assert got.again_frames == 5


def test_a_refusal_after_a_right_accepted_pose_is_no_notice():
    got = measured(track([50, 0, 0, 0, 0], [0, 0, 5, 0, 0]), Event(0, 5, 0.0))
    assert got.again_frames == 2
    assert got.notice_frames == INF


def test_without_a_threshold_nothing_is_accepted_and_nothing_counted():
    got = measured(track([50, 0, 0, 0]), Event(0, 4, 0.0), threshold=float("nan"))
    assert got.frames == 2
    assert np.isnan(got.wrong_frames)
    assert got.again_frames == INF


def test_the_threshold_accepts_at_least_95_percent(rng):
    for n in (1, 2, 19, 20, 21, 100, 1000):
        values = rng.normal(size=n)
        level = accepting_level(values)
        assert (values <= level).mean() >= 0.95
        assert (values < level - 1e-5).mean() < 0.95
    assert np.isnan(accepting_level(np.zeros(0)))
    assert accepting_level(np.arange(100.0)) == pytest.approx(94.0, rel=2e-6)


def test_jumps_near_the_end_of_a_log_are_no_events():
    start = np.array([40, 80, 145, 200])
    got = jumps_to_events(start, np.ones(4), np.array([160, 160, 160, 320]), 20)
    assert got == [Event(40, 80, 1.0), Event(80, 145, 1.0), Event(200, 320, 1.0)]


def test_censored_trials_count_in_every_quantile():
    frames = np.array([1.0, 2.0, 3.0, INF])
    assert quantile(frames, 0.5) == 2.0
    assert np.isnan(quantile(frames, 0.95))
    assert np.isnan(quantile(np.zeros(0), 0.5))
    assert quantile(np.array([1.0] * 95 + [INF] * 5), 0.95) == 1.0


def test_a_row_summarises_with_failures_inside():
    good, bad = Outcome(2.0, 5.0, 1.0, 1.0, 3.0), Outcome(INF, INF, 4.0, INF, INF)
    row = recovery_row([good, good, good, bad], dt_s=0.5)
    assert row["trials"] == 4
    assert row["recovered"] == 0.75
    assert row["median_frames"] == 2.0
    assert np.isnan(row["p95_frames"])
    assert np.isnan(row["p95_m"])
    assert row["wrong_accepted_frames"] == pytest.approx(7 / 4)
    assert row["wrong_accepted_s"] == pytest.approx(7 / 8)
    assert row["noticed"] == 0.75
    assert row["median_notice_frames"] == 1.0
    assert row["median_accepted_again_frames"] == 3.0
    assert row["recovered_lo"] < 0.75 < row["recovered_hi"]
    assert recovery_row([], 1.0)["trials"] == 0


def test_wilson_against_published_values():
    # Newcombe, Statistics in Medicine 1998, table I: 81/263 and 0/20.
    np.testing.assert_allclose(wilson(81, 263), (0.2553, 0.3662), atol=1e-4)
    np.testing.assert_allclose(wilson(0, 20), (0.0, 0.1611), atol=1e-4)
    assert np.isnan(wilson(0, 0)).all()


def test_curves_grow_and_count_failures():
    curve = recovered_within(np.array([1.0, 3.0, 3.0, INF]), 5)
    np.testing.assert_allclose(curve[:, 0], [0.25, 0.25, 0.75, 0.75, 0.75])
    assert (curve[:, 1] <= curve[:, 0]).all()
    assert (curve[:, 0] <= curve[:, 2]).all()


def test_reentries_begin_where_the_truth_comes_back():
    query = line(30, 1.0)
    query[5:12, 1] = 40.0
    query[20:22, 1] = 40.0
    query[24:26, 1] = 40.0
    got = reentries(query, line(30, 1.0), 2.0, 4)
    # Frames 22 and 23 are too short a visit.
    assert [(event.start, event.end) for event in got] == [(12, 20), (26, 30)]
    assert got[0].step_m == pytest.approx(np.hypot(1.0, 40.0))


def test_a_robot_that_starts_on_the_map_has_not_come_back():
    assert reentries(line(20), line(20), 1.0, 3) == []
    query = line(20)
    query[:4, 1] = 90.0
    assert [event.start for event in reentries(query, line(20), 1.0, 3)] == [4]


def write_truth(folder, kidnaps="0,5,1.0\n1,3,1.0\n"):
    folder.mkdir()
    (folder / "kidnaps.csv").write_text("log,frame,step_m\n" + kidnaps)
    head = "log,drift,stretch_frames,split\n"
    (folder / "logs.csv").write_text(head + "0,low,40,calibration\n1,low,40,test\n")
    return folder


def test_trials_are_read_in_frames_of_the_run(tmp_path):
    got = read_trials(write_truth(tmp_path / "truth"), 20)
    assert got.log_frames == 10
    assert got.start.tolist() == [5, 13]


@pytest.mark.parametrize("kidnaps", ["2,1,1.0\n", "0,10,1.0\n", "0,5,1.0\n0,4,1.0\n"])
def test_jumps_outside_the_logs_are_refused(kidnaps, tmp_path):
    with pytest.raises(InputError, match="outside the logs or out of order"):
        read_trials(write_truth(tmp_path / "truth", kidnaps), 20)


def test_truth_of_another_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="do not divide"):
        read_trials(write_truth(tmp_path / "truth"), 21)
