"""May this answer enter the graph? One verdict per frame, with its reason."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from taojax.audit.calibration import sigma_threshold
from taojax.audit.labels import CalibrationSplit

ABSTAIN = {
    "warming_up": "warming_up: fewer than three frames seen",
    "degenerate": "degenerate: the window does not determine a pose",
    "no_candidates": "no_candidates: the retrieval offered no place",
    "lost": "lost: a jump was noticed and no branch is established again",
}
"""Statuses in which nothing is decided."""

_TERMS = {"tao_geom": "residual", "tao_vel": "velocity", "tao_sim": "similarity"}


def plain(value: float) -> str:
    """Return four significant digits without an exponent, for people."""
    return np.format_float_positional(value, precision=4, unique=False, fractional=False, trim="-")


def _loudest_term(
    signals: Mapping[str, np.ndarray], calibration: CalibrationSplit
) -> tuple[list[str], Float[np.ndarray, " t"]]:
    """Name, per frame, the term of tao that lies farthest above its mean in-map level."""
    excess = np.stack(
        [signals[name] - np.mean(calibration.signals[name][calibration.is_in]) for name in _TERMS],
        axis=1,
    )
    loudest = np.argmax(excess, axis=1)
    names = list(_TERMS)
    return [names[i] for i in loudest], excess[np.arange(len(loudest)), loudest]


def _describe(term: str, excess: float) -> str:
    if excess <= 0:
        return "no term lies above its in-map mean"
    return f"most of it from {term} ({_TERMS[term]}): {plain(excess)} above its in-map mean"


def decide(
    signals: Mapping[str, np.ndarray],
    calibration: CalibrationSplit,
    probability: Float[np.ndarray, " t"],
    sigmas: float,
) -> dict[str, np.ndarray]:
    """Judge every frame by `tao` at its sigma threshold, the paper's rule.

    The terms of tao add up to it, so their excess over the in-map mean, in units of cost, says
    which of them carried a frame to where it is.

    Args:
        signals: the columns of signals.csv, status included.
        calibration: the frames that the threshold may come from.
        probability: of being map-out; NaN = unknown.
        sigmas: the paper's 3.

    Returns:
        The columns of verdicts.csv; no reason holds a comma.
    """
    threshold = sigma_threshold(calibration, "tao", sigmas)
    blind = np.isnan(threshold)
    no_level = "no in-map frame in the calibration split: no threshold"
    terms = None if blind else _loudest_term(signals, calibration)
    verdict, reason = [], []
    for t, (status, tao) in enumerate(zip(signals["status"], signals["tao"], strict=True)):
        if status in ABSTAIN or terms is None:
            verdict.append("abstain")
            reason.append(ABSTAIN.get(status, no_level))
            continue
        is_above = tao > threshold
        verdict.append("reject" if is_above else "accept")
        reason.append(
            f"tao {plain(tao)} {'exceeds' if is_above else 'is within'} threshold "
            f"{plain(threshold)} by "
            f"{plain(abs(tao - threshold))}; {_describe(terms[0][t], terms[1][t])}"
        )
    return {
        "frame": signals["frame"],
        "verdict": np.array(verdict, dtype=object),
        "probability_map_out": probability,
        "reason": np.array(reason, dtype=object),
    }
