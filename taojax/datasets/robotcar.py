"""Oxford RobotCar: inertial navigation in north, east and down; stamps in microseconds."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Int

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
from taojax.specs import column_names, fail, read_text
from taojax.tables import read_table

__all__ = ["CAMERA", "read_robotcar"]

CAMERA = "stereo/centre"

KEYS = ("timestamp", "northing", "easting", "down", "roll", "pitch", "yaw")
"""Columns that are used or guard those that are; a header must have them where the devkit does."""


def read_robotcar(
    folder: Path,
    *,
    camera: str = CAMERA,
    gps: Literal["ins", "rtk"] = "ins",
    matching: Matching | None = None,
) -> Session:
    """Read one traverse of Oxford RobotCar.

    Args:
        folder: holds gps/.
        camera: folder of the images; where it is not at hand its list `stereo.timestamps` is
            read, and where that is not either the poses are the frames.
        gps: which of gps/ins.csv and gps/rtk.csv.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a pose: x east, y north, theta counter-clockwise from east.

    Raises:
        InputError: a file is missing or breaks its spec, or too few frames have a pose.

    Source:
        Maddern et al., 1 Year, 1000 km, IJRR 2017.
    """
    path = folder / "gps" / f"{gps}.csv"
    other = path.with_name("rtk.csv" if gps == "ins" else "ins.csv")
    if not path.exists() and other.exists():
        raise fail(path, f"no such file, but {other.name} is there", f"add --gps {other.stem}")
    table = _read_gps(present(path), f"robotcar_{gps}")
    xyt = np.stack([table["easting"], table["northing"], np.pi / 2.0 - table["yaw"]], axis=1)
    drive, repeats = checked_drive(path, table["timestamp"], xyt, 1e-6)
    theta, turned = agreed_headings(drive.xyt)
    drive = Trajectory(drive.t_s, np.column_stack([drive.xyt[:, :2], theta]))
    notes = (*repeats, *turned)
    found = _frames_of(folder, camera)
    if found is None:
        kept = np.concatenate([[True], np.diff(table["timestamp"]) > 0])
        return own_session([str(stamp) for stamp in table["timestamp"][kept]], drive, notes)
    source, names, stamps = found
    return matched_session(source, (names, stamps / 1e6), drive, matching or Matching(), notes)


def _read_gps(path: Path, spec: str) -> dict[str, np.ndarray]:
    header = [cell.strip() for cell in read_text(path).partition("\n")[0].split(",")]
    columns = column_names(spec)
    if "timestamp" in header:
        for key in KEYS:
            at = columns.index(key)
            if at >= len(header) or header[at] != key:
                what = f"row 1: column {at + 1} is not {key}"
                raise fail(path, what, f"expected {','.join(columns)}")
    table = read_table(path, spec)
    check_unit(path, "timestamp", table["timestamp"], "microseconds")
    zone = table["utm_zone"]
    if (mixed := np.flatnonzero(zone != zone[0])).size:
        row = row_of(path, len(zone), int(mixed[0]))
        what = f"{row}: UTM zone {zone[mixed[0]]}, but {zone[0]} before"
        raise fail(path, what, "project all rows to one zone")
    return table


def _frames_of(
    folder: Path, camera: str
) -> tuple[Path, tuple[str, ...], Int[np.ndarray, " n"]] | None:
    """Return where the frames are listed, their names and stamps [us]."""
    if (folder / camera).is_dir():
        return folder / camera, *stamped_images(folder / camera, 16)
    path = folder / f"{Path(camera).parts[0]}.timestamps"
    if not path.is_file():
        if camera != CAMERA:
            raise fail(folder / camera, "no such folder of images", "choose another --camera")
        return None
    stamps = read_table(path, "robotcar_timestamps")["timestamp"]
    check_unit(path, "timestamp", stamps, "microseconds")
    return path, tuple(f"{stamp}.png" for stamp in stamps), stamps
