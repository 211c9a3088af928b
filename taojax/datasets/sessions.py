"""What the readers of data sets share: stamps from file names, poses by stamp, headings checked."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from taojax.datasets.folder import Session
from taojax.datasets.trajectories import looks_like, row_of
from taojax.datasets.trajectory import Trajectory, headings, pose_at, spaced, wrap
from taojax.errors import InputError
from taojax.files.specs import fail

__all__ = [
    "Matching",
    "agreed_headings",
    "check_unit",
    "checked_drive",
    "matched_session",
    "own_session",
    "present",
    "stamp_of",
    "stamped_images",
]

JUMP_M = 10e3
"""No vehicle drives so far from one pose to the next; another UTM zone is farther."""

AGREED_RAD = np.deg2rad(30.0)
"""A heading column and the direction of travel agree within this."""

MOST = 0.8
"""Share of the way on which they have to agree: parking and reversing may differ."""

LATEST = 9_200_000_000_000_000_000
"""The year 2261 in nanoseconds; an int64 ends soon after."""


@dataclass(frozen=True)
class Matching:
    """How a frame comes to its pose."""

    gate_s: float = 0.5
    """A pose farther than this in time is none, seconds."""

    is_interpolated: bool = True
    """Between the poses around, instead of the nearest one."""

    least: float = 0.5
    """Share of the frames that must have a pose."""

    def __post_init__(self) -> None:
        """Refuse what no frame can meet."""
        if not self.gate_s > 0 or not 0 <= self.least <= 1:
            raise InputError(
                f"a gate of {self.gate_s:g} s for a share of {self.least:g} of the frames matches"
                " nothing; the gate is positive, the share from 0 to 1"
            )


def present(path: Path) -> Path:
    """Return a path that exists, or say what lies there instead.

    Args:
        path: a file or folder of a data set.

    Raises:
        InputError: it is missing; a packed copy of it, or of a folder above, is named.
    """
    if path.exists():
        return path
    for above in (path, *list(path.parents)[:3]):
        for suffix in (".gz", ".tar", ".tar.gz", ".zip"):
            if above.name and (packed := above.with_name(above.name + suffix)).exists():
                raise fail(path, f"no such file, but {packed.name} is there", "unpack it first")
    raise fail(path, "no such file or folder", "add it or point at another folder")


def stamped_images(
    folder: Path, digits: int, suffixes: Sequence[str] = (".png",)
) -> tuple[tuple[str, ...], Int[np.ndarray, " n"]]:
    """List the frames of a sensor by the stamps in their names.

    Args:
        folder: one sensor's files; others than images, and hidden ones, are passed over.
        digits: of a stamp, such as 19 for UNIX time in nanoseconds.
        suffixes: of the files that are frames.

    Returns:
        File names and stamps in time order.

    Raises:
        InputError: there is no such folder, a name is no stamp, or no frame is there.
    """
    if not folder.exists() and folder.parent.is_dir():
        beside = sorted(path.name for path in folder.parent.iterdir() if path.is_dir())
        if beside:
            raise fail(folder, "no such folder", f"there are {', '.join(beside)[:200]}")
    if not present(folder).is_dir():
        raise fail(folder, "is not a folder", "point at the folder with the images")
    paths = (p for p in folder.iterdir() if p.suffix in suffixes and not p.name.startswith("."))
    names = sorted(path.name for path in paths)
    for name in names:
        if stamp_of(name, digits) is None:
            what = f"its name is not a stamp of {digits} digits"
            raise fail(folder / name, what, "restore the name or remove the file")
    if not names:
        wanted = f"expected names of {digits} digits and {' or '.join(suffixes)}"
        raise fail(folder, "holds no frames", wanted)
    return tuple(names), np.array([stamp_of(name, digits) for name in names], np.int64)


def stamp_of(name: str, digits: int) -> int | None:
    """Return the stamp that an image is named by, None where its name is none."""
    stem = name.rpartition(".")[0]
    if not (stem.isascii() and stem.isdigit() and len(stem) == digits):
        return None
    return stamp if (stamp := int(stem)) <= LATEST else None


def check_unit(path: Path, column: str, stamps: np.ndarray, unit: str) -> None:
    """Refuse UNIX times of another unit than a column holds.

    Args:
        path: the table they come from.
        column: its name.
        stamps: as read.
        unit: seconds, microseconds or nanoseconds.

    Raises:
        InputError: naming row, unit and what to do.
    """
    for at in (int(stamps.argmin()), int(stamps.argmax())):
        seen = looks_like(float(stamps[at]))
        if seen not in (None, unit):
            where = f"{row_of(path, len(stamps), at)}, column {column}"
            what = f"{where}: {stamps[at]:.16g} looks like {seen}"
            raise fail(path, what, f"convert the column to {unit}")


def checked_drive(
    path: Path,
    stamps: np.ndarray,
    xyt: Float[np.ndarray, "n 3"],
    unit_s: float,
    *,
    n_odd: int = 0,
) -> tuple[Trajectory, tuple[str, ...]]:
    """Make the poses of a table a drive: repeated rows once, no contradiction, no jump.

    Args:
        path: the table, for the messages.
        stamps: (n,) that do not run backwards, seconds or whole units.
        xyt: (n, 3) pose of every row.
        unit_s: seconds in a unit of `stamps`.
        n_odd: rows that the table has before these and again behind them.

    Returns:
        The drive, and what the report must repeat.

    Raises:
        InputError: time runs backwards, one stamp has two poses, or poses are more than `JUMP_M`
            apart.
    """
    steps = np.diff(stamps)
    is_repeat = (steps == 0) & np.all(xyt[1:] == xyt[:-1], axis=1)
    far_m = np.hypot(*np.diff(xyt[:, :2], axis=0).T)
    for is_wrong, what, fix in (
        (steps < 0, "time runs backwards", "sort the rows by time"),
        ((steps == 0) & ~is_repeat, "the stamp of the row before with another pose",
         "keep one row per stamp"),
        (far_m > JUMP_M, f"jumps {np.max(far_m, initial=0.0) / 1e3:.0f} km from the row before",
         "if UTM zones are mixed, project all rows to one zone"),
    ):  # fmt: skip
        if is_wrong.any():
            at = int(np.flatnonzero(is_wrong)[0]) + 1 + n_odd
            row = row_of(path, len(xyt) + 2 * n_odd, at)
            raise fail(path, f"{row}: {what}", fix)
    stays = np.concatenate([[True], ~is_repeat])
    n_twice = int(is_repeat.sum())
    notes = (f"{n_twice:,} repeated row(s) of {path.name} count once",) if n_twice else ()
    return Trajectory(stamps[stays].astype(float) * unit_s, xyt[stays]), notes


def agreed_headings(
    xyt: Float[np.ndarray, "n 3"], *, may_turn: bool = False
) -> tuple[Float[np.ndarray, " n"], tuple[str, ...]]:
    """Hold the headings that a data set states against the direction of travel.

    Args:
        xyt: (n, 3) poses in the order driven.
        may_turn: headings that all point backwards are turned round; otherwise, and wherever they
            agree with nothing, the direction of travel replaces them.

    Returns:
        (n,) theta [rad], and what the report must repeat.
    """
    travel = headings(xyt[:, :2], least_m=1.0)
    metre = spaced(xyt, 1.0)  # standing counts once
    off = wrap(xyt[metre, 2] - travel[metre])
    if len(metre) > 2 and np.mean(np.abs(off) <= AGREED_RAD) >= MOST:
        return xyt[:, 2], ()
    median = float(np.degrees(np.median(np.abs(off))))
    said = f"the headings of the data set are {median:.0f} degrees off the direction of travel"
    if len(metre) > 2 and may_turn and np.mean(np.abs(wrap(off + np.pi)) <= AGREED_RAD) >= MOST:
        return wrap(xyt[:, 2] + np.pi), (f"{said} and were turned round",)
    return travel, (f"{said}: derived from positions instead",)


def _left_out(n_frames: int, is_kept: Bool[np.ndarray, " n"], matching: Matching) -> str:
    how = "interpolated" if matching.is_interpolated else "nearest"
    words = f"{int(is_kept.sum()):,} of {n_frames:,} frames have a pose within {matching.gate_s:g}"
    return f"{words} s ({how})" + ("" if is_kept.all() else "; the others are left out")


def matched_session(
    source: Path,
    frames: tuple[tuple[str, ...], Float[np.ndarray, " n"]],
    drive: Trajectory,
    matching: Matching,
    notes: Sequence[str],
) -> Session:
    """Give frames the poses of a drive on the same clock.

    Args:
        source: where the frames come from, for the message.
        frames: their names and stamps [s].
        drive: the poses.
        matching: nearest or interpolated, and the gate.
        notes: what is to be repeated of the drive.

    Raises:
        InputError: too few of the frames have a pose.
    """
    names, t_s = frames
    poses, is_matched = pose_at(drive, t_s, matching.gate_s, interpolated=matching.is_interpolated)
    said = _left_out(len(names), is_matched, matching)
    if not is_matched.any() or is_matched.mean() < matching.least:
        what = (
            f"{said.partition(';')[0]}: frames from {t_s[0]:.3f} s to {t_s[-1]:.3f} s, poses from"
            f" {drive.t_s[0]:.3f} s to {drive.t_s[-1]:.3f} s"
        )
        raise fail(source, what, "compare the clocks, widen --gate-s or lower --least-matched")
    kept = tuple(name for name, is_there in zip(names, is_matched, strict=True) if is_there)
    found = Trajectory(t_s[is_matched], poses[is_matched])
    return Session(kept, found, True, (*notes, said), listed=names)


def own_session(names: Sequence[str], drive: Trajectory, notes: Sequence[str]) -> Session:
    """Let the poses themselves be the frames, where a data set holds no images."""
    said = "no images are at hand: the poses themselves are the frames"
    return Session(tuple(names), drive, True, (*notes, said))
