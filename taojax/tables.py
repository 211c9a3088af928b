"""Tables of text, read and written by their spec: the project's own and other people's."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taojax.errors import InputError
from taojax.specs import fail, load_spec, read_text


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
    if not math.isfinite(value):
        raise fail(path, f"{where}: {text} is not finite", "remove the row or repair it")
    low, high = column.get("min", -math.inf), column.get("max", math.inf)
    if not low <= value <= high:
        what = f"{where}: {text} is outside [{low:g}, {high:g}] {column.get('unit', '')}".rstrip()
        raise fail(path, what, column.get("fix", "check the unit"))
    return value


def _rows(path: Path, spec: Mapping[str, Any]) -> list[tuple[int, list[str]]]:
    """Return line number and cells of every line that is neither blank at the end nor a comment."""
    separator, comment = spec.get("separator", ","), spec.get("comment")
    lines = read_text(path).splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    return [
        (row, [c.strip() for c in (line.split() if separator == " " else line.split(separator))])
        for row, line in enumerate(lines, start=1)
        if not (comment and line.lstrip().startswith(comment))
    ]


def _is_header(cells: list[str], layouts: Sequence[Sequence[Mapping[str, Any]]]) -> bool:
    """Tell names from numbers: a header has no number in any column that holds numbers."""
    layout = next((own for own in layouts if len(own) == len(cells)), ())
    return bool(layout) and not any(
        _is_number(cell)
        for cell, column in zip(cells, layout, strict=True)
        if column.get("type") != "text"
    )


def _is_number(text: str) -> bool:
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
    rows = _rows(path, spec)
    if not rows:
        raise fail(path, "the file is empty", f"expected the columns {wanted}")
    header = spec.get("header", "required")
    names = [[column["name"] for column in layout] for layout in layouts]
    if header == "required" and rows[0][1] not in names:
        what = f"row 1: header is {','.join(rows[0][1])[:80]!r}"
        raise fail(path, what, f"expected {wanted}")
    has_header = header == "required" or (header == "optional" and _is_header(rows[0][1], layouts))
    rows = rows[has_header:]
    width = len(rows[0][1]) if rows else len(layouts[0])
    columns = next((layout for layout in layouts if len(layout) == width), layouts[0])
    for row, parts in rows:
        if len(parts) != len(columns):
            what = f"row {row}: {len(parts)} cells where {len(columns)} are expected"
            raise fail(path, what, f"columns are {wanted}")
    least = spec.get("min_rows", 0)
    if len(rows) < least:
        raise fail(path, f"{len(rows)} data row(s)", f"at least {least} are needed")
    table = {
        column["name"]: np.array(
            [_cell(path, row, column, parts[at]) for row, parts in rows],
            dtype={"text": object, "stamp": np.int64}.get(column.get("type", ""), float),
        )
        for at, column in enumerate(columns)
    }
    _check_order(path, columns, table, [row for row, _ in rows])
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
        steps = np.diff(table[column["name"]])
        if (back := np.flatnonzero(steps < 0)).size:
            what = f"row {rows[int(back[0]) + 1]}: {column['name']} runs backwards"
            raise fail(path, what, "sort the rows by time")
        if column.get("increasing") and (twice := np.flatnonzero(steps == 0)).size:
            what = f"row {rows[int(twice[0]) + 1]}: {column['name']} is that of the row before"
            raise fail(path, what, "keep one row per stamp")


def format_number(value: float, column: Mapping[str, Any]) -> str:
    """Return a cell: shortest text that reads back to the same float32, blank for NaN."""
    if np.isnan(value):
        return ""
    if column.get("type") == "int":
        return str(int(value))
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
