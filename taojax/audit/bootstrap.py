"""Intervals by circular block bootstrap, all resamples at once.

A resample is a weight per frame (how often it was drawn), so a statistic that takes weights
needs one sort for all resamples.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

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
