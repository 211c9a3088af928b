"""Files of stamped poses that other programs write: TUM, KITTI, EuRoC, g2o and tables with names.

A 3-D pose is laid flat in one of three ways. `xz` is the camera's: x right, y down, z forward; the
plane then has x along the camera's z and y along its -x, so that it is right-handed and seen from
above. `xz-up` is that of a camera with y up and x left. `xy` is that of a z-up frame with x
forward, as ROS and most lidar programs use it. In all, theta is the direction of the body's forward
axis in the plane, counter-clockwise.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from taojax.datasets.clocks import FASTEST_S, in_order, seconds
from taojax.datasets.reading import PLAIN, Drive, Plane, Quaternion, Reading
from taojax.datasets.text_tables import (
    COMPASS,
    NAMES,
    Column,
    TextRows,
    find_columns,
    numbers,
    read_rows,
    values_of,
)
from taojax.datasets.trajectory import Trajectory, driven_m, headings, motions, spaced
from taojax.errors import InputError
from taojax.files.specs import fail, load_spec, read_text
from taojax.files.tables import is_number

__all__ = [
    "CLEAR_RAD",
    "DERIVED",
    "NUMBERED",
    "Kind",
    "decided",
    "flat_poses",
    "headings_of",
    "looks_like",
    "misfit_rad",
    "ordered_quaternions",
    "read_stamps",
    "read_trajectory",
    "rotations",
    "row_of",
    "stamps_s",
    "text_columns",
    "with_times",
]

CLEAR_RAD = np.deg2rad(2.0)
"""A reading that is nearer than this to the direction of motion is not questioned."""

LEAST_CHORDS = 4
"""So many pieces of way are needed to say anything."""


def misfit_rad(xy: Float[np.ndarray, "n 2"], theta: Float[np.ndarray, " n"]) -> float | None:
    """Return how far headings are from the direction of motion, forwards or in reverse.

    Args:
        xy: (n, 2) positions [m] in the order driven.
        theta: (n,) headings [rad].

    Returns:
        Root of the mean square [rad] over pieces of a metre, at most pi / 2; shorter pieces where
        the whole way is short. None where the body hardly moves.
    """
    way = float(driven_m(xy)[-1])
    piece = min(1.0, way / 20.0)
    if piece < 0.02:
        return None
    at = spaced(xy, piece)
    if len(at) <= LEAST_CHORDS:
        return None
    step = np.diff(xy[at], axis=0)
    middle = np.angle(np.exp(1j * theta[at[:-1]]) + np.exp(1j * theta[at[1:]]))
    off = np.arctan2(step[:, 1], step[:, 0]) - middle
    off = np.abs((off + np.pi / 2) % np.pi - np.pi / 2)
    return float(np.sqrt(np.mean(off**2)))


def decided(misfits: Mapping[str, float | None]) -> str | None:
    """Return the reading that the direction of motion leaves, None where it says nothing.

    Args:
        misfits: reading -> what `misfit_rad` says of it.
    """
    known = sorted((value, name) for name, value in misfits.items() if value is not None)
    if len(known) < len(misfits) or len(known) < 2:
        return None
    (best, name), (second, _) = known[:2]
    is_clear = second > CLEAR_RAD and best < 0.5 * second and best < np.deg2rad(20.0)
    return name if is_clear else None


Kind = Literal["tum", "kitti", "euroc", "g2o", "csv"]
"""Who wrote the file."""

Where = Callable[[int], str]
"""Names the row, message or line that pose i comes from."""

DERIVED = "headings are derived from positions"

NUMBERED = "no time stamps: row numbers stand for seconds"

UNIT_LENGTH = 0.01
"""How far a quaternion may be from unit length, and a rotation matrix from orthonormal."""

UPRIGHT = 0.1
"""A forward axis with less than this in the plane stands upright on it and has no heading."""

LARGEST = 1e7
"""No coordinate is larger, UTM northings in metres included."""

APART_M = 1.0
"""Poses nearer to each other than this say nothing about where forward is."""

FITS_RAD = math.radians(20.0)
"""Headings this near to the direction of motion are headings."""

SIDEWAYS_RAD = math.radians(30.0)
"""Headings farther than this from the direction of motion are worth a line."""

_Fine = Literal["microseconds", "nanoseconds"]

_UNITS = ("seconds", "milliseconds", "microseconds", "nanoseconds")

_VERTICES = {"VERTEX_SE2": 3, "VERTEX_SE3:QUAT": 7}

_Q = ("qx", "qy", "qz", "qw")

_R = ("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33")

_OURS = ("t_s", "x_m", "y_m", "theta_rad")

KNOWN = "x,y,theta, t,x,y,z,qx,qy,qz,qw or dx,dy,dtheta"


class Found(NamedTuple):
    """What the columns of a text table hold."""

    columns: Mapping[str, Sequence[Column]]
    """Name of `pose_names.toml` or of the spec -> column."""

    said: str
    """How that was known: a sentence without the file's name, blank where it need not be said."""

    unit: str | None = None
    """Of the stamps, where the format says it."""

    is_certain: bool = True
    """False: the order of the quaternion is a guess."""


