"""Tables of text, read and written by their spec: the project's own and other people's."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taojax.errors import InputError
from taojax.files.specs import fail, load_spec, read_text

POSE = ("x_m", "y_m", "theta_rad")
"""Columns of a pose."""

MOTION = ("dx_m", "dy_m", "dtheta_rad")
"""Columns of the odometry into a frame."""


def stacked(table: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    """Return columns of numbers side by side, (rows, columns) float64; a missing name is a bug."""
    return np.stack([np.asarray(table[name], float) for name in names], axis=1)


def _cell(path: Path, row: int, column: Mapping[str, Any], text: str) -> float | int | str:
    """Return one checked cell; `row` is the line number an editor shows."""
    name = column["name"]
    where = f"row {row}, column {name}"
    if column.get("type") == "text":
        allowed = column.get("values")
        if allowed and text not in allowed:
            raise fail(path, f"{where}: {text!r} is unknown", f"use one of {', '.join(allowed)}")
        return text
    if text == "" and column.get("blank"):
        return float("nan")
    try:
        # A stamp in nanoseconds has more digits than a float64 can hold.
        value = int(text) if column.get("type") == "stamp" else float(text)
    except ValueError as error:
        kind = "a whole number" if column.get("type") == "stamp" else "a number"
        raise fail(path, f"{where}: {text[:40]!r} is not {kind}", "fix the cell") from error
    # Whole numbers are finite, and may be too long to be asked.
    if isinstance(value, float) and not math.isfinite(value):
        raise fail(path, f"{where}: {text} is not finite", "remove the row or repair it")
    low, high = _limits(column)
    if not low <= value <= high:
        what = (
            f"{where}: {text[:40]} is outside [{low:g}, {high:g}] {column.get('unit', '')}".rstrip()
        )
        raise fail(path, what, column.get("fix", "check the unit"))
    return value


def _limits(column: Mapping[str, Any]) -> tuple[float | int, float | int]:
    """Return the least and the largest value of a column; stamps must fit their 64 bits."""
    widest = (-(2**63), 2**63 - 1) if column.get("type") == "stamp" else (-math.inf, math.inf)
    return column.get("min", widest[0]), column.get("max", widest[1])


def _column(
    path: Path, rows: Sequence[int], column: Mapping[str, Any], cells: Sequence[str]
) -> np.ndarray:
    """Return one checked column: at once, and cell by cell only to say which one is wrong."""
    kind = {"text": object, "stamp": np.int64}.get(column.get("type", ""), float)
    values = None if kind is object else _numbers(column, cells)
    if values is None:
        checked = [_cell(path, row, column, cell) for row, cell in zip(rows, cells, strict=True)]
        values = np.array(checked, dtype=kind)
    return values


def _numbers(column: Mapping[str, Any], cells: Sequence[str]) -> np.ndarray | None:
    """Return a column of numbers, None where a cell is wrong."""
    is_stamp, n = column.get("type") == "stamp", len(cells)
    is_blank = np.zeros(n, bool)
    if column.get("blank") and "" in cells:
        is_blank = np.array([cell == "" for cell in cells])
        cells = [cell or "nan" for cell in cells]
    try:
        values = (
            np.fromiter(map(int, cells), np.int64, n)
            if is_stamp
            else np.fromiter(map(float, cells), np.float64, n)
        )
    except (ValueError, OverflowError):
        return None
    low, high = _limits(column)
    is_good = is_blank | (np.isfinite(values) & (values >= low) & (values <= high))
    return values if is_good.all() else None


def _lines(path: Path, spec: Mapping[str, Any]) -> tuple[list[int], list[str]]:
    """Return number and text of every line that is neither blank at the end nor a comment."""
    comment, lines = spec.get("comment"), read_text(path).splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    if comment is None:
        return list(range(1, len(lines) + 1)), lines
    rows = [at for at, line in enumerate(lines) if not line.lstrip().startswith(comment)]
    return [at + 1 for at in rows], [lines[at] for at in rows]


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    cells = line.split(separator)
    # A blank is the only printable white space: most lines of a long file need no stripping.
    return cells if " " not in line and line.isprintable() else [cell.strip() for cell in cells]


def _is_header(cells: list[str], layouts: Sequence[Sequence[Mapping[str, Any]]]) -> bool:
    """Tell names from numbers: a header has no number in any column that holds numbers."""
    layout = next((own for own in layouts if len(own) == len(cells)), ())
    return bool(layout) and not any(
        is_number(cell)
        for cell, column in zip(cells, layout, strict=True)
        if column.get("type") != "text"
    )


def is_number(text: str) -> bool:
    """Tell whether a cell is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def read_table(path: Path, name: str) -> dict[str, np.ndarray]:
    """Read a table of text and hold it against its spec.

    Args:
        path: the file; CRLF or LF, with or without byte-order mark, trailing blank lines.
        name: the spec in data_specs/. It may name the `separator` (a comma; " " is any blank
            space), whether there is a `header` (required, optional or none), what starts a
            `comment`, and several `layouts`, told apart by their number of cells.

    Returns:
        Column name -> `(rows,)` float64 array (object array of str for text columns, int64 for
        stamps); blank cells, where the spec allows them, are NaN.

    Raises:
        InputError: naming file, row (counted from 1 with the header) and what to do.
    """
    spec = load_spec(name)
    layouts = _layouts(spec)
    wanted = " or ".join(",".join(column["name"] for column in layout) for layout in layouts)
    rows, lines = _lines(path, spec)
    separator = spec.get("separator", ",")
    if not lines:
        raise fail(path, "the file is empty", f"expected the columns {wanted}")
    header, first = spec.get("header", "required"), _cells(lines[0], separator)
    names = [[column["name"] for column in layout] for layout in layouts]
    if header == "required" and first not in names:
        what = f"row 1: header is {','.join(first)[:80]!r}"
        raise fail(path, what, f"expected {wanted}")
    if header == "required" or (header == "optional" and _is_header(first, layouts)):
        rows, lines = rows[1:], lines[1:]
    width = len(_cells(lines[0], separator)) if lines else len(layouts[0])
    columns = next((layout for layout in layouts if len(layout) == width), layouts[0])
    # One flat list: a list for every row costs the collector more than the parsing.
    cells: list[str] = []
    for row, line in zip(rows, lines, strict=True):
        parts = _cells(line, separator)
        if len(parts) != len(columns):
            what = f"row {row}: {len(parts)} cells where {len(columns)} are expected"
            raise fail(path, what, f"columns are {wanted}")
        cells += parts
    least = spec.get("min_rows", 0)
    if len(rows) < least:
        raise fail(path, f"{len(rows)} data row(s)", f"at least {least} are needed")
    table = {
        column["name"]: _column(path, rows, column, cells[at :: len(columns)])
        for at, column in enumerate(columns)
    }
    _check_order(path, columns, table, rows)
    return table


