"""Descriptors that users already have, checked and brought to the frames of two sessions.

    npy    rows are the frames in the order of their names, or the frames that stay
    npz    `descs`, and `paths` where rows go by name
    h5     hloc: one group per image

Nothing is loaded whole: chosen rows are a view of the file or a copy in a temporary file (TMPDIR).
"""

import zipfile
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from taojax.datasets.arrays import (
    blocks,
    check_begin,
    check_kind,
    is_native,
    kind_notes,
    map_archive,
    map_npy,
    spool,
    two_axes,
)  # fmt: skip
from taojax.datasets.folder import Descriptors, Lists, Session
from taojax.datasets.lists import H5_SUFFIXES, Names, has_scores, open_features, read_lists
from taojax.files.specs import fail

__all__ = ["goes_by_name", "read_side", "read_views", "view_notes"]

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")
"""Endings of names that sort as image files do."""


def read_views(
    map_path: Path,
    query_path: Path | None,
    sessions: tuple[Session, Session],
    kept: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " t"]],
) -> Descriptors | Lists:
    """Read descriptors (two files) or what a frontend answered (one file) for the frames that stay.

    Args:
        map_path: descriptors of the map images (.npy, .npz, .h5). Without `query_path`: an .h5 that
            holds both sessions, retrieval lists (.npz, .csv, .txt), or a dense matrix of
            similarities (.npy, queries x map). Larger must mean more alike: a matrix of distances
            cannot be told from one of similarities.
        query_path: descriptors of the query images; may be the same .h5.
        sessions: map and query before sub-sampling.
        kept: rows of each session that stay, in the order wanted.

    Raises:
        InputError: naming file, row or frame, and what to do.
    """
    if query_path is None and map_path.suffix.lower() not in H5_SUFFIXES:
        return read_lists(map_path, sessions, kept)
    paths = (map_path, map_path if query_path is None else query_path)
    (of_map, said), (of_query, more) = (
        read_side(path, session.frames, rows)
        for path, session, rows in zip(paths, sessions, kept, strict=True)
    )
    if of_map.shape[1] != of_query.shape[1]:
        what = f"dimension {of_query.shape[1]}, but {paths[0]} has {of_map.shape[1]}"
        raise fail(paths[1], what, "use the same network for both")
    return Descriptors(of_map, of_query, (*said, *more))


def goes_by_name(path: Path) -> bool:
    """Tell whether a file names the image of each row, so that their order does not matter."""
    if path.suffix.lower() in (*H5_SUFFIXES, ".csv", ".txt"):
        return True
    try:
        with zipfile.ZipFile(path) as archive:
            return path.suffix.lower() == ".npz" and "paths.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def view_notes(map_path: Path, query_path: Path | None) -> tuple[str, ...]:
    """Return what the report must repeat of files that `read_views` has read."""
    suffix = map_path.suffix.lower()
    if query_path is None and suffix == ".npy":
        return ("retrieval lists are the best of a dense similarity matrix",)
    if query_path is None and suffix in (".csv", ".txt") and not has_scores(map_path):
        return ("retrieval lists came without scores: similarity is made from the rank",)
    return ()


def read_side(
    path: Path, frames: Sequence[str], kept: np.ndarray
) -> tuple[Float[np.ndarray, "k d"], tuple[str, ...]]:
    """Read the descriptors of one session.

    Args:
        path: .npy, .npz or .h5.
        frames: names of all frames.
        kept: rows of those that stay.

    Returns:
        (K, D) rows of the frames that stay, in their order, and what was assumed.

    Raises:
        InputError: naming file, row or frame, and what to do.
    """
    check_begin(path)
    names = [frames[int(row)] for row in kept]
    if len(names) < 3:
        raise fail(path, f"{len(names)} frames stay", "choose at least three")
    suffix = path.suffix.lower()
    if suffix in H5_SUFFIXES:
        return _from_h5(path, names)
    may_be = (len(frames), len(kept))
    if suffix == ".npy":
        array, said = two_axes(path, map_npy(path, "views"), may_be, "(rows, D) float32")
        rows = _by_order(path, len(array), frames, kept)
        return _from_array(path, array, rows, names), (*said, *kind_notes(path, array.dtype))
    if suffix != ".npz":
        known = f"use .npy, .npz or {' or '.join(H5_SUFFIXES)}"
        raise fail(path, f"is no known file of descriptors ({suffix or 'no ending'})", known)
    arrays = map_archive(path, "descriptor_archive")
    has_names = "paths" in arrays
    n_named = (len(arrays["paths"]),) if has_names else may_be
    array, said = two_axes(path, arrays["descs"], n_named, "(rows, D) float32")
    said += kind_notes(path, array.dtype)
    if not has_names:
        rows = _by_order(path, len(array), frames, kept)
        return _from_array(path, array, rows, names), said
    if len(arrays["paths"]) != len(array):
        what = f"{len(array)} descs but {len(arrays['paths'])} paths"
        raise fail(path, what, "store one path per row")
    return _from_array(path, array, _by_name(path, arrays["paths"], names), names), said


