"""One drive that is its own map: what a frame may know of the frames before it."""

import numpy as np
from jaxtyping import Float, Int

__all__ = ["known_frames"]


def known_frames(odometry: Float[np.ndarray, "t 3"], gap_m: float) -> Int[np.ndarray, " t"]:
    """Return how many frames, from the first, each frame has for a map.

    Args:
        odometry: motion into each frame: forward [m], left [m], turn [rad]; row 0 does not count.
        gap_m: way that lies between a frame and the newest one that it knows, metres.

    Returns:
        Never falling; 0 until the gap is driven for the first time.

    Source:
        Public protocols leave out what was seen within the last 30 s or 50 to 100 m, which would
        be trivially found: Kim & Kim, Scan Context, IROS 2018; Chen et al., OverlapNet, RSS 2020.
    """
    driven = np.hypot(odometry[:, 0], odometry[:, 1]).astype(float)
    driven[:1] = 0.0
    way = np.cumsum(np.where(np.isfinite(driven), driven, 0.0))
    return np.searchsorted(way, way - gap_m, side="right")
