"""Files of stamped poses that other programs write: TUM, KITTI, EuRoC, g2o and our own CSV.

A 3-D pose is laid flat in one of two ways. `xz` is the camera's: x right, y down, z forward; the
plane then has x along the camera's z and y along its -x, so that it is right-handed and seen from
above. `xy` is that of a z-up frame with x forward, as ROS and most lidar programs use it. In both,
theta is the direction of the body's forward axis in the plane, counter-clockwise.
"""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from taojax.datasets.trajectory import Trajectory, motions
from taojax.specs import fail, read_text
from taojax.tables import POSE, read_table, stacked

__all__ = [
    "Kind", "Plane", "check_seconds", "flat_poses", "looks_like", "read_trajectory", "rotations",
    "row_of", "stamps_s",
]  # fmt: skip

Kind = Literal["tum", "kitti", "euroc", "g2o", "csv"]
"""Who wrote the file."""

Plane = Literal["xz", "xy"]
"""Which plane 3-D poses are laid into, and which body axis looks forward there."""

Where = Callable[[int], str]
"""Names the row, message or line that pose i comes from."""

UNIT_LENGTH = 0.01
"""How far a quaternion may be from unit length, and a rotation matrix from orthonormal."""

UPRIGHT = 0.1
"""A forward axis with less than this in the plane stands upright on it and has no heading."""

LARGEST = 1e7
"""No coordinate is larger, UTM northings in metres included."""

APART_M = 1.0
"""Poses nearer to each other than this say nothing about where forward is."""

FASTEST_S = 5e-4
"""No sensor here stamps faster; closer stamps are in another unit."""

_Fine = Literal["microseconds", "nanoseconds"]
_UNITS = ("seconds", "milliseconds", "microseconds", "nanoseconds")
_VERTICES = {"VERTEX_SE2": 3, "VERTEX_SE3:QUAT": 7}


def read_trajectory(
    path: Path, kind: Kind, *, times: Path | None = None, plane: Plane | None = None
) -> Trajectory:
    """Read a drive from a file of poses.

    Args:
        path: the file.
        kind: `tum` (seconds, quaternion w last), `kitti` (12 cells, or 13 with the frame number
            first), `euroc` (nanoseconds, quaternion w first, 8 to 17 columns), `g2o`
            (VERTEX_SE2 or VERTEX_SE3:QUAT lines), `csv` (t_s,x_m,y_m,theta_rad).
        times: stamp of every KITTI frame [s]; without it stamps are frame numbers, counted from 0.
        plane: how 3-D poses are laid flat; without it `xz` for KITTI and `xy` for the others.

    Returns:
        At least two poses. Stamps of g2o poses are vertex ids, or row numbers where ids are
        symbols too large for a number.

    Raises:
        InputError: naming file, row and fix: another format or unit, or a drive out of the plane.

    Source:
        Column orders as in evo's documentation of its trajectory formats.
    """
    if times is not None and kind != "kitti":
        raise fail(times, f"{kind} poses carry their own stamps", "leave the times away")
    if kind == "g2o":
        return _read_g2o(path, plane or "xy")
    if kind == "kitti":
        return _read_kitti(path, times, plane or "xz")
    table = read_table(path, {"tum": "tum", "euroc": "euroc", "csv": "trajectory"}[kind])
    where = partial(row_of, path, len(next(iter(table.values()))))
    if kind == "euroc":
        t_s = stamps_s(path, table["t_ns"], "nanoseconds", where)
    else:
        check_seconds(path, t_s := table["t_s"], where)
    if kind == "csv":
        return Trajectory(t_s, stacked(table, POSE))
    rotation = rotations(path, stacked(table, ["qx", "qy", "qz", "qw"]), where)
    xyt = flat_poses(path, stacked(table, ["x_m", "y_m", "z_m"]), rotation, plane or "xy", where)
    return Trajectory(t_s, xyt)


def row_of(path: Path, n_rows: int, index: int) -> str:
    """Name the line of a table's row, as an editor counts them; for errors only.

    Args:
        path: a table that `read_table` accepted.
        n_rows: its rows.
        index: one of them, from 0.
    """
    lines = read_text(path).rstrip().splitlines()
    rows = [row for row, line in enumerate(lines, 1) if not line.lstrip().startswith("#")]
    return f"row {rows[len(rows) - n_rows + index]}"


def looks_like(stamp: float | int) -> str | None:
    """Return the unit in which a stamp is a date from 1973 to 5138, if any."""
    power = next((k for k in range(4) if 1e8 <= stamp / 10 ** (3 * k) < 1e11), None)
    return None if power is None else _UNITS[power]


