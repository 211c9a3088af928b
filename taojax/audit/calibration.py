"""From signals to thresholds and probabilities; everything is fitted on the calibration split."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from taojax.audit.labels import CalibrationSplit
from taojax.risk import Detector, probability

VIEW = ("top1", "margin", "entropy")
"""What one view tells: its best similarity, and how the list stands out (paper, section 3.3)."""

LOGISTIC = {
    "single_view": VIEW,
    "joint_features": (*VIEW, "velocity", "c_geom", "a_aniso", "h_proxy", "tao_rank"),
}
"""Row of metrics.csv -> features of a plain logistic model, the paper's two: of the frontend, and
of the frontend and what Eq. 1 and its alignment say."""

PLAIN_PRECISION = 1.0
"""How firmly the weights of these two hold to zero, scikit-learn's habit; the bias as below."""

PLAIN_BIAS_PRECISION = 0.01
"""How firmly their bias holds to zero: hardly, for it follows how many frames are off the map."""

PRIOR_PRECISION = 10.0
"""How firmly weights hold to the pooled ones before they go half of the way, per unit of log odds
squared; one labelled effective frame weighs about 1/4. Between 3 and 30 nothing changes by more
than .01 in recall or wrong share (`python -m benchmarks verdict`)."""

BIAS_PRECISION = 0.05
"""The same for the bias, which follows how many answers are wrong here."""

OF_THE_WAY = 0.5
"""Share of the way from the pooled numbers to the fitted ones that is gone: half a recording is a
narrow view of its other half. Of the left-out recordings all of it accepts .76 of the right answers
with .034 wrong, half of it .74 with .019 (`python -m benchmarks verdict`)."""

CORRELATED_FRAMES = 8.0
"""Neighbouring frames repeat each other: so many count as one."""

MOST_EFFECTIVE = 40.0
"""Effective frames of a class at most, so that a long standstill does not outvote the prior."""

ACCEPTED_SHARE = 0.95
"""Share of the calibration frames that belong in the map which a frozen threshold accepts."""

ROUNDING = 1e-6
"""A level is so much above the frame that sets it, relative: files hold nine digits, and that frame
must be accepted again where it is computed anew."""

_TINY = 1e-9  # below it a signal is constant and says nothing
LEAST_PER_CLASS = 5
"""Frames of each class below which the model is called a fallback."""

FALLBACK = "The probability of being off the map is a fallback"
"""So begins the note of a detector that had too few frames to be fitted."""


def _note(what: str, n_in: int, n_out: int) -> str:
    counts = f"{n_in} in-map and {n_out} map-out calibration frames"
    if min(n_in, n_out) >= LEAST_PER_CLASS:
        return (
            f"The probability of being off the map is a logistic model over {what}, and fitted on "
            f"{counts}."
        )
    return (
        f"{FALLBACK}, because there are only {counts} and two classes of at "
        f"least {LEAST_PER_CLASS} are needed to calibrate: its weights are the prior's, so "
        "it ranks frames, but its level is not calibrated; record a drive that leaves the map in "
        "both halves."
    )


