"""Thresholds, and the probability of being off the map."""

import numpy as np
import pytest

from taojax.audit import calibration, labels
from taojax.risk import Detector, probability, terms

NAMES = ("top1_w5", "tao", "entropy", "margin", "velocity", "sue")
ONES = np.ones(len(NAMES))
BASE = Detector(
    NAMES, 0 * ONES, ONES, np.array([0.3, 0.9, 0.6, 0.0, 0.0, 0.0]), -0.2, 0.5, "pooled"
)


def frames(rng, n_in, n_out, *, shift=3.0):
    is_out = np.r_[np.zeros(n_in, bool), np.ones(n_out, bool)]
    signals = {name: rng.normal(size=n_in + n_out) for name in NAMES}
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
    model = calibration.fit(split_of(*frames(rng, 120, 80)), BASE)
    signals, label = frames(rng, 100, 100)
    p = probability(model, signals)
    assert ((p > 0) & (p < 1)).all()
    pairs = p[label == "map_out"][:, None] > p[label == "in_map"][None]
    assert pairs.mean() > 0.9


def test_the_probability_follows_the_prior_of_the_calibration_split(rng):
    few = probability(calibration.fit(split_of(*frames(rng, 190, 10, shift=0.0)), BASE),
                              frames(rng, 50, 0)[0])  # fmt: skip
    many = probability(calibration.fit(split_of(*frames(rng, 10, 190, shift=0.0)), BASE),
                               frames(rng, 50, 0)[0])  # fmt: skip
    assert few.mean() < 0.3
    assert many.mean() > 0.7


def test_a_probability_depends_on_its_own_frame_alone(rng):
    model = calibration.fit(split_of(*frames(rng, 60, 40)), BASE)
    signals, _ = frames(rng, 20, 20)
    whole = probability(model, signals)
    part = probability(model, {k: v[:13] for k, v in signals.items()})
    np.testing.assert_array_equal(whole[:13], part)


def test_a_constant_feature_leaves_finite_probabilities(rng):
    signals, label = frames(rng, 30, 30)
    signals["entropy"] = np.zeros(60)
    p = probability(calibration.fit(split_of(signals, label), BASE), signals)
    assert np.isfinite(p).all()


@pytest.mark.parametrize("n_out", [0, calibration.LEAST_PER_CLASS - 1])
def test_too_few_frames_of_a_class_give_a_fallback_that_says_so(rng, n_out):
    model = calibration.fit(split_of(*frames(rng, 30, n_out)), BASE)
    assert "fallback" in model.note
    assert f"30 in-map and {n_out} map-out" in model.note
    signals, label = frames(rng, 40, 40)
    p = probability(model, signals)
    assert ((p > 0) & (p < 1)).all()
    pairs = p[label == "map_out"][:, None] > p[label == "in_map"][None]
    assert pairs.mean() > 0.8


def test_without_labels_the_weights_are_the_pooled_ones_and_there_is_no_threshold(rng):
    signals, _ = frames(rng, 20, 20)
    model = calibration.fit(split_of(signals, np.full(40, "grey")), BASE)
    np.testing.assert_allclose(model.weight, BASE.weight)
    assert model.bias == pytest.approx(BASE.bias)
    assert np.isnan(model.threshold)


def test_labels_pull_the_weights_half_of_the_way_and_never_below_zero(rng):
    signals, label = frames(rng, 200, 200, shift=0.0)
    signals["tao"] = -3.0 * (label == "map_out") + rng.normal(size=400)
    model = calibration.fit(split_of(signals, label), BASE)
    # The likeliest weight is none at all; half of the way there it stops.
    assert model.weight[1] == pytest.approx(BASE.weight[1] / 2, abs=1e-3)


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


def test_terms_are_told_from_the_mean_in_map_frame(rng):
    signals, label = frames(rng, 60, 40)
    inside = split_of(signals, label)
    model = calibration.fit_plain(inside, NAMES)
    own = {name: values[inside.is_in] for name, values in inside.signals.items()}
    np.testing.assert_allclose(terms(model, own).mean(axis=0), 0.0, atol=1e-12)


def slope(model, split, start, precision, *, firm, mean=None, scale=None):  # noqa: PLR0913
    """Return the gradient of what a fit minimises, in plain NumPy; zero at its minimum."""
    x = np.stack([split.signals[name] for name in model.columns], axis=1)
    mean = x.mean(axis=0) if mean is None else mean
    scale = x.std(axis=0) if scale is None else scale
    z = (x - mean) / scale
    # A detector may measure its terms from elsewhere: told from the same mean again.
    bias = model.bias - np.sum((model.mean - mean) / scale * model.weight)
    n = np.array([split.is_in.sum(), split.is_out.sum()])
    counts = (np.minimum(40.0, n / 8.0) / n)[split.is_out.astype(int)]
    gap = counts * (1.0 / (1.0 + np.exp(-(z @ model.weight + bias))) - split.is_out)
    pull = np.append(precision * (model.weight - start[:-1]), firm * (bias - start[-1]))
    return np.append(gap @ z, gap.sum()) + pull


def test_refined_weights_go_half_of_the_way_to_a_fit_that_holds_to_them_with_precision_ten(rng):
    split = split_of(*frames(rng, 150, 100, shift=1.0))
    start, model = np.append(BASE.weight, BASE.bias), calibration.fit(split, BASE)
    there = start + (np.append(model.weight, model.bias) - start) / calibration.OF_THE_WAY
    whole = model._replace(weight=there[:-1], bias=there[-1])
    pooled = {"firm": 0.05, "mean": BASE.mean, "scale": BASE.scale}
    off = slope(whole, split, start, 10.0, **pooled)
    free = np.append(there[:-1] > 1e-6, True)
    np.testing.assert_allclose(off[free], 0.0, atol=1e-3)
    # A weight at zero wants to be negative.
    assert (off[~free] > -1e-3).all()
    assert np.abs(slope(whole, split, start, 0.1, **pooled)).max() > 0.1


def test_a_plain_model_holds_to_zero_with_a_precision_of_one(rng):
    signals, label = frames(rng, 150, 100, shift=1.0)
    split = split_of(signals, label)
    model = calibration.fit_plain(split, ("tao", "entropy"))
    assert model.columns == ("tao", "entropy")
    np.testing.assert_allclose(slope(model, split, np.zeros(3), 1.0, firm=0.01), 0.0, atol=1e-3)
    assert model.weight[0] > 0.5
    assert abs(model.weight[1]) < 0.3
    assert "2 signals, shrunk to zero" in model.note
