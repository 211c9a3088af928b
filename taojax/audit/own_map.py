"""Judge a drive that is its own map: an answer is a place seen before, wherever odometry put it.

At run time a place lies where the drive's own odometry, which drifts, has put it. So an answer is
right if the robot truly was where the answer says relative to the true pose of the place it names.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from taojax.audit.labels import Truth
from taojax.drive import known_frames
from taojax.files.pose_graph_io import between, compose
from taojax.files.records import Run
from taojax.files.tables import MOTION, POSE, stacked

__all__ = ["in_truth", "nearest_known", "placed"]

NOWHERE_M = 1e6
"""Distance to the nearest map pose of a frame that knows no other yet, metres."""

NOW = ("now_map_index", "now_x_m", "now_y_m", "now_theta_rad")


def placed(
    pose: Float[np.ndarray, "t 3"],
    anchor: Int[np.ndarray, " t"],
    drive: Float[np.ndarray, "n 3"],
    truth: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "t 3"]:
    """Return answers moved along with the place that each names, from odometry to truth.

    Args:
        pose: answered, in the drive's odometry; NaN stays NaN.
        anchor: the frame that each names, -1 where there is no answer.
        drive: pose of every frame in odometry.
        truth: true pose of every frame.
    """
    row = np.maximum(anchor, 0)
    moved = compose(truth[row], between(drive[row], pose))
    return np.where((anchor >= 0)[:, None], moved, np.nan)


def nearest_known(
    xy_m: Float[np.ndarray, "t 2"], odometry: Float[np.ndarray, "t 3"], gap_m: float
) -> Float[np.ndarray, " t"]:
    """Return the distance from each frame to the nearest that it may close on, metres.

    Args:
        xy_m: true positions.
        odometry: motion into each frame.
        gap_m: see `drive.known_frames`.
    """
    known, out = known_frames(odometry, gap_m), np.full(len(xy_m), NOWHERE_M)
    for t, n in enumerate(known.tolist()):
        if n:
            out[t] = np.hypot(*(xy_m[:n] - xy_m[t]).T).min()
    return out


def in_truth(
    run: Run, truth: Truth, odometry: dict[str, np.ndarray]
) -> tuple[Run, Float[np.ndarray, " t"]]:
    """Return a run as the judge of two drives reads it, and how far the nearest place is.

    Args:
        run: of a drive that is its own map.
        truth: of the same drive.
        odometry: the columns of its odometry.csv.

    Returns:
        The run with map and answers at their true places; metres from each frame to the nearest
        that it may close on.
    """
    drive = stacked(run.map_poses, POSE)
    true = np.column_stack([truth.xy_m, truth.theta_rad])

    def moved(table: dict[str, np.ndarray], names: tuple[str, ...]) -> dict[str, np.ndarray]:
        index, *pose = names
        found = placed(stacked(table, tuple(pose)), table[index].astype(int), drive, true)
        return table | dict(zip(pose, found.T, strict=True))

    signals = moved(moved(run.signals, ("map_index", *POSE)), NOW)
    nearest = nearest_known(truth.xy_m, stacked(odometry, MOTION), run.manifest["own_gap_m"])
    return dataclasses.replace(
        run,
        signals=signals,
        delayed=moved(run.delayed, ("map_index", *POSE)),
        map_poses=run.map_poses | dict(zip(POSE, true.T, strict=True)),
    ), nearest
