"""Rows of numbers in text as people write it: any usual delimiter, decimal sign, comment, header.

What the text says of itself is found, not demanded; what could be read in two ways is refused.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from taojax.specs import fail, read_text
from taojax.tables import is_number

__all__ = ["NAMES", "TextRows", "read_rows"]

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
