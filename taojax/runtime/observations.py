"""The way in: sensor files become checked arrays here, and are believed from here on."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taojax.errors import InputError
from taojax.files.dataset_info import DESCRIPTORS, read_about
from taojax.files.records import INPUTS, digest_file
from taojax.files.specs import read_npy, read_npz
from taojax.files.tables import MOTION, POSE, read_table, stacked


@dataclasses.dataclass(frozen=True)
class Retrievals:
    """Answers of the place-recognition frontend, best first."""

    index: np.ndarray
    """(T, K) int32 map rows, -1 = no candidate."""

    similarity: np.ndarray
    """(T, K) float32, 0 where there is no candidate."""


@dataclasses.dataclass(frozen=True)
class Observations:
    """All that the robot may know. There is no field for the truth."""

    map_poses: dict[str, np.ndarray]
    """Columns of map/poses.csv, (M,) float64 each."""

    t_s: np.ndarray
    """(T,) stamps of the query frames."""

    odometry: np.ndarray
    """(T, 3) float32 motion from the frame before: forward [m], left [m], yaw [rad]."""

    descriptors: tuple[np.ndarray, np.ndarray] | None
    """Map (M, D) and query (T, D), memory-mapped, not yet normalised; None where retrieval lists
    are given."""

    retrievals: Retrievals | None
    """Lists made by the user's own frontend; None where descriptors are given."""

    notes: tuple[str, ...]
    """What the data folder says of itself (about.toml), such as: simulated descriptors."""

    sha256: dict[str, str]
    """Hash of every file that was read."""

    trial_frames: int | None = None
    """The log is a row of trials of so many frames, each with a fresh start; None = one log."""

    own_gap_m: float | None = None
    """The drive is its own map, see `taojax.drive`; None = the map is another drive."""

    @property
    def map_xyt(self) -> np.ndarray:
        """(M, 3) map poses: x [m], y [m], theta [rad]."""
        return stacked(self.map_poses, POSE)


def _check_rows(path: Path, n_rows: int, n_wanted: int, other: Path) -> None:
    if n_rows != n_wanted:
        raise InputError(
            f"{path}: {n_rows} rows, but {other} has {n_wanted}; both must describe the same frames"
        )


def _check_finite(path: Path, array: np.ndarray, label: str = "") -> None:
    """Refuse NaN and infinity, block by block so that a memory map stays one."""
    for start in range(0, len(array), 4096):
        bad = ~np.isfinite(np.asarray(array[start : start + 4096], np.float32))
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise InputError(
                f"{path}: {label}row {start + int(row)} (from 0), column {int(column)} is not"
                " finite; drop the frame or compute it again"
            )


def descriptor_names(folder: Path) -> tuple[str, str]:
    """Return the names of a data folder's map and query descriptors.

    Raises:
        InputError: files of both pairs of names are there.
    """
    there = [[name for name in pair if (folder / name).exists()] for pair in DESCRIPTORS]
    if all(there):
        raise InputError(
            f"{folder}: holds {there[0][0]} and {there[1][0]}; keep one pair of descriptors"
        )
    return DESCRIPTORS[1 if there[1] else 0]


def _load_descriptors(
    folder: Path, names: tuple[str, str], n_map: int, n_query: int
) -> tuple[np.ndarray, np.ndarray]:
    paths = folder / names[0], folder / names[1]
    poses = folder / "map/poses.csv", folder / "query/odometry.csv"
    arrays = []
    for path, other, n_rows in zip(paths, poses, (n_map, n_query), strict=True):
        array = read_npy(path, "descriptors")
        _check_rows(path, len(array), n_rows, other)
        _check_finite(path, array)
        arrays.append(array)
    if arrays[0].shape[1] != arrays[1].shape[1]:
        raise InputError(
            f"{paths[1]}: dimension {arrays[1].shape[1]}, but {paths[0]} has"
            f" {arrays[0].shape[1]}; use the same network for both"
        )
    return arrays[0], arrays[1]


