"""Which closures each method hands to the back-end, from what a run answered and decided."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from taojax.closures import Verdicts, build_graph, read_verdicts
from taojax.errors import InputError
from taojax.records import Run

__all__ = ["Answers", "Closure", "Run2D", "Stream", "read_answers"]

UNSURE = 0.5
"""Probability of being wrong of an answer that carries none."""


class Closure(NamedTuple):
    """One answer as a measurement of a query pose in the fixed map."""

    frame: int
    """Query frame."""

    pose: Float[np.ndarray, "3"]
    """x [m], y [m], theta [rad], map frame."""

    covariance: Float[np.ndarray, "3 3"]
    """Of x, y and theta, map frame; an infinite last entry: the heading was not answered."""

    probability_wrong: float
    """That the pose is farther than r_out from the true one."""


class Stream(NamedTuple):
    """One answer per frame, and whether it is accepted."""

    accepted: Bool[np.ndarray, " t"]
    pose: Float[np.ndarray, "t 3"]
    """NaN where there is no answer."""

    covariance: Float[np.ndarray, "t 3 3"]
    probability_wrong: Float[np.ndarray, " t"]

    def closures(self, chosen: Bool[np.ndarray, " t"]) -> tuple[Closure, ...]:
        """Return the chosen frames that have an answer, in the order of time."""
        rows = np.flatnonzero(chosen & np.isfinite(self.pose[:, 0]))
        p = np.where(np.isnan(self.probability_wrong), UNSURE, self.probability_wrong)
        return tuple(Closure(int(t), self.pose[t], self.covariance[t], float(p[t])) for t in rows)


class Answers(NamedTuple):
    """What a run answered: the final verdicts, those of the moment, and the raw first candidate."""

    final: Stream
    now: Stream
    top1: Stream
    """Every first candidate: the map image's position, no heading. A place may have been met in
    either direction, so the direction of the map image is no measurement."""

    similarity: Float[np.ndarray, " t"]
    """Of the first candidate; -inf without one."""


class Run2D(NamedTuple):
    """A run as a pose graph needs it."""

    answers: Answers
    odometry: Float[np.ndarray, "t 3"]
    """Motion into each frame, in axes of the frame before: forward [m], left [m], turn [rad]."""

    is_start: Bool[np.ndarray, " t"]
    """No odometry leads into this frame."""

    map_pose: Float[np.ndarray, "m 3"]
    spacing_m: float
    """Median distance between neighbouring map poses."""


def _raw(run: Run, map_pose: np.ndarray, sigma_m: float) -> tuple[Stream, np.ndarray]:
    """Return the first candidates as answers, and their similarity."""
    index = run.index[:, 0].astype(int)
    has = index >= 0
    pose = np.where(has[:, None], map_pose[np.where(has, index, 0)], np.nan)
    covariance = np.diag([sigma_m**2, sigma_m**2, np.inf])
    every = np.broadcast_to(covariance, (len(index), 3, 3))
    unsure = np.full(len(index), UNSURE)
    similarity = np.where(has, run.similarity[:, 0].astype(float), -np.inf)
    return Stream(has, pose, every, unsure), similarity


def read_answers(folder: Path, run: Run, verdicts: Verdicts | None = None) -> Run2D:
    """Read what a run answered and decided. The only place that knows the columns of its files.

    Args:
        folder: the run.
        run: read from it by `records.read_run`.
        verdicts: what was decided; read from the folder when omitted.

    Raises:
        InputError: nothing is decided, or the run was sealed without its odometry.
    """
    verdicts = verdicts or read_verdicts(folder, run)
    if verdicts is None:
        raise InputError(
            f"{folder}: nothing is decided here; judge it with `taojax evaluate`, or score with"
            " --calibration"
        )
    graph = build_graph(folder, run, verdicts)
    top1, similarity = _raw(run, graph.map_pose, graph.sigma_m)
    final = Stream(verdicts.verdict == "accept", graph.pose, graph.covariance, verdicts.probability)
    now = Stream(
        verdicts.verdict_now == "accept", verdicts.pose_now, graph.covariance,
        verdicts.probability_now,
    )  # fmt: skip
    return Run2D(
        answers=Answers(final, now, top1, similarity),
        odometry=graph.odometry,
        is_start=graph.is_start,
        map_pose=graph.map_pose,
        spacing_m=graph.spacing_m,
    )