def read_trajectory(path: Path, kind: Kind | None, reading: Reading = PLAIN) -> Drive:
    """Read a drive from a file of poses.

    Args:
        path: the file.
        kind: `tum` (quaternion w last), `kitti` (12 or 16 cells, or one more with the frame number
            first), `euroc` (nanoseconds, quaternion w first, 8 to 17 columns), `g2o` (VERTEX_SE2 or
            VERTEX_SE3:QUAT lines), `csv` (a header with names); None: as header or columns say.
            A header with names comes before the kind.
        reading: what the user says of it.

    Returns:
        At least two poses. Stamps of g2o poses are vertex ids, or row numbers where ids are
        symbols too large for a number; of KITTI poses frame numbers, unless stamps are given.

    Raises:
        InputError: naming file, row and fix: no known format, two readings of which none is
            excluded, or a drive out of the plane.

    Source:
        Column orders as in evo's documentation of its trajectory formats.
    """
    if kind == "g2o":
        drive = _read_g2o(path, reading)
        return drive if reading.times is None else with_times(path, drive, reading)
    table = read_rows(path, reading.decimal)
    found = text_columns(path, table, kind, reading)
    if "dx_m" in found.columns and "x_m" not in found.columns:
        raise fail(path, "holds motions, not poses", "give poses, or --odometry-kind steps")
    return _posed(path, table, found, reading)


def text_columns(path: Path, table: TextRows, kind: str | None, reading: Reading) -> Found:
    """Find what the columns of a text table hold.

    Args:
        path: the table.
        table: its rows.
        kind: the format that is expected where there is no header; None: any.
        reading: what the user says.

    Raises:
        InputError: the header has no names of positions, or rows without one may be anything.
    """
    width = len(table.columns)
    if table.header:
        columns = find_columns(path, table.header)
        if {"x_m", "y_m"} <= columns.keys() or "dx_m" in columns:
            return Found(columns, _mapping(table.header, columns))
        if not table.is_commented and not (kind == "euroc" and width >= 8):
            what = f"row {table.lines[0] - 1}: header is {','.join(table.header)[:80]!r}"
            raise fail(path, what, f"expected names such as t_s,x_m,y_m,theta_rad, {KNOWN}")
    if len(reading.columns) == width:
        columns = find_columns(path, reading.columns)
        if not ({"x_m", "y_m"} <= columns.keys() or "dx_m" in columns):
            raise fail(path, f"--columns {','.join(reading.columns)}", f"use names such as {KNOWN}")
        return Found(columns, "columns as you say")
    return _by_width(path, table, kind)


def _mapping(header: Sequence[str], columns: Mapping[str, Sequence[Column]]) -> str:
    """Say which columns are used, and which are not."""
    used = {column.at: role for role, own in columns.items() for column in own}
    if [used.get(at) for at in range(len(header))] == [name.strip() for name in header]:
        return ""
    pairs = [f"{header[at].strip().lstrip('#% ')} = {used[at]}" for at in sorted(used)]
    left = [name.strip() or "an unnamed column" for at, name in enumerate(header) if at not in used]
    more = f" and {len(left) - 6} more" if len(left) > 6 else ""
    unused = f"; not used: {', '.join(left[:6])}{more}" if left else ""
    return f"read by its header: {', '.join(pairs)}{unused}"


