"""Which closures each method hands to the back-end, from what a run answered and decided."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from taojax.errors import InputError
from taojax.files.pose_graph_io import Verdicts, between, build_graph, read_verdicts, wrap
from taojax.files.records import Run

__all__ = ["DIRECTION_RAD", "Answers", "Closure", "Run2D", "Stream", "Tie", "read_answers"]

DIRECTION_RAD = 0.3
"""Standard deviation between the direction of travel and that of a map image, or its reverse,
where the heading was not answered [rad]: a lane change, a bend between two images."""

AROUND = 5
"""Frames to either side whose candidates say in which direction a place is travelled."""

UNSURE = 0.5
"""Probability of being wrong of an answer that carries none."""


class Tie(NamedTuple):
    """The other end of a closure between two frames of one drive."""

    frame: int
    """The older one."""

    motion: Float[np.ndarray, "3"]
    """Pose of the newer frame in axes of the older: x [m], y [m], theta [rad]."""


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

    tie: Tie | None = None
    """Of one drive that closes on itself: the frame it closes on; None = the map is fixed."""


class Stream(NamedTuple):
    """One answer per frame, and whether it is accepted."""

    accepted: Bool[np.ndarray, " t"]
    pose: Float[np.ndarray, "t 3"]
    """NaN where there is no answer."""

    covariance: Float[np.ndarray, "t 3 3"]
    probability_wrong: Float[np.ndarray, " t"]
    anchor: Int[np.ndarray, " t"] | None = None
    """Of one drive that closes on itself: the frame that each closes on, -1 = none."""

    motion: Float[np.ndarray, "t 3"] | None = None
    """And the pose in axes of that frame."""

    def _tie(self, t: int) -> Tie | None:
        if self.anchor is None or self.motion is None:
            return None
        return Tie(int(self.anchor[t]), self.motion[t])

    def closures(self, chosen: Bool[np.ndarray, " t"]) -> tuple[Closure, ...]:
        """Return the chosen frames that have an answer, in the order of time."""
        rows = np.flatnonzero(chosen & np.isfinite(self.pose[:, 0]))
        p = np.where(np.isnan(self.probability_wrong), UNSURE, self.probability_wrong)
        return tuple(
            Closure(t, self.pose[t], self.covariance[t], float(p[t]), self._tie(t))
            for t in rows.tolist()
        )


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

    own_gap_m: float = 0.0
    """One drive that closes on itself: the way between a frame and the newest one that it may close
    on; map row m is frame m, where odometry has put it. 0 = the map is another drive."""

    @property
    def is_own(self) -> bool:
        """Whether the map is the drive itself."""
        return self.own_gap_m > 0


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


def _headed(stream: Stream, index: np.ndarray) -> Stream:
    """Give first candidates of one drive a heading: that of their place, or the other way.

    A factor between two free poses needs one. Where the candidates of the frames around run
    backwards along the drive, the place is travelled the other way; by how far a lane or a bend may
    turn it, `DIRECTION_RAD` says.
    """
    n, votes = len(index), np.zeros(len(index))
    for away in range(1, AROUND + 1):
        if n <= 2 * away:
            break
        before, after = index[: -2 * away], index[2 * away :]
        step = after - before
        is_near = (before >= 0) & (after >= 0) & (np.abs(step) <= 4 * away)
        votes[away:-away] += np.where(is_near, np.sign(step), 0)
    pose = stream.pose.copy()
    pose[:, 2] = wrap(np.where(votes < 0, pose[:, 2] + np.pi, pose[:, 2]))
    covariance = stream.covariance.copy()
    covariance[:, 2, 2] = DIRECTION_RAD**2
    return stream._replace(pose=pose, covariance=covariance)


def _tied(stream: Stream, anchor: np.ndarray, drive: np.ndarray) -> Stream:
    """Say of every answer of one drive which frame it closes on."""
    return stream._replace(anchor=anchor, motion=between(drive[np.maximum(anchor, 0)], stream.pose))


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
    if graph.is_own:
        top1 = _headed(top1, run.index[:, 0].astype(int))
    final = Stream(verdicts.verdict == "accept", graph.pose, graph.covariance, verdicts.probability)
    now = Stream(
        verdicts.verdict_now == "accept", verdicts.pose_now, graph.covariance,
        verdicts.probability_now,
    )  # fmt: skip
    if graph.is_own:
        now_index = np.where(np.isfinite(now.pose[:, 0]), run.signals["now_map_index"], -1)
        final = _tied(final, verdicts.map_index, graph.map_pose)
        now = _tied(now, now_index.astype(int), graph.map_pose)
        top1 = _tied(top1, run.index[:, 0].astype(int), graph.map_pose)
    return Run2D(
        answers=Answers(final, now, top1, similarity),
        odometry=graph.odometry,
        is_start=graph.is_start,
        map_pose=graph.map_pose,
        spacing_m=graph.spacing_m,
        own_gap_m=float(run.manifest.get("own_gap_m", 0.0)),
    )
