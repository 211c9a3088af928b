"""What the columns of a text table hold, by their names: `pose_names.toml` lists the names."""

import functools
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taojax.datasets.text_rows import TextRows
from taojax.errors import InputError
from taojax.specs import fail, load_spec
from taojax.tables import is_number

__all__ = ["COMPASS", "Column", "find_columns", "values_of"]

UNITS = {
    "m": "m", "meter": "m", "meters": "m", "metres": "m", "mm": "mm", "cm": "cm", "km": "km",
    "rad": "rad", "radian": "rad", "radians": "rad", "deg": "deg", "degree": "deg",
    "degrees": "deg", "°": "deg", "s": "s", "sec": "s", "secs": "s", "second": "s", "seconds": "s",
    "ms": "ms", "msec": "ms", "millis": "ms", "milliseconds": "ms", "us": "us", "µs": "us",
    "usec": "us", "micros": "us", "microseconds": "us", "ns": "ns", "nsec": "ns", "nsecs": "ns",
    "nanosec": "ns", "nanosecs": "ns", "nanoseconds": "ns",
}  # fmt: skip
"""Words of a unit -> the unit."""

KINDS = {
    "t_s": ("s", "ms", "us", "ns"), "theta_rad": ("rad", "deg"), "dtheta_rad": ("rad", "deg"),
}  # fmt: skip
"""Units that a column may have; the others are lengths."""

SCALE = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "rad": 1.0, "deg": np.pi / 180.0}

COMPASS = ("heading", "hdg", "azimuth", "bearing", "course", "cog")
"""Names of headings that may count clockwise from north."""

NOT_A_POSE = frozenset((
    "linear", "angular", "twist", "velocity", "vel", "speed", "v", "w", "b", "a", "omega", "rate",
    "acc", "acceleration", "accel", "gyro", "mag", "cov", "covariance", "std", "sigma", "stddev",
    "var", "err", "error", "bias", "imu", "cmd", "gravity", "orientation", "rotation", "quaternion",
    "quat", "orient", "rot", "q", "roll", "pitch", "ba", "bw",
))  # fmt: skip
"""Words in front of x, y, z that make it another quantity."""


class Column(NamedTuple):
    """One column that is used."""

    at: int
    """Its number, from 0."""

    name: str
    """As the file has it."""

    unit: str | None
    """As its name says; None where it does not."""

    word: str
    """The name that was recognised."""


@functools.cache
def _known() -> dict[str, str]:
    """Return every name and what it stands for."""
    columns = load_spec("pose_names")["columns"]
    return {name: column["name"] for column in columns for name in column["names"]}


def _plain(name: str) -> tuple[str, str | None]:
    """Return a name in small letters and underscores, and the unit in its brackets."""
    text = name.strip().strip("\"'").lstrip("#%/ ").lower()
    found = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", text)
    unit = UNITS.get(found.group(1)) if found else None
    text = text[: found.start()] if found else text
    return re.sub(r"[^0-9a-zµ°]+", "_", text).strip("_"), unit


def _role(name: str) -> tuple[str, int, str | None, str] | None:
    """Return what a column holds, how surely (0 best), its unit and the name that was known."""
    text, unit = _plain(name)
    known = _known()
    for own, tail in ((text, None), (text.rpartition("_")[0], text.rpartition("_")[2])):
        if tail is not None and (tail not in UNITS or not own):
            continue
        if own in known:
            role = known[own]
            said = unit or (UNITS[tail] if tail else None) or _own_unit(role, own)
            return role, 0, said, own
        words = own.split("_")
        for k in range(1, len(words)):
            end = "_".join(words[k:])
            is_other = k == len(words) - 1 and NOT_A_POSE & set(words[:k])
            if end in known and not is_other and not (NOT_A_POSE - {"a", "b"}) & set(words[:k]) - {
                "orientation", "rotation", "quaternion"
            }:  # fmt: skip
                role = known[end]
                said = unit or (UNITS[tail] if tail else None) or _own_unit(role, end)
                return role, 1 if "_" in end else 2, said, end
    return None


def _own_unit(role: str, word: str) -> str | None:
    """Return the unit of a time whose name is one, such as nanosec."""
    return UNITS.get(word.rpartition("_")[2]) if role == "t_s" and word != "s" else None


def find_columns(path: Path, names: Sequence[str]) -> dict[str, list[Column]]:
    """Find what the columns of a table hold.

    Args:
        path: the table, for messages.
        names: of all columns, as the file has them.

    Returns:
        Name of `pose_names.toml` -> its column; of t_s perhaps two, seconds and nanoseconds. Empty
        where no name is known.

    Raises:
        InputError: two columns of one meaning, or degrees of latitude instead of metres.
    """
    found: dict[str, list[tuple[int, Column]]] = {}
    for at, name in enumerate(names):
        if (role := _role(name)) is not None:
            found.setdefault(role[0], []).append((role[1], Column(at, name, *role[2:])))
    out: dict[str, list[Column]] = {}
    for role, columns in found.items():
        best = min(rank for rank, _ in columns)
        own = [column for rank, column in columns if rank == best]
        if role == "t_s":
            own = _times([column for _, column in columns])
        if len(own) > 1 and role != "t_s":
            what = f"columns {own[0].name!r} and {own[1].name!r} may both be {role}"
            raise fail(path, what, "keep one of them, or rename the other")
        if len(own) > 2 or (len(own) == 2 and [c.unit for c in own] != ["s", "ns"]):
            what = f"columns {own[0].name!r} and {own[1].name!r} may both be the stamp"
            raise fail(path, what, "keep one of them")
        out[role] = own
    is_placed = {"x_m", "y_m"} <= out.keys() or {"dx_m", "dy_m"} <= out.keys()
    if {"latitude", "longitude"} & out.keys() and not is_placed:
        what = (
            f"columns {', '.join(out[k][0].name for k in out if k.endswith('itude'))} are degrees"
        )
        raise fail(path, what, "project the positions to metres (UTM), as columns x and y")
    return {k: v for k, v in out.items() if not k.endswith("itude")}