def _laid(names: Sequence[str], first: int = 0) -> dict[str, list[Column]]:
    return {name: [Column(first + at, name, None, name)] for at, name in enumerate(names)}


def _layout(name: str) -> list[str]:
    """Return the columns of a format as its spec has them, those of a pose alone."""
    spec = load_spec(name)
    names = spec["layouts"][0] if "layouts" in spec else [c["name"] for c in spec["columns"]]
    return ["t_s" if own == "t_ns" else own for own in names]


def _by_width(path: Path, table: TextRows, kind: str | None) -> Found:
    """Tell columns without names by their number and by what stands in them."""
    width = len(table.columns)
    if kind == "steps" and width in (3, 4):
        names = ("t_s", "dx_m", "dy_m", "dtheta_rad")[4 - width :]
        return Found(_laid(names), f"no header: read as {','.join(names)}")
    if width in (2, 3, 4) and all(is_number(cell) for column in table.columns for cell in column):
        return _few(path, table)
    between = "" if table.separator == " " else f" with {NAMES[table.separator]} between the cells"
    is_fine = _is_fine(table)
    if kind == "euroc" and 8 <= width <= 17:
        return Found(_laid(_layout("euroc")), "read as euroc", "ns")
    if kind in (None, "kitti", "csv") and (known := _by_matrix(table, between)) is not None:
        return known
    if width == 8 and kind != "kitti" and (kind == "tum" or not is_fine):
        return Found(_laid(_layout("tum")), f"read as tum{between}", "s")
    if 8 <= width <= 17 and is_fine and kind != "kitti":
        said = "no header, whole stamps: read as euroc"
        return Found(_laid(_layout("euroc")), said, "ns", is_certain=False)
    if (known := _by_quaternion(table, between)) is not None:
        return known
    if kind in ("tum", "kitti"):
        cells = {"tum": "8", "kitti": "12 or 13"}[kind]
        what = f"row {table.lines[0]}: {width} cells where {cells} are expected"
        raise fail(path, what, f"leave the kind {kind} away, or name the columns {KNOWN}")
    what = f"row {table.lines[0]}: is no known file of poses: {width} columns without names"
    fix = f"add --columns with {width} names, or a header; known are .npy, a table t_s,x_m,y_m,"
    raise fail(path, what, f"{fix}theta_rad, TUM (8 columns), KITTI (12 or 13), EuRoC and g2o")


def _by_matrix(table: TextRows, between: str) -> Found | None:
    """Know KITTI, with or without a last row 0 0 0 1, perhaps behind a frame number."""
    width = len(table.columns)
    is_square = width in (16, 17) and np.all(_last_four(table) == np.array([[0.0, 0, 0, 1]]))
    if not is_square and (width not in (12, 13) or _is_fine(table)):
        return None
    begin = width % 2
    frame = {"frame": [Column(0, "frame", None, "")]} if begin else {}
    return Found(_laid(_layout("kitti"), begin) | frame, f"read as kitti{between}")


def _by_quaternion(table: TextRows, between: str) -> Found | None:
    """Know TUM behind a row number or without stamps by its last four columns, of unit length."""
    width = len(table.columns)
    is_turn = np.abs(np.linalg.norm(_last_four(table), axis=1) - 1).max() <= UNIT_LENGTH
    if width == 9 and is_turn and _is_count(table.columns[0]):
        return Found(_laid(_layout("tum"), 1), f"read as tum behind a row number{between}", "s")
    if width == 7 and is_turn:
        return Found(_laid(_layout("tum")[1:]), "no header: read as x,y,z,qx,qy,qz,qw")
    return None


