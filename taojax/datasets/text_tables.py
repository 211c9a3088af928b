"""Tables in text as people write them: any usual delimiter, decimal sign, comment and header.

Columns are known by their names: `pose_names.toml` lists them.
"""

import functools
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taojax.errors import InputError
from taojax.files.specs import fail, load_spec, read_text
from taojax.files.tables import is_number

__all__ = ["COMPASS", "NAMES", "Column", "TextRows", "find_columns", "read_rows", "values_of"]

COMMENTS = ("#", "%", "//")
"""How a line begins that is none of the table."""

COMMA_NUMBER = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")

THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")

WHOLE = re.compile(r"[+-]?\d+")

NAMES = {";": "semicolons", "\t": "tabs", ",": "commas", "|": "bars", " ": "blanks"}


class TextRows(NamedTuple):
    """A table of text, cell by cell."""

    columns: list[list[str]]
    """Cells of every column."""

    lines: list[int]
    """Number of every row's line, as an editor counts."""

    header: tuple[str, ...]
    """Names of the columns; none where the text has no header."""

    is_commented: bool
    """The header is a comment, which may say anything."""

    separator: str
    """Between the cells; a blank stands for any white space."""

    notes: tuple[str, ...]
    """What was assumed."""


def read_rows(path: Path, decimal: str | None = None) -> TextRows:
    """Read a text table.

    Args:
        path: the file; CRLF or LF, with or without byte-order mark, blank lines and comments.
        decimal: `point` or `comma`; None finds it.

    Returns:
        At least one row, all of one width.

    Raises:
        InputError: empty, rows of different widths, or commas that could be decimal signs or not.
    """
    text = read_text(path)
    lines = [(at, line) for at, line in enumerate(text.splitlines(), 1) if line.strip()]
    table = [(at, line) for at, line in lines if not line.lstrip().startswith(COMMENTS)]
    if not table:
        raise fail(path, "the file is empty", "expected rows of numbers")
    first = next((k for k, (_, line) in enumerate(table) if _has_number(line)), len(table))
    if first == len(table):
        what = f"0 data row(s) below row {table[0][0]}: {table[0][1].strip()[:80]!r}"
        raise fail(path, what, "at least 2 are needed, with numbers")
    heads, rows = table[:first], table[first:]
    separator, is_comma = _separator(path, rows, decimal)
    cells = [_split(line, separator) for _, line in rows]
    cells, notes = _one_width(path, rows, cells, text)
    header = _header(path, heads, lines, rows[0][0], separator, cells)
    if header and len(header) == len(cells[0]) - 1:
        # R and pandas leave the name of the row names away.
        header = ("", *header)
    columns = [list(column) for column in zip(*cells, strict=True)]
    if is_comma:
        notes += (f"{path.name}: commas are read as decimal signs",)
        columns = [[cell.replace(",", ".") for cell in column] for column in columns]
    at = [line for line, _ in rows[: len(cells)]]
    return TextRows(columns, at, header, not heads, separator, notes)


def _has_number(line: str) -> bool:
    return any(
        is_number(cell.strip().strip('"').replace(",", "."))
        and not cell.strip().lower().startswith(("nan", "inf"))
        for cell in re.split(r"[;\t|\s]+|,(?!\d)|,", line)
        if cell.strip()
    )


def _separator(
    path: Path, rows: Sequence[tuple[int, str]], decimal: str | None
) -> tuple[str, bool]:
    """Return what stands between the cells, and whether commas are decimal signs."""
    line = rows[0][1].strip()
    for own in (";", "\t", "|"):
        if own in line:
            return own, _has_comma(path, rows, own, decimal)
    if "," not in line:
        return " ", False
    words = line.split()
    is_alone = len(words) > 1 and all(
        COMMA_NUMBER.fullmatch(w) or WHOLE.fullmatch(w) for w in words
    )
    if decimal != "point" and is_alone:
        return " ", _has_comma(path, rows, " ", decimal)
    if decimal == "comma":
        what = f"row {rows[0][0]}: commas stand between the cells too"
        raise fail(path, what, "save it with semicolons, or with decimal points")
    return ",", False


