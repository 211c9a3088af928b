"""Two folders of images as two sessions: which image has which pose, or which motion.

Images whose names hold a UNIX time are matched by it; others are as many as rows and follow their
order.
"""

import dataclasses
import hashlib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from taojax.datasets.clocks import PER_S
from taojax.datasets.convert import Motion
from taojax.datasets.describe import list_images, names_below
from taojax.datasets.files import read_motion, read_poses
from taojax.datasets.folder import Session
from taojax.datasets.plain import session_of
from taojax.datasets.reading import Drive, Reading
from taojax.datasets.sessions import Matching, matched_session
from taojax.datasets.trajectory import Trajectory, pose_at
from taojax.files.records import code_digest
from taojax.files.specs import fail

__all__ = ["Images", "images_of", "key_of", "map_session", "query_session", "row_by_row"]

UNIT_OF = {10: "s", 13: "ms", 16: "us", 19: "ns"}
"""Unit of a UNIX time of so many digits, from 2001 to 2286."""

_UNIX = re.compile(
    r"(?<![\d.])(?:"
    r"([1-9]\d{9}\.\d+)|([1-9]\d{9})[-_](\d{9})|([1-9](?:\d{9}|\d{12}|\d{15}|\d{18}))"
    r")(?!\d)",
    re.ASCII,
)
"""Seconds with decimals, seconds and nanoseconds, or one number; a leading zero counts frames."""

TIMED = "images were taken when their names say, in UNIX time"

FIX = "store one row per image in the order of their names, or name images by their UNIX time"


class Images(NamedTuple):
    """The images of one drive, in the order in which they were taken."""

    folder: Path
    paths: tuple[Path, ...]
    names: tuple[str, ...]
    """Relative to the folder."""

    t_s: Float[np.ndarray, " n"] | None
    """When each was taken, where all names hold a UNIX time [s]."""


def images_of(folder: Path) -> Images:
    """List the images of a folder and read the times off their names.

    Raises:
        InputError: no folder, fewer than three images, or names that are times which do not rise.
    """
    paths, _ = list_images(folder)
    found = [_unix_s(path.stem) for path in paths]
    times = [t for t in found if t is not None]
    t_s = np.array(times) if len(times) == len(paths) else None
    if t_s is not None and (late := np.flatnonzero(np.diff(t_s) <= 0)).size:
        at = int(late[0])
        what = f"its name is a time not after that of {paths[at].name}"
        raise fail(paths[at + 1], what, "name the folder of one camera and one drive")
    return Images(folder, tuple(paths), tuple(names_below(folder, paths)), t_s)


def _unix_s(stem: str) -> float | None:
    """Return the only UNIX time in a name, such as frame_1600000000.25 or 1600000000250000000."""
    found = _UNIX.findall(stem)
    if len(found) != 1:
        return None
    decimal, seconds, nanoseconds, whole = found[0]
    if whole:
        return int(whole) / PER_S[UNIT_OF[len(whole)]]
    return float(decimal) if decimal else int(seconds) + int(nanoseconds) / PER_S["ns"]


def map_session(images: Images, poses: Path, reading: Reading, matching: Matching) -> Session:
    """Give the images of the map their poses.

    Args:
        images: of the map drive.
        poses: any file that `read_poses` takes.
        reading: what the user says of it.
        matching: how near in time a pose must be.

    Raises:
        InputError: the file is malformed, or neither times nor numbers of rows fit the images.
    """
    drive = read_poses(poses, reading)
    if images.t_s is not None and drive.has_stamps:
        covered = pose_at(drive.poses, images.t_s, matching.gate_s)[1].mean()
        if covered >= matching.least or not _is_row_by_row(drive, images):
            frames, notes = (images.names, images.t_s), (*drive.notes, TIMED)
            return matched_session(images.folder, frames, drive.poses, matching, notes)
    _check_row_by_row(drive, images, poses)
    own = session_of(drive, images.names)
    return dataclasses.replace(own, notes=(*own.notes, row_by_row(images, poses)))


def row_by_row(images: Images, path: Path) -> str:
    """Say which image was taken to go with which row."""
    return (
        f"the images of {images.folder.name} go with the rows of {path.name} one by one, from"
        f" {images.names[0]} to {images.names[-1]}"
    )


def query_session(images: Images, motion: Motion) -> Session | None:
    """Give the images of the query their times; where they are is for nobody to know here.

    Args:
        images: of the query drive.
        motion: its odometry.

    Returns:
        None where the rows of the odometry are the frames.

    Raises:
        InputError: the odometry is malformed, or has neither times nor as many rows as images.
    """
    drive = read_motion(motion.path, motion.kind, motion.reading)
    if images.t_s is None or not drive.has_stamps:
        _check_row_by_row(drive, images, motion.path)
    if images.t_s is None:
        return None
    unknown = Trajectory(images.t_s, np.zeros((len(images.t_s), 3)))
    return Session(images.names, unknown, False, (TIMED,))


def _is_row_by_row(drive: Drive, images: Images) -> bool:
    return (drive.n_rows or len(drive.poses.t_s)) == len(images.paths)


def _check_row_by_row(drive: Drive, images: Images, path: Path) -> None:
    if not _is_row_by_row(drive, images):
        n_rows = drive.n_rows or len(drive.poses.t_s)
        what = f"{n_rows:,} rows, but {images.folder} holds {len(images.paths):,} images"
        raise fail(path, what, FIX)


def key_of(said: object, places: Iterable[Path]) -> str:
    """Return what tells one intermediate file from another: 12 hex digits.

    Args:
        said: all else that decides what is made; its `repr` counts.
        places: files, and folders with all that lies in them; names, sizes and times of writing
            count, and so does the code of this package.
    """
    files = [
        file for place in places
        for file in (sorted(place.rglob("*")) if place.is_dir() else [place]) if file.is_file()
    ]  # fmt: skip
    states = [(str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    return hashlib.sha256(repr((said, states, code_digest())).encode()).hexdigest()[:12]