def effective_weights(is_positive: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return what each frame counts, so that a class counts by its effective frames.

    Args:
        is_positive: the class of every frame.
    """
    counts = np.array([(~is_positive).sum(), is_positive.sum()])
    effective = np.minimum(MOST_EFFECTIVE, counts / CORRELATED_FRAMES) / np.maximum(counts, 1)
    return effective[is_positive.astype(int)]


def fit_logistic(
    z: Float[np.ndarray, "n f"],
    is_positive: Bool[np.ndarray, " n"],
    frame_weight: Float[np.ndarray, " n"],
    *,
    start: Float[np.ndarray, " g"],
    precision: Float[np.ndarray, " g"],
    is_signed: bool = True,
) -> Float[np.ndarray, " g"]:
    """Return weights and bias of the likeliest logistic model under a Gaussian prior.

    Args:
        z: standardised features.
        is_positive: the class whose log odds are modelled.
        frame_weight: what each frame counts.
        start: mean of the prior, the bias last (g = f + 1).
        precision: of the prior around it.
        is_signed: False allows no negative weight.
    """
    from scipy.optimize import minimize

    y = is_positive.astype(float)

    def loss(numbers: np.ndarray) -> tuple[float, np.ndarray]:
        # Summed by hand: a matrix product may round differently for other numbers of frames.
        odds, pull = np.sum(z * numbers[None, :-1], axis=1) + numbers[-1], numbers - start
        surprise = frame_weight * (np.logaddexp(0.0, odds) - y * odds)
        residual = frame_weight * (1.0 / (1.0 + np.exp(-odds)) - y)
        slope = np.append(np.sum(residual[:, None] * z, axis=0), residual.sum())
        value = surprise.sum() + 0.5 * np.sum(precision * pull**2)
        return float(value), slope + precision * pull

    low = None if is_signed else 0.0
    bounds = [(low, None)] * z.shape[1] + [(None, None)]
    return minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x


def moved(
    numbers: Float[np.ndarray, " g"],
    z: Float[np.ndarray, "n f"],
    is_positive: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, " g"]:
    """Return pooled weights and bias moved part of the way to what fits some labelled answers.

    Args:
        numbers: pooled weights, the bias last (g = f + 1).
        z: features, standardised as in the pool.
        is_positive: the class whose log odds are modelled.
    """
    # Every feature is larger where that class is more likely: a negative weight is chance.
    fitted = fit_logistic(
        z,
        is_positive,
        effective_weights(is_positive),
        start=numbers,
        precision=np.append(np.full(len(numbers) - 1, PRIOR_PRECISION), BIAS_PRECISION),
        is_signed=False,
    )
    return numbers + OF_THE_WAY * (fitted - numbers)


def fit(calibration: CalibrationSplit, base: Detector) -> Detector:
    """Refine the pooled numbers of being map-out by the labelled frames of a calibration half.

    Args:
        calibration: frames that may be fitted on, with the columns that `base` reads.
        base: the shipped numbers.

    Returns:
        Weights half of the way from the pooled to the fitted ones; its threshold is the level that
        accepts 95 % of the in-map calibration frames, NaN where there is none.
    """
    x = np.stack([np.asarray(calibration.signals[name], float) for name in base.columns], axis=1)
    known, is_out = calibration.is_in | calibration.is_out, calibration.is_out
    z = ((x - base.mean) / base.scale)[known]
    best = moved(np.append(base.weight, base.bias), z, is_out[known])
    counts = int(calibration.is_in.sum()), int(is_out.sum())
    note = _note(f"{len(base.columns)} signals, shrunk to pooled recordings", *counts)
    return _accepting(base._replace(weight=best[:-1], bias=float(best[-1]), note=note), calibration)


def _accepting(detector: Detector, calibration: CalibrationSplit) -> Detector:
    """Return the detector with the level that accepts 95 % of the in-map calibration frames."""
    inside = probability(detector, calibration.signals)[calibration.is_in]
    return detector._replace(threshold=accepting_level(inside))


def fit_plain(calibration: CalibrationSplit, columns: Sequence[str]) -> Detector:
    """Fit a plain logistic model of being map-out, as the paper's Table 3 has two of.

    Args:
        calibration: frames that may be fitted on, with these signals; location and scale of each
            come from all of them, labelled or not.
        columns: signals that it may read, as in `LOGISTIC`.

    Returns:
        The detector; with one class, or a handful of frames, it knows nothing. Its threshold is
        the level that accepts 95 % of the in-map calibration frames; NaN where there is none.
    """
    x = np.stack([np.asarray(calibration.signals[name], float) for name in columns], axis=1)
    mean, spread = x.mean(axis=0), x.std(axis=0)
    scale = np.where(spread > _TINY, spread, 1.0)
    known = calibration.is_in | calibration.is_out
    is_out = calibration.is_out[known]
    best = fit_logistic(
        ((x - mean) / scale)[known],
        is_out,
        effective_weights(is_out),
        start=np.zeros(len(columns) + 1),
        precision=np.append(np.full(len(columns), PLAIN_PRECISION), PLAIN_BIAS_PRECISION),
    )
    # Told from the mean in-map frame, a term says what makes a frame unlike the places it knows.
    level = x[calibration.is_in].mean(axis=0) if calibration.is_in.any() else mean
    detector = Detector(
        columns=tuple(columns),
        mean=level,
        scale=scale,
        weight=best[:-1],
        bias=float(best[-1] + np.sum((level - mean) / scale * best[:-1])),
        threshold=float("nan"),
        note=_note(
            f"{len(columns)} signals, shrunk to zero", int((~is_out).sum()), int(is_out.sum())
        ),
    )
    return _accepting(detector, calibration)


def accepting_level(inside: Float[np.ndarray, " n"]) -> float:
    """Return the lowest level that accepts at least 95 % of some frames.

    Args:
        inside: signal of calibration frames that should be accepted.

    Returns:
        NaN without any frame, or where the signal of one is NaN.
    """
    if not inside.size or np.isnan(inside).any():
        return float("nan")
    level = float(np.sort(inside)[int(np.ceil(ACCEPTED_SHARE * len(inside))) - 1])
    return level + ROUNDING * abs(level)


def sigma_threshold(
    calibration: CalibrationSplit, name: str, sigmas: float, *, is_probability: bool = False
) -> float:
    """Return a signal's frozen threshold: mean + sigmas x standard deviation of in-map frames.

    Args:
        calibration: frames that may be fitted on.
        name: the signal.
        sigmas: the paper's 3.
        is_probability: a mean and a deviation mean little for a probability; take the level that
            accepts 95 % of the in-map frames instead.

    Returns:
        The threshold (population standard deviation), or NaN without an in-map frame.
    """
    inside = np.asarray(calibration.signals[name], dtype=float)[calibration.is_in]
    if is_probability:
        return accepting_level(inside)
    if not inside.size or np.isnan(inside).any():
        return float("nan")
    return float(inside.mean() + sigmas * inside.std())


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
