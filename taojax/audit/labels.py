"""The truth of a query and what it labels: in the map or off it, calibration and test halves."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from taojax.errors import InputError
from taojax.files.records import digest_file
from taojax.files.tables import read_table

_CELLS = 4_000_000  # distances held at once: 32 MB


def nearest_map_distance(
    query_m: Float[np.ndarray, "t 2"], map_m: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " t"]:
    """Return the distance from each query to the nearest map pose.

    Args:
        query_m: true positions, metres.
        map_m: positions of the map images, metres.

    Returns:
        Metres.
    """
    rows = max(1, _CELLS // len(map_m))
    nearest = np.empty(len(query_m))
    for start in range(0, len(query_m), rows):
        part = query_m[start : start + rows, None]
        gap = part - map_m[None]
        nearest[start : start + rows] = np.sqrt((gap**2).sum(axis=2).min(axis=1))
    return nearest


def label_frames(
    nearest_m: Float[np.ndarray, " t"], r_in_m: float, r_out_m: float
) -> Shaped[np.ndarray, " t"]:
    """Name each frame in_map, map_out or grey.

    Args:
        nearest_m: distance to the nearest map pose, metres.
        r_in_m: in-map means at most this far.
        r_out_m: map-out means farther than this; between the two lies the grey zone.
    """
    far = np.where(nearest_m > r_out_m, "map_out", "grey")
    return np.where(nearest_m <= r_in_m, "in_map", far)


@dataclasses.dataclass(frozen=True)
class _Frames:
    """Some frames of a run with their labels."""

    frame: Int[np.ndarray, " n"]
    """Row of the run."""

    label: Shaped[np.ndarray, " n"]

    signals: Mapping[str, np.ndarray]
    """Signal -> (n,)."""

    @property
    def is_in(self) -> Bool[np.ndarray, " n"]:
        """Which frames are in-map."""
        return self.label == "in_map"

    @property
    def is_out(self) -> Bool[np.ndarray, " n"]:
        """Which frames are map-out."""
        return self.label == "map_out"


@dataclasses.dataclass(frozen=True)
class CalibrationSplit(_Frames):
    """Frames that thresholds and models may be fitted on. Made by `split_frames` alone."""


@dataclasses.dataclass(frozen=True)
class TestSplit(_Frames):
    """Frames that are only scored, with all numbers frozen. Made by `split_frames` alone."""


class Splits(NamedTuple):
    """A run cut in two, with a gap between that belongs to neither."""

    name: Shaped[np.ndarray, " t"]
    """calibration, gap or test, per frame."""

    calibration: CalibrationSplit
    test: TestSplit


def split_frames(
    signals: Mapping[str, np.ndarray],
    label: Shaped[np.ndarray, " t"],
    *,
    calibration_share: float,
    gap_frames: int,
) -> Splits:
    """Cut a run into calibration, gap and test, in this order.

    Args:
        signals: signal -> (t,).
        label: in_map, map_out or grey, per frame.
        calibration_share: share of all frames, from the start.
        gap_frames: one window. No literal signal of a test frame remembers a calibration frame;
            those of the filter fade over more frames, so the first of the test half are not
            independent of the calibration half. Labels never reach a signal.

    Returns:
        The two tables; a very short run may leave the test table empty.
    """
    n = len(label)
    end = int(np.floor(n * calibration_share))
    start = min(n, end + gap_frames)
    name = np.full(n, "gap", dtype="<U11")
    name[:end], name[start:] = "calibration", "test"

    def part(low: int, high: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        cut = {key: values[low:high] for key, values in signals.items()}
        return np.arange(low, high), label[low:high], cut

    return Splits(name, CalibrationSplit(*part(0, end)), TestSplit(*part(start, n)))


class Truth(NamedTuple):
    """Where the robot really was."""

    t_s: Float[np.ndarray, " t"]
    xy_m: Float[np.ndarray, "t 2"]
    sha256: str
    theta_rad: Float[np.ndarray, " t"]


def read_truth(path: Path, n_rows: int) -> Truth:
    """Read the true query poses and check that they belong to a run.

    Args:
        path: the truth folder, or its `query_poses.csv`, or the data folder around both.
        n_rows: frames of the run.

    Returns:
        Times [s], positions [m] and the hash of the file.

    Raises:
        InputError: missing or malformed file, or another number of rows than the run has.
    """
    within = path / "truth" if (path / "truth/query_poses.csv").is_file() else path
    file = within / "query_poses.csv" if path.is_dir() else path
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