def check_seconds(path: Path, t_s: Float[np.ndarray, " n"], where: Where) -> None:
    """Refuse stamps that cannot be seconds.

    Raises:
        InputError: a stamp lies beyond the year 5138; it names the unit it looks like.
    """
    if (odd := np.flatnonzero(t_s >= 1e11)).size:
        at, unit = int(odd[0]), looks_like(float(t_s[odd[0]])) or "no time at all"
        what = f"{where(at)}: stamp {t_s[at]:.0f} cannot be seconds, it looks like {unit}"
        raise fail(path, what, "convert the stamps to seconds")


def stamps_s(
    path: Path, stamps: Int[np.ndarray, " n"], unit: _Fine, where: Where
) -> Float[np.ndarray, " n"]:
    """Convert whole stamps to seconds.

    Args:
        path: where they come from.
        stamps: (n,) UNIX time or counted from any start, in either direction.
        unit: what the format says they are.
        where: names a row.

    Returns:
        (n,) seconds.

    Raises:
        InputError: they are in another unit, as their size or their rate shows.
    """
    power, last = _UNITS.index(unit), int(stamps.max())
    per_s, seen = 10.0 ** (3 * power), looks_like(last)
    step_s = float(np.median(np.abs(np.diff(stamps)))) / per_s
    # Stamps of a unit next to this one would make a log of days, or of no time at all.
    away = 0 if seen is None else _UNITS.index(seen) - power
    if step_s < FASTEST_S or abs(away) == 1:
        guess = seen if away else "a longer unit"
        what = f"{where(int(stamps.argmax()))}: stamp {last} is not in {unit}"
        raise fail(path, f"{what}, it looks like {guess}", f"convert the stamps to {unit}")
    return stamps / per_s


def rotations(path: Path, q: Float[np.ndarray, "n 4"], where: Where) -> Float[np.ndarray, "n 3 3"]:
    """Turn quaternions into matrices.

    Args:
        path: where they come from.
        q: (n, 4) x, y, z, w.
        where: names a row.

    Returns:
        (n, 3, 3) rotations of the body in the world; columns are the body's axes.

    Raises:
        InputError: a quaternion is not near unit length.
    """
    length = np.sqrt((q**2).sum(axis=1))
    if (odd := np.flatnonzero(~(np.abs(length - 1.0) <= UNIT_LENGTH))).size:
        what = f"{where(int(odd[0]))}: the quaternion has length {length[odd[0]]:.3g}"
        raise fail(path, what, "store unit quaternions in the order of this format")
    x, y, z, w = (q / length[:, None]).T
    first = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    second = [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
    third = [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    return np.moveaxis(np.array([first, second, third]), 2, 0)


def flat_poses(
    path: Path,
    xyz: Float[np.ndarray, "n 3"],
    rotation: Float[np.ndarray, "n 3 3"],
    plane: Plane,
    where: Where,
) -> Float[np.ndarray, "n 3"]:
    """Lay 3-D poses into a plane, and refuse the plane where the drive does not lie in it.

    Args:
        path: where they come from.
        xyz: (n, 3) positions [m].
        rotation: (n, 3, 3) of the body in the world.
        plane: see the head of this module.
        where: names a row.

    Returns:
        (n, 3) x [m], y [m], theta [rad].

    Raises:
        InputError: the forward axis stands upright on the plane, most of the way is driven out of
            the plane, or the body moves sideways throughout.
    """
    axis, up, other = (2, 1, "xy") if plane == "xz" else (0, 2, "xz")
    ahead = _flat(rotation[:, :, axis], plane)
    fix = f"try plane {other}, or give poses of a body that drives along its x (xy) or z (xz) axis"
    if (odd := np.flatnonzero(np.hypot(*ahead.T) < UPRIGHT)).size:
        what = f"{where(int(odd[0]))}: the forward axis stands upright on the plane {plane}"
        raise fail(path, what, fix)
    flat = np.concatenate([_flat(xyz, plane), np.arctan2(ahead[:, 1:], ahead[:, :1])], axis=1)
    far = _apart(xyz)
    step = np.diff(xyz[far], axis=0)
    out = float(np.abs(step[:, up]).sum() / max(np.sqrt((step**2).sum(axis=1)).sum(), APART_M))
    forward_m, left_m, _ = np.abs(motions(flat[far])).sum(axis=0)
    if out > 0.5:
        raise fail(path, f"{out:.0%} of the way leaves the plane {plane}", fix)
    if left_m > 3.0 * forward_m:
        raise fail(path, f"in the plane {plane} the body moves sideways, not forward", fix)
    return flat


def _flat(vectors: np.ndarray, plane: Plane) -> np.ndarray:
    return np.stack([vectors[:, 2], -vectors[:, 0]], axis=1) if plane == "xz" else vectors[:, :2]


def _apart(xyz: np.ndarray) -> list[int]:
    """Choose poses that are some way from each other, so that jitter at a stop is no motion."""
    chosen, places = [0], xyz.tolist()
    for index, place in enumerate(places):
        if math.dist(place, places[chosen[-1]]) >= APART_M:
            chosen.append(index)
    return chosen


def _read_kitti(path: Path, times: Path | None, plane: Plane) -> Trajectory:
    table = read_table(path, "kitti")
    n = len(table["x_m"])
    where = partial(row_of, path, n)
    rotation = stacked(
        table, ["r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"]
    ).reshape(n, 3, 3)
    away = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)[None]).max(axis=(1, 2))
    if (odd := np.flatnonzero((away > UNIT_LENGTH) | (np.linalg.det(rotation) < 0))).size:
        what = f"{where(int(odd[0]))}: the first three columns are no rotation"
        raise fail(path, what, "store 3 x 4 matrices row by row: r11 r12 r13 x r21 ...")
    xyt = flat_poses(path, stacked(table, ["x_m", "y_m", "z_m"]), rotation, plane, where)
    frame = table.get("frame", np.arange(n, dtype=float))
    check_seconds(path, frame, where)
    if times is None:
        return Trajectory(frame, xyt)
    t_s = read_table(times, "kitti_times")["t_s"]
    check_seconds(times, t_s, partial(row_of, times, len(t_s)))
    if "frame" not in table and len(t_s) != n:
        raise fail(times, f"{len(t_s)} stamps for the {n} poses of {path.name}", "pair the files")
    if (odd := np.flatnonzero((frame >= len(t_s)) | (frame % 1.0 > 0))).size:
        what = f"{where(int(odd[0]))}: frame {frame[odd[0]]:g} has no line in {times.name}"
        raise fail(path, what, "pair the files; frames count from 0")
    return Trajectory(t_s[frame.astype(int)], xyt)