def _few(path: Path, table: TextRows) -> Found:
    """Read two to four columns of numbers without names, where only one reading is possible."""
    rows = np.array([list(map(float, column)) for column in table.columns]).T
    rows = rows[np.isfinite(rows).all(axis=1)]
    width = rows.shape[1]
    if width == 2:
        return Found(_laid(("x_m", "y_m")), "no header: read as x,y")
    step = np.diff(rows[:, 0])
    is_clock = len(step) > 0 and step.min() >= 0 and step.max() > 0
    last = rows[:, -1]
    may_turn = np.abs(last).max() <= 4 * math.pi
    xy = rows[:, :2] if width == 3 else rows[:, 1:3]
    off = misfit_rad(xy, last) if may_turn else None
    is_heading = off is not None and off <= FITS_RAD
    names = ("x_m", "y_m", "theta_rad") if width == 3 else _OURS
    if is_heading and (width == 3 or is_clock):
        return Found(_laid(names), f"no header: read as {','.join(names)}")
    is_even = is_clock and 0 < step.max() <= 1.01 * step.min()
    if (
        width == 3
        and (is_even or rows[0, 0] > 1e8)
        and off is not None
        and off > math.radians(40.0)
    ):
        return Found(_laid(_OURS[:3]), "no header: read as t_s,x_m,y_m")
    what = f"row {table.lines[0]}: {width} columns without names may be " + (
        "x,y,theta or t,x,y" if width == 3 else "t,x,y,theta, t,x,y,z or x,y,z,theta"
    )
    ours = "x,y,theta" if width == 3 else "t,x,y,theta"
    raise fail(path, what, f"name them, such as --columns {ours}, or give a header")


def _is_fine(table: TextRows) -> bool:
    """Tell rows that begin with whole stamps of fine units, between commas, as EuRoC writes."""
    ends = (table.columns[0][0], table.columns[0][-1])
    return table.separator == "," and all(c.isdecimal() and len(c) >= 15 for c in ends)


def _last_four(table: TextRows) -> np.ndarray:
    try:
        return np.array([list(map(float, column)) for column in table.columns[-4:]]).T
    except ValueError:
        return np.full((1, 4), np.nan)


def _is_count(cells: Sequence[str]) -> bool:
    return all(cell.isdecimal() for cell in cells) and bool(
        np.all(np.diff([int(cell[:18]) for cell in cells]) == 1)
    )


def _posed(path: Path, table: TextRows, found: Found, reading: Reading) -> Drive:
    """Make the rows of a text table a drive."""
    where: Where = lambda index: f"row {table.lines[index]}"
    n = len(table.lines)
    if n < 2:
        raise fail(path, f"{n} data row(s)", "at least 2 are needed")
    own = found.columns
    value: dict[str, np.ndarray] = {}
    said_units: dict[str, str | None] = {}
    kitti = {c["name"]: c for c in load_spec("kitti")["columns"]}
    for role, columns in own.items():
        if role in kitti and role not in ("x_m", "y_m", "z_m"):
            value[role] = numbers(path, table, columns[0], kitti[role])
        else:
            value[role], said_units[role] = values_of(path, table, role, columns)
    notes = [*table.notes, *([f"{path.name}: {found.said}"] if found.said else [])]
    xyt, more, has_handedness = _flat_rows(path, value, own, found, reading, where)
    notes += more
    step_m = np.hypot(*np.diff(xyt[:, :2], axis=0).T)
    if "t_s" not in value or np.ptp(value["t_s"]) == 0:
        if "t_s" in value:
            notes.append(f"{path.name}: all stamps are alike, which is none")
        frame = value.get("frame", np.arange(float(n)))
        drive = Drive(Trajectory(frame, xyt), tuple(notes), False, has_handedness=has_handedness)
        if reading.times is not None:
            return with_times(path, drive, reading, has_numbers="frame" in value)
        order = in_order(path, frame, xyt, where)
        poses = Trajectory(frame[order.rows], xyt[order.rows])
        notes += [NUMBERED, *order.notes]
        return Drive(poses, tuple(notes), False, order.rows, n, has_handedness)
    if reading.times is not None:
        raise fail(reading.times, f"poses of {path.name} carry their own stamps",
                   "leave the times away")  # fmt: skip
    unit = said_units["t_s"] or found.unit
    t_s, assumed = seconds(path, value["t_s"], step_m, unit, reading.time_unit, where)
    order = in_order(path, t_s, xyt, where)
    notes += [*assumed, *order.notes]
    poses = Trajectory(t_s[order.rows], xyt[order.rows])
    return Drive(poses, tuple(notes), True, order.rows, n, has_handedness)


