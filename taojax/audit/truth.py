"""The only reader of the truth."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from taojax.errors import InputError
from taojax.files.records import digest_file
from taojax.files.tables import read_table


class Truth(NamedTuple):
    """Where the robot really was."""

    t_s: Float[np.ndarray, " t"]
    xy_m: Float[np.ndarray, "t 2"]
    sha256: str
    theta_rad: Float[np.ndarray, " t"]


def read_truth(path: Path, n_rows: int) -> Truth:
    """Read the true query poses and check that they belong to a run.

    Args:
        path: the truth folder, or its `query_poses.csv`.
        n_rows: frames of the run.

    Returns:
        Times [s], positions [m] and the hash of the file.

    Raises:
        InputError: missing or malformed file, or another number of rows than the run has.
    """
    file = path / "query_poses.csv" if path.is_dir() else path
    table = read_table(file, "query_poses")
    n = len(table["t_s"])
    if n != n_rows:
        fix = "give the truth of the same recording"
        raise InputError(f"{file}: {n} poses for a run of {n_rows} frames; {fix}")
    xy = np.stack([table["x_m"], table["y_m"]], axis=1)
    return Truth(t_s=table["t_s"], xy_m=xy, sha256=digest_file(file), theta_rad=table["theta_rad"])


class Trials(NamedTuple):
    """Where a robot was carried elsewhere, and how each spliced log was made."""

    start: Int[np.ndarray, " k"]
    """First frames after the jumps, counted over the whole run."""

    step_m: Float[np.ndarray, " k"]
    """Metres driven into them."""

    log: Int[np.ndarray, " k"]
    """The log of each jump."""

    drift: Shaped[np.ndarray, " l"]
    """Per log: level of the odometry noise."""

    stretch_frames: Int[np.ndarray, " l"]
    split: Shaped[np.ndarray, " l"]
    """Per log: calibration or test."""

    log_frames: int


def read_trials(folder: Path, n_rows: int) -> Trials:
    """Read the truth of spliced logs.

    Args:
        folder: a truth folder with kidnaps.csv and logs.csv.
        n_rows: frames of the run.

    Raises:
        InputError: missing or malformed file, or logs that do not belong to the run.
    """
    logs = read_table(folder / "logs.csv", "logs")
    jumps = read_table(folder / "kidnaps.csv", "kidnaps")
    n_logs = len(logs["log"])
    length = n_rows // n_logs
    if length * n_logs != n_rows:
        raise InputError(
            f"{folder / 'logs.csv'}: {n_logs} logs do not divide the {n_rows} frames of the run;"
            " give the truth of the same recording"
        )
    log, frame = jumps["log"].astype(int), jumps["frame"].astype(int)
    start = log * length + frame
    wrong = (log >= n_logs) | (frame >= length) | (np.diff(start, prepend=-1) <= 0)
    if wrong.any():
        raise InputError(
            f"{folder / 'kidnaps.csv'}: row {int(np.argmax(wrong)) + 2} is outside the logs or out"
            " of order; write the logs again"
        )
    return Trials(
        start=start,
        step_m=jumps["step_m"],
        log=log,
        drift=logs["drift"],
        stretch_frames=logs["stretch_frames"].astype(int),
        split=logs["split"],
        log_frames=length,
    )
