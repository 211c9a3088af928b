"""The frozen numbers of the paper's question, in the map or off it: fitted by the judge.

A linear model of the log odds of being off the map, over sealed signals. Each frame is judged from
its own row; memory is in the signals.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LARGEST_LOG_ODDS = 30.0
"""Keeps probabilities inside (0, 1) in float64."""

LIST_RECALL = 0.75
"""Recall of retrieval lists without map descriptors, and of a run that does not say: neither blind
nor sure."""


class MapFacts(NamedTuple):
    """Which map a detector was fitted on, told by what both sides can measure."""

    poses_sha256: str
    """Of map/poses.csv."""

    views_sha256: str
    """Of the map's descriptors; blank where the frontend gives lists."""

    spacing_m: float
    """Median distance between neighbours."""

    recall: float
    """Share of map images whose most similar other image lies nearby."""


class Detector(NamedTuple):
    """Everything that `probability` needs."""

    columns: tuple[str, ...]
    """Signals it reads."""

    mean: Float[np.ndarray, " f"]
    """Of each signal over the in-map calibration frames, over all where none is: what its term is
    measured from."""

    scale: Float[np.ndarray, " f"]
    weight: Float[np.ndarray, " f"]
    """Log odds per standardised signal."""

    bias: float
    threshold: float
    """Frames with a probability above it are rejected; NaN = nothing can be decided."""

    note: str
    """How it was fitted, in words."""


def log_odds_terms(
    detector: Detector, signals: Mapping[str, np.ndarray]
) -> Float[np.ndarray, "t f"]:
    """Return what each signal adds to the log odds of each frame above the mean in-map frame's."""
    table = np.stack([np.asarray(signals[name], float) for name in detector.columns], axis=1)
    return (table - detector.mean[None]) / detector.scale[None] * detector.weight[None]


def probability(detector: Detector, signals: Mapping[str, np.ndarray]) -> Float[np.ndarray, " t"]:
    """Return the probability of being off the map, frame by frame; no frame sees another.

    Args:
        detector: fitted numbers.
        signals: column -> (t,).
    """
    # Summed by hand: a matrix product may round differently for other numbers of frames.
    log_odds = np.sum(log_odds_terms(detector, signals), axis=1) + detector.bias
    return 1.0 / (1.0 + np.exp(-np.clip(log_odds, -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)))


def foreign_map(then: MapFacts | None, here: MapFacts | None) -> str | None:
    """Say so where numbers were fitted on another map than the one at hand.

    Args:
        then: the map they were fitted on; None = no site's.
        here: the map that they are about to judge; None = unknown.

    Returns:
        One sentence; None where the map is the same, or nobody knows.
    """
    if then is None or here is None or then[:2] == here[:2]:
        return None
    is_same = then.poses_sha256 == here.poses_sha256
    what = "other descriptors of this map" if is_same else "another map"
    told = lambda facts: f"spacing {facts.spacing_m:.3g} m and recall {facts.recall:.2f}"
    return (
        f"the calibration was fitted on {what} ({told(then)}; here {told(here)}): how many wrong"
        " answers its level accepts here is unknown until this place is audited"
    )
