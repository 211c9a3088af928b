"""ViViD++: thermal and RGB drives with positions from GPS."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from taojax.datasets.folder import Session
from taojax.datasets.sessions import (
    Matching,
    check_unit,
    checked_drive,
    matched_session,
    own_session,
    present,
)
from taojax.datasets.trajectory import Trajectory, headings
from taojax.specs import fail
from taojax.tables import read_table

__all__ = ["IMAGES", "read_vivid"]

IMAGES = "img/thermal_fieldscale_clahe"

LEAST_M = 2.0
"""GPS wanders by less, so that a heading over this distance is one."""


def read_vivid(
    folder: Path,
    *,
    images: str = IMAGES,
    matching: Matching | None = None,
) -> Session:
    """Read one driving sequence of ViViD++.

    Args:
        folder: holds gpslist.txt or thermal_gps_framelist.txt.
        images: folder whose files `<seconds>.png` are the frames. Where it is not at hand the rows
            of thermal_gps_framelist.txt are, and where that is not either those of gpslist.txt.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a position; headings are derived.

    Raises:
        InputError: a file is missing or breaks its spec, or too few frames have a pose.

    Source:
        Lee et al., ViViD++, RA-L 2022.
    """
    listed = folder / "thermal_gps_framelist.txt"
    track = folder / "gpslist.txt"
    is_shown = (folder / images).is_dir()
    if not is_shown and images != IMAGES:
        raise fail(folder / images, "no such folder of images", "choose another --frames")
    path = track if is_shown or not listed.is_file() else listed
    if path == track and not track.exists() and listed.is_file():
        path = listed
    table = read_table(present(path), "vivid_gpslist")
    check_unit(path, "t_s", table["t_s"], "seconds")
    xy = np.stack([table["x_m"], table["y_m"]], axis=1)
    flat, notes = checked_drive(path, table["t_s"], np.column_stack([xy, np.zeros(len(xy))]), 1.0)
    theta = headings(flat.xyt[:, :2], LEAST_M)
    drive = Trajectory(flat.t_s, np.column_stack([flat.xyt[:, :2], theta]))
    notes = (*notes, "the headings are derived from the positions")
    if not is_shown:
        return own_session([f"{t!r}.png" for t in drive.t_s.tolist()], drive, notes)
    frames = _named(folder / images)
    return matched_session(folder / images, frames, drive, matching or Matching(), notes)


def _named(folder: Path) -> tuple[tuple[str, ...], Float[np.ndarray, " n"]]:
    """Return names `<seconds>.png` and their stamps [s], in time order."""
    found = []
    for path in folder.iterdir():
        if path.suffix != ".png" or path.name.startswith("."):
            continue
        whole, _, part = path.stem.partition(".")
        if not (path.stem.isascii() and whole.isdigit() and (not part or part.isdigit())):
            what = "its name is not a time in seconds"
            raise fail(path, what, "restore the name or remove the file")
        found.append((float(path.stem), path.name))
    if not found:
        raise fail(folder, "holds no frames", "expected names such as 1600000000.123456.png")
    found.sort()
    return tuple(name for _, name in found), np.array([t for t, _ in found])
