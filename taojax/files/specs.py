"""The file contract, read from `data_specs/*.toml` and enforced on every table that comes in.

A spec names the columns of a CSV with unit and legal range, or the axes of an array. Readers
and writers take the column order from it, so a file and its documentation cannot part ways.
"""

import contextlib
import functools
import io
import lzma
import os
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from taojax.errors import InputError
from taojax.files.atomic_write import locked_part

MAX_BYTES = 8 << 30
"""Largest array file that is opened, bytes; guards against bombs inside npz archives."""

ARRAY_FAULTS = (
    ValueError, OSError, EOFError, KeyError, NotImplementedError, RuntimeError, MemoryError,
    OverflowError, tokenize.TokenError, zipfile.BadZipFile, zlib.error, lzma.LZMAError,
)  # fmt: skip
"""What numpy and zipfile raise for damaged or hostile bytes."""

GZIP = b"\x1f\x8b"
"""How a compressed file begins."""


@functools.cache
def load_spec(name: str) -> dict[str, Any]:
    """Return the spec `data_specs/<name>.toml`.

    Specs lie inside an installed package and beside it in a source checkout.
    """
    inside = Path(__file__).parents[1] / "data_specs"
    folder = inside if inside.is_dir() else Path(__file__).parents[2] / "data_specs"
    return tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))


def column_names(name: str) -> tuple[str, ...]:
    """Return the columns of a table spec, in file order."""
    return tuple(column["name"] for column in load_spec(name)["columns"])


def fail(path: Path, what: str, fix: str) -> InputError:
    """Return the error that says which file, what is wrong with it and what to do."""
    return InputError(f"{path}: {what}; {fix}")


def first_line(error: Exception) -> str:
    """Return what an exception says, short enough for one line."""
    return (str(error).splitlines() or [type(error).__name__])[0][:80]


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[io.BufferedReader]:
    """Open a regular file for reading its bytes.

    Raises:
        InputError: missing, a folder, a pipe or device, or unreadable, also while it is read.
    """
    try:
        if path.exists() and not path.is_file():
            # A pipe or a device may never end.
            kind = "a folder" if path.is_dir() else "a pipe or device"
            raise fail(path, f"cannot be read (is {kind})", "point at a file")
        with path.open("rb") as stream:
            yield stream
    except FileNotFoundError as error:
        raise fail(path, "no such file", "add it or point at another folder") from error
    except OSError as error:
        raise fail(path, f"cannot be read ({error.strerror})", "check the file") from error


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes.

    Raises:
        InputError: missing, no regular file, or unreadable.
    """
    with open_file(path) as stream:
        return stream.read()


def read_text(path: Path) -> str:
    """Return a UTF-8 text file, without a byte-order mark.

    Raises:
        InputError: unreadable or not UTF-8.
    """
    raw = read_bytes(path)
    if raw[:2] == GZIP:
        raise fail(path, "is compressed with gzip", "unpack it first (gunzip)")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise fail(path, f"line {line} is not UTF-8 text", "save it as plain CSV") from error


def _checked_array(path: Path, label: str, array: Any, spec: Mapping[str, Any]) -> None:
    if not isinstance(array, np.ndarray):
        raise fail(path, f"{label}is not an array", "save it with np.savez")
    # Zero stands for any number of axes.
    if spec["ndim"] and array.ndim != spec["ndim"]:
        what = f"{label}has shape {array.shape}"
        raise fail(path, what, f"expected {spec['shape']}")
    if array.dtype.kind not in spec["kinds"]:
        want = {"f": "floating point", "i": "integers"}[spec["kinds"][0]]
        raise fail(path, f"{label}has dtype {array.dtype}", f"store {want}")
    if 0 in array.shape:
        raise fail(path, f"{label}has shape {array.shape}", "it holds no values")


def read_npy(path: Path, name: str) -> np.ndarray:
    """Memory-map one array and check rank and dtype; pickles are never loaded.

    Raises:
        InputError: missing, not an npy file, an object array, wrong rank or dtype.
    """
    if not path.is_file():
        raise fail(path, "no such file", "add it or point at another folder")
    try:
        with np.errstate(over="ignore"):  # a header may claim any number of values
            array = np.load(path, mmap_mode="r", allow_pickle=False)
    except ARRAY_FAULTS as error:
        what = f"is not a plain numpy array ({first_line(error)})"
        raise fail(path, what, "save it with np.save as float32") from error
    if not isinstance(array, np.ndarray):
        raise fail(path, "is an archive, not one array", "save it with np.save")
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
                raise fail(path, "unpacks to more than 8 GiB", "split the recording")
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            missing = [spec["name"] for spec in specs if spec["name"] not in archive.files]
            if missing:
                raise fail(path, f"lacks the array {missing[0]}", "see data_specs/README.md")
            arrays = {spec["name"]: archive[spec["name"]] for spec in specs}
    except ARRAY_FAULTS as error:
        what = f"is not a plain npz archive ({first_line(error)})"
        raise fail(path, what, "save it with np.savez") from error
    for spec in specs:
        _checked_array(path, f"{spec['name']} ", arrays[spec["name"]], spec)
    return arrays


def write_atomically(path: Path, data: bytes | str) -> None:
    """Write a file so that a reader sees the old bytes or the new ones, never a part.

    Raises:
        InputError: the folder is read-only or the disk is full.
    """
    raw = data.encode() if isinstance(data, str) else data
    try:
        with locked_part(path, is_folder=False) as part:
            with part.open("wb") as stream:
                stream.write(raw)
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(path)
    except OSError as error:
        raise fail(path, f"cannot be written ({error.strerror})", "choose another --out") from error