def _flat_rows(
    path: Path,
    value: Mapping[str, np.ndarray],
    own: Mapping[str, Sequence[Column]],
    found: Found,
    reading: Reading,
    where: Where,
) -> tuple[np.ndarray, list[str], bool]:
    """Return poses in the plane, what was assumed, and whether left and right are sure."""
    n = len(value["x_m"])
    xyz = np.column_stack([value["x_m"], value["y_m"], value.get("z_m", np.zeros(n))])
    notes: list[str] = []
    if "r11" in value:
        rotation = np.column_stack([value[name] for name in _R]).reshape(n, 3, 3)
        away = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)[None]).max(axis=(1, 2))
        if (odd := np.flatnonzero((away > UNIT_LENGTH) | (np.linalg.det(rotation) < 0))).size:
            what = f"{where(int(odd[0]))}: the first three columns are no rotation"
            raise fail(path, what, "store 3 x 4 matrices row by row: r11 r12 r13 x r21 ...")
        flat, notes = _as_told(path, xyz, rotation, "xz", reading, where)
        return flat, notes, reading.plane is not None
    plane = reading.plane or "xy"
    if len(there := [name for name in _Q if name in value]) == 4:
        at = sorted(there, key=lambda name: own[name][0].at)
        raw = np.column_stack([value[name] for name in at])
        declared: Quaternion | None = {"qx": "xyzw", "qw": "wxyz"}.get(at[0])  # type: ignore
        if at not in (list(_Q), ["qw", "qx", "qy", "qz"]) or declared is None:
            raw, declared = np.column_stack([value[name] for name in _Q]), "xyzw"
        words = (declared, found.is_certain)
        q, notes = ordered_quaternions(path, xyz, raw, words, reading, where)
        turn = rotations(path, q, where)
        flat, more = _as_told(path, xyz, turn, "xy", reading, where)
        return flat, notes + more, True
    if there:
        what = f"the quaternion has only {', '.join(there)}"
        raise fail(path, what, "store all of qx,qy,qz,qw, or a heading yaw")
    if plane != "xy" and reading.is_shared and _share_out(xyz, 2) <= 0.5:
        notes.append(f"{path.name}: stays in the plane xy, in which it is driven")
    elif plane != "xy":
        xyz = np.column_stack([_flat(xyz, plane), xyz[:, 1]])
    if "theta_rad" in value:
        column = own["theta_rad"][0]
        theta, more = headings_of(path, xyz[:, :2], value["theta_rad"], column, reading)
        return np.column_stack([xyz[:, :2], theta]), notes + more, True
    out = _share_out(xyz, 2)
    if "z_m" in value and reading.plane is None and out > 0.5:
        what = f"{out:.0%} of the way leaves the plane xy"
        raise fail(path, what, "add --plane xz for poses of a camera, or --plane xy")
    notes.append(f"{path.name}: {DERIVED}")
    return np.column_stack([xyz[:, :2], headings(xyz[:, :2])]), notes, True


def _as_told(
    path: Path, xyz: np.ndarray, rotation: np.ndarray, usual: Plane, reading: Reading, where: Where
) -> tuple[np.ndarray, list[str]]:
    """Lay poses into the plane that the user names, or the usual one, and say which it was not."""
    try:
        return flat_poses(path, xyz, rotation, reading.plane or usual, where), []
    except InputError:
        if reading.plane in (None, usual) or not reading.is_shared:
            raise
        flat = flat_poses(path, xyz, rotation, usual, where)
        return flat, [f"{path.name}: stays in the plane {usual}: it does not fit {reading.plane}"]


