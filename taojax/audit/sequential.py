"""Evidence summed over time: a two-state filter and a sequential test of one signal.

Both need a likelihood ratio that was fitted on labels, so they belong to the judge. No geometry
enters: what they reach is what geometry has to beat.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

LEAST_PER_CLASS = 5
"""Frames of each class below which no likelihood ratio is fitted."""

_FALLBACK_SLOPE = 1.0  # per in-map standard deviation: one deviation above the mean is a factor e
_INVERSE_PENALTY = 1.0  # scikit-learn's C on the standardised signal
_MOST = 700.0  # exp of it is still finite

OPEN, IN_MAP, MAP_OUT = range(3)


class SequentialTest(NamedTuple):
    """What a sequential test knows after each frame."""

    evidence: Float[np.ndarray, " t"]
    """Log likelihood ratio collected since the last decision; positive = map-out."""

    decision: Int[np.ndarray, " t"]
    """The latest decision: OPEN before the first, then IN_MAP or MAP_OUT."""

    is_decided: Bool[np.ndarray, " t"]
    """True on the frames that reach a decision."""

    signal: Float[np.ndarray, " t"]
    """The level of the latest decision plus the evidence since: larger = more likely map-out."""


def fit_log_likelihood_ratio(
    values: Float[np.ndarray, " n"], is_map_out: Bool[np.ndarray, " n"]
) -> tuple[float, float]:
    """Fit log p(value | map-out) / p(value | in-map) as a line, by logistic regression.

    Args:
        values: one signal on the labelled frames of the calibration split.
        is_map_out: their truth.

    Returns:
        Slope and intercept. The prior odds of the split are taken out: classes are balanced while
        the line is fitted. The slope is never negative, since a signal grows towards map-out by
        definition. With fewer than `LEAST_PER_CLASS` frames of a class the line rises by one per
        standard deviation of the class that is there and is zero two deviations outside it, or is
        zero everywhere when no frame is labelled.

    Source:
        Platt, 1999, with the prior of the training set removed.
    """
    values = np.asarray(values, float)
    n_out = int(is_map_out.sum())
    n_in = len(values) - n_out
    if min(n_in, n_out) >= LEAST_PER_CLASS:
        from sklearn.linear_model import LogisticRegression

        mean, spread = float(values.mean()), float(values.std())
        scale = spread if spread > 0 else 1.0
        standard = np.reshape((values - mean) / scale, (-1, 1))
        model = LogisticRegression(C=_INVERSE_PENALTY, class_weight="balanced", max_iter=1000)
        model.fit(standard, is_map_out)
        slope = max(0.0, float(np.ravel(model.coef_)[0])) / scale
        bias = float(np.ravel(model.intercept_)[0]) if slope > 0 else 0.0
        return float(slope), float(bias - slope * mean)
    if not len(values):
        return 0.0, 0.0
    is_seen = is_map_out if n_out > n_in else ~is_map_out
    seen, side = values[is_seen], (-2.0 if n_out > n_in else 2.0)
    scale = seen.std() if seen.std() > 0 else 1.0
    slope = _FALLBACK_SLOPE / scale
    return float(slope), float(-slope * (seen.mean() + side * scale))


def sticky_filter(
    log_likelihood_ratio: Float[np.ndarray, " t"], switch: float = 0.03
) -> Float[np.ndarray, " t"]:
    """Filter per-frame evidence with two states that rarely change.

    Args:
        log_likelihood_ratio: map-out against in-map, per frame; not finite = no evidence.
        switch: probability of entering or leaving the map in one frame, in (0, 0.5].

    Returns:
        Probability of being map-out given this frame and all earlier ones, strictly inside (0, 1);
        both states are equally likely before the first.
    """
    evidence = np.where(np.isfinite(log_likelihood_ratio), log_likelihood_ratio, 0.0)
    evidence = np.clip(evidence, -_MOST, _MOST)
    probability, out = np.empty(len(evidence)), 0.5
    for t, ratio in enumerate(evidence):
        if t:
            out = out * (1.0 - switch) + (1.0 - out) * switch
        # In log odds: exp of the evidence alone may overflow.
        log_odds = np.clip(np.log(out) - np.log1p(-out) + ratio, -_MOST, _MOST)
        out = 1.0 / (1.0 + np.exp(-log_odds))
        probability[t] = out = np.clip(out, 1e-15, 1.0 - 1e-15)
    return probability


def sequential_test(
    log_likelihood_ratio: Float[np.ndarray, " t"], alpha: float = 0.05, beta: float = 0.05
) -> SequentialTest:
    """Collect evidence until one side reaches its stated error rate, decide, and start again.

    Args:
        log_likelihood_ratio: map-out against in-map, per frame; not finite = no evidence.
        alpha: allowed share of in-map stretches called map-out, in (0, 0.5).
        beta: allowed share of map-out stretches called in-map, in (0, 0.5).

    Returns:
        Evidence, latest decision, when it was reached, and one signal, per frame. The error rates
        hold for independent frames; neighbouring frames are not, and realised rates are higher.

    Source:
        Wald, "Sequential tests of statistical hypotheses", Annals of Mathematical Statistics 16(2),
        1945.
    """
    upper, lower = np.log((1.0 - beta) / alpha), np.log(beta / (1.0 - alpha))
    ratio = np.where(np.isfinite(log_likelihood_ratio), log_likelihood_ratio, 0.0)
    evidence, decision = np.empty(len(ratio)), np.empty(len(ratio), dtype=int)
    is_decided = np.zeros(len(ratio), dtype=bool)
    level, signal = {OPEN: 0.0, IN_MAP: lower, MAP_OUT: upper}, np.empty(len(ratio))
    total, latest = 0.0, OPEN
    for t, value in enumerate(ratio):
        total += value
        evidence[t] = total
        if not lower < total < upper:
            latest, total, is_decided[t] = (MAP_OUT if total > 0 else IN_MAP), 0.0, True
        decision[t], signal[t] = latest, level[latest] + total
    return SequentialTest(evidence, decision, is_decided, signal)
