"""STheReO: thermal and RGB stereo with poses, or one of the frame lists made of it."""

from pathlib import Path

import numpy as np

from taojax.datasets.folder import Session
from taojax.datasets.sessions import (
    Matching,
    agreed_headings,
    check_unit,
    checked_drive,
    matched_session,
    present,
    stamp_of,
    stamped_images,
)
from taojax.datasets.trajectories import row_of
from taojax.datasets.trajectory import Trajectory, headings
from taojax.specs import fail
from taojax.tables import read_table

__all__ = ["CAMERA", "check_sensors", "read_frame_list", "read_sthereo"]

CAMERA = "stereo_thermal_14_left"
"""The camera of the paper; thermal images of the right one have stamps of their own."""

DIGITS = 19
"""Of UNIX time in nanoseconds."""

SENSORS = ("data_stamp", "gps", "inspva", "xsens_imu")
LOCAL_NOTE = (
    "local poses: that the sequences share a frame is not known; the odd first and last row are"
    " left out"
)


def read_sthereo(
    source: Path,
    *,
    camera: str = CAMERA,
    is_local: bool = False,
    matching: Matching | None = None,
) -> Session:
    """Read one sequence of STheReO.

    Args:
        source: a folder that holds image/ and pose/, or a frame list.
        camera: folder below image/ whose files are the frames.
        is_local: take pose/local_pose.csv instead of pose/global_pose.csv.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a pose, in UTM zone 52N.

    Raises:
        InputError: a file is missing or breaks its spec, a name is no stamp, or too few frames
            have a pose.

    Source:
        Yun et al., STheReO, IROS 2022; poses have seven columns with time in seconds.
    """
    if source.is_file():
        return read_frame_list(source)
    if not any((source / part).exists() for part in ("image", "image.tar", "pose", "pose.tar")):
        wanted = "expected a sequence with image/ and pose/, or a frame list"
        raise fail(source, "is no STheReO sequence", wanted)
    name = "local_pose" if is_local else "global_pose"
    path = present(source / "pose" / f"{name}.csv")
    table = read_table(path, f"sthereo_{name}")
    check_unit(path, "t_s", table["t_s"], "seconds")
    xyt = np.stack([table["x_m"], table["y_m"], np.deg2rad(table["yaw_deg"])], axis=1)
    t_s, notes = table["t_s"], ()
    if is_local:
        t_s, xyt, notes = t_s[1:-1], xyt[1:-1], (LOCAL_NOTE,)
    drive, repeats = checked_drive(path, t_s, xyt, 1.0, n_odd=int(is_local))
    theta, turned = agreed_headings(drive.xyt)
    drive = Trajectory(drive.t_s, np.column_stack([drive.xyt[:, :2], theta]))
    names, stamps = stamped_images(source / "image" / camera, DIGITS)
    frames = names, stamps / 1e9
    said = (*notes, *repeats, *turned)
    return matched_session(source / "image" / camera, frames, drive, matching or Matching(), said)


def read_frame_list(path: Path) -> Session:
    """Read a list of frames with the positions that its maker gave them.

    Args:
        path: lines `rgb.png thermal.png easting northing altitude`.

    Returns:
        The thermal images, stamped by their names; headings follow the positions.

    Raises:
        InputError: the list breaks its spec, or a name is no stamp.
    """
    table = read_table(path, "sthereo_frame_list")
    names = [str(name) for name in table["thermal"]]
    stamps = np.array([_stamp(path, at, names) for at in range(len(names))], np.int64)
    xy = np.stack([table["x_m"], table["y_m"]], axis=1)
    flat, repeats = checked_drive(path, stamps, np.column_stack([xy, np.zeros(len(xy))]), 1e-9)
    xy = flat.xyt[:, :2]
    stays = np.concatenate([[True], np.diff(stamps) > 0])
    kept = tuple(name for name, is_first in zip(names, stays, strict=True) if is_first)
    said = "a frame list: every frame has the position of the pose nearest in time, and the"
    return Session(
        kept,
        Trajectory(flat.t_s, np.column_stack([xy, headings(xy)])),
        True,
        (*repeats, f"{said} headings are derived from the positions"),
        listed=tuple(names),
    )


def _stamp(path: Path, at: int, names: list[str]) -> int:
    stamp = stamp_of(names[at], DIGITS)
    if stamp is None:
        row = row_of(path, len(names), at)
        what = f"{row}, column thermal: {names[at][:40]!r} is not a stamp of {DIGITS} digits"
        raise fail(path, what, "restore the name or remove the row")
    return stamp


def check_sensors(source: Path) -> tuple[str, ...]:
    """Hold the other sensors of a sequence against their specs, where they are there.

    Args:
        source: a sequence; a frame list has no sensors.

    Returns:
        Names of the files that were read and are sound; nothing else is taken from them.

    Raises:
        InputError: a file breaks its spec.
    """
    sound = []
    for name in SENSORS:
        path = source / "sensor_data" / f"{name}.csv"
        if path.is_file():
            check_unit(
                path, "stamp_ns", read_table(path, f"sthereo_{name}")["stamp_ns"], "nanoseconds"
            )
            sound.append(path.name)
    return tuple(sound)
