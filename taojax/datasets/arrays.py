"""Arrays in other people's files: checked before use, mapped instead of loaded."""

import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Int, Shaped

from taojax.specs import ARRAY_FAULTS, GZIP, MAX_BYTES, fail, first_line, load_spec, read_npy

__all__ = ["blocks", "check_begin", "check_kind", "map_archive", "map_npy", "spool"]

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
    """Refuse numbers that are not the floats of this machine's kind.

    Raises:
        InputError: big-endian, or not float16, float32 or float64.
    """
    if dtype.newbyteorder("<") != dtype:
        raise fail(path, f"is big-endian ({dtype.str})", "save it as little-endian float32")
    if dtype.kind != "f" or dtype.itemsize > 8:
        raise fail(path, f"has dtype {dtype}", "save it as float32")


def map_npy(path: Path, spec: str) -> Shaped[np.ndarray, "n d"]:
    """Memory-map one table of numbers and check rank, kind and byte order.

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
            for name in held & {one["name"] for one in wanted}:
                found[name] = _unpack(archive, name)
    except ARRAY_FAULTS as error:
        what = f"is not a plain npz archive ({first_line(error)})"
        raise fail(path, what, "save it with np.savez, names as text") from error
    for one in wanted:
        array = found.get(one["name"])
        if array is None and not one.get("optional"):
            what = f"lacks the array {one['name']}; it holds {', '.join(sorted(held)) or 'nothing'}"
            raise fail(path, what, "save it with np.savez")
        if array is not None and (
            array.ndim != one["ndim"] or array.dtype.kind not in one["kinds"]
        ):
            what = f"{one['name']} has shape {array.shape} and dtype {array.dtype}"
            raise fail(path, what, f"expected {one['shape']}")
    return found


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