def ordered_quaternions(
    path: Path,
    xyz: Float[np.ndarray, "n 3"],
    raw: Float[np.ndarray, "n 4"],
    words: tuple[Quaternion, bool],
    reading: Reading,
    where: Where,
) -> tuple[Float[np.ndarray, "n 4"], list[str]]:
    """Bring quaternions into the order x, y, z, w, and hold that against the direction of motion.

    Args:
        path: where they come from.
        xyz: (n, 3) positions [m].
        raw: (n, 4) as written.
        words: the order that the format or the header says, and whether it surely does.
        reading: the user's order and plane.
        where: names a row.

    Returns:
        (n, 4) x, y, z, w, and what was assumed.

    Raises:
        InputError: the direction of motion fits the other order alone.
    """
    declared, is_certain = words
    plane, flag = reading.plane or "xy", reading.quaternion
    if reading.is_shared and _share_out(xyz, 2) <= 0.5:
        plane = "xy"
    as_order = {"xyzw": raw, "wxyz": raw[:, [1, 2, 3, 0]]}
    misfits = {order: _misfit(xyz, q, plane) for order, q in as_order.items()}
    seen = decided(misfits)
    if flag is not None:
        chosen = flag if flag == declared or seen in (None, flag) else declared
        if chosen != flag:
            return as_order[chosen], [
                f"{path.name}: quaternions stay {chosen}: its direction of motion excludes {flag}"
            ]
        is_news = flag != declared or not is_certain
        note = [f"{path.name}: quaternions are read as {flag}, as you say"] if is_news else []
        if seen not in (None, flag):
            off = math.degrees(misfits[flag] or 0.0)
            note += [f"{path.name}: warning: headings are {off:.0f} degrees off the motion"]
        return as_order[flag], note
    if seen in (None, declared):
        return as_order[declared], []
    own, other = (math.degrees(misfits[order] or 0.0) for order in (declared, str(seen)))
    if not is_certain:
        said = f"quaternions are read as {seen}, by the direction of motion"
        return as_order[str(seen)], [f"{path.name}: {said}"]
    what = (
        f"{where(0)}: read as {declared} the headings are {own:.0f} degrees off the direction of"
        f" motion, read as {seen} {other:.0f}"
    )
    fix = f"add --quaternion {seen}, or --quaternion {declared} if the robot does drive askew"
    raise fail(path, what, fix)


def _misfit(xyz: np.ndarray, q: np.ndarray, plane: Plane) -> float | None:
    """Return how far the headings of quaternions are from the direction of motion [rad]."""
    axis, up = (0, 2) if plane == "xy" else (2, 1)
    length = np.linalg.norm(q, axis=1)
    if not (np.abs(length - 1.0) <= UNIT_LENGTH).all() or _share_out(xyz, up) > 0.5:
        return None
    ahead = _flat(_matrices(q / length[:, None])[:, :, axis], plane)
    return misfit_rad(_flat(xyz, plane), np.arctan2(ahead[:, 1], ahead[:, 0]))


def headings_of(
    path: Path,
    xy: Float[np.ndarray, "n 2"],
    raw: Float[np.ndarray, " n"],
    column: Column,
    reading: Reading,
) -> tuple[Float[np.ndarray, " n"], list[str]]:
    """Return headings in radians, counter-clockwise from x.

    Args:
        path: where they come from.
        xy: (n, 2) positions [m].
        raw: (n,) as written.
        column: its name may say the unit, or that it may be a compass.
        reading: the user's word.

    Returns:
        (n,) theta [rad], and what was assumed.

    Raises:
        InputError: two readings are possible; it names the flag that decides.
    """
    readings = {"rad": raw, "deg": np.deg2rad(raw), "compass": np.pi / 2 - np.deg2rad(raw)}
    words = {"rad": "radians", "deg": "degrees", "compass": "degrees clockwise from north (y)"}
    if reading.angles is not None and column.unit is None:
        return readings[reading.angles], [f"{path.name}: headings are {words[reading.angles]}"]
    may = ["rad", "deg"] if column.unit is None else [column.unit]
    if column.word in COMPASS and "deg" in may:
        may.append("compass")
    misfits = {name: misfit_rad(xy, readings[name]) for name in may}
    is_small = np.abs(raw).max() <= 2.0 * math.pi + 1e-6
    # Degrees of a drive that hardly turns are read as radians by nobody.
    if (seen := decided(misfits)) is not None:
        chosen = seen
    elif len(may) == 1:
        chosen = may[0]
    elif (
        (is_small and "compass" not in may)
        or (misfits["rad"] is not None and misfits["rad"] <= FITS_RAD and "compass" not in may)
        or column.name == "theta_rad"
    ):
        chosen = "rad"
    else:
        what = f"row 2, column {column.name}: may be {', '.join(words[name] for name in may)}"
        raise fail(path, what, f"add --angles {' or '.join(may)}")
    notes = []
    if chosen != "rad":
        notes.append(f"{path.name}: column {column.name} is read as {words[chosen]}")
    off = misfits[chosen]
    if off is not None and off > SIDEWAYS_RAD:
        notes.append(
            f"{path.name}: warning: headings are {math.degrees(off):.0f} degrees off the direction"
            " of motion; check column and unit"
        )
    return readings[chosen], notes


