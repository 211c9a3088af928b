"""What a data folder's truth says of its odometry and of its frontend, before anything is scored.

These measures take true positions, so they stand outside the room that must not know them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from taojax.runtime.inspection import step_m
from taojax.runtime.likeness import Views, chance


def scale_of(odometry: Float[np.ndarray, "t 3"], true_xy: Float[np.ndarray, "t 2"]) -> float | None:
    """Return odometry over truth, the median over the steps that truly move; None without any.

    Args:
        odometry: (T, 3) forward [m], left [m], yaw [rad]; row 0 is ignored.
        true_xy: (T, 2) true positions [m].
    """
    length, true = np.hypot(odometry[1:, 0], odometry[1:, 1]), step_m(true_xy)
    moves = true > max(1e-6, 0.25 * float(np.quantile(true, 0.9)))
    return float(np.median(length[moves] / true[moves])) if moves.any() else None


def drift_m(
    odometry: Float[np.ndarray, "t 3"], true_xy: Float[np.ndarray, "t 2"], n_frames: int
) -> float:
    """Measure how far odometry strays from the truth over a window.

    Args:
        odometry: (T, 3) forward [m], left [m], yaw [rad]; row 0 is ignored.
        true_xy: (T, 2) true positions [m].
        n_frames: of a window.

    Returns:
        Median over all windows of the root mean square distance after the best rigid alignment [m].
    """
    theta = np.cumsum(np.r_[0.0, odometry[1:, 2]])
    step = (odometry[1:, 0] + 1j * odometry[1:, 1]) * np.exp(1j * theta[:-1])
    # Points of the plane are complex numbers: aligning is then one product.
    own, true = (
        windows - windows.mean(axis=1, keepdims=True)
        for windows in (
            np.lib.stride_tricks.sliding_window_view(points, min(n_frames, len(points)))
            for points in (np.cumsum(np.r_[0.0, step]), true_xy[:, 0] + 1j * true_xy[:, 1])
        )
    )
    spread = (np.abs(own) ** 2 + np.abs(true) ** 2).sum(axis=1)
    rest = spread - 2.0 * np.abs((own.conj() * true).sum(axis=1))
    return float(np.median(np.sqrt(np.maximum(rest, 0.0) / own.shape[1])))


@dataclass(frozen=True)
class Places:
    """Where the queries truly are, against the map."""

    near_m: float
    """Radius that counts as the same place."""

    nearest_m: Float[np.ndarray, " t"]
    """From every query to the nearest map pose."""

    right: float
    """Of the queries that have a map pose within `near_m`: share whose best match is one; NaN where
    there is none."""

    chance: float
    """The same for a random answer."""


def places(
    seen: Views, map_xy: Float[np.ndarray, "m 2"], true_xy: Float[np.ndarray, "t 2"], reach_m: float
) -> Places:
    """Hold best matches against the true positions.

    Args:
        seen: from `views`.
        map_xy: (M, 2) [m].
        true_xy: (T, 2) of the queries [m].
        reach_m: what counts as the same place.
    """
    nearest_m, _ = KDTree(map_xy).query(true_xy)
    there = nearest_m[seen.rows] <= reach_m
    gap = map_xy[seen.best[there]] - true_xy[seen.rows[there]]
    is_right = np.hypot(gap[:, 0], gap[:, 1]) <= reach_m
    right = float(is_right.mean()) if is_right.size else float("nan")
    return Places(reach_m, np.asarray(nearest_m), right, chance(map_xy, reach_m))
