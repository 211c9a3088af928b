"""Arrays in other people's files: checked before use, mapped instead of loaded."""

import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped

from taojax.files.specs import ARRAY_FAULTS, GZIP, MAX_BYTES, fail, first_line, load_spec, read_npy

__all__ = [
    "blocks", "check_begin", "check_kind", "is_native", "kind_notes", "map_archive", "map_npy",
    "spool", "two_axes",
]  # fmt: skip

BLOCK_BYTES = 8 << 20
"""Rows are read and checked so much at a time."""


def blocks(rows: Int[np.ndarray, " n"], row_bytes: int) -> Iterator[Int[np.ndarray, " k"]]:
    """Yield rows in blocks of bounded memory."""
    step = max(1, BLOCK_BYTES // max(1, row_bytes))
    for start in range(0, len(rows), step):
        yield rows[start : start + step]


def check_begin(path: Path) -> None:
    """Refuse what is no file, empty or compressed.

    Raises:
        InputError: naming the file and what to do.
    """
    if not path.is_file():
        raise fail(path, "no such file", "add it or point at another file")
    with path.open("rb") as file:
        begin = file.read(len(GZIP))
    if not begin:
        raise fail(path, "the file is empty", "write it again")
    if begin == GZIP:
        raise fail(path, "is compressed with gzip", "unpack it first (gunzip)")


def check_kind(path: Path, dtype: np.dtype) -> None:
    """Refuse what is no number.

    Raises:
        InputError: complex, text, dates or objects.
    """
    if dtype.kind not in "fiub":
        raise fail(path, f"has dtype {dtype}", "save it as float32")


def is_native(dtype: np.dtype) -> bool:
    """Tell whether numbers are float16, float32 or float64 in this machine's order of bytes."""
    return dtype.kind == "f" and dtype.itemsize <= 8 and dtype.isnative


def kind_notes(path: Path, dtype: np.dtype) -> tuple[str, ...]:
    """Return what must be said of numbers that are not floats of this machine's kind."""
    if is_native(dtype):
        return ()
    if dtype.kind == "f":
        what = "big-endian" if not dtype.isnative else str(dtype)
        return (f"{path.name}: {what} numbers are read as float32",)
    return (f"{path.name}: {dtype} numbers are read as float32, each row brought to unit length",)


def two_axes(
    path: Path, array: np.ndarray, n_rows: Sequence[int], shape: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Bring an array to rows and columns, where that can be done in one way.

    Args:
        path: where it comes from.
        array: any axes.
        n_rows: how many rows it may have.
        shape: what is expected, for the message.

    Returns:
        A view of it: without axes of length one, and transposed where only its columns are as many
        as the rows should be; and what was assumed.

    Raises:
        InputError: more than two axes, or none.
    """
    if 0 in array.shape:
        raise fail(path, f"has shape {array.shape}", "it holds no values")
    rows = array
    if array.ndim > 2:
        left = [n for n in array.shape if n != 1]
        # One number per row is a column.
        left = left + [1] if len(left) == 1 and left[0] in n_rows else left
        rows = array.reshape(left) if len(left) == 2 else array
    if rows.ndim != 2:
        raise fail(path, f"has shape {array.shape}", f"expected {shape}")
    n, d = tuple[int, ...](rows.shape)
    if n not in n_rows and d in n_rows:
        rows = rows.T
    if rows is array:
        return rows, ()
    return rows, (f"{path.name}: shape {array.shape} is read as {rows.shape}",)


def map_npy(path: Path, spec: str) -> np.ndarray:
    """Memory-map one array of numbers and check its kind.

    Args:
        path: an .npy.
        spec: what it is, for the messages.

    Raises:
        InputError: naming the file and what to do.
    """
    check_begin(path)
    array = read_npy(path, spec)
    check_kind(path, array.dtype)
    return array


def map_archive(path: Path, spec: str) -> dict[str, np.ndarray]:
    """Memory-map the arrays of an archive, unpacked to temporary files.

    Args:
        path: an .npz.
        spec: names the `arrays`, of which some may be `optional`.

    Returns:
        Those that are there, by name.

    Raises:
        InputError: damaged, too large, a pickle, an array missing or of another rank or kind.
    """
    check_begin(path)
    wanted, found = load_spec(spec)["arrays"], {}
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > MAX_BYTES:
                raise fail(path, "unpacks to more than 8 GiB", "save the rows with np.save")
            held = {name.removesuffix(".npy") for name in archive.namelist()}
            alone = _only_one(held, wanted)
            for name in held & {one["name"] for one in wanted}:
                found[name] = _unpack(archive, name)
            if alone is not None:
                found[wanted[0]["name"]] = _unpack(archive, alone)
    except ARRAY_FAULTS as error:
        what = f"is not a plain npz archive ({first_line(error)})"
        raise fail(path, what, "save it with np.savez, names as text") from error
    for one in wanted:
        array = found.get(one["name"])
        if array is None and not one.get("optional"):
            what = f"lacks the array {one['name']}; it holds {', '.join(sorted(held)) or 'nothing'}"
            raise fail(path, what, "save it with np.savez")
        if array is not None and (
            (one["ndim"] and array.ndim != one["ndim"]) or array.dtype.kind not in one["kinds"]
        ):
            what = f"{one['name']} has shape {array.shape} and dtype {array.dtype}"
            raise fail(path, what, f"expected {one['shape']}")
    return found


def _only_one(held: set[str], wanted: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the name of the only array, where the one that is needed is not there by its name."""
    needed = [one["name"] for one in wanted if not one.get("optional")]
    if len(needed) != 1 or needed[0] in held:
        return None
    others = held - {one["name"] for one in wanted}
    return others.pop() if len(others) == 1 else None


def _unpack(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Copy one array of an archive to a temporary file and map it; the map outlives the name."""
    with archive.open(f"{name}.npy") as member, tempfile.NamedTemporaryFile(suffix=".npy") as file:
        shutil.copyfileobj(member, file)
        file.flush()
        with np.errstate(over="ignore"):  # a header may claim any number of values
            return np.load(file.name, mmap_mode="r", allow_pickle=False)


def spool(
    path: Path, parts: Iterable[np.ndarray], shape: tuple[int, int], dtype: np.dtype
) -> Shaped[np.ndarray, "n d"]:
    """Write blocks of rows to a temporary file and map it; the file goes with the array.

    Args:
        path: where the rows come from, for the message.
        parts: (k, d) blocks, `shape` together.
        shape: rows and columns.
        dtype: of the numbers.

    Raises:
        InputError: the temporary folder has no room for them.
    """
    with tempfile.TemporaryFile() as file:
        for part in parts:
            try:
                file.write(np.ascontiguousarray(part, dtype).data)
            except OSError as error:
                what = f"its rows do not fit into {tempfile.gettempdir()} ({error.strerror})"
                raise fail(path, what, "set TMPDIR to a folder with more room") from error
        file.flush()
        return np.memmap(file, dtype, "r", shape=shape)