def read_frames(path: Path, name: str, n_frames: int) -> dict[str, np.ndarray]:
    """Read a judge's table, which has a row for every frame of the run, in their order.

    Args:
        path: the file.
        name: the spec in data_specs/.
        n_frames: frames of the run.

    Returns:
        As `read_table`.

    Raises:
        InputError: malformed, or of other frames.
    """
    table = read_table(path, name)
    if not np.array_equal(table["frame"], np.arange(n_frames)):
        what = f"its frames are not the {n_frames} of signals.csv"
        raise fail(path, what, "judge the run again with `taojax evaluate`")
    return table


def _layouts(spec: Mapping[str, Any]) -> list[list[Mapping[str, Any]]]:
    """Return the columns of every layout a table may have."""
    if "layouts" not in spec:
        return [spec["columns"]]
    named = {column["name"]: column for column in spec["columns"]}
    return [[named[name] for name in layout] for layout in spec["layouts"]]


def _check_order(
    path: Path,
    columns: Sequence[Mapping[str, Any]],
    table: Mapping[str, np.ndarray],
    rows: Sequence[int],
) -> None:
    """Refuse times that run backwards, and times that stand still where they may not."""
    for column in columns:
        if not column.get("monotonic") and not column.get("increasing"):
            continue
        # Compared, not subtracted: stamps at both ends of 64 bits have no difference.
        before, behind = table[column["name"]][:-1], table[column["name"]][1:]
        if (back := np.flatnonzero(behind < before)).size:
            what = f"row {rows[int(back[0]) + 1]}: {column['name']} runs backwards"
            raise fail(path, what, "sort the rows by time")
        if column.get("increasing") and (twice := np.flatnonzero(behind == before)).size:
            what = f"row {rows[int(twice[0]) + 1]}: {column['name']} is that of the row before"
            raise fail(path, what, "keep one row per stamp")


def format_number(value: float, column: Mapping[str, Any]) -> str:
    """Return a cell: shortest text that reads back to the same float32, blank for NaN."""
    if np.isnan(value):
        return ""
    if column.get("type") == "int":
        return str(int(value))
    if column["name"].endswith("t_s"):
        return repr(float(value))  # nine digits of UNIX time are tens of seconds
    return repr(float(f"{value:.9g}"))


def table_text(name: str, table: Mapping[str, np.ndarray]) -> str:
    """Return a table as CSV text in the spec's column order.

    Raises:
        InputError: a value is infinite, or NaN where the spec allows no blank.
    """
    columns = load_spec(name)["columns"]
    texts = []
    for column in columns:
        values = table[column["name"]]
        if column.get("type") == "text":
            texts.append([str(v) for v in values])
            continue
        numbers = np.asarray(values, dtype=float)
        bad = np.isinf(numbers) | (np.isnan(numbers) & (not column.get("blank", False)))
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(f"{name}: column {column['name']}, frame {row} is not finite")
        texts.append([format_number(v, column) for v in numbers])
    rows = [",".join(column["name"] for column in columns)]
    rows += [",".join(row) for row in zip(*texts, strict=True)]
    return "\n".join(rows) + "\n"