def with_times(path: Path, drive: Drive, reading: Reading, *, has_numbers: bool = False) -> Drive:
    """Give poses without stamps those of another file, where the user names one.

    Args:
        path: where the poses come from.
        drive: frame numbers for stamps.
        reading: the file of stamps and their unit.
        has_numbers: the file says which frame each pose is of.

    Raises:
        InputError: other counts, or a frame without a line.
    """
    times = reading.times
    if times is None:
        return drive
    raw, table = read_stamps(times, reading)
    frame, xyt = drive.poses
    n = len(frame)
    is_counted = not has_numbers and bool((np.diff(frame) == 1).all())
    if is_counted and len(raw) != n:
        raise fail(times, f"{len(raw)} stamps for the {n} poses of {path.name}", "pair the files")
    at = np.arange(n) if is_counted else frame
    if (odd := np.flatnonzero((at >= len(raw)) | (at % 1.0 > 0))).size:
        what = f"row {odd[0] + 1}: frame {frame[odd[0]]:g} has no line in {times.name}"
        raise fail(path, what, "pair the files; frames count from 0")
    raw = raw[at.astype(int)]
    where: Where = lambda index: f"row {table.lines[int(at[index])]}"
    step_m = np.hypot(*np.diff(xyt[:, :2], axis=0).T)
    t_s, assumed = seconds(times, raw, step_m, None, reading.time_unit, where)
    order = in_order(times, t_s, xyt, where)
    notes = (*drive.notes, *table.notes, *assumed, *order.notes)
    notes = tuple(note for note in notes if note != NUMBERED)
    poses = Trajectory(t_s[order.rows], xyt[order.rows])
    return Drive(poses, notes, True, order.rows, n, drive.has_handedness)


def read_stamps(path: Path, reading: Reading = PLAIN) -> tuple[Shaped[np.ndarray, " n"], TextRows]:
    """Read a file of stamps, one per line, perhaps with row numbers or names of images beside.

    Args:
        path: the file.
        reading: the user's decimal sign.

    Returns:
        (n,) stamps in their own unit, and the rows they come from.

    Raises:
        InputError: naming file and row.
    """
    table = read_rows(path, reading.decimal)
    columns = find_columns(path, table.header) if table.header else {}
    if "t_s" not in columns:
        fits = [
            at for at, cells in enumerate(table.columns)
            if is_number(cells[0]) and is_number(cells[-1])
        ]  # fmt: skip
        if len(fits) == 2 and _is_count(table.columns[fits[0]]):
            fits = fits[1:]
        if len(fits) != 1 and len(table.columns) > 1:
            what = f"row {table.lines[0]}: {len(table.columns)} cells where 1 is expected"
            raise fail(path, what, "give one stamp per line, or a header that names it timestamp")
        columns = {"t_s": [Column(fits[0] if fits else 0, "t_s", None, "t_s")]}
    raw, unit = values_of(path, table, "t_s", columns["t_s"])
    if len(raw) < 2:
        raise fail(path, f"{len(raw)} data row(s)", "at least 2 are needed")
    per = {"ms": 1e3, "us": 1e6, "ns": 1e9}.get(unit or "", 1.0)
    return (raw if per == 1.0 else raw / per), table


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
    return _matrices(q / length[:, None])


