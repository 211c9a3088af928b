"""The promise on simulated recordings: what is drawn and counted, and a small version of it."""

import numpy as np
import pytest

from benchmarks import promise
from taojax.config import VerdictConfig


@pytest.mark.parametrize("seed", range(20))
def test_as_many_map_frames_stay_as_asked_for(seed: int) -> None:
    rows = promise.mapped_rows(1000, 400, np.random.default_rng(seed))
    assert len(rows) == 400
    assert np.all(np.diff(rows) > 0)
    assert rows[0] >= 0
    assert rows[-1] < 1000
    assert np.sum(np.diff(rows) > 1) <= 2


def test_all_recordings_have_one_shape_and_differ() -> None:
    made = [promise.recording(seed)[0] for seed in (1, 2)]
    assert {len(one.map_poses) for one in made} == {promise.MAP_FRAMES}
    assert {len(one.odometry) for one in made} == {promise.QUERY_FRAMES}
    assert not np.array_equal(made[0].odometry, made[1].odometry)


def _row(seed: int, right: int, wrong: int) -> dict[str, float | int | str]:
    return {
        "seed": seed, "verdict": "final", "numbers": "shipped", "max_wrong": 0.05,
        "right": right, "wrong": wrong, "right_total": 100,
    }  # fmt: skip


def test_a_broken_promise_is_counted() -> None:
    (said,) = promise.summary([_row(0, 50, 0), _row(1, 30, 20), _row(2, 5, 5)])
    assert said["wrong_share"] == pytest.approx(25 / 110)
    assert said["wrong_lo"] <= said["wrong_share"] <= said["wrong_hi"]
    assert said["with_20_accepted"] == 2
    assert said["broke"] == 0.5
    assert said["recall"] == pytest.approx(0.85 / 3)


def test_the_promise_is_kept_and_answers_are_accepted() -> None:
    rows = [
        row
        for seed in range(promise.FIRST_SEED + 1, promise.FIRST_SEED + 4)
        for row in promise.rows_of(seed, VerdictConfig())
    ]
    for said in promise.summary(rows):
        assert said["wrong_share"] <= said["max_wrong"]
        if said["verdict"] == "final" and said["max_wrong"] == promise.PROMISED:
            assert said["accepted"] > 150
            assert said["recall"] > 0.6
