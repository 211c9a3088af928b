"""MulRan and KAIST Complex Urban: poses as matrices, stamped in nanoseconds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from taojax.datasets.folder import Session
from taojax.datasets.sessions import (
    Matching,
    agreed_headings,
    check_unit,
    checked_drive,
    matched_session,
    own_session,
    present,
    stamped_images,
)
from taojax.datasets.trajectories import row_of
from taojax.datasets.trajectory import Trajectory
from taojax.specs import fail
from taojax.tables import read_table

__all__ = ["read_complex_urban", "read_mulran"]

FRAMES = {
    "mulran": ("sensor_data/Ouster", "sensor_data/radar/polar"),
    "complex_urban": ("image/stereo_left",),
}
"""Where frames usually lie; the first folder that is there counts."""

UNIT_LENGTH = 1e-2
"""Slack of a rotation's first column."""


def read_mulran(
    folder: Path, *, frames: str | None = None, matching: Matching | None = None
) -> Session:
    """Read one sequence of MulRan.

    Args:
        folder: holds global_pose.csv.
        frames: folder below whose files, named by their stamp, are the frames; by default the
            lidar scans, else the radar images, else the poses themselves.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a pose of the vehicle's base, in UTM zone 52N. The lidar looks
        backwards: poses that are the lidar's are turned round, and a note says so.

    Raises:
        InputError: a file is missing or breaks its spec, or too few frames have a pose.

    Source:
        Kim et al., MulRan, ICRA 2020; thirteen columns, the 3x4 matrix row by row.
    """
    return _read(folder, "mulran", frames, matching or Matching())


def read_complex_urban(
    folder: Path, *, frames: str | None = None, matching: Matching | None = None
) -> Session:
    """Read one sequence of KAIST Complex Urban.

    Args:
        folder: holds global_pose.csv.
        frames: as in `read_mulran`; by default the left camera, else the poses themselves.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a pose, in UTM zone 52N.

    Raises:
        InputError: a file is missing or breaks its spec, or too few frames have a pose.

    Source:
        Jeong et al., Complex Urban Dataset, IJRR 2019; poses as in MulRan.
    """
    return _read(folder, "complex_urban", frames, matching or Matching())


def _read(
    folder: Path,
    name: Literal["mulran", "complex_urban"],
    frames: str | None,
    matching: Matching,
) -> Session:
    path = present(folder / "global_pose.csv")
    table = read_table(path, f"{name}_global_pose")
    check_unit(path, "stamp_ns", table["stamp_ns"], "nanoseconds")
    length = np.sqrt(table["r11"] ** 2 + table["r21"] ** 2 + table["r31"] ** 2)
    if (bent := np.flatnonzero(np.abs(length - 1.0) > UNIT_LENGTH)).size:
        row = row_of(path, len(length), int(bent[0]))
        what = f"{row}: column (r11, r21, r31) has length {length[bent[0]]:.3f}"
        raise fail(path, what, "expected a rotation; store the 3x4 matrix row by row")
    theta = np.arctan2(table["r21"], table["r11"])
    xyt = np.stack([table["x_m"], table["y_m"], theta], axis=1)
    drive, repeats = checked_drive(path, table["stamp_ns"], xyt, 1e-9)
    theta, turned = agreed_headings(drive.xyt, may_turn=True)
    drive = Trajectory(drive.t_s, np.column_stack([drive.xyt[:, :2], theta]))
    notes = (*repeats, *turned)
    images = _frames_of(folder, FRAMES[name] if frames is None else (frames,), frames is not None)
    if images is None:
        kept = np.concatenate([[True], np.diff(table["stamp_ns"]) > 0])
        return own_session([str(stamp) for stamp in table["stamp_ns"][kept]], drive, notes)
    names, stamps = stamped_images(images, 19, (".bin", ".png"))
    return matched_session(images, (names, stamps / 1e9), drive, matching, notes)


def _frames_of(folder: Path, usual: Sequence[str], is_wanted: bool) -> Path | None:
    """Return the folder of the frames; None where there is none and none was asked for."""
    for name in usual:
        if is_wanted or (folder / name).is_dir():
            return folder / name
    return None