def _matrices(q: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Turn unit quaternions x, y, z, w into matrices."""
    x, y, z, w = q.T
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
    axis, up, other = (0, 2, "xz") if plane == "xy" else (2, 1, "xy")
    ahead = _flat(rotation[:, :, axis], plane)
    fix = (
        f"try plane {other} (--plane {other}), or give poses of a body that drives along its x (xy)"
        " or z (xz) axis"
    )
    if (odd := np.flatnonzero(np.hypot(*ahead.T) < UPRIGHT)).size:
        what = f"{where(int(odd[0]))}: the forward axis stands upright on the plane {plane}"
        raise fail(path, what, fix)
    flat = np.concatenate([_flat(xyz, plane), np.arctan2(ahead[:, 1:], ahead[:, :1])], axis=1)
    far = _apart(xyz)
    out = _share_out(xyz, up, far)
    forward_m, left_m, _ = np.abs(motions(flat[far])).sum(axis=0)
    if out > 0.5:
        raise fail(path, f"{out:.0%} of the way leaves the plane {plane}", fix)
    if left_m > 3.0 * forward_m:
        raise fail(path, f"in the plane {plane} the body moves sideways, not forward", fix)
    return flat


def _flat(vectors: np.ndarray, plane: Plane) -> np.ndarray:
    if plane == "xy":
        return vectors[:, :2]
    left = vectors[:, 0] if plane == "xz-up" else -vectors[:, 0]
    return np.stack([vectors[:, 2], left], axis=1)


def _share_out(xyz: np.ndarray, up: int, far: list[int] | None = None) -> float:
    """Return the share of the way that goes along the axis that should point up."""
    step = np.diff(xyz[_apart(xyz) if far is None else far], axis=0)
    return float(np.abs(step[:, up]).sum() / max(np.sqrt((step**2).sum(axis=1)).sum(), APART_M))


def _apart(xyz: np.ndarray) -> list[int]:
    """Choose poses that are some way from each other, so that jitter at a stop is no motion."""
    chosen, places = [0], xyz.tolist()
    for index, place in enumerate(places):
        if math.dist(place, places[chosen[-1]]) >= APART_M:
            chosen.append(index)
    return chosen


def _read_g2o(path: Path, reading: Reading) -> Drive:
    """Read the vertices of a graph in the order of their ids; edges, landmarks are passed over."""
    lines = enumerate(map(str.split, read_text(path).splitlines()), 1)
    found = [(row, words) for row, words in lines if words and words[0] in _VERTICES]
    tags = {words[0] for _, words in found}
    if len(tags) != 1 or len(found) < 2:
        what = f"{len(found)} pose vertices of {len(tags)} kinds"
        raise fail(path, what, "store at least two VERTEX_SE2 or VERTEX_SE3:QUAT lines")
    (tag,) = tags
    values = np.array([_vertex(path, row, words, _VERTICES[tag]) for row, words in found])
    ids = [int(words[1]) for _, words in found]
    notes = [f"{path.name}: read as g2o"]
    order = sorted(range(len(ids)), key=ids.__getitem__)
    if order != list(range(len(ids))):
        notes.append(f"{path.name}: vertices are put in the order of their ids")
    if twice := [k for k in range(1, len(order)) if ids[order[k]] == ids[order[k - 1]]]:
        for k in twice:
            if not np.array_equal(values[order[k]], values[order[k - 1]]):
                what = f"row {found[order[k]][0]}: vertex {ids[order[k]]} is there before"
                raise fail(path, what, "store each vertex once")
        order = [at for k, at in enumerate(order) if k not in set(twice)]
        notes.append(f"{path.name}: {len(twice):,} vertices that came twice are kept once")
    values = values[order]
    where: Where = lambda index: f"row {found[order[index]][0]}"
    own = [ids[at] for at in order]
    # GTSAM packs a letter into the top byte of an id, which no float64 holds.
    stamps = np.array(own if own[-1] < 2**53 else range(len(own)), dtype=float)
    if tag == "VERTEX_SE3:QUAT":
        words: tuple[Quaternion, bool] = ("xyzw", True)
        q, said = ordered_quaternions(path, values[:, :3], values[:, 3:], words, reading, where)
        notes += said
        turn = rotations(path, q, where)
        values, more = _as_told(path, values[:, :3], turn, "xy", reading, where)
        notes += more
    return Drive(Trajectory(stamps, values), (*notes, NUMBERED), False)


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
