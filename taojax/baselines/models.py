"""What the rivals share: the same frames for all, measurement and motion models of their papers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Frames(NamedTuple):
    """A map and a log, as the frontend and the odometry deliver them. There is no truth in it."""

    map_poses: Float[np.ndarray, "m 3"]
    """x [m], y [m], theta [rad] of every map image, driving order."""

    odometry: Float[np.ndarray, "t 3"]
    """Motion from the frame before, in its body axes: forward [m], left [m], yaw [rad]."""

    rows: Float[np.ndarray, "t m"]
    """Dense similarity, float32, at most 1; 0 where a retrieval list has no candidate."""

    # A field of the log hides a method of tuple that nobody calls on one.
    index: Int[np.ndarray, "t k"]  # pyright: ignore[reportIncompatibleMethodOverride]
    """Retrieved map rows, best first, -1 = no candidate."""

    similarity: Float[np.ndarray, "t k"]
    """Their similarities, 0 where there is no candidate."""


class Track(NamedTuple):
    """What a rival says of every frame, using that frame and earlier ones alone."""

    signal: Float[np.ndarray, " t"]
    """Larger = more likely off the map; always finite."""

    map_index: Int[np.ndarray, " t"]
    """Map row the rival believes in, -1 without one."""

    pose: Float[np.ndarray, "t 3"]
    """x [m], y [m], theta [rad] of the estimate, or of the map row; zero without one."""


def clean(frames: Frames) -> Frames:
    """Make every defect of a log harmless, so that it can hurt only the frame that carries it.

    Args:
        frames: as recorded.

    Returns:
        The same frames. Odometry that is not finite becomes no motion, a similarity that is not
        finite becomes no candidate, similarities lie in [-1, 1] (float32 cosines of equal
        descriptors can exceed 1), and map rows that do not exist become -1.
    """
    is_usable = np.isfinite(frames.odometry).all(axis=1, keepdims=True)
    rows = np.nan_to_num(np.asarray(frames.rows, np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    is_there = (
        (frames.index >= 0)
        & (frames.index < len(frames.map_poses))
        & np.isfinite(frames.similarity)
    )
    similarity = np.where(is_there, frames.similarity, 0.0).astype(np.float32)
    return Frames(
        map_poses=np.asarray(frames.map_poses, float),
        odometry=np.where(is_usable, frames.odometry, 0.0).astype(float),
        rows=np.clip(rows, -1.0, 1.0),
        index=np.where(is_there, frames.index, -1).astype(np.int32),
        similarity=np.clip(similarity, -1.0, 1.0),
    )


def track_of_nodes(
    map_poses: Float[np.ndarray, "m 3"],
    signal: Float[np.ndarray, " t"],
    map_index: Int[np.ndarray, " t"],
) -> Track:
    """Return the track of a rival that believes in map rows and not in poses between them."""
    is_there = map_index >= 0
    pose = np.where(is_there[:, None], map_poses[np.maximum(map_index, 0)], 0.0)
    return Track(signal, map_index.astype(np.int32), pose.astype(np.float32))


def descriptor_distance(similarity: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Return the distance of unit descriptors from their cosine: sqrt(2 - 2 s), in [0, 2]."""
    return np.sqrt(np.maximum(2.0 - 2.0 * similarity, 0.0))


def decay_rate(distance: Float[np.ndarray, "t m"], delta: float) -> Float[np.ndarray, " t"]:
    """Choose the rate lam of the likelihood exp(-lam d) from the first frame that tells anything.

    lam makes the best 2.5 % of the map `delta` times as likely as the worst 2.5 %. Where fewer
    nodes than that have a candidate, the best node takes the place of the best 2.5 %.

    Args:
        distance: `(T, M)` descriptor distances.
        delta: likelihood ratio, > 1.

    Returns:
        `(T,)` lam per frame: one value from the first informative frame on, 0 before it.

    Source:
        Xu, Suenderhauf and Milford, "Probabilistic visual place recognition for hierarchical
        localization", IEEE RA-L 6(2), 2021.
    """
    rate = np.zeros(len(distance))
    for t, row in enumerate(distance):
        low, high = np.quantile(row, [0.025, 0.975])
        spread = high - (low if high > low else row.min())
        # Differences within float32 rounding of equal distances are no information.
        if spread > 1e-6:
            rate[t:] = np.log(delta) / spread
            break
    return rate