def _read_g2o(path: Path, plane: Plane) -> Trajectory:
    """Read the vertices of a graph; its edges and landmarks are passed over."""
    lines = enumerate(map(str.split, read_text(path).splitlines()), 1)
    found = [(row, words) for row, words in lines if words and words[0] in _VERTICES]
    tags = {words[0] for _, words in found}
    if len(tags) != 1 or len(found) < 2:
        what = f"{len(found)} pose vertices of {len(tags)} kinds"
        raise fail(path, what, "store at least two VERTEX_SE2 or VERTEX_SE3:QUAT lines")
    (tag,) = tags
    values = np.array([_vertex(path, row, words, _VERTICES[tag]) for row, words in found])
    ids = [int(words[1]) for _, words in found]
    where: Where = lambda index: f"row {found[index][0]}"
    if odd := [index for index in range(1, len(ids)) if ids[index] <= ids[index - 1]]:
        what = f"{where(odd[0])}: vertex {ids[odd[0]]} comes after vertex {ids[odd[0] - 1]}"
        raise fail(path, what, "sort the vertices by id, each once")
    # GTSAM packs a letter into the top byte of an id, which no float64 holds.
    stamps = np.array(ids if ids[-1] < 2**53 else range(len(ids)), dtype=float)
    if tag == "VERTEX_SE3:QUAT":
        rotation = rotations(path, values[:, 3:], where)
        values = flat_poses(path, values[:, :3], rotation, plane, where)
    return Trajectory(stamps, values)


def _vertex(path: Path, row: int, words: list[str], n_values: int) -> list[float]:
    if len(words) != 2 + n_values:
        what = f"row {row}: {len(words)} words where {2 + n_values} are expected"
        raise fail(path, what, f"a {words[0]} line is its name, an id and {n_values} numbers")
    try:
        int(words[1])
        values = [float(word) for word in words[2:]]
    except ValueError as error:
        raise fail(path, f"row {row}: {str(error)[:80]}", "fix the cell") from error
    if all(abs(value) <= LARGEST for value in values):
        return values
    raise fail(path, f"row {row}: a number is not finite or beyond {LARGEST:g}", "repair it")
