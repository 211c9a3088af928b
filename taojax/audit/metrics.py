"""Point estimates and their intervals by circular block bootstrap.

Map-out is the positive class; accept means signal <= threshold.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from taojax.audit.labels import TestSplit
from taojax.errors import InputError

_CELLS = 2_000_000  # weights handled at once: 16 MB per temporary array

_LEVEL = (2.5, 97.5)  # percent: a 95 % interval


class Separation(NamedTuple):
    """How well a signal separates the classes, one value per resample; NaN = a class is lost."""

    auroc: Float[np.ndarray, " b"]
    aupr_out: Float[np.ndarray, " b"]
    aupr_in: Float[np.ndarray, " b"]
    far_at_95: Float[np.ndarray, " b"]


def block_weights(n: int, block: int, n_resamples: int, seed: int) -> Float[np.ndarray, "b n"]:
    """Draw resamples of whole blocks of time, the end joined to the start.

    Args:
        n: frames.
        block: frames per block; frames nearer than this are not independent.
        n_resamples: rows to draw.
        seed: of the generator.

    Returns:
        How often each frame was drawn; every row sums to n.

    Source:
        Politis & Romano, A circular block-resampling procedure for stationary data, 1992.
    """
    rng = np.random.default_rng(seed)
    block = min(block, max(n, 1))
    starts = rng.integers(0, max(n, 1), size=(n_resamples, -(-n // block)))
    drawn = (starts[..., None] + np.arange(block)).reshape(n_resamples, -1)[:, :n] % max(n, 1)
    flat = drawn + n * np.arange(n_resamples)[:, None]
    counts = np.bincount(flat.ravel(), minlength=n_resamples * n)
    return counts.reshape(n_resamples, n).astype(float)


def _separate(
    w_in: Float[np.ndarray, "b g"], w_out: Float[np.ndarray, "b g"]
) -> Float[np.ndarray, "4 b"]:
    """Return the four statistics from class weights per distinct value, ascending."""
    c_in, c_out = np.cumsum(w_in, axis=1), np.cumsum(w_out, axis=1)
    n_in, n_out = c_in[:, -1:], c_out[:, -1:]
    with np.errstate(invalid="ignore", divide="ignore"):
        auroc = np.sum(w_out * (c_in - 0.5 * w_in), axis=1) / (n_in * n_out)[:, 0]
        above_out = n_out - c_out + w_out
        above = above_out + n_in - c_in + w_in
        # An empty tail has no precision, and no weight to multiply it with.
        precision = np.divide(above_out, above, out=np.zeros_like(above), where=above > 0)
        aupr_out = np.sum(w_out * precision, axis=1) / n_out[:, 0]
        below = c_in + c_out
        precision = np.divide(c_in, below, out=np.zeros_like(below), where=below > 0)
        aupr_in = np.sum(w_in * precision, axis=1) / n_in[:, 0]
        # In whole numbers, for 0.95 n is not exact.
        first = np.argmax(20.0 * c_in >= 19.0 * n_in, axis=1)[:, None]
        far = (np.take_along_axis(c_out, first, axis=1) / n_out)[:, 0]
        lost = (n_in * n_out)[:, 0] == 0
    return np.where(lost, np.nan, np.stack([auroc, aupr_out, aupr_in, far]))


def weighted_separation(
    signal: Float[np.ndarray, " n"],
    is_out: Bool[np.ndarray, " n"],
    weights: Float[np.ndarray, "b n"],
) -> Separation:
    """Compute AUROC, both AUPR and FAR@95 under every row of weights.

    Args:
        signal: larger = more likely map-out.
        is_out: the true class.
        weights: non-negative whole numbers, one row per resample.

    Returns:
        What scikit-learn returns with `sample_weight`, for all rows at once.
    """
    if not signal.size:
        return Separation(*np.full((4, len(weights)), np.nan))
    order = np.argsort(signal, kind="stable")
    ordered = signal[order]
    starts = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]])
    rows = max(1, _CELLS // len(signal))
    parts = []
    for start in range(0, len(weights), rows):
        w = weights[start : start + rows, order]
        w_out = np.add.reduceat(w * is_out[order][None], starts, axis=1)
        parts.append(_separate(np.add.reduceat(w, starts, axis=1) - w_out, w_out))
    return Separation(*np.concatenate(parts, axis=1))


def weighted_mean(
    value: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, " b"]:
    """Return the mean under every row of weights; NaN where a row has no weight."""
    total = weights.sum(axis=1)
    return np.divide(weights @ value, total, out=np.full(len(total), np.nan), where=total > 0)


def weighted_median(
    value: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, " b"]:
    """Return the median under every row of whole-number weights; NaN where a row has none."""
    if not value.size:
        return np.full(len(weights), np.nan)
    order = np.argsort(value, kind="stable")
    mass = np.cumsum(weights[:, order], axis=1)
    half = mass[:, -1:] / 2
    low, high = np.argmax(mass >= half, axis=1), np.argmax(mass > half, axis=1)
    middle = (value[order][low] + value[order][high]) / 2
    return np.where(mass[:, -1] > 0, middle, np.nan)


def interval(samples: Float[np.ndarray, " b"]) -> tuple[float, float]:
    """Return the 95 % percentile interval, or NaN when more than half of the resamples are lost.

    Args:
        samples: one value per resample; NaN = lost (a class was not drawn).
    """
    kept = samples[np.isfinite(samples)]
    if 2 * len(kept) < len(samples) or not len(kept):
        return float("nan"), float("nan")
    low, high = np.percentile(kept, _LEVEL)
    return float(low), float(high)


def _check(signal: np.ndarray, is_out: np.ndarray) -> None:
    if signal.shape != is_out.shape:
        raise InputError(f"signal {signal.shape} and labels {is_out.shape} differ in length")
    n_out = int(is_out.sum())
    if n_out in (0, len(is_out)):
        n_in = len(is_out) - n_out
        raise InputError(f"both classes are needed; got {n_in} in-map and {n_out} map-out frames")


def auroc(signal: Float[np.ndarray, " n"], is_out: Bool[np.ndarray, " n"]) -> float:
    """Return the chance that a random map-out frame outscores a random in-map one, ties half.

    Args:
        signal: larger = more likely map-out.
        is_out: the true class, grey frames left out.

    Raises:
        InputError: one class only; 0.5 would be an invented number.

    Source:
        Hanley & McNeil, Radiology 143, 1982.
    """
    from sklearn.metrics import roc_auc_score

    _check(signal, is_out)
    return float(roc_auc_score(is_out, signal))


def aupr(signal: Float[np.ndarray, " n"], is_out: Bool[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the average precision for map-out and for in-map as the positive class.

    Raises:
        InputError: one class only.
    """
    from sklearn.metrics import average_precision_score as score

    _check(signal, is_out)
    return float(score(is_out, signal)), float(score(~is_out, -signal))


