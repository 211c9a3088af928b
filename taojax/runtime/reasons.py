"""What stands behind a verdict at run time, in words."""

from collections.abc import Mapping

import numpy as np

from taojax.detector import Detector, log_odds_terms

STATUS_MEANS = {
    "ok": "",
    "warming_up": "fewer than three frames seen",
    "degenerate": "the window does not determine a pose",
    "no_candidates": "the frontend offered no place for this frame",
    "lost": "the newest frames contradict the window: the robot was moved, or the branch was wrong",
}
"""Status -> what it says."""

STALE = "this frame itself does not support the place, and older ones alone must not close a loop"
"""Why a frame that looks in-map is not accepted."""


def signal_terms(detector: Detector, row: Mapping[str, float]) -> dict[str, float]:
    """Return what each signal of a frame adds to its log odds of being off the map.

    Args:
        detector: frozen numbers.
        row: signals of the frame.

    Returns:
        Signal -> log odds against a mean calibration frame, the largest first.
    """
    terms = log_odds_terms(detector, {name: np.array([row[name]]) for name in detector.columns})[0]
    order = np.argsort(-np.abs(terms), kind="stable")
    return {detector.columns[at]: float(terms[at]) for at in order}


def reason(
    detector: Detector, row: Mapping[str, float], status: str, verdict: str, probability: float
) -> str:
    """Return why a frame got its verdict, in one line.

    Args:
        detector: frozen numbers.
        row: signals of the frame.
        status: of the frame.
        verdict: accept, reject or abstain.
        probability: of being off the map.
    """
    if verdict == "abstain":
        return STATUS_MEANS[status] or STALE
    if np.isnan(detector.threshold):
        return "the calibration holds no threshold"
    side = "exceeds" if verdict == "reject" else "is within"
    name, term = next(iter(signal_terms(detector, row).items()))
    gap = abs(probability - detector.threshold)
    return (
        f"probability {probability:.4g} {side} threshold {detector.threshold:.4g} by {gap:.4g}; "
        f"most from {name}: {term:+.3g} log odds"
    )
