"""The file contract, read from `data_specs/*.toml` and enforced on every table that comes in.

A spec names the columns of a CSV with unit and legal range, or the axes of an array. Readers
and writers take the column order from it, so a file and its documentation cannot part ways.
"""

import functools
import io
import os
import secrets
import tomllib
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from taojax.errors import InputError

MAX_BYTES = 8 << 30
"""Largest array file that is opened, bytes; guards against bombs inside npz archives."""


@functools.cache
def load_spec(name: str) -> dict[str, Any]:
    """Return the spec `data_specs/<name>.toml`.

    Specs lie inside an installed package and beside it in a source checkout.
    """
    inside = Path(__file__).parent / "data_specs"
    folder = inside if inside.is_dir() else Path(__file__).parents[1] / "data_specs"
    return tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))


def column_names(name: str) -> tuple[str, ...]:
    """Return the columns of a table spec, in file order."""
    return tuple(column["name"] for column in load_spec(name)["columns"])


def _fail(path: Path, what: str, fix: str) -> InputError:
    return InputError(f"{path}: {what}; {fix}")


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes.

    Raises:
        InputError: missing, a directory, or unreadable.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise _fail(path, "no such file", "add it or point at another folder") from error
    except OSError as error:
        raise _fail(path, f"cannot be read ({error.strerror})", "check the file") from error


def read_text(path: Path) -> str:
    """Return a UTF-8 text file, without a byte-order mark.

    Raises:
        InputError: unreadable or not UTF-8.
    """
    raw = read_bytes(path)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise _fail(path, f"line {line} is not UTF-8 text", "save it as plain CSV") from error


def _cell(path: Path, row: int, column: Mapping[str, Any], text: str) -> float | str:
    """Return one checked cell; `row` is the line number an editor shows."""
    name = column["name"]
    where = f"row {row}, column {name}"
    if column.get("type") == "text":
        allowed = column.get("values")
        if allowed and text not in allowed:
            raise _fail(path, f"{where}: {text!r} is unknown", f"use one of {', '.join(allowed)}")
        return text
    if text == "" and column.get("blank"):
        return float("nan")
    try:
        value = float(text)
    except ValueError as error:
        raise _fail(path, f"{where}: {text[:40]!r} is not a number", "fix the cell") from error
    if not np.isfinite(value):
        raise _fail(path, f"{where}: {text} is not finite", "remove the row or repair it")
    low, high = column.get("min", -np.inf), column.get("max", np.inf)
    if not low <= value <= high:
        what = f"{where}: {text} is outside [{low:g}, {high:g}] {column.get('unit', '')}".rstrip()
        raise _fail(path, what, column.get("fix", "check the unit"))
    return value


def read_table(path: Path, name: str) -> dict[str, np.ndarray]:
    """Read a CSV and hold it against its spec.

    Args:
        path: the file; CRLF or LF, with or without byte-order mark, trailing blank lines.
        name: the spec in data_specs/.

    Returns:
        Column name -> `(rows,)` float64 array (object array of str for text columns); blank
        cells, where the spec allows them, are NaN.

    Raises:
        InputError: naming file, row (counted from 1 with the header) and what to do.
    """
    spec = load_spec(name)
    columns = spec["columns"]
    names = [column["name"] for column in columns]
    lines = read_text(path).splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise _fail(path, "the file is empty", f"expected the header {','.join(names)}")
    if [cell.strip() for cell in lines[0].split(",")] != names:
        raise _fail(path, f"row 1: header is {lines[0][:80]!r}", f"expected {','.join(names)}")
    cells: list[list[float | str]] = [[] for _ in names]
    for row, line in enumerate(lines[1:], start=2):
        parts = line.split(",")
        if len(parts) != len(names):
            what = f"row {row}: {len(parts)} cells where {len(names)} are expected"
            raise _fail(path, what, f"columns are {','.join(names)}")
        for out, column, text in zip(cells, columns, parts, strict=True):
            out.append(_cell(path, row, column, text.strip()))
    n_rows, least = len(lines) - 1, spec.get("min_rows", 0)
    if n_rows < least:
        raise _fail(path, f"{n_rows} data row(s)", f"at least {least} are needed")
    table = {
        column["name"]: np.array(values, dtype=object if column.get("type") == "text" else float)
        for column, values in zip(columns, cells, strict=True)
    }
    for column in columns:
        values = table[column["name"]]
        if column.get("monotonic") and (back := np.flatnonzero(np.diff(values) < 0)).size:
            what = f"row {int(back[0]) + 3}: {column['name']} runs backwards"
            raise _fail(path, what, "sort the rows by time")
    return table


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


def _checked_array(path: Path, label: str, array: np.ndarray, spec: Mapping[str, Any]) -> None:
    if array.ndim != spec["ndim"]:
        what = f"{label}has shape {array.shape}"
        raise _fail(path, what, f"expected {spec['shape']}")
    if array.dtype.kind not in spec["kinds"]:
        want = {"f": "floating point", "i": "integers"}[spec["kinds"][0]]
        raise _fail(path, f"{label}has dtype {array.dtype}", f"store {want}")
    if 0 in array.shape:
        raise _fail(path, f"{label}has shape {array.shape}", "it holds no values")


def read_npy(path: Path, name: str) -> np.ndarray:
    """Memory-map one array and check rank and dtype; pickles are never loaded.

    Raises:
        InputError: missing, not an npy file, an object array, wrong rank or dtype.
    """
    if not path.is_file():
        raise _fail(path, "no such file", "add it or point at another folder")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        what = f"is not a plain numpy array ({str(error).splitlines()[0][:80]})"
        raise _fail(path, what, "save it with np.save as float32") from error
    if not isinstance(array, np.ndarray):
        raise _fail(path, "is an archive, not one array", "save it with np.save")
    _checked_array(path, "", array, load_spec(name)["array"])
    return array


def read_npz(path: Path, name: str) -> dict[str, np.ndarray]:
    """Read the named arrays of an archive and check rank and dtype.

    Raises:
        InputError: missing, damaged, too large, an object array, a missing name.
    """
    specs = load_spec(name)["arrays"]
    raw = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            if sum(info.file_size for info in archive.infolist()) > MAX_BYTES:
                raise _fail(path, "unpacks to more than 8 GiB", "split the recording")
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            missing = [spec["name"] for spec in specs if spec["name"] not in archive.files]
            if missing:
                raise _fail(path, f"lacks the array {missing[0]}", "see data_specs/README.md")
            arrays = {spec["name"]: archive[spec["name"]] for spec in specs}
    except (ValueError, OSError, EOFError, KeyError, NotImplementedError, RuntimeError,
            zipfile.BadZipFile, zlib.error) as error:  # fmt: skip
        lines = str(error).splitlines() or [type(error).__name__]
        what = f"is not a plain npz archive ({lines[0][:80]})"
        raise _fail(path, what, "save it with np.savez") from error
    for spec in specs:
        _checked_array(path, f"{spec['name']} ", arrays[spec["name"]], spec)
    return arrays


def write_atomically(path: Path, data: bytes | str) -> None:
    """Write a file so that a reader sees the old bytes or the new ones, never a part.

    Raises:
        InputError: the folder is read-only or the disk is full.
    """
    raw = data.encode() if isinstance(data, str) else data
    part = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as stream:
            stream.write(raw)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise _fail(
            path, f"cannot be written ({error.strerror})", "choose another --out"
        ) from error
