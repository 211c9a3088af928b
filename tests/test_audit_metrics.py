"""Metrics: laws, scikit-learn as the oracle, and cases small enough to count by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import average_precision_score, roc_auc_score

from taojax.audit import labels, metrics
from taojax.errors import InputError

cases = st.lists(
    st.tuples(st.integers(-4, 4), st.booleans()), min_size=2, max_size=40
).filter(lambda rows: len({out for _, out in rows}) == 2)  # fmt: skip


def arrays(rows):
    return np.array([v for v, _ in rows], dtype=float), np.array([o for _, o in rows])


@given(cases)
@settings(max_examples=60, deadline=None)
def test_auroc_ignores_monotone_maps_and_flips_with_the_sign(rows):
    signal, is_out = arrays(rows)
    value = metrics.auroc(signal, is_out)
    assert metrics.auroc(np.exp(signal) * 3 - 1, is_out) == pytest.approx(value)
    assert metrics.auroc(-signal, is_out) == pytest.approx(1 - value)


@given(cases)
@settings(max_examples=60, deadline=None)
def test_auroc_is_the_share_of_pairs_won_with_ties_one_half(rows):
    signal, is_out = arrays(rows)
    pairs = np.sign(signal[is_out][:, None] - signal[~is_out][None])
    assert metrics.auroc(signal, is_out) == pytest.approx(np.mean((pairs + 1) / 2))


def test_a_constant_signal_scores_one_half():
    assert metrics.auroc(np.zeros(6), np.array([True, False] * 3)) == 0.5


@pytest.mark.parametrize("measure", [metrics.auroc, metrics.aupr, metrics.far_at_95])
def test_one_class_is_refused_not_scored(measure):
    with pytest.raises(InputError, match="both classes"):
        measure(np.arange(4.0), np.zeros(4, dtype=bool))


def test_lengths_that_differ_are_refused():
    with pytest.raises((InputError, TypeError)):
        metrics.auroc(np.arange(3.0), np.array([True, False]))


def test_weighted_statistics_equal_scikit_learn_for_every_resample(rng):
    signal = rng.integers(0, 12, 80).astype(float)
    is_out = rng.random(80) < 0.4
    weights = metrics.block_weights(80, 7, 25, seed=3)
    got = metrics.weighted_separation(signal, is_out, weights)
    for row, w in enumerate(weights):
        assert got.auroc[row] == pytest.approx(roc_auc_score(is_out, signal, sample_weight=w))
        out = average_precision_score(is_out, signal, sample_weight=w)
        inside = average_precision_score(~is_out, -signal, sample_weight=w)
        assert got.aupr_out[row] == pytest.approx(out)
        assert got.aupr_in[row] == pytest.approx(inside)
        drawn = np.repeat(np.arange(80), w.astype(int))
        far = metrics.far_at_95(signal[drawn], is_out[drawn])
        assert got.far_at_95[row] == pytest.approx(far)


def test_equal_weights_give_the_point_estimates(rng):
    signal, is_out = rng.normal(size=60), rng.random(60) < 0.5
    got = metrics.weighted_separation(signal, is_out, np.ones((1, 60)))
    point = (metrics.auroc(signal, is_out), *metrics.aupr(signal, is_out))
    np.testing.assert_allclose([got.auroc[0], got.aupr_out[0], got.aupr_in[0]], point)
    assert got.far_at_95[0] == metrics.far_at_95(signal, is_out)


def test_a_resample_without_a_class_is_lost():
    weights = np.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]])
    is_out = np.array([False, False, True, True])
    got = metrics.weighted_separation(np.arange(4.0), is_out, weights)
    np.testing.assert_array_equal(got.auroc, [np.nan, 1.0])


def test_an_interval_is_blank_when_most_resamples_are_lost():
    assert np.isnan(metrics.interval(np.array([0.5, np.nan, np.nan]))).all()
    assert np.isfinite(metrics.interval(np.array([0.5, 0.6, np.nan]))).all()


def test_block_resamples_keep_neighbours_together_and_the_length():
    weights = metrics.block_weights(100, 10, 200, seed=0)
    assert (weights.sum(axis=1) == 100).all()
    together = np.mean(weights[:, 20] == weights[:, 21])
    apart = np.mean(weights[:, 20] == weights[:, 60])
    assert together > apart + 0.2


def test_the_same_seed_draws_the_same_resamples():
    first, again = (metrics.block_weights(30, 4, 5, seed=9) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, metrics.block_weights(30, 4, 5, seed=10))


def test_the_interval_of_white_noise_holds_one_half(rng):
    signal, is_out = rng.normal(size=600), np.arange(600) % 2 == 0
    drawn = metrics.weighted_separation(signal, is_out, metrics.block_weights(600, 10, 200, seed=0))
    low, high = metrics.interval(drawn.auroc)
    assert low < 0.5 < high
    assert high - low < 0.2


def test_weighted_median_equals_the_median_of_the_repeated_values(rng):
    value = rng.normal(size=9)
    weights = rng.integers(0, 4, (20, 9)).astype(float)
    weights[:, 0] += 1
    got = metrics.weighted_median(value, weights)
    want = [np.median(np.repeat(value, w.astype(int))) for w in weights]
    np.testing.assert_allclose(got, want)
    assert np.isnan(metrics.weighted_median(value, np.zeros((1, 9)))).all()


def test_weighted_mean_of_nothing_is_nan():
    got = metrics.weighted_mean(np.array([1.0, 3.0]), np.array([[1.0, 1.0], [0.0, 0.0]]))
    np.testing.assert_array_equal(got, [2.0, np.nan])


def test_far_at_95_uses_the_first_threshold_that_accepts_95_percent():
    inside = np.arange(1.0, 41.0)  # the 38th of 40 is 95 %
    outside = np.array([37.5, 38.0, 38.5, 50.0])
    signal = np.r_[inside, outside]
    is_out = np.r_[np.zeros(40, bool), np.ones(4, bool)]
    assert metrics.far_at_95(signal, is_out) == 0.5  # 38.0 is a tie and is accepted


def test_far_at_95_counts_in_whole_numbers():
    # 0.95 x 220 is 208.99999999999997 in floating point, and 209 in truth.
    signal = np.r_[np.arange(220.0), 208.0, 208.5]
    is_out = np.r_[np.zeros(220, bool), True, True]
    assert metrics.far_at_95(signal, is_out) == 0.5


def test_far_and_frr_count_accepted_outsiders_and_rejected_insiders():
    label = np.array(["in_map"] * 4 + ["map_out"] * 5 + ["grey"] * 3)
    signal = np.array([0.0, 1, 2, 3] + [1.0, 2, 5, 6, 7] + [9.0, 0, 0])
    test = labels.TestSplit(np.arange(12), label, {"tao": signal})
    point = metrics.operate(test, "tao", 2.0)
    assert (point.far, point.frr) == (0.4, 0.25)


def test_an_absent_class_leaves_its_rate_undefined():
    label = np.array(["in_map", "in_map"])
    test = labels.TestSplit(np.arange(2), label, {"tao": np.array([0.0, 9.0])})
    point = metrics.operate(test, "tao", 1.0)
    assert np.isnan(point.far)
    assert point.frr == 0.5


LABEL = {"i": "in_map", "o": "map_out", "g": "grey"}


def named(text):
    return np.array([LABEL[c] for c in text])


def test_an_exit_starts_at_the_first_map_out_frame_and_grey_does_not_reset():
    exits = metrics.find_exits(named("ooiigooogoggiioo"))
    np.testing.assert_array_equal(exits.first, [5, 14])
    np.testing.assert_array_equal(exits.last, [9, 15])


@pytest.mark.parametrize("text", ["ooo", "iii", "ggg", "ooii", "oogi"])
def test_there_is_no_exit_without_an_in_map_frame_before_it(text):
    assert metrics.find_exits(named(text)).first.size == 0


def test_delay_counts_frames_to_the_first_rejection_and_censors_the_unnoticed():
    label = named("iioooiiooooi")
    signal = np.array([0.0, 0, 0, 0, 9, 9, 9, 1, 1, 1, 1, 9])
    delays, missed = metrics.detection_delays(signal, metrics.find_exits(label), 5.0)
    np.testing.assert_array_equal(delays, [2, 4])
    np.testing.assert_array_equal(missed, [False, True])


def test_an_exit_noticed_at_once_has_no_delay():
    delays, missed = metrics.detection_delays(
        np.array([0.0, 9.0, 0.0]), metrics.find_exits(named("ioo")), 5.0
    )
    assert delays.tolist() == [0]
    assert not missed.any()


def test_recall_counts_all_queries_and_ignores_missing_candidates():
    map_m = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    query_m = np.array([[0.5, 0.0], [10.0, 0.0], [500.0, 0.0], [0.0, 0.0]])
    index = np.array([[2, 0, 1], [1, 0, 2], [2, 1, 0], [-1, -1, -1]])
    curve = metrics.recall_curve(index, query_m, map_m, 1.0)
    np.testing.assert_allclose(curve, [0.25, 0.5, 0.5])
