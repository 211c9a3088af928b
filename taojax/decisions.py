"""May this answer enter the graph? Two verdicts per frame, with reasons, for robot and judge."""

from collections.abc import Mapping

import numpy as np

from taojax.risk import Calibration, Risk, lone_doubt, probability, probability_wrong, terms

STATUS_MEANS = {
    "ok": "",
    "warming_up": "fewer than three frames seen",
    "degenerate": "the window does not determine a pose",
    "no_candidates": "the frontend offered no place",
}
"""Status -> what it says; no comma, because reasons stand in CSV cells."""

SILENT = ("warming_up", "no_candidates")
"""Statuses of frames that offer no answer of their own to be accepted."""

REJECTED_ABOVE = 0.5
"""An answer that is more likely wrong than right is rejected."""

POSE = ("x_m", "y_m", "theta_rad")


def plain(value: float) -> str:
    """Return four significant digits without an exponent, for people."""
    return np.format_float_positional(value, precision=4, unique=False, fractional=False, trim="-")


def judged(
    risk: Risk, features: Mapping[str, np.ndarray], status: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return verdict, reason and probability of being wrong of every answer.

    Args:
        risk: frozen numbers.
        features: the columns that they read.
        status: of every frame, as in signals.csv.
    """
    p, parts = probability_wrong(risk, features), terms(risk, features)
    is_alone = p == lone_doubt(risk, features)
    verdicts, reasons = [], []
    for t, said in enumerate(status):
        name = risk.alone if is_alone[t] else risk.columns[int(np.argmax(parts[t]))]
        doubt = f"largest doubt: {name}"
        if said in SILENT:
            verdict, reason = "abstain", f"{said}: {STATUS_MEANS[said]}"
        elif p[t] <= risk.level:
            verdict = "accept"
            reason = f"wrong with probability {plain(p[t])}; accepted up to {plain(risk.level)}"
        elif p[t] > REJECTED_ABOVE:
            verdict = "reject"
            reason = f"wrong with probability {plain(p[t])}: more likely wrong than right; {doubt}"
        elif np.isnan(risk.level):
            verdict, reason = "abstain", f"no level: {risk.promise}"
        else:
            verdict = "abstain"
            reason = (
                f"wrong with probability {plain(p[t])}: neither sure enough to accept "
                f"(at most {plain(risk.level)}) nor to reject; {doubt}"
            )
        verdicts.append(verdict)
        reasons.append(reason.replace(",", ";"))
    return np.array(verdicts, dtype=object), np.array(reasons, dtype=object), p


def decide(
    calibration: Calibration, signals: Mapping[str, np.ndarray], delayed: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Judge every frame twice: as it came, and a lag later.

    Args:
        calibration: frozen numbers.
        signals: the columns of signals.csv, status included.
        delayed: the columns of delayed.csv.

    Returns:
        The columns of verdicts.csv; no reason holds a comma. A frame without candidates, and the
        first two, are answered by neither.
    """
    status = np.asarray(signals["status"])
    has = ~np.isin(status, SILENT)
    verdict, reason, p = judged(calibration.final, delayed, status)
    now, why_now, p_now = judged(calibration.now, signals, status)
    answered = lambda values: np.where(has, np.asarray(values, float), np.nan)
    return {
        "frame": signals["frame"],
        "verdict": verdict,
        "reason": reason,
        "probability_wrong": p,
        **{name: answered(delayed[name]) for name in POSE},
        "map_index": np.where(has, np.asarray(delayed["map_index"]), -1),
        "verdict_now": now,
        "reason_now": why_now,
        "probability_wrong_now": p_now,
        "x_now_m": answered(signals["now_x_m"]),
        "y_now_m": answered(signals["now_y_m"]),
        "theta_now_rad": answered(signals["now_theta_rad"]),
        "probability_map_out": probability(calibration.map_out, delayed),
    }