def _load_retrievals(path: Path, n_map: int, n_query: int, odometry: Path) -> Retrievals:
    arrays = read_npz(path, "retrievals")
    index, similarity = arrays["index"], arrays["similarity"]
    if index.shape != similarity.shape:
        raise InputError(
            f"{path}: index {index.shape} and similarity {similarity.shape} differ; both are (T, K)"
        )
    _check_rows(path, len(index), n_query, odometry)
    wrong = (index < -1) | (index >= n_map)
    if wrong.any():
        row, rank = (int(i) for i in np.argwhere(wrong)[0])
        raise InputError(
            f"{path}: index row {row} (from 0), rank {rank} is {index[row, rank]}, but the map has"
            f" rows 0..{n_map - 1}; use -1 for no candidate"
        )
    is_there = index >= 0
    similarity = np.where(is_there, similarity, 0.0).astype(np.float32)
    _check_finite(path, similarity, "similarity ")
    if similarity.max() > 1.0 + 1e-3:
        row, rank = (int(i) for i in np.argwhere(similarity > 1.0 + 1e-3)[0])
        raise InputError(
            f"{path}: similarity row {row} (from 0), rank {rank} is {similarity[row, rank]:g};"
            " similarities are at most 1, store cosines or rescale"
        )
    # A gap in a list must not pass for a rise behind it.
    running = np.minimum.accumulate(np.where(is_there, similarity, np.inf), axis=1)
    rises = is_there[:, 1:] & (similarity[:, 1:] > running[:, :-1] + 1e-6)
    if rises.any():
        row, rank = (int(i) for i in np.argwhere(rises)[0])
        raise InputError(
            f"{path}: similarity row {row} (from 0) rises after rank {rank};"
            " store candidates best first"
        )
    return Retrievals(index.astype(np.int32), np.minimum(similarity, 1.0))


def _refuse_truth(folder: Path, names: Sequence[str]) -> None:
    """Refuse files that are links into truth/: what the robot reads must not come from there."""
    truth = Path(os.path.realpath(folder / "truth"))
    for name in names:
        if Path(os.path.realpath(folder / name)).is_relative_to(truth):
            raise InputError(
                f"{folder / name}: is a link into {truth}, which only the judge may read; store the"
                " file itself"
            )


def load_observations(folder: Path, *, may_be_own: bool = False) -> Observations:
    """Load and check a data folder; the only reader of sensor files. Never looks into truth/.

    Args:
        folder: laid out as data_specs/README.md says.
        may_be_own: whether the caller can replay a drive that is its own map.

    Raises:
        InputError: naming file, row and fix.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such data folder; see data_specs/README.md for the layout")
    files = ["map/poses.csv", "query/odometry.csv"]
    views = ("query/retrievals.npz", *(name for pair in DESCRIPTORS for name in pair))
    _refuse_truth(folder, [*files, *views, "about.toml"])
    map_poses = read_table(folder / files[0], "map_poses")
    odometry = read_table(folder / files[1], "query_odometry")
    n_map, n_query = len(map_poses["t_s"]), len(odometry["t_s"])
    lists = folder / "query/retrievals.npz"
    descriptors = retrievals = None
    if lists.exists():
        retrievals = _load_retrievals(lists, n_map, n_query, folder / files[1])
        files.append("query/retrievals.npz")
    else:
        names = descriptor_names(folder)
        descriptors = _load_descriptors(folder, names, n_map, n_query)
        files += names
    notes, trial_frames, own_gap_m = read_about(folder, n_query)
    if own_gap_m is not None and not may_be_own:
        raise InputError(
            f"{folder}: is one drive that closes on itself (own_gap_m in about.toml), which only"
            " audit, score, evaluate, closures and graph know"
        )
    if own_gap_m is not None and n_map != n_query:
        raise InputError(
            f"{folder / files[0]}: {n_map} rows for {n_query} frames; a drive that is its own map"
            " has a pose for every frame, make it with `taojax convert self`"
        )
    files += ["about.toml"] if (folder / "about.toml").exists() else []
    motion = stacked(odometry, MOTION)
    return Observations(
        map_poses=map_poses,
        t_s=odometry["t_s"],
        odometry=motion.astype(np.float32),
        descriptors=descriptors,
        retrievals=retrievals,
        notes=notes,
        sha256={INPUTS + name: digest_file(folder / name) for name in files},
        trial_frames=trial_frames,
        own_gap_m=own_gap_m,
    )