def _by_order(
    path: Path, n_rows: int, frames: Sequence[str], kept: np.ndarray
) -> Int[np.ndarray, " k"]:
    """Return the file's rows of the frames that stay, where rows are frames in name order."""
    if n_rows not in (len(frames), len(kept)):
        some = "" if len(kept) == len(frames) else f", of which {len(kept)} stay"
        what = f"{n_rows} rows, but the poses or odometry beside it have {len(frames)} frames{some}"
        fix = "store one row per frame, or their names (npz with descs and paths, or h5)"
        raise fail(path, what, fix)
    chosen = np.arange(n_rows) if n_rows == len(frames) else kept
    names = [frames[int(row)] for row in chosen]
    order = np.array(sorted(range(n_rows), key=names.__getitem__))
    rank = np.arange(n_rows)
    if np.any(order != rank) and all(Path(name).suffix.lower() in IMAGES for name in names):
        if not all("@" in name for name in names):
            before, after = next((a, b) for a, b in pairwise(names) if a > b)
            what = f"rows may go by time or by name: {before} comes before {after} in time alone"
            raise fail(path, what, "store the names too (npz with descs and paths, or h5)")
        # Names that hold positions are what VPR-methods-evaluation sorts by.
        rank[order] = np.arange(n_rows)
    return rank[kept] if n_rows == len(frames) else rank


def _by_name(path: Path, stored: np.ndarray, names: Sequence[str]) -> Int[np.ndarray, " k"]:
    """Return the file's rows of frames, where rows have names."""
    texts = stored.tolist()
    table = Names([t.decode("utf-8", "replace") if isinstance(t, bytes) else t for t in texts])
    rows = []
    for name in names:
        found = table.find(name)
        if len(found) != 1:
            what = f"{len(found) or 'no'} path(s) fit the frame {name}"
            raise fail(path, what, "store every frame once, by its whole relative path")
        rows.append(found[0])
    return np.array(rows, dtype=np.int64)


def _from_array(
    path: Path, array: np.ndarray, rows: np.ndarray, names: Sequence[str]
) -> Float[np.ndarray, "k d"]:
    """Return checked rows of a mapped array: a view where they are evenly spaced, else a copy."""
    labels = [f"row {row} (from 0), frame {name}" for row, name in zip(rows, names, strict=True)]
    parts = (array[some] for some in blocks(rows, array.itemsize * array.shape[1]))
    shape = (len(rows), array.shape[1])
    if not is_native(array.dtype):
        floats = _as_floats(_checked(path, parts, labels), array.dtype)
        return spool(path, floats, shape, np.dtype(np.float32))
    stride = int(rows[1] - rows[0])
    if stride > 0 and np.all(np.diff(rows) == stride):
        for _ in _checked(path, parts, labels):
            pass
        return array[int(rows[0]) : int(rows[-1]) + 1 : stride]
    return spool(path, _checked(path, parts, labels), shape, array.dtype)


def _as_floats(parts: Iterator[np.ndarray], dtype: np.dtype) -> Iterator[np.ndarray]:
    """Yield blocks as float32; whole numbers, which have no scale of their own, at unit length."""
    for part in parts:
        rows = np.asarray(part, np.float64)
        if dtype.kind != "f":
            rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        yield rows.astype(np.float32)


def _from_h5(path: Path, names: Sequence[str]) -> tuple[Float[np.ndarray, "k d"], tuple[str, ...]]:
    """Return a checked copy of the descriptors of frames, and what was assumed."""
    with open_features(path, names) as features:
        dtype = features.dtype
        check_kind(path, dtype)
        shape = (len(names), features.dimension)
        some = blocks(np.arange(len(names)), dtype.itemsize * features.dimension)
        parts = (features.read(rows) for rows in some)
        labels = [f"frame {name}" for name in names]
        rows = _checked(path, parts, labels)
        if is_native(dtype):
            return spool(path, rows, shape, dtype), features.notes
        floats = spool(path, _as_floats(rows, dtype), shape, np.dtype(np.float32))
        return floats, (*features.notes, *kind_notes(path, dtype))


def _checked(
    path: Path, parts: Iterator[np.ndarray], labels: Sequence[str]
) -> Iterator[np.ndarray]:
    """Yield blocks of rows that are finite and point somewhere."""
    start = 0
    for part in parts:
        with np.errstate(invalid="ignore"):
            size = np.max(np.abs(part.astype(float) if part.dtype.kind != "f" else part), axis=1)
        # What float32 cannot hold would turn infinite on the way.
        wrong = ~(size <= np.finfo(np.float32).max)
        for is_bad, what in ((wrong, "is not finite"), (size == 0, "is all zero")):
            if is_bad.any():
                where = labels[start + int(np.argmax(is_bad))]
                raise fail(path, f"{where} {what}", "drop the frame or compute it again")
        start += len(part)
        yield part
