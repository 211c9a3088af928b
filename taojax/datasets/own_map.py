"""One drive as a data folder that is its own map.

The map's poses are the drive's own odometry, added up: nobody knows others while it is driven.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from taojax.datasets.folder import Descriptors, Lists, write_folder
from taojax.datasets.simulate import WorldConfig, simulated_odometry
from taojax.datasets.trajectory import Trajectory, integrate
from taojax.errors import InputError
from taojax.files.dataset_info import DESCRIPTORS, read_about
from taojax.files.specs import read_npy, read_npz
from taojax.files.tables import MOTION, POSE, read_table, stacked

__all__ = ["GAP_M", "write_own_map"]

GAP_M = 50.0
"""Way between a frame and the newest one that it may close on, metres, by default: protocols of
road data sets leave out 30 s or 50 to 100 m. In buildings 10 to 20 do."""

LATER_S = 1.0
"""A second drive that is joined begins so long after the end of the first, if not later."""


class _Drive(NamedTuple):
    t_s: Float[np.ndarray, " t"]
    odometry: Float[np.ndarray, "t 3"]
    truth: Float[np.ndarray, "t 3"] | None
    notes: tuple[str, ...]


def _query(folder: Path) -> _Drive:
    path, known = folder / "query/odometry.csv", folder / "truth/query_poses.csv"
    table = read_table(path, "query_odometry")
    truth = None
    if known.is_file():
        truth = stacked(read_table(known, "query_poses"), POSE)
        if len(truth) != len(table["t_s"]):
            raise InputError(f"{known}: {len(truth)} rows, but {path} has {len(table['t_s'])}")
    return _Drive(table["t_s"], stacked(table, MOTION), truth, read_about(folder).notes)


def _joined(folder: Path, query: _Drive, seed: int) -> _Drive:
    """Let the query's drive follow the map's, whose odometry is simulated from its poses."""
    table = read_table(folder / "map/poses.csv", "map_poses")
    poses = stacked(table, POSE)
    if query.truth is None:
        raise InputError(
            f"{folder}: map and query can only be joined where truth/query_poses.csv says how they"
            " lie; add it, or give a folder of one drive without map/"
        )
    link = np.concatenate([poses, query.truth[:1]])
    moved = simulated_odometry(link, WorldConfig(), seed)
    away = float(np.hypot(*(link[-1] - link[-2])[:2]))
    late = float(table["t_s"][-1]) + LATER_S - float(query.t_s[0])
    return _Drive(
        np.concatenate([table["t_s"], query.t_s + max(0.0, late)]),
        np.concatenate([moved, query.odometry[1:]]),
        np.concatenate([poses, query.truth]),
        (
            *query.notes,
            f"two drives joined to one: frames 0 to {len(poses) - 1} are the map's; their odometry"
            f" and the motion of {away:.0f} m onto the second drive are simulated from poses",
        ),
    )


def _own_views(folder: Path, n: int) -> Descriptors | Lists:
    lists = folder / "query/retrievals.npz"
    if lists.exists():
        found = read_npz(lists, "retrievals")
        if len(found["index"]) != n or found["index"].max(initial=-1) >= n:
            what = f"its lists must hold {n} rows, of rows of the drive itself"
            raise InputError(f"{lists}: {what}")
        return Lists(found["index"], found["similarity"])
    there = [own for _, own in DESCRIPTORS if (folder / own).exists()]
    if not there:
        names = " or ".join([*(own for _, own in DESCRIPTORS), "query/retrievals.npz"])
        raise InputError(f"{folder}: lacks {names}; add what the frames look like")
    rows = read_npy(folder / there[0], "descriptors")
    return Descriptors(rows, rows)


def _joined_views(folder: Path, n_map: int) -> Descriptors | Lists:
    lists = folder / "query/retrievals.npz"
    if lists.exists():
        found = read_npz(lists, "retrievals")
        # The map's own frames were never looked up: they name no place.
        room = ((n_map, 0), (0, 0))
        index = np.pad(found["index"], room, constant_values=-1)
        return Lists(index, np.pad(found["similarity"], room))
    pairs = [pair for pair in DESCRIPTORS if all((folder / name).exists() for name in pair)]
    if not pairs:
        raise InputError(f"{folder}: lacks {' with '.join(DESCRIPTORS[0])}; see data_specs")
    rows = np.concatenate([read_npy(folder / name, "descriptors") for name in pairs[0]])
    return Descriptors(rows, rows)


def write_own_map(folder: Path, out: Path, gap_m: float, *, seed: int = 0) -> tuple[str, ...]:
    """Write a data folder of one drive that closes on itself.

    Args:
        folder: a data folder of one drive (query/ alone, truth/ where it is known); with map/ too,
            the query's drive follows the map's.
        out: the folder to make.
        gap_m: way between a frame and the newest one that it may close on, metres.
        seed: of odometry that is simulated.

    Returns:
        What the report must say of it.

    Raises:
        InputError: files are missing or do not fit one another, or `out` exists.
    """
    drive = _query(folder)
    if (folder / "map/poses.csv").is_file():
        n_query = len(drive.t_s)
        drive = _joined(folder, drive, seed)
        views = _joined_views(folder, len(drive.t_s) - n_query)
    else:
        views = _own_views(folder, len(drive.t_s))
    path = Trajectory(drive.t_s, integrate(drive.odometry))
    write_folder(
        out, path, (drive.t_s, drive.odometry), views, truth=drive.truth, notes=drive.notes,
        own_gap_m=gap_m,
    )  # fmt: skip
    return drive.notes
