"""Solve the query's pose graph with GTSAM: plain, robust kernels, GNC, and a switch with a prior.

GTSAM is the extra `graph`; it is imported inside functions, so that the rest works without it.
"""

import importlib.util
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from taojax.errors import MissingExtraError
from taojax.files.pose_graph_io import between, compose, in_axes_of, inverse, wrap
from taojax.graph.answers import Closure
from taojax.graph.odometry import Chain, dead_reckoning

__all__ = ["INSTALL", "BackEnd", "Solution", "check_extra", "has_extra", "solve"]

BackEnd = Literal["plain", "huber", "geman_mcclure", "gnc", "switch"]

INSTALL = "python -m pip install 'taojax[graph]'"
"""Brings GTSAM."""

HUBER = 1.345
"""Residual in standard deviations at which Huber's kernel turns linear: 95 % efficiency on Gaussian
noise (Huber, Robust Statistics, 1981)."""

GEMAN_MCCLURE = 2.0
"""Residual in standard deviations at which Geman and McClure's weight is 1/4."""

INLIERS = 0.99
"""Share of right closures that GNC's truncation keeps: its threshold is this quantile of chi^2."""

LM_STEPS = 100
"""Most steps of Levenberg-Marquardt."""

FREE_STEPS = 10
"""The same within a round of GNC where both ends of closures are free: a step takes ten times as
long there, and the next round goes on from where one ends."""

SWITCH_STEPS = 30
"""Most rounds of the switches; they settle in about ten."""

SETTLED = 1e-3
"""A switch that moves less has settled."""

LEAST_WEIGHT = 1e-6
"""Weight of a closure that is switched off: its factor stays, its pull is gone."""

LOOSE = 10.0
"""Standard deviation of the prior that fixes the first pose of a stretch, in lengths of the stretch
and in radians: it only matters where closures leave something open."""

FIRM_M, FIRM_RAD = 1.0, 0.1
"""Standard deviations of the same prior on a stretch without any closure; they move nothing."""


class Solution(NamedTuple):
    """An optimised graph."""

    pose: Float[np.ndarray, "n 3"]
    """x [m], y [m], theta [rad] of every frame of the chain, map frame."""

    weight: Float[np.ndarray, " c"]
    """What GNC or the switches left of each closure, 0 to 1; 1 for the other back-ends."""


def has_extra() -> bool:
    """Return whether GTSAM is there."""
    return importlib.util.find_spec("gtsam") is not None


def check_extra() -> None:
    """Check, before any work, that GTSAM is there.

    Raises:
        MissingExtraError: it is not.
    """
    if not has_extra():
        raise MissingExtraError(f"graph needs gtsam; run: {INSTALL}")


def _aligned(path: np.ndarray, rows: np.ndarray, closures: Sequence[Closure]) -> np.ndarray:
    """Lay dead reckoning on its closures: the rigid motion with the least squared distances.

    Closed form in the plane; answered headings vote with their variance. `path` (n, 3), `rows` the
    row of each closure.
    """
    d, p = path[rows, 0] + 1j * path[rows, 1], np.array([complex(*c.pose[:2]) for c in closures])
    spread = np.array([c.covariance for c in closures])
    weight = 1.0 / (0.5 * (spread[:, 0, 0] + spread[:, 1, 1]))
    weight_rad = 1.0 / spread[:, 2, 2]
    d_mean, p_mean = (np.average(z, weights=weight) for z in (d, p))
    headings = np.array([c.pose[2] for c in closures]) - path[rows, 2]
    vote = (weight * np.conj(d - d_mean) * (p - p_mean)).sum()
    vote += (weight_rad * np.exp(1j * headings)).sum()
    angle = float(np.angle(vote)) if vote else 0.0
    shift = p_mean - np.exp(1j * angle) * d_mean
    return compose(np.array([shift.real, shift.imag, angle]), path)


def _joined(path: np.ndarray, rows: np.ndarray, closures: Sequence[Closure]) -> np.ndarray:
    """Return a path through every closure that follows odometry from the last one."""
    out = path.copy()
    ends = [*rows[1:].tolist(), len(path)]
    for number, (closure, row, end) in enumerate(zip(closures, rows.tolist(), ends, strict=True)):
        first = 0 if number == 0 else row
        leads = compose(closure.pose, inverse(path[row]))
        out[first:end] = compose(leads, path[first:end])
    return out