def _times(columns: list[Column]) -> list[Column]:
    """Choose among stamps: those of the header of a message, whole and fine seconds together."""
    own = [c for c in columns if "header" in c.name.lower()] or columns
    fine = [c for c in own if c.unit == "ns"]
    whole = [c for c in own if c.unit != "ns" or c not in fine]
    if len(fine) == 1 and len(whole) == 1:
        return [whole[0]._replace(unit="s"), fine[0]]
    return own


def values_of(
    path: Path, table: TextRows, role: str, columns: Sequence[Column]
) -> tuple[np.ndarray, str | None]:
    """Return the numbers of a column and their unit.

    Args:
        path: the table.
        table: its rows.
        role: name in `pose_names.toml`.
        columns: as `find_columns` returned them.

    Returns:
        (n,) lengths in metres, angles and stamps as they are (whole stamps as int64); and the unit
        that is said of the latter, if any.

    Raises:
        InputError: naming row and column.
    """
    if role == "t_s":
        return _stamps(path, table, columns)
    spec = next(c for c in load_spec("pose_names")["columns"] if c["name"] == role)
    column = columns[0]
    values = numbers(path, table, column, spec)
    allowed = KINDS.get(role, ("m", "mm", "cm", "km") if "unit" in spec else ())
    unit = column.unit if column.unit in allowed else None
    if role == "theta_rad":
        return values, unit
    if role == "dtheta_rad":
        return values * SCALE[unit or "rad"], unit
    return values * SCALE[unit or "m"], unit


def _stamps(
    path: Path, table: TextRows, columns: Sequence[Column]
) -> tuple[np.ndarray, str | None]:
    spec = {"name": "t_s"}
    unit = columns[0].unit if columns[0].unit in KINDS["t_s"] else None
    cells = table.columns[columns[0].at]
    if len(columns) == 2:
        whole, fine = (numbers(path, table, column, spec) for column in columns)
        return whole + fine / 1e9, "s"
    if not is_number(cells[0]) and _date(cells[0]) is not None:
        stamps = [_date(cell) for cell in cells]
        if (at := next((k for k, t in enumerate(stamps) if t is None), None)) is not None:
            where = f"row {table.lines[at]}, column {columns[0].name}"
            raise fail(path, f"{where}: {cells[at][:40]!r} is no date", "fix the cell")
        return np.array(stamps, float), "s"
    if all(cell.isascii() and cell.lstrip("-").isdigit() and len(cell) < 20 for cell in cells):
        whole_numbers = [int(cell) for cell in cells]
        if max(whole_numbers) < 2**63:
            # Nanoseconds since 1970 have more digits than a float64 holds.
            return np.array(whole_numbers, np.int64), unit
    return numbers(path, table, columns[0], spec), unit


def _date(cell: str) -> float | None:
    """Return UNIX time of an ISO 8601 date; without a zone it is taken as UTC."""
    try:
        at = datetime.fromisoformat(cell)
    except ValueError:
        return None
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()


def numbers(path: Path, table: TextRows, column: Column, spec: Mapping[str, Any]) -> np.ndarray:
    """Return a column of finite numbers within the limits of its spec.

    Raises:
        InputError: naming the row, as an editor counts, and the column.
    """
    cells = table.columns[column.at]
    try:
        values = np.array(list(map(float, cells)))
    except ValueError:
        at = next(k for k, cell in enumerate(cells) if not is_number(cell))
        where = f"row {table.lines[at]}, column {spec['name']}"
        raise fail(path, f"{where}: {cells[at][:40]!r} is not a number", "fix the cell") from None
    if (error := fault(path, spec, values, table.lines)) is not None:
        raise error
    return values


def fault(
    path: Path, spec: Mapping[str, Any], values: np.ndarray, lines: Sequence[int]
) -> InputError | None:
    """Return what is wrong with a column of numbers, if anything."""
    low, high = spec.get("min", -np.inf), spec.get("max", np.inf)
    wrong = ~(np.isfinite(values) & (values >= low) & (values <= high))
    if not wrong.any():
        return None
    at = int(np.argmax(wrong))
    where = f"row {lines[at]}, column {spec['name']}"
    if not np.isfinite(values[at]):
        fix = "remove the row or repair it"
        return fail(path, f"{where}: {values[at]:g} is not finite", fix)
    what = f"{where}: {values[at]:g} is outside [{low:g}, {high:g}] {spec.get('unit', '')}".rstrip()
    return fail(path, what, spec.get("fix", "check the unit"))
