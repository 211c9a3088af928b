"""How far odometry can be believed, and where it leads."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from taojax.files.pose_graph_io import ODOMETRY_RAD, ODOMETRY_SHARE, compose, wrap
from taojax.graph.answers import Closure

__all__ = [
    "DRIFTING",
    "FEW",
    "Chain",
    "Noise",
    "Walk",
    "dead_reckoning",
    "estimate",
    "spread",
    "steps_m",
    "walk",
]

SHARES = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Standard deviations of the position after one map spacing that are tried, in spacings."""

ANGLES_RAD = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
"""Those of the heading after one map spacing [rad]."""

SCATTERS = (0.1, 0.2, 0.5, 1.0, 2.0)
"""Scatter of closures that is tried, in the standard deviations that they carry."""

WINDOWS = (1, 2, 4, 8)
"""Windows between neighbouring closures of a selection: nearer ones share frames, and a graph has
to bridge gaps of every length."""

LEAST_CLOSURES = 8
"""Fewer closures one window apart say too little, and the stated default is used."""

WRONG_SHARE = 0.05
"""Share of the accepted closures that may be wrong without pulling the estimate: what verdicts
promise."""

LOST = 3
"""So many closures in a row that look wrong start a filter anew at the last of them."""

LEAST_SPACINGS = 0.01
"""Way that a frame counts at least, in map spacings: a robot at rest also has some noise."""


class Noise(NamedTuple):
    """Odometry error as a random walk over the way travelled, whatever the frame rate.

    After a way of L spacings the standard deviation of the position, heading known, is
    `share * sqrt(L)` spacings, and that of the heading `angle_rad * sqrt(L)`.
    """

    share: float
    angle_rad: float
    why: str
    """Where the two numbers come from, in words."""

    def said(self, spacing_m: float) -> str:
        """Return it in words, for 100 m of way."""
        root = np.sqrt(100.0 / spacing_m)
        return (
            f"Odometry noise: {self.share * spacing_m * root:.2g} m and "
            f"{np.degrees(self.angle_rad * root):.2g} degrees after 100 m, {self.why}."
        )


FEW = Noise(ODOMETRY_SHARE, ODOMETRY_RAD, "the default, for the calibration half has few closures")
DRIFTING = FEW._replace(
    why="the default, for the map of a drive that closes on itself drifts as its odometry does"
)
CONTRARY = FEW._replace(
    why="the default, for closures and odometry of the calibration half do not agree"
)


class Chain(NamedTuple):
    """Consecutive query frames tied by odometry."""

    first: int
    """Query frame of row 0."""

    odometry: Float[np.ndarray, "n 3"]
    """Motion into each frame: forward [m], left [m], turn [rad]."""

    is_start: Bool[np.ndarray, " n"]
    """No odometry leads into this frame; true for the first."""

    way_m: Float[np.ndarray, " n"]
    """Way into each frame, see `steps_m`."""

    spacing_m: float
    noise: Noise

    def variances(self) -> Float[np.ndarray, "n 2"]:
        """Return the variances of each motion: position [m^2] and heading [rad^2]."""
        spacings = self.way_m / self.spacing_m
        position = (self.noise.share * self.spacing_m) ** 2 * spacings
        return np.stack([position, self.noise.angle_rad**2 * spacings], axis=1)

    def parts(self) -> list[tuple[int, int]]:
        """Return first and end row of every stretch that odometry ties together."""
        starts = np.flatnonzero(self.is_start).tolist()
        return list(zip(starts, [*starts[1:], len(self.is_start)], strict=True))


def steps_m(odometry: Float[np.ndarray, "n 3"], spacing_m: float) -> Float[np.ndarray, " n"]:
    """Return the way into each frame: metres driven, and one spacing per radian turned.

    Args:
        odometry: forward [m], left [m], turn [rad].
        spacing_m: of the map.
    """
    driven = np.hypot(odometry[:, 0], odometry[:, 1])
    turned = spacing_m * np.abs(wrap(odometry[:, 2]))
    return np.maximum(driven + turned, LEAST_SPACINGS * spacing_m)


