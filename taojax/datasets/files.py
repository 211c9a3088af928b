"""Poses and odometry in single files of any name; the file says what it is, or the user does.

.npy       (N, 3) x, y, theta; (N, 4) with the stamp first; (N, 2) without headings; (N, 7) and
           (N, 8) with a quaternion; (N, 3, 4) and (N, 4, 4) matrices
text       tables with names, TUM, KITTI, EuRoC, g2o, known by header or number of columns
"""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from taojax.datasets.arrays import check_begin
from taojax.datasets.clocks import in_order, seconds
from taojax.datasets.odometry import OdometryKind, read_odometry
from taojax.datasets.reading import PLAIN, Drive, Plane, Reading
from taojax.datasets.text_tables import COMMENTS, Column, TextRows, read_rows
from taojax.datasets.trajectories import (
    DERIVED,
    NUMBERED,
    flat_poses,
    headings_of,
    ordered_quaternions,
    read_trajectory,
    rotations,
    text_columns,
    with_times,
)  # fmt: skip
from taojax.datasets.trajectory import Trajectory, headings, integrate
from taojax.errors import InputError
from taojax.files.specs import fail, load_spec, read_npy, read_text
from taojax.files.tables import MOTION, POSE, stacked

__all__ = ["DERIVED", "NUMBERED", "Drive", "MotionKind", "kind_of", "read_motion", "read_poses"]

MotionKind = OdometryKind | Literal["poses"]
"""What holds the odometry; `poses`: whatever `read_poses` takes."""


def kind_of(path: Path, reading: Reading = PLAIN) -> OdometryKind | None:
    """Tell what a file of poses or odometry is, where its ending, header or columns say so.

    Returns:
        None for an array, which cannot say whether it holds poses or motions, and for text that no
        known program writes.

    Raises:
        InputError: no such file, empty, or not text.
    """
    if path.is_dir():
        is_bag = (path / "metadata.yaml").is_file() or any(path.glob("*.bag"))
        return "bag" if is_bag else None
    check_begin(path)
    by_ending: dict[str, OdometryKind | None] = {
        ".npy": None, ".bag": "bag", ".mcap": "bag", ".db3": "bag", ".g2o": "g2o",
    }  # fmt: skip
    if path.suffix.lower() in by_ending:
        return by_ending[path.suffix.lower()]
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    text = [line for line in lines if not line.startswith(COMMENTS)]
    if not text:
        return None
    if text[0].replace(" ", "").startswith("source_timestamp"):
        return "robotcar-vo"
    if text[0].startswith(("VERTEX_", "EDGE_", "FIX ")):
        return "g2o"
    return _kind_of_table(path, read_rows(path, reading.decimal), reading)


def _kind_of_table(path: Path, table: TextRows, reading: Reading) -> OdometryKind | None:
    try:
        found = text_columns(path, table, None, reading)
    except InputError:
        if table.header and not table.is_commented:
            raise
        return None
    if "x_m" not in found.columns:
        return "steps"
    if len(table.columns) in (3, 4) and "header" not in found.said and not table.header:
        # Two or three numbers may as well be a motion.
        return "csv" if reading.columns else None
    for kind in ("tum", "kitti", "euroc") if found.is_certain else ():
        if f"read as {kind}" in found.said:
            return kind
    return "csv"


def read_poses(path: Path, reading: Reading = PLAIN) -> Drive:
    """Read poses from a file of any name.

    Args:
        path: see the head of this module.
        reading: what the user says of it.

    Raises:
        InputError: naming file, row and fix.
    """
    if path.suffix.lower() == ".npy":
        return _from_array(path, reading)
    kind = kind_of(path, reading)
    if kind == "bag":
        return read_odometry(path, kind, reading)
    if kind == "robotcar-vo":
        raise fail(path, "holds motions, not poses", "give poses")
    return read_trajectory(path, "g2o" if kind == "g2o" else None, reading)


def read_motion(path: Path, kind: MotionKind, reading: Reading = PLAIN) -> Drive:
    """Read odometry as a drive in its own frame, from all that `read_odometry` takes or an array.

    Args:
        path: a file; a folder for some kinds.
        kind: `steps` (motion from row to row) or `poses` of an .npy; else see `read_odometry`.
        reading: what the user says of it.

    Raises:
        InputError: naming file, row and fix.
    """
    if kind == "poses" or (kind == "csv" and path.suffix.lower() == ".npy"):
        return read_poses(path, reading)
    if path.suffix.lower() != ".npy":
        return read_odometry(path, kind, reading)
    if kind != "steps":
        raise fail(path, f"an array is no file of kind {kind}", "its kind is steps or poses")
    table, notes = _columns(path, "motion_array")
    steps = stacked(table, MOTION)
    n = len(steps)
    if "t_s" not in table:
        drive = Drive(Trajectory(np.arange(float(n)), integrate(steps)), (*notes, NUMBERED), False)
        return with_times(path, drive, reading)
    step_m = np.hypot(*steps[1:, :2].T)
    t_s, assumed = seconds(path, table["t_s"], step_m, "s", reading.time_unit, _row)
    order = in_order(path, t_s, steps, _row, is_motion=True)
    poses = Trajectory(t_s[order.rows], integrate(steps[order.rows]))
    return Drive(poses, (*notes, *assumed, *order.notes), True, order.rows, n)


