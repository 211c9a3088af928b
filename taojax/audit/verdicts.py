"""May this answer enter the graph? One verdict per frame, with its reason."""

from collections.abc import Mapping

import numpy as np

from taojax.audit.labels import CalibrationSplit
from taojax.detector import Detector, log_odds_terms, probability

ABSTAIN = {
    "warming_up": "warming_up: fewer than three frames seen",
    "degenerate": "degenerate: the window does not determine a pose",
    "no_candidates": "no_candidates: the retrieval offered no place",
    "lost": "lost: a jump was noticed and no branch is established again",
}
"""Statuses in which nothing is decided."""

STALE = "stale: the newest frame itself does not support the place"
"""Why a frame that looks in-map is not accepted: its closure would rest on older frames alone, and
after a kidnap those are wrong."""


def plain(value: float) -> str:
    """Return four significant digits without an exponent, for people."""
    return np.format_float_positional(value, precision=4, unique=False, fractional=False, trim="-")


def _loudest(
    detector: Detector, signals: Mapping[str, np.ndarray], calibration: CalibrationSplit
) -> list[str]:
    """Say, per frame, which signal speaks most for being off the map, against its in-map level."""
    inside = {name: calibration.signals[name][calibration.is_in] for name in detector.columns}
    level = log_odds_terms(detector, inside).mean(axis=0, keepdims=True)
    excess = log_odds_terms(detector, signals) - level
    loudest = np.argmax(excess, axis=1)
    said = []
    for row, column in zip(excess, loudest, strict=True):
        name = detector.columns[column]
        if row[column] <= 0:
            said.append("no signal lies above its in-map mean")
        else:
            said.append(f"most of it from {name}: {plain(row[column])} log odds above in-map")
    return said


def decide(
    signals: Mapping[str, np.ndarray], calibration: CalibrationSplit, detector: Detector
) -> dict[str, np.ndarray]:
    """Judge every frame by its probability at the detector's frozen threshold.

    Args:
        signals: the columns of signals.csv, status included.
        calibration: the frames that the detector was fitted on.
        detector: from `calibration.fit`.

    Returns:
        The columns of verdicts.csv; no reason holds a comma.
    """
    threshold, p = detector.threshold, probability(detector, signals)
    blind = np.isnan(threshold)
    no_level = "no in-map frame in the calibration split: no threshold"
    loudest = None if blind else _loudest(detector, signals, calibration)
    verdict, reason = [], []
    for t, status in enumerate(signals["status"]):
        if status in ABSTAIN or loudest is None:
            verdict.append("abstain")
            reason.append(ABSTAIN.get(status, no_level))
            continue
        is_above = p[t] > threshold
        if not is_above and signals["stale"][t] > 0:
            verdict.append("abstain")
            reason.append(STALE)
            continue
        verdict.append("reject" if is_above else "accept")
        reason.append(
            f"probability {plain(p[t])} {'exceeds' if is_above else 'is within'} threshold "
            f"{plain(threshold)} by {plain(abs(p[t] - threshold))}; {loudest[t]}"
        )
    return {
        "frame": signals["frame"],
        "verdict": np.array(verdict, dtype=object),
        "probability_map_out": p,
        "reason": np.array(reason, dtype=object),
    }
