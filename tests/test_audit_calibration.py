"""Thresholds, and the probability of being off the map."""

import numpy as np
import pytest

from taojax.audit import calibration, labels
from taojax.detector import log_odds_terms, probability


def frames(rng, n_in, n_out, *, shift=3.0):
    is_out = np.r_[np.zeros(n_in, bool), np.ones(n_out, bool)]
    signals = {name: rng.normal(size=n_in + n_out) for name in calibration.DISTINCT}
    for name in ("top1_w5", "tao"):
        signals[name] = signals[name] + shift * is_out
    return signals, np.where(is_out, "map_out", "in_map")


def split_of(signals, label):
    cut = labels.split_frames(
        {k: np.r_[v, v] for k, v in signals.items()}, np.r_[label, label],
        calibration_share=0.5, gap_frames=0,
    )  # fmt: skip
    return cut.calibration


def test_sigma_threshold_is_mean_plus_sigmas_of_in_map_frames():
    label = np.array(["in_map"] * 4 + ["map_out", "grey"])
    split = split_of({"tao": np.array([1.0, 3.0, 1.0, 3.0, 100.0, 50.0])}, label)
    assert calibration.sigma_threshold(split, "tao", 3.0) == pytest.approx(2.0 + 3.0)


def test_the_threshold_of_a_probability_accepts_95_percent_of_the_in_map_frames():
    label = np.array(["in_map"] * 20 + ["map_out"])
    split = split_of({"fused": np.r_[np.linspace(0.05, 0.97, 20), 0.99]}, label)
    threshold = calibration.sigma_threshold(split, "fused", 3.0, is_probability=True)
    assert threshold == pytest.approx(np.linspace(0.05, 0.97, 20)[18], rel=2e-6)
    assert threshold > np.linspace(0.05, 0.97, 20)[18]


def test_there_is_no_threshold_without_an_in_map_frame():
    split = split_of({"tao": np.array([1.0, 2.0])}, np.array(["map_out", "grey"]))
    assert np.isnan(calibration.sigma_threshold(split, "tao", 3.0))


def test_the_model_ranks_held_out_frames(rng):
    model = calibration.fit(split_of(*frames(rng, 120, 80)))
    signals, label = frames(rng, 100, 100)
    p = probability(model, signals)
    assert ((p > 0) & (p < 1)).all()
    pairs = p[label == "map_out"][:, None] > p[label == "in_map"][None]
    assert pairs.mean() > 0.9


def test_the_probability_follows_the_prior_of_the_calibration_split(rng):
    few = probability(calibration.fit(split_of(*frames(rng, 190, 10, shift=0.0))),
                              frames(rng, 50, 0)[0])  # fmt: skip
    many = probability(calibration.fit(split_of(*frames(rng, 10, 190, shift=0.0))),
                               frames(rng, 50, 0)[0])  # fmt: skip
    assert few.mean() < 0.2
    assert many.mean() > 0.8


def test_a_probability_depends_on_its_own_frame_alone(rng):
    model = calibration.fit(split_of(*frames(rng, 60, 40)))
    signals, _ = frames(rng, 20, 20)
    whole = probability(model, signals)
    part = probability(model, {k: v[:13] for k, v in signals.items()})
    np.testing.assert_array_equal(whole[:13], part)


def test_a_constant_feature_leaves_finite_probabilities(rng):
    signals, label = frames(rng, 30, 30)
    signals["tao_rival"] = np.zeros(60)
    p = probability(calibration.fit(split_of(signals, label)), signals)
    assert np.isfinite(p).all()


@pytest.mark.parametrize("n_out", [0, calibration.LEAST_PER_CLASS - 1])
def test_too_few_frames_of_a_class_give_a_fallback_that_says_so(rng, n_out):
    model = calibration.fit(split_of(*frames(rng, 30, n_out)))
    assert "fallback" in model.note
    assert f"30 in-map and {n_out} map-out" in model.note
    signals, label = frames(rng, 40, 40)
    p = probability(model, signals)
    assert ((p > 0) & (p < 1)).all()
    pairs = p[label == "map_out"][:, None] > p[label == "in_map"][None]
    assert pairs.mean() > 0.8