def _row(index: int) -> str:
    return f"row {index} (from 0)"


def _from_array(path: Path, reading: Reading) -> Drive:
    table, notes = _columns(path, "pose_array")
    if "t_s" not in table and "theta_rad" in table:
        _check_stampless(path, table)
    xyt, more, has_handedness = _laid_flat(path, table, reading)
    notes += more
    n = len(xyt)
    if "t_s" not in table or np.ptp(table["t_s"]) == 0:
        poses = Trajectory(np.arange(float(n)), xyt)
        drive = Drive(poses, (*notes, NUMBERED), False, has_handedness=has_handedness)
        return with_times(path, drive, reading)
    step_m = np.hypot(*np.diff(xyt[:, :2], axis=0).T)
    t_s, assumed = seconds(path, table["t_s"], step_m, "s", reading.time_unit, _row)
    order = in_order(path, t_s, xyt, _row)
    poses = Trajectory(t_s[order.rows], xyt[order.rows])
    return Drive(poses, (*notes, *assumed, *order.notes), True, order.rows, n, has_handedness)


def _laid_flat(
    path: Path, table: Mapping[str, np.ndarray], reading: Reading
) -> tuple[Float[np.ndarray, "n 3"], tuple[str, ...], bool]:
    """Return poses in the plane, what was assumed, and whether left and right are sure."""
    xy = stacked(table, POSE[:2])
    if "theta_rad" in table:
        column = Column(0, "theta_rad", None, "theta_rad")
        theta, said = headings_of(path, xy, table["theta_rad"], column, reading)
        return np.column_stack([xy, theta]), tuple(said), True
    if "z_m" not in table:
        said = (f"{path.name}: {DERIVED}",)
        return np.column_stack([xy, headings(xy)]), said, True
    xyz = stacked(table, ("x_m", "y_m", "z_m"))
    if "qx" in table:
        raw = stacked(table, ("qx", "qy", "qz", "qw"))
        q, said = ordered_quaternions(path, xyz, raw, ("xyzw", False), reading, _row)
        flat = flat_poses(path, xyz, rotations(path, q, _row), reading.plane or "xy", _row)
        return flat, tuple(said), True
    turn = stacked(table, [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]).reshape(-1, 3, 3)
    if reading.plane is not None:
        return flat_poses(path, xyz, turn, reading.plane, _row), (), True
    found = {}
    planes: tuple[Plane, ...] = ("xy", "xz")
    for plane in planes:
        with contextlib.suppress(InputError):
            found[plane] = flat_poses(path, xyz, turn, plane, _row)
    if not found:
        return flat_poses(path, xyz, turn, "xy", _row), (), True
    if len(found) > 1:
        what = "matrices that may be of a vehicle (x forward, z up) or a camera (z forward)"
        raise fail(path, what, "add --plane xy or --plane xz")
    (plane,) = found
    said = f"{path.name}: matrices are laid into the plane {plane}, the only one they fit"
    return found[plane], (said,), plane == "xy"


def _check_stampless(path: Path, table: Mapping[str, np.ndarray]) -> None:
    """Refuse t, x, y in the place of x, y, theta: the first column then rises like a clock."""
    step = np.diff(table["x_m"])
    is_clock = step.min() > 0 and step.max() <= 1.01 * step.min()
    if is_clock and np.abs(table["theta_rad"]).max() > 4 * np.pi:
        what = "3 columns that look like t, x, y"
        raise fail(path, what, "3 columns are x, y, theta; store 4 with t, or 2 with x, y alone")


def _columns(path: Path, name: str) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Read the columns of an array and hold them against their spec."""
    check_begin(path)
    spec = load_spec(name)
    array, notes = _table_of(path, read_npy(path, name))
    layouts = {len(layout): layout for layout in spec["layouts"]}
    if array.ndim != 2 or array.shape[1] not in layouts:
        raise fail(path, f"has shape {array.shape}", f"expected {spec['array']['shape']}")
    if len(array) < spec["min_rows"]:
        raise fail(path, f"{len(array)} row(s)", f"at least {spec['min_rows']} are needed")
    columns = {column["name"]: column for column in spec["columns"]}
    layout = layouts[array.shape[1]]
    table = {}
    for label, column in zip(layout, array.T, strict=True):
        is_whole = label == "t_s" and column.dtype.kind in "iu"
        table[label] = column.astype(np.int64 if is_whole else np.float64)
        if (error := _fault(path, columns[label], table[label])) is not None:
            raise error
    return table, notes


def _table_of(path: Path, array: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Take axes of length one away, and lay matrices out in rows of twelve."""
    if array.ndim == 3 and array.shape[1:] in ((3, 4), (4, 4)):
        return array[:, :3].reshape(len(array), 12), ()
    if array.ndim > 2 and 1 in array.shape:
        flat = array.reshape([n for n in array.shape if n != 1])
        return flat, (f"{path.name}: shape {array.shape} is read as {flat.shape}",)
    return array, ()


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
    return None