def dead_reckoning(
    odometry: Float[np.ndarray, "n 3"], is_start: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Return odometry added up; every stretch starts at the origin."""
    out = np.zeros((len(odometry), 3))
    for t in range(1, len(odometry)):
        if not is_start[t]:
            out[t] = compose(out[t - 1], odometry[t])
    return out


class Walk(NamedTuple):
    """Sums along dead reckoning that give the covariance of any stretch of it at once."""

    pose: Float[np.ndarray, "n 3"]
    """Dead reckoning: x [m], y [m], theta [rad]."""

    part: Int[np.ndarray, " n"]
    """Number of the stretch that odometry ties together."""

    sums: Float[np.ndarray, "n 6"]
    """Way so far, in spacings, and way times x, y, xx, xy, yy of where each step ended."""


def walk(chain: Chain) -> Walk:
    """Add up what `spread` needs."""
    pose, spacings = dead_reckoning(chain.odometry, chain.is_start), chain.way_m / chain.spacing_m
    x, y = pose[:, 0], pose[:, 1]
    parts = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    return Walk(pose, np.cumsum(chain.is_start), np.cumsum(spacings[:, None] * parts, axis=0))


def spread(
    walked: Walk, i: Int[np.ndarray, " p"], j: Int[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p 3 3"]]:
    """Return what the ways from rows i to rows j add to the covariance of the pose.

    An error in the turn at c moves the far end e by the perpendicular of e - c. Backwards the far
    end is the earlier one and the turns between are the same, so i may be after j.

    Returns:
        Way [spacings], which times (share * spacing)^2 is the variance of x and of y; and what
        times angle_rad^2 is the covariance of x, y, theta through the heading. In the axes of dead
        reckoning.
    """
    sums = np.where(j >= i, 1.0, -1.0)[:, None] * (walked.sums[j] - walked.sums[i])
    way, x, y, xx, xy, yy = sums.T
    ex, ey = walked.pose[j, 0], walked.pose[j, 1]
    turn = np.empty((len(i), 3, 3))
    turn[:, 0, 0] = np.maximum(way * ey**2 - 2 * ey * y + yy, 0.0)
    turn[:, 1, 1] = np.maximum(way * ex**2 - 2 * ex * x + xx, 0.0)
    turn[:, 0, 1] = turn[:, 1, 0] = -(way * ex * ey - ex * y - ey * x + xy)
    turn[:, 0, 2] = turn[:, 2, 0] = y - way * ey
    turn[:, 1, 2] = turn[:, 2, 1] = way * ex - x
    turn[:, 2, 2] = way
    return way, turn


def _selections(rows: np.ndarray, window: int) -> list[list[int]]:
    """Return selections of closures, each with a number of windows between neighbours.

    Of `WINDOWS` windows there are as many selections, each begun one window later, so that every
    distance counts about as often.
    """
    found = []
    for apart in WINDOWS:
        for offset in range(apart):
            chosen, free = [], offset * window
            for number, row in enumerate(rows.tolist()):
                if row >= free:
                    chosen.append(number)
                    free = row + apart * window
            found.append(chosen)
    return found


class _Filters(NamedTuple):
    """Kalman filters of one pose, one for every noise that is tried."""

    pose: Float[np.ndarray, "g 3"]
    covariance: Float[np.ndarray, "g 3 3"]
    missed: Int[np.ndarray, " g"]
    """Closures in a row that looked wrong."""


def _turns(angle: np.ndarray) -> np.ndarray:
    """Return rotations (g, 3, 3) of x and y that leave theta alone."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((len(angle), 3, 3))
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1], out[:, 2, 2] = c, -s, s, c, 1.0
    return out


def _moved(
    now: _Filters, walked: Walk, rows: tuple[int, int], by_step: np.ndarray, by_turn: np.ndarray
) -> _Filters:
    """Drive from one row to another; `by_step` [m^2] and `by_turn` [rad^2] per spacing, (g,)."""
    a, b = np.array(rows[:1]), np.array(rows[1:])
    way = walked.pose[rows[1]] - walked.pose[rows[0]]
    turn = _turns(now.pose[:, 2] - walked.pose[rows[0], 2])
    step = turn @ way
    lever = np.tile(np.eye(3), (len(step), 1, 1))
    lever[:, 0, 2], lever[:, 1, 2] = -step[:, 1], step[:, 0]
    spacings, angular = spread(walked, a, b)
    own = by_turn[:, None, None] * angular
    own[:, [0, 1], [0, 1]] += (by_step * spacings)[:, None]
    covariance = lever @ now.covariance @ lever.transpose(0, 2, 1)
    covariance = covariance + turn @ own @ turn.transpose(0, 2, 1)
    return now._replace(pose=now.pose + step, covariance=covariance)


