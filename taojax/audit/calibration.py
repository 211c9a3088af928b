"""From signals to thresholds and probabilities; everything is fitted on the calibration split."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from taojax.audit.labels import CalibrationSplit

FEATURES = (
    "top1", "top1_w10", "margin", "entropy", "velocity", "sue",
    "tao_rank", "tao_rank_geom", "tao_rank_vel", "support", "h_proxy", "tao",
)  # fmt: skip
"""What the logistic model sees: the frontend, then the backend."""

LEAST_PER_CLASS = 5
"""Frames of each class below which no two-class model is fitted."""

_INVERSE_PENALTY = 0.01  # scikit-learn's C: neighbouring frames are worth far less than one each
_CLIP_SD = 4.0  # one wild residual must not outvote everything else
_TINY = 1e-9  # keeps log odds finite


class Logistic(NamedTuple):
    """A linear model of the log odds of being map-out."""

    mean: Float[np.ndarray, " f"]
    scale: Float[np.ndarray, " f"]
    weight: Float[np.ndarray, " f"]
    """Per standardised feature."""

    bias: float
    note: str


class Ranked(NamedTuple):
    """The fallback: where does `tao` rank among the in-map calibration frames?"""

    tao: Float[np.ndarray, " n"]
    """Ascending; empty when not even the fallback is possible."""

    note: str


def _table(signals: Mapping[str, np.ndarray]) -> Float[np.ndarray, "n f"]:
    return np.stack([np.asarray(signals[name], dtype=float) for name in FEATURES], axis=1)


def _standardise(
    x: Float[np.ndarray, "n f"], mean: Float[np.ndarray, " f"], scale: Float[np.ndarray, " f"]
) -> Float[np.ndarray, "n f"]:
    return np.clip((x - mean[None]) / scale[None], -_CLIP_SD, _CLIP_SD)


def fit(calibration: CalibrationSplit) -> Logistic | Ranked:
    """Fit the probability of being map-out.

    Classes are balanced while the weights are fitted, so that a rare class is not ignored; the
    calibration prior, smoothed by one frame of each class, is put back into the bias.

    Args:
        calibration: labelled frames; grey ones are ignored.

    Returns:
        A logistic model, or the fallback where a class has fewer than `LEAST_PER_CLASS` frames.
    """
    n_in, n_out = int(calibration.is_in.sum()), int(calibration.is_out.sum())
    if min(n_in, n_out) < LEAST_PER_CLASS:
        counts = f"the calibration split holds {n_in} in-map and {n_out} map-out frames"
        if n_in == 0:
            note = (
                f"No probability is given, because {counts}: nothing says what in-map looks like."
            )
        else:
            note = (
                f"The probability is a fallback, because {counts} and a two-class model needs at "
                f"least {LEAST_PER_CLASS} of each: it is the share of in-map calibration frames "
                "whose tao is lower. It ranks frames; it is not a calibrated probability."
            )
        return Ranked(np.sort(calibration.signals["tao"][calibration.is_in]), note)
    from sklearn.linear_model import LogisticRegression

    known = calibration.is_in | calibration.is_out
    x, y = _table(calibration.signals)[known], calibration.is_out[known]
    mean, spread = x.mean(axis=0), x.std(axis=0)
    scale = np.where(spread > 0, spread, 1.0)
    model = LogisticRegression(C=_INVERSE_PENALTY, class_weight="balanced", max_iter=1000)
    model.fit(_standardise(x, mean, scale), y)
    prior_log_odds = np.log((n_out + 1) / (n_in + 1))
    bias = float(np.ravel(model.intercept_)[0] + prior_log_odds)
    note = (
        f"The probability is a logistic model over {len(FEATURES)} signals, fitted on {n_in} "
        f"in-map and {n_out} map-out calibration frames."
    )
    return Logistic(mean, scale, model.coef_[0], bias, note)


def predict(model: Logistic | Ranked, signals: Mapping[str, np.ndarray]) -> Float[np.ndarray, " t"]:
    """Return the probability of being map-out, frame by frame; no frame sees another.

    Args:
        model: from `fit`.
        signals: signal -> (t,).

    Returns:
        In (0, 1), or NaN on every frame where the calibration split had no in-map frame.
    """
    if isinstance(model, Ranked):
        n = len(model.tao)
        if n == 0:
            return np.full(len(signals["tao"]), np.nan)
        below = np.searchsorted(model.tao, signals["tao"], side="left")
        return (below + 0.5) / (n + 1.0)
    # Summed by hand: a matrix product may round differently for other numbers of frames.
    z = _standardise(_table(signals), model.mean, model.scale)
    log_odds = np.sum(z * model.weight[None], axis=1) + model.bias
    return 1.0 / (1.0 + np.exp(-log_odds))


def sigma_threshold(
    calibration: CalibrationSplit, name: str, sigmas: float, *, is_probability: bool = False
) -> float:
    """Return the paper's threshold: mean + sigmas x standard deviation of in-map frames.

    Args:
        calibration: frames that may be fitted on.
        name: the signal.
        sigmas: the paper's 3.
        is_probability: apply the rule to the log odds, where it cannot leave (0, 1).

    Returns:
        The threshold (population standard deviation), or NaN without an in-map frame. That of
        `fused` rests on frames its model was fitted on, so its in-map spread is flattering.
    """
    inside = np.asarray(calibration.signals[name], dtype=float)[calibration.is_in]
    if not inside.size or np.isnan(inside).any():
        return float("nan")
    if not is_probability:
        return float(inside.mean() + sigmas * inside.std())
    p = np.clip(inside, _TINY, 1.0 - _TINY)
    log_odds = np.log(p / (1.0 - p))
    return float(1.0 / (1.0 + np.exp(-(log_odds.mean() + sigmas * log_odds.std()))))


class Reliability(NamedTuple):
    """Promised against realised share of map-out frames, in bins of equal count."""

    bin_of: Int[np.ndarray, " n"]
    promised: Float[np.ndarray, " b"]
    realised: Float[np.ndarray, " b"]
    n_frames: Int[np.ndarray, " b"]


def reliability(
    probability: Float[np.ndarray, " n"], is_out: np.ndarray, n_bins: int = 10
) -> Reliability:
    """Sort frames by probability into bins of equal count.

    Args:
        probability: of being map-out.
        is_out: `(n,)` bool, the truth.
        n_bins: fewer are made when there are fewer frames.
    """
    parts = np.array_split(np.argsort(probability, kind="stable"), n_bins)
    parts = [part for part in parts if part.size]
    bin_of = np.zeros(len(probability), dtype=int)
    for number, part in enumerate(parts):
        bin_of[part] = number
    return Reliability(
        bin_of=bin_of,
        promised=np.array([probability[part].mean() for part in parts]),
        realised=np.array([is_out[part].mean() for part in parts]),
        n_frames=np.array([len(part) for part in parts], dtype=int),
    )


def ece(
    probability: Float[np.ndarray, " n"], is_out: np.ndarray, weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, " b"]:
    """Return the expected calibration error under every row of weights; the bins stay fixed.

    Source:
        Nguyen & O'Connor, EMNLP 2015 (equal-count bins).
    """
    bins = reliability(probability, is_out)
    member = np.eye(len(bins.n_frames))[bins.bin_of]
    gap = (probability - is_out)[:, None] * member
    total = weights.sum(axis=1)
    error = np.abs(weights @ gap).sum(axis=1)
    return np.divide(error, total, out=np.full(len(total), np.nan), where=total > 0)