def _starts(
    chain: Chain, closures: Sequence[Closure], anchor: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return first guesses of all poses, (n, 3) each, from which the graph is solved.

    The one lays the whole of odometry rigidly on the closures; the other starts anew at each of
    them, where all have a heading. Stretches without closures start at their anchor.
    """
    path = dead_reckoning(chain.odometry, chain.is_start)
    if any(c.tie is not None for c in closures):
        return (compose(anchor[0], path),)
    row_of = np.array([c.frame - chain.first for c in closures], int)
    laid, joined, has_heading = path.copy(), path.copy(), True
    for (first, end), pose in zip(chain.parts(), anchor, strict=True):
        inside = np.flatnonzero((row_of >= first) & (row_of < end))
        own, rows = [closures[int(k)] for k in inside], row_of[inside] - first
        if not own:
            laid[first:end] = joined[first:end] = compose(pose, path[first:end])
            continue
        laid[first:end] = _aligned(path[first:end], rows, own)
        if all(np.isfinite(c.covariance[2, 2]) for c in own):
            joined[first:end] = _joined(path[first:end], rows, own)
        else:
            has_heading = False
    return (laid, joined) if has_heading and closures else (laid,)


def _odometry_graph(chain: Chain, closures: Sequence[Closure], start: np.ndarray) -> Any:
    """Return the graph without closures: odometry, and a prior on the first pose of a stretch."""
    import gtsam

    graph, diagonal = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Diagonal.Sigmas
    sigma = np.sqrt(chain.variances())
    # A closure onto the fixed map holds its stretch; one between two free frames does not.
    rows = {c.frame - chain.first for c in closures if c.tie is None}
    for first, end in chain.parts():
        length = float(chain.way_m[first:end].sum())
        is_open = rows.isdisjoint(range(first, end))
        loose = [LOOSE * length, LOOSE * length, LOOSE]
        prior = diagonal([FIRM_M, FIRM_M, FIRM_RAD] if is_open else loose)
        graph.add(gtsam.PriorFactorPose2(first, gtsam.Pose2(*start[first]), prior))
        for t in range(first + 1, end):
            noise = diagonal([sigma[t, 0], sigma[t, 0], sigma[t, 1]])
            graph.add(gtsam.BetweenFactorPose2(t - 1, t, gtsam.Pose2(*chain.odometry[t]), noise))
    return graph


def _factor(closure: Closure, first: int, weight: float = 1.0, kernel: Any = None) -> Any:
    """Return a closure as a factor: a prior on its pose, or on its position alone.

    Args:
        closure: the answer; its covariance is turned into the axes of its pose.
        first: frame of row 0 of the chain.
        weight: its information is multiplied by it.
        kernel: one of gtsam.noiseModel.mEstimator.
    """
    import gtsam

    row, covariance = closure.frame - first, closure.covariance / max(weight, LEAST_WEIGHT)
    has_heading = np.isfinite(closure.covariance[2, 2])
    known = in_axes_of(closure.pose, covariance) if has_heading else covariance[:2, :2]
    noise: Any = gtsam.noiseModel.Gaussian.Covariance(known)
    if kernel is not None:
        noise = gtsam.noiseModel.Robust.Create(kernel, noise)
    if closure.tie is not None:
        other = closure.tie.frame - first
        return gtsam.BetweenFactorPose2(other, row, gtsam.Pose2(*closure.tie.motion), noise)
    if has_heading:
        return gtsam.PriorFactorPose2(row, gtsam.Pose2(*closure.pose), noise)
    # The error of a prior on the whole pose would mix an unknown heading into the position.
    return gtsam.PoseTranslationPrior2D(row, gtsam.Point2(*closure.pose[:2]), noise)


def _values(pose: np.ndarray) -> Any:
    import gtsam

    values = gtsam.Values()
    for row, one in enumerate(pose):
        values.insert(row, gtsam.Pose2(*one))
    return values


def _poses(values: Any) -> np.ndarray:
    import gtsam

    return np.asarray(gtsam.utilities.extractPose2(values))


def _lago(chain: Chain, closures: Sequence[Closure], start: np.ndarray) -> np.ndarray:
    """Return a first guess whose headings solve the linear part of the problem, (n, 3).

    Odometry that has turned too far leads into a wrong minimum; this does not start from it.
    Carlone, Aragues, Castellanos & Bona, A fast and accurate approximation for planar pose graph
    optimization, IJRR 2014. It takes diagonal covariances alone.
    """
    import gtsam

    graph = _odometry_graph(chain, closures, start)
    for closure in closures:
        if closure.tie is None:
            continue
        sigma = np.sqrt(np.diag(in_axes_of(closure.pose, closure.covariance)))
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
        ends = closure.tie.frame - chain.first, closure.frame - chain.first
        graph.add(gtsam.BetweenFactorPose2(*ends, gtsam.Pose2(*closure.tie.motion), noise))
    return _poses(gtsam.lago.initialize(graph))


def _minimise(graph: Any, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the poses that Levenberg-Marquardt ends at, (n, 3), and their cost."""
    import gtsam

    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(LM_STEPS)
    params.setRelativeErrorTol(1e-7)
    values = gtsam.LevenbergMarquardtOptimizer(graph, _values(start), params).optimize()
    return _poses(values), float(graph.error(values))


def _gnc(graph: Any, start: np.ndarray, n_closures: int, *, is_free: bool) -> Solution:
    """Solve by graduated non-convexity with truncated least squares; odometry is never doubted.

    Yang, Antonante, Tzoumas & Carlone, Graduated Non-Convexity for Robust Spatial Perception, RA-L
    2020. The closures are the last factors of the graph; with both ends free a round of it takes
    few steps.
    """
    import gtsam

    params = gtsam.GncLMParams()
    if is_free:
        steps = gtsam.LevenbergMarquardtParams()
        steps.setMaxIterations(FREE_STEPS)
        params = gtsam.GncLMParams(steps)
    trusted = graph.size() - n_closures
    params.setKnownInliers(list(range(trusted)))
    optimizer = gtsam.GncLMOptimizer(graph, _values(start), params)
    optimizer.setInlierCostThresholdsAtProbability(INLIERS)
    values = optimizer.optimize()
    return Solution(_poses(values), np.asarray(optimizer.getWeights())[trusted:])


def _residuals(pose: np.ndarray, chain: Chain, closures: Sequence[Closure]) -> np.ndarray:
    """Return the log densities of all closures at the poses [1 / (m^2 rad)], (c,)."""
    rows = [c.frame - chain.first for c in closures]
    gap = np.array([c.pose for c in closures]) - pose[rows]
    spread = np.array([c.covariance for c in closures])
    if closures[0].tie is not None:
        # In axes of the answer, which move with the older end.
        leads = np.array(
            [compose(pose[c.tie.frame - chain.first], c.tie.motion) for c in closures if c.tie]
        )
        gap = between(leads, pose[rows])
        spread = in_axes_of(np.array([c.pose for c in closures]), spread)
    gap[:, 2] = wrap(gap[:, 2])
    log_p = np.empty(len(closures))
    has_heading = np.isfinite(spread[:, 2, 2])
    for chosen, n in ((has_heading, 3), (~has_heading, 2)):
        own, part = spread[chosen][:, :n, :n], gap[chosen][:, :n]
        squared = (part * np.linalg.solve(own, part[:, :, None])[:, :, 0]).sum(axis=1)
        log_p[chosen] = -0.5 * (squared + np.linalg.slogdet(2 * np.pi * own)[1])
    return np.where(has_heading, log_p, log_p - np.log(2 * np.pi))


def _switched(
    odometry: Callable[[], Any],
    chain: Chain,
    closures: Sequence[Closure],
    start: np.ndarray,
    area_m2: float,
) -> Solution:
    """Solve with a switch on every closure whose prior is its own probability of being wrong.

    Expectation maximisation: a switch is on with the posterior probability that the closure is
    right, where a wrong one lies anywhere on the map; then the graph is solved with these weights.
    The switches of Suenderhauf & Protzel, IROS 2012, with a prior for each instead of one for all.
    """
    p = np.clip([c.probability_wrong for c in closures], 1e-3, 1 - 1e-3)
    log_wrong = np.log(p) - np.log(2 * np.pi * max(area_m2, 1.0))
    weight, pose = 1.0 - p, start
    for _ in range(SWITCH_STEPS):
        graph = odometry()
        for closure, w in zip(closures, weight, strict=True):
            graph.add(_factor(closure, chain.first, float(w)))
        pose, _ = _minimise(graph, pose)
        log_right = np.log1p(-p) + _residuals(pose, chain, closures)
        new = np.exp(log_right - np.logaddexp(log_right, log_wrong))
        moved = float(np.abs(new - weight).max())
        weight = new
        if moved < SETTLED:
            break
    return Solution(pose, weight)


def solve(
    chain: Chain,
    closures: Sequence[Closure],
    back_end: BackEnd,
    anchor: Float[np.ndarray, "p 3"],
    area_m2: float,
) -> Solution:
    """Optimise the poses of a chain under its odometry and closures.

    Plain least squares starts from two guesses and the better minimum is kept; everything else
    starts at that minimum.

    Args:
        chain: odometry and its noise.
        closures: of frames of the chain; may be empty, then the result is odometry alone.
        back_end: plain, huber, geman_mcclure, gnc or switch.
        anchor: first pose of each stretch of the chain; used where it has no closure.
        area_m2: of the map; where a wrong closure may lie.

    Returns:
        Poses in the map frame and what was left of each closure.
    """
    import gtsam

    starts = _starts(chain, closures, anchor)
    if not closures:
        return Solution(starts[0], np.zeros(0))

    def with_closures(kernel: Any = None) -> Any:
        graph = _odometry_graph(chain, closures, starts[0])
        for closure in closures:
            graph.add(_factor(closure, chain.first, kernel=kernel))
        return graph

    plain = with_closures()
    is_free = closures[0].tie is not None
    starts = (*starts, *((_lago(chain, closures, starts[0]),) if is_free else ()))
    pose, _ = min((_minimise(plain, start) for start in starts), key=lambda found: found[1])
    estimator = gtsam.noiseModel.mEstimator
    if back_end == "gnc":
        return _gnc(plain, pose, len(closures), is_free=is_free)
    if back_end == "switch":

        def odometry() -> Any:
            return _odometry_graph(chain, closures, starts[0])

        return _switched(odometry, chain, closures, pose, area_m2)
    if back_end == "huber":
        pose, _ = _minimise(with_closures(estimator.Huber.Create(HUBER)), pose)
    if back_end == "geman_mcclure":
        pose, _ = _minimise(with_closures(estimator.GemanMcClure.Create(GEMAN_MCCLURE)), pose)
    return Solution(pose, np.ones(len(closures)))
