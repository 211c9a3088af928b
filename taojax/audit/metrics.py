"""Point estimates. Map-out is the positive class; accept means signal <= threshold."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from taojax.audit.labels import TestSplit
from taojax.errors import InputError


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