def off_map_distance(distance: Float[np.ndarray, "t m"], rank: int) -> Float[np.ndarray, " t"]:
    """Return the descriptor distance that stands for "not in the map".

    Args:
        distance: `(T, M)` descriptor distances.
        rank: the off-map likelihood is the rank-th smallest node likelihood, so this is the
            rank-th largest distance; the smallest one where the map has fewer nodes.
    """
    n_nodes = distance.shape[1]
    place = max(0, n_nodes - rank)
    return np.partition(distance, place, axis=1)[:, place]


def rot_trans_rot(odometry: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    """Split planar motions into a turn, a straight drive and a turn [rad, m, rad].

    Source:
        Thrun, Burgard and Fox, "Probabilistic Robotics", 2005, section 5.4.
    """
    forward, left, yaw = odometry.T
    drive = np.hypot(forward, left)
    first = np.where(drive > 1e-9, np.arctan2(left, forward), 0.0)
    second = yaw - first
    second = np.arctan2(np.sin(second), np.cos(second))
    return np.stack([first, drive, second], axis=1)


def motion_variances(
    motion: Float[np.ndarray, "t 3"],
    alphas: tuple[float, float, float, float],
    least: float,
) -> Float[np.ndarray, "t 3"]:
    """Return the variances of turn, drive and turn [rad^2, m^2, rad^2].

    Args:
        motion: `(T, 3)` from `rot_trans_rot`.
        alphas: turn from turn, turn from drive [rad^2/m^2], drive from drive, drive from turn
            [m^2/rad^2].
        least: no variance is smaller [rad^2 or m^2].
    """
    first, drive, second = (motion**2).T
    turn_turn, turn_drive, drive_drive, drive_turn = alphas
    variances = np.stack(
        [
            turn_turn * first + turn_drive * drive,
            drive_drive * drive + drive_turn * (first + second),
            turn_turn * second + turn_drive * drive,
        ],
        axis=1,
    )
    return np.maximum(variances, least)


def whitening(
    odometry: Float[np.ndarray, "t 3"],
    alphas: tuple[float, float, float, float],
    least_variance: float,
    jitter: float,
) -> Float[np.ndarray, "t 3 3"]:
    """Return the lower triangular W with |W e|^2 the squared Mahalanobis length of an error e.

    Args:
        odometry: `(T, 3)` forward [m], left [m], yaw [rad].
        alphas: noise of the rot-trans-rot model.
        least_variance: floor of its three variances [rad^2 or m^2].
        jitter: added to the variances of x, y and yaw; without it a robot that does not move has
            a singular covariance [m^2 or rad^2].
    """
    motion = rot_trans_rot(odometry)
    first, drive, _ = motion.T
    jacobian = np.zeros((len(motion), 3, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 1] = -drive * np.sin(first), np.cos(first)
    jacobian[:, 1, 0], jacobian[:, 1, 1] = drive * np.cos(first), np.sin(first)
    jacobian[:, 2, 0] = jacobian[:, 2, 2] = 1.0
    scaled = jacobian * motion_variances(motion, alphas, least_variance)[:, None, :]
    covariance = scaled @ np.swapaxes(jacobian, 1, 2) + jitter * np.eye(3)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def median_step_m(map_poses: Float[np.ndarray, "m 3"]) -> float:
    """Return the median distance between consecutive map poses, steps of length 0 ignored [m].

    1 where the map never moves.
    """
    steps = np.hypot(*np.diff(map_poses[:, :2], axis=0).T)
    steps = steps[steps > 1e-6]
    return float(np.median(steps)) if steps.size else 1.0
