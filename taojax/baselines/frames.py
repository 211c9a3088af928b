"""What every rival is given and what it returns; the same for all, so that none has an edge."""

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