def _met(
    now: _Filters, pose: np.ndarray, spread_of: np.ndarray, log_wrong: float
) -> tuple[_Filters, np.ndarray]:
    """Return the filters after a closure, and the log likelihood it had before, (g,).

    Args:
        now: at the frame of the closure.
        pose: answered, (3,).
        spread_of: its covariance for every filter, (g, 3, 3).
        log_wrong: log density of a wrong closure.
    """
    gap = pose - now.pose
    gap[:, 2] = wrap(gap[:, 2])
    total = now.covariance + spread_of
    solved = np.linalg.solve(total, gap[:, :, None])
    squared = (gap[:, None, :] @ solved)[:, 0, 0]
    log_right = np.log(1 - WRONG_SHARE) - 0.5 * (squared + np.linalg.slogdet(2 * np.pi * total)[1])
    is_right = log_right > log_wrong
    gain = now.covariance @ np.linalg.inv(total)
    better = now.pose + (gain @ gap[:, :, None])[:, :, 0]
    tighter = now.covariance - gain @ now.covariance
    missed = np.where(is_right, 0, now.missed + 1)
    is_lost = missed >= LOST
    kept = np.where(is_right[:, None], better, now.pose)
    sure = np.where(is_right[:, None, None], tighter, now.covariance)
    after = _Filters(
        np.where(is_lost[:, None], pose, kept),
        np.where(is_lost[:, None, None], spread_of, sure),
        np.where(is_lost, 0, missed),
    )
    return after, np.logaddexp(log_right, log_wrong)


def estimate(chain: Chain, closures: Sequence[Closure], window: int, area_m2: float) -> Noise:
    """Return the noise under which closures and odometry of the calibration half agree best.

    For each pair of `SHARES` and `ANGLES_RAD` a Kalman filter drives along odometry and predicts
    every closure from those before it; the pair with the largest likelihood wins (prediction error
    decomposition; Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, 1989,
    section 3.4). How far closures scatter against the covariances that they carry is found with it,
    for otherwise cautious covariances would hide the drift. A closure may be wrong and then lies
    anywhere on the map. No truth is needed.

    Args:
        chain: of the calibration half; its own noise is not used.
        closures: accepted there, with headings, in the order of time.
        window: frames of a window; closures nearer than that share frames.
        area_m2: of the map.

    Returns:
        The default, and why, where fewer than `LEAST_CLOSURES` lie a window apart, or where only
        the largest noise that is tried would explain them.
    """
    rows = np.array([c.frame - chain.first for c in closures], int)
    selections = _selections(rows, window)
    if len(selections[0]) < LEAST_CLOSURES:
        return FEW
    walked = walk(chain)
    tried = np.array([(a, b, c) for a in SHARES for b in ANGLES_RAD for c in SCATTERS])
    by_step, by_turn = (tried[:, 0] * chain.spacing_m) ** 2, tried[:, 1] ** 2
    scatter = tried[:, 2, None, None] ** 2
    log_wrong = float(np.log(WRONG_SHARE / (2 * np.pi * max(area_m2, 1.0))))
    total = np.zeros(len(tried))
    for chosen in selections:
        now, last = None, -1
        for number in chosen:
            closure, row = closures[number], int(rows[number])
            own = scatter * closure.covariance
            if now is None or walked.part[row] != walked.part[last]:
                pose = np.tile(closure.pose, (len(tried), 1))
                now = _Filters(pose, own, np.zeros(len(tried), int))
            else:
                now = _moved(now, walked, (last, row), by_step, by_turn)
                now, log_p = _met(now, closure.pose, own, log_wrong)
                total += log_p
            last = row
    share, angle_rad, _ = tried[int(total.argmax())].tolist()
    if share == SHARES[-1] or angle_rad == ANGLES_RAD[-1]:
        return CONTRARY
    why = f"the likeliest for the {len(closures)} accepted closures of the calibration half"
    return Noise(share, angle_rad, why)
