"""Poses and odometry in single files of any name; the file says what it is, or the user does.

.npy       (N, 3) x, y, theta; (N, 4) with the stamp first; (N, 2) without headings
text       our own tables, TUM, KITTI, EuRoC, g2o, known by header or number of columns
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from taojax.datasets.arrays import check_begin
from taojax.datasets.odometry import OdometryKind, read_odometry
from taojax.datasets.trajectories import Plane, read_trajectory
from taojax.datasets.trajectory import Trajectory, headings, integrate
from taojax.errors import InputError
from taojax.specs import fail, load_spec, read_npy, read_text
from taojax.tables import MOTION, POSE, read_table, stacked

__all__ = ["DERIVED", "NUMBERED", "Drive", "MotionKind", "kind_of", "read_motion", "read_poses"]

MotionKind = OdometryKind | Literal["poses"]
"""What holds the odometry; `poses`: whatever `read_poses` takes."""

DERIVED = "headings are derived from positions"
NUMBERED = "no time stamps: row numbers stand for seconds"

WIDTHS: dict[int, OdometryKind] = {8: "tum", 12: "kitti", 13: "kitti"}
"""Number of cells between blanks -> who writes so."""

HEADERS: dict[str, OdometryKind] = {
    "t_s,x_m,y_m": "csv",
    "t_s,dx_m": "steps",
    "source_timestamp": "robotcar-vo",
}
"""How a header begins -> what it stands above."""

KNOWN = (
    ".npy, a table t_s,x_m,y_m,theta_rad, TUM (8 columns), KITTI (12 or 13), EuRoC or g2o"
)  # fmt: skip


class Drive(NamedTuple):
    """What one file holds."""

    poses: Trajectory
    notes: tuple[str, ...] = ()
    """Sentences that the report must repeat."""

    has_stamps: bool = True
    """False: row numbers stand for seconds."""


def kind_of(path: Path) -> OdometryKind | None:
    """Tell what a file of poses or odometry is, where its ending, header or columns say so.

    Returns:
        None for an array, which cannot say whether it holds poses or motions, and for text that no
        known program writes.

    Raises:
        InputError: no such file, empty, or not text.
    """
    if path.is_dir():
        return None
    check_begin(path)
    by_ending: dict[str, OdometryKind | None] = {".npy": None, ".bag": "bag", ".g2o": "g2o"}
    if path.suffix.lower() in by_ending:
        return by_ending[path.suffix.lower()]
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    text = [line for line in lines if not line.startswith("#")]
    if not text:
        return None
    first = text[0].replace(" ", "")
    for begin, kind in HEADERS.items():
        if first.startswith(begin):
            return kind
    if first.startswith("VERTEX_"):
        return "g2o"
    if "," in first:
        return "euroc" if 8 <= first.count(",") + 1 <= 17 and _is_stamp(first) else None
    return WIDTHS.get(len(text[0].split()))


def _is_stamp(line: str) -> bool:
    """Tell whether a row begins with nanoseconds."""
    return line.split(",")[0].isdecimal() and len(line.split(",")[0]) >= 15


def read_poses(path: Path, plane: Plane | None = None) -> Drive:
    """Read poses from a file of any name.

    Args:
        path: see the head of this module.
        plane: how 3-D poses are laid flat, as `read_trajectory` has it.

    Raises:
        InputError: naming file, row and fix.
    """
    if path.suffix.lower() == ".npy":
        return _from_array(path)
    kind = kind_of(path)
    # A table with another header is told which one is expected.
    if kind == "csv" or (kind is None and path.suffix.lower() == ".csv"):
        return _flat(path, read_table(path, "plain_poses"))
    if kind not in ("tum", "kitti", "euroc", "g2o"):
        what = "holds motions, not poses" if kind == "steps" else "is no known file of poses"
        raise fail(path, what, f"give {KNOWN}")
    has_stamps = kind in ("tum", "euroc")
    notes = (f"{path.name}: read as {kind}", *(() if has_stamps else (NUMBERED,)))
    return Drive(read_trajectory(path, kind, plane=plane), notes, has_stamps)


def read_motion(
    path: Path,
    kind: MotionKind,
    *,
    times: Path | None = None,
    plane: Plane | None = None,
    topic: str | None = None,
) -> Drive:
    """Read odometry as a drive in its own frame, from all that `read_odometry` takes or an array.

    Args:
        path: a file; a folder for some kinds.
        kind: `steps` (motion from row to row) or `poses` of an .npy; else see `read_odometry`.
        times: stamp of every KITTI frame [s].
        plane: how 3-D poses are laid flat.
        topic: of a bag.

    Raises:
        InputError: naming file, row and fix.
    """
    if kind == "poses" or (kind == "csv" and path.suffix.lower() == ".npy"):
        return read_poses(path, plane)
    if path.suffix.lower() != ".npy":
        poses = read_odometry(path, kind, times=times, plane=plane, topic=topic)
        return Drive(poses, has_stamps=kind != "kitti" or times is not None)
    if kind != "steps":
        raise fail(path, f"an array is no file of kind {kind}", "its kind is steps or poses")
    table = _columns(path, "motion_array")
    n_rows = len(table["dx_m"])
    return Drive(_stamped(table, integrate(stacked(table, MOTION)), n_rows), (), "t_s" in table)


def _from_array(path: Path) -> Drive:
    table = _columns(path, "pose_array")
    if "t_s" not in table and "theta_rad" in table:
        _check_stampless(path, table)
    return _flat(path, table)


def _flat(path: Path, table: Mapping[str, np.ndarray]) -> Drive:
    """Complete poses whose stamps or headings are not there, and say so."""
    xy = stacked(table, POSE[:2])
    theta = table["theta_rad"] if "theta_rad" in table else headings(xy)
    notes = () if "theta_rad" in table else (f"{path.name}: {DERIVED}",)
    notes += () if "t_s" in table else (NUMBERED,)
    poses = _stamped(table, np.column_stack([xy, theta]), len(xy))
    return Drive(poses, notes, "t_s" in table)


def _stamped(
    table: Mapping[str, np.ndarray], xyt: Float[np.ndarray, "n 3"], n_rows: int
) -> Trajectory:
    return Trajectory(table.get("t_s", np.arange(float(n_rows))), xyt)


def _check_stampless(path: Path, table: Mapping[str, np.ndarray]) -> None:
    """Refuse t, x, y in the place of x, y, theta: the first column then rises like a clock."""
    step = np.diff(table["x_m"])
    is_clock = step.min() > 0 and step.max() <= 1.01 * step.min()
    if is_clock and np.abs(table["theta_rad"]).max() > 4 * np.pi:
        what = "3 columns that look like t, x, y"
        raise fail(path, what, "3 columns are x, y, theta; store 4 with t, or 2 with x, y alone")


def _columns(path: Path, name: str) -> dict[str, np.ndarray]:
    """Read the columns of an array and hold them against their spec."""
    check_begin(path)
    spec = load_spec(name)
    array = read_npy(path, name)
    layouts = {len(layout): layout for layout in spec["layouts"]}
    if array.shape[1] not in layouts:
        raise fail(path, f"has shape {array.shape}", f"expected {spec['array']['shape']}")
    if len(array) < spec["min_rows"]:
        raise fail(path, f"{len(array)} row(s)", f"at least {spec['min_rows']} are needed")
    columns = {column["name"]: column for column in spec["columns"]}
    table = dict(zip(layouts[array.shape[1]], np.asarray(array, np.float64).T, strict=True))
    for label, values in table.items():
        if (error := _fault(path, columns[label], values)) is not None:
            raise error
    return table


def _fault(path: Path, column: Mapping[str, Any], values: np.ndarray) -> InputError | None:
    """Return what is wrong with a column, if anything."""
    where = f"column {column['name']}"
    wrong = ~((values >= column["min"]) & (values <= column["max"]))
    if wrong.any():
        row = int(np.argmax(wrong))
        if not np.isfinite(values[row]):
            return fail(path, f"row {row} (from 0), {where}: is not finite", "drop the row")
        what = f"{values[row]:g} is outside [{column['min']:g}, {column['max']:g}] {column['unit']}"
        fix = column.get("fix", "check the unit")
        return fail(path, f"row {row} (from 0), {where}: {what}", fix)
    if column.get("monotonic") and (back := np.flatnonzero(np.diff(values) < 0)).size:
        row = int(back[0]) + 1
        return fail(path, f"row {row} (from 0), {where}: time runs backwards", "sort the rows")
    return None