def test_without_labels_the_weights_are_the_prior_and_there_is_no_threshold(rng):
    signals, _ = frames(rng, 20, 20)
    model = calibration.fit(split_of(signals, np.full(40, "grey")))
    np.testing.assert_allclose(
        model.weight, list(calibration.prior(calibration.LIST_RECALL).values())
    )
    assert np.isnan(model.threshold)


def test_labels_pull_the_weights_away_from_a_prior_that_is_wrong(rng):
    signals, label = frames(rng, 200, 200, shift=0.0)
    signals["tao"] = -3.0 * (label == "map_out") + rng.normal(size=400)
    model = calibration.fit(split_of(signals, label))
    assert model.weight[list(calibration.DISTINCT).index("tao")] < 0


def test_perfect_promises_have_no_calibration_error():
    p = np.repeat([0.0, 1.0], 50)
    assert calibration.ece(p, p == 1.0, np.ones((1, 100)))[0] == 0.0


def test_calibration_error_of_a_constant_promise_is_its_distance_to_the_rate():
    is_out = np.tile([True, False, False, False], 25)
    got = calibration.ece(np.full(100, 0.75), is_out, np.ones((1, 100)))
    # Equal-count bins of a constant split it by order: each holds the same mix, give or take one.
    assert got[0] == pytest.approx(0.5, abs=1e-12)


def test_reliability_bins_hold_equal_counts(rng):
    bins = calibration.reliability(rng.random(103), rng.random(103) < 0.5)
    assert bins.n_frames.sum() == 103
    assert bins.n_frames.max() - bins.n_frames.min() <= 1
    assert (np.diff(bins.promised) > 0).all()


def test_the_map_alone_sets_the_prior():
    blurred, distinct = calibration.prior(0.3), calibration.prior(1.0)
    assert blurred == calibration.BLURRED
    assert distinct == calibration.DISTINCT
    between = calibration.prior(0.75)["recursive"]
    assert blurred["recursive"] < between < distinct["recursive"]


def test_terms_are_told_from_the_mean_in_map_frame(rng):
    signals, label = frames(rng, 60, 40)
    inside = split_of(signals, label)
    model = calibration.fit(inside)
    own = {name: values[inside.is_in] for name, values in inside.signals.items()}
    np.testing.assert_allclose(log_odds_terms(model, own).mean(axis=0), 0.0, atol=1e-12)


def slope(model, split, start, precision):
    """Return the gradient of what a fit minimises, in plain NumPy; zero at its minimum."""
    x = np.stack([split.signals[name] for name in model.columns], axis=1)
    z = (x - x.mean(axis=0)) / x.std(axis=0)
    # The detector measures its terms from the mean in-map frame: told from the overall mean again.
    shift = (model.mean - x.mean(axis=0)) / x.std(axis=0)
    bias = model.bias - np.sum(shift * model.weight)
    n = np.array([split.is_in.sum(), split.is_out.sum()])
    counts = (np.minimum(40.0, n / 8.0) / n)[split.is_out.astype(int)]
    gap = counts * (1.0 / (1.0 + np.exp(-(z @ model.weight + bias))) - split.is_out)
    return np.append(gap @ z + precision * (model.weight - start), gap.sum() + 0.01 * bias)


def test_the_weights_hold_to_the_prior_with_a_precision_of_ten(rng):
    split = split_of(*frames(rng, 150, 100, shift=1.0))
    start = np.array(list(calibration.prior(0.9).values()))
    model = calibration.fit(split, 0.9)
    np.testing.assert_allclose(slope(model, split, start, 10.0), 0.0, atol=1e-3)
    assert np.abs(slope(model, split, start, 0.1)).max() > 0.1


def test_a_plain_model_holds_to_zero_with_a_precision_of_one(rng):
    signals, label = frames(rng, 150, 100, shift=1.0)
    split = split_of(signals, label)
    model = calibration.fit_plain(split, ("tao", "entropy"))
    assert model.columns == ("tao", "entropy")
    np.testing.assert_allclose(slope(model, split, np.zeros(2), 1.0), 0.0, atol=1e-3)
    assert model.weight[0] > 0.5
    assert abs(model.weight[1]) < 0.3
    assert "2 signals, shrunk to zero" in model.note