def far_at_95(signal: Float[np.ndarray, " n"], is_out: Bool[np.ndarray, " n"]) -> float:
    """Return the share of map-out frames accepted where 95 % of in-map frames are.

    The threshold is the first value that accepts at least 95 %, ties accepted.

    Raises:
        InputError: one class only.
    """
    _check(signal, is_out)
    inside = np.sort(signal[~is_out])
    threshold = inside[-(-19 * len(inside) // 20) - 1]
    return float(np.mean(signal[is_out] <= threshold))


class Exits(NamedTuple):
    """Each time the robot left the map."""

    first: Int[np.ndarray, " e"]
    """First map-out frame."""

    last: Int[np.ndarray, " e"]
    """Last map-out frame before the robot is back in the map, or the recording ends."""


def find_exits(label: Shaped[np.ndarray, " n"]) -> Exits:
    """Find where in-map turns into map-out; grey frames between do not reset.

    Args:
        label: in_map, map_out or grey, in order of time.

    Returns:
        One entry per exit; map-out frames before the first in-map frame are no exit.
    """
    frame = np.flatnonzero(label != "grey")
    out = label[frame] == "map_out"
    turns = np.flatnonzero(np.diff(out.astype(int))) + 1
    starts = turns[out[turns]]
    ends = np.r_[turns, len(out)][np.searchsorted(turns, starts) + 1]
    return Exits(frame[starts], frame[ends - 1])


def detection_delays(
    signal: Float[np.ndarray, " n"], exits: Exits, threshold: float
) -> tuple[Int[np.ndarray, " e"], Bool[np.ndarray, " e"]]:
    """Count the frames from each exit to the first rejection.

    Args:
        signal: of the frames that `exits` counts.
        exits: from `find_exits`.
        threshold: frozen.

    Returns:
        Delay in frames (0 = the first map-out frame is rejected), and whether the exit was
        never noticed, in which case the delay is its length.
    """
    delays, missed = [], []
    for first, last in zip(*exits, strict=True):
        above = signal[first : last + 1] > threshold
        missed.append(not above.any())
        delays.append(int(np.argmax(above)) if above.any() else len(above))
    return np.array(delays, dtype=int), np.array(missed, dtype=bool)


class OperatingPoint(NamedTuple):
    """A signal at its frozen threshold; NaN where the class is absent."""

    far: float
    frr: float
    delays: Int[np.ndarray, " e"]
    is_censored: Bool[np.ndarray, " e"]


def operate(test: TestSplit, name: str, threshold: float) -> OperatingPoint:
    """Score one signal of the test split at a threshold that was frozen before.

    Args:
        test: held-out frames.
        name: the signal.
        threshold: from the calibration split.
    """
    accepted = test.signals[name] <= threshold
    far = float(accepted[test.is_out].mean()) if test.is_out.any() else float("nan")
    frr = float((~accepted[test.is_in]).mean()) if test.is_in.any() else float("nan")
    delays, missed = detection_delays(test.signals[name], find_exits(test.label), threshold)
    return OperatingPoint(far, frr, delays, missed)


def recall_curve(
    index: Int[np.ndarray, "t k"],
    query_m: Float[np.ndarray, "t 2"],
    map_m: Float[np.ndarray, "m 2"],
    radius_m: float,
) -> Float[np.ndarray, " k"]:
    """Return recall@1 to recall@K over all queries, answerable or not.

    Args:
        index: retrieved map rows, best first; -1 = no candidate.
        query_m: true positions, metres.
        map_m: map positions, metres.
        radius_m: a candidate within this distance of the truth is right.
    """
    gap = map_m[np.maximum(index, 0)] - query_m[:, None]
    right = (np.hypot(gap[..., 0], gap[..., 1]) <= radius_m) & (index >= 0)
    return np.maximum.accumulate(right, axis=1).mean(axis=0)
