"""The only reader of the truth."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from taojax.errors import InputError
from taojax.records import digest_file
from taojax.specs import read_table


class Truth(NamedTuple):
    """Where the robot really was."""

    t_s: Float[np.ndarray, " t"]
    xy_m: Float[np.ndarray, "t 2"]
    sha256: str


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
    return Truth(t_s=table["t_s"], xy_m=xy, sha256=digest_file(file))
