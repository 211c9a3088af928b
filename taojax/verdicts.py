"""May this answer enter the graph? One verdict per frame, with its reason, for robot and judge."""

from collections.abc import Mapping

import numpy as np

from taojax.detector import Detector, log_odds_terms, probability

STATUS_MEANS = {
    "ok": "",
    "warming_up": "fewer than three frames seen",
    "degenerate": "the window does not determine a pose",
    "no_candidates": "the frontend offered no place",
    "lost": "the newest frames contradict the window and no branch is established again",
}
"""Status -> what it says; no comma, because reasons stand in CSV cells."""

STALE = "stale: this frame itself does not support the place"
"""Why a frame that looks in-map is not accepted: its closure would rest on older frames alone, and
after a kidnap those are wrong."""

NO_LEVEL = "no threshold: no in-map frame in the calibration split"


def plain(value: float) -> str:
    """Return four significant digits without an exponent, for people."""
    return np.format_float_positional(value, precision=4, unique=False, fractional=False, trim="-")


def _margin(p: float, threshold: float, terms: Mapping[str, float]) -> str:
    """Say how far a probability lies from the threshold, and what speaks most for off the map."""
    name, is_above = max(terms, key=lambda name: terms[name]), p > threshold
    kind = "most of it from" if is_above else "its largest doubt is"
    loudest = f"{kind} {name}: {plain(terms[name])} log odds above in-map"
    if terms[name] <= 0:
        loudest = "no signal lies above its in-map mean"
    side = "exceeds" if is_above else "is within"
    return (
        f"probability {plain(p)} {side} threshold {plain(threshold)} by {plain(abs(p - threshold))}"
        f"; {loudest}"
    )


def decide(detector: Detector, signals: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Judge every frame by its probability at the detector's frozen threshold.

    Accepted is what lies within the threshold and is supported by the frame itself; nothing is
    decided where the status is not `ok`, or where there is no threshold.

    Args:
        detector: frozen numbers.
        signals: the columns of signals.csv, status included.

    Returns:
        The columns of verdicts.csv; no reason holds a comma.
    """
    threshold, p = detector.threshold, probability(detector, signals)
    terms = log_odds_terms(detector, signals)
    verdicts, reasons = [], []
    for t, status in enumerate(signals["status"]):
        is_above = bool(p[t] > threshold)
        if status != "ok":
            verdict, reason = "abstain", f"{status}: {STATUS_MEANS[status]}"
        elif np.isnan(threshold):
            verdict, reason = "abstain", NO_LEVEL
        elif not is_above and signals["stale"][t] > 0:
            verdict, reason = "abstain", STALE
        else:
            verdict = "reject" if is_above else "accept"
            own = dict(zip(detector.columns, terms[t].tolist(), strict=True))
            reason = _margin(float(p[t]), threshold, own)
        verdicts.append(verdict)
        reasons.append(reason)
    return {
        "frame": signals["frame"],
        "verdict": np.array(verdicts, dtype=object),
        "probability_map_out": p,
        "reason": np.array(reasons, dtype=object),
    }