def _has_comma(
    path: Path, rows: Sequence[tuple[int, str]], separator: str, decimal: str | None
) -> bool:
    """Tell whether the commas within cells are decimal signs."""
    if decimal is not None:
        return decimal == "comma"
    found = [
        (at, cell) for at, line in rows for cell in _split(line, separator) if "," in cell
    ]  # fmt: skip
    if not found or not all(COMMA_NUMBER.fullmatch(cell) for _, cell in found):
        return False
    if all(THOUSANDS.fullmatch(cell) for _, cell in found):
        at, cell = found[0]
        what = f"row {at}: {cell} may be {cell.replace(',', '.')} or {cell.replace(',', '')}"
        raise fail(path, what, "add --decimal comma, or save it without commas")
    return True


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    cells = line.split(separator)
    if " " in line or '"' in line or not line.isprintable():
        cells = [cell.strip().strip("\"'").strip() for cell in cells]
    return cells


def _one_width(
    path: Path, rows: Sequence[tuple[int, str]], cells: list[list[str]], text: str
) -> tuple[list[list[str]], tuple[str, ...]]:
    """Hold all rows to the width of the first; an unfinished last line is left out and said."""
    width, notes = len(cells[0]), ()
    is_cut = len(cells) > 2 and len(cells[-1]) < width and not text.endswith(("\n", "\r"))
    if is_cut:
        said = f"{path.name}: row {rows[-1][0]} is cut off in the middle and left out"
        cells, notes = cells[:-1], (said,)
    for (at, _), own in zip(rows, cells, strict=False):
        if len(own) != width:
            what = f"row {at}: {len(own)} cells where {width} are expected"
            raise fail(path, what, "every row has the same columns; mend or remove the row")
    if width > 1 and all(own[-1] == "" for own in cells):
        cells = [own[:-1] for own in cells]
    return cells, notes


def _header(
    path: Path,
    heads: Sequence[tuple[int, str]],
    lines: Sequence[tuple[int, str]],
    first: int,
    separator: str,
    cells: Sequence[Sequence[str]],
) -> tuple[str, ...]:
    """Return the names of the columns, from a header or from the comment above the first row."""
    width = len(cells[0])
    if heads:
        fits = [names for _, line in heads if (names := _names(line, separator, width))]
        if not fits:
            at, line = heads[0]
            what = f"row {at}: header is {line.strip()[:80]!r}, but the rows have {width} cells"
            raise fail(path, what, "name every column once")
        # A second line of words holds the units.
        units = fits[1] if len(fits) > 1 and len(fits[1]) == len(fits[0]) else ()
        if units:
            return tuple(f"{n} [{u.strip('[]()')}]" for n, u in zip(fits[0], units, strict=True))
        return fits[0]
    above = [line for at, line in lines if at < first and line.lstrip().startswith(COMMENTS)]
    if not above:
        return ()
    names = _names(above[-1].lstrip().lstrip("#%/").strip(), separator, width)
    return names if not any(is_number(name) for name in names) else ()


def _names(line: str, separator: str, width: int) -> tuple[str, ...]:
    """Split a line of names as its rows are split, or as another usual sign would; () if none."""
    bare = re.sub(r"\s+(?=[\[(])", "", line.strip().lstrip("#%").strip())
    for own in dict.fromkeys((separator, ",", ";", "\t", " ")):
        names = tuple(_split(bare if own == " " else line.strip().lstrip("#%"), own))
        if len(names) == width + 1 and names[-1] == "":
            names = names[:-1]
        if len(names) == width or (len(names) == width - 1 and width > 2 and own == separator):
            return names
    return ()


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
