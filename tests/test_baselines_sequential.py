"""Evidence over time: the sticky filter and the sequential test."""

import numpy as np
from scipy.stats import norm

from taojax.audit import sequential
from taojax.audit.sequential import fit_log_likelihood_ratio, sequential_test, sticky_filter


def test_the_filter_equals_bayes_rule_by_hand():
    ratio = np.array([0.4, -1.0, 2.0])
    stay = np.array([[0.97, 0.03], [0.03, 0.97]])
    wanted = []
    belief = np.array([0.5, 0.5])
    for t, value in enumerate(ratio):
        belief = (stay @ belief if t else belief) * np.array([1.0, np.exp(value)])
        belief = belief / belief.sum()
        wanted.append(belief[1])
    np.testing.assert_allclose(sticky_filter(ratio), wanted, rtol=1e-12)


def test_the_filter_is_causal(rng):
    ratio = rng.normal(size=40)
    tampered = np.concatenate([ratio[:20], 9.0 - ratio[20:]])
    np.testing.assert_array_equal(sticky_filter(ratio)[:20], sticky_filter(tampered)[:20])


def test_the_filter_survives_absurd_evidence():
    ratio = np.array([1e9, -np.inf, np.nan, np.inf, -1e9, 1e9])
    probability = sticky_filter(ratio)
    assert ((probability > 0) & (probability < 1)).all()
    assert probability[-1] > 0.99


def test_one_contrary_frame_does_not_flip_the_filter():
    ratio = np.full(30, -1.0)
    ratio[15] = 2.0
    assert (sticky_filter(ratio)[5:] < 0.5).all()


def test_the_fit_recovers_two_gaussians_whatever_the_prior(rng):
    for n_in, n_out in ((4000, 1000), (1000, 4000)):
        values = np.concatenate([rng.normal(0, 1, n_in), rng.normal(1.5, 1, n_out)])
        slope, intercept = fit_log_likelihood_ratio(values, np.arange(n_in + n_out) >= n_in)
        grid = np.linspace(-1.0, 2.5, 20)
        wanted = norm.logpdf(grid, 1.5) - norm.logpdf(grid, 0.0)
        np.testing.assert_allclose(slope * grid + intercept, wanted, atol=0.25)


def test_one_class_gives_a_plain_line_on_the_right_side(rng):
    values = rng.normal(3.0, 0.5, 50)
    slope, intercept = fit_log_likelihood_ratio(values, np.zeros(50, bool))
    assert slope > 0
    assert slope * 3.0 + intercept < 0 < slope * 5.0 + intercept
    slope, intercept = fit_log_likelihood_ratio(values, np.ones(50, bool))
    assert slope * 1.0 + intercept < 0 < slope * 3.0 + intercept


def test_no_labels_give_no_evidence():
    assert fit_log_likelihood_ratio(np.zeros(0), np.zeros(0, bool)) == (0.0, 0.0)


def test_a_constant_signal_gives_no_evidence():
    slope, intercept = fit_log_likelihood_ratio(np.ones(40), np.arange(40) < 20)
    assert abs(slope + intercept) < 1e-6


def test_a_signal_that_falls_towards_map_out_is_ignored(rng):
    values = np.concatenate([rng.normal(1, 1, 200), rng.normal(0, 1, 200)])
    slope, intercept = fit_log_likelihood_ratio(values, np.arange(400) >= 200)
    assert (slope, intercept) == (0.0, 0.0)


def test_the_sequential_test_keeps_its_error_rates(rng):
    for mean, wrong, allowed in ((-0.5, sequential.MAP_OUT, 0.05), (0.5, sequential.IN_MAP, 0.02)):
        # Unit-variance Gaussians half a unit either side of zero: the ratio is N(+-0.5, 1).
        found = sequential_test(rng.normal(mean, 1.0, 60_000), alpha=0.05, beta=0.02)
        decisions = found.decision[found.is_decided]
        assert len(decisions) > 1000
        assert np.mean(decisions == wrong) <= allowed


def test_the_sequential_test_is_open_until_the_evidence_suffices():
    found = sequential_test(np.full(6, 1.0), alpha=0.05, beta=0.05)
    np.testing.assert_array_equal(found.decision, [0, 0, 2, 2, 2, 2])
    np.testing.assert_array_equal(found.is_decided, [False, False, True, False, False, True])
    assert np.isfinite(sequential_test(np.array([np.nan, np.inf])).signal).all()
