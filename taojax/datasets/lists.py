"""Retrieval lists, similarity matrices and hloc files of a user's own frontend, frames by name."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float, Int

from taojax.datasets.arrays import (  # fmt: skip
    blocks,
    check_begin,
    check_kind,
    map_archive,
    map_npy,
    two_axes,
)
from taojax.datasets.folder import Lists, Session
from taojax.errors import InputError
from taojax.files.specs import fail, load_spec, read_text
from taojax.files.tables import read_table

__all__ = [
    "H5_SUFFIXES",
    "N_BEST",
    "Features",
    "Names",
    "has_scores",
    "open_features",
    "read_lists",
]


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.replace("\\", "/").split("/") if part not in ("", "."))


class Names:
    """Names of images, and which of them another program's name means."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = [_parts(name) for name in names]
        self._whole: dict[tuple[str, ...], list[int]] = defaultdict(list)
        self._base: dict[str, list[int]] = defaultdict(list)
        for at, name in enumerate(self._names):
            self._whole[name].append(at)
            self._base[name[-1] if name else ""].append(at)

    def find(self, name: str) -> list[int]:
        """Return where a name lies among these.

        Args:
            name: a path, relative to anything.

        Returns:
            Positions: none for an unknown name, several where it could mean several.
        """
        wanted = _parts(name)
        if wanted in self._whole:
            return self._whole[wanted]
        same_base = self._base.get(wanted[-1] if wanted else "", [])
        if len(same_base) < 2:
            return same_base
        ends = [at for at in same_base if _ends_alike(self._names[at], wanted)]
        return ends or same_base


def _ends_alike(a: tuple[str, ...], b: tuple[str, ...]) -> bool:
    """Tell whether the shorter path is the end of the longer one."""
    n = min(len(a), len(b))
    return a[-n:] == b[-n:]


H5_SUFFIXES = (".h5", ".hdf5")

DATASET = "global_descriptor"


CACHE_BYTES = 2 << 20
"""HDF5 would otherwise keep 10 kB of every group it has seen."""


class Features:
    """Descriptors of some frames in an open file."""

    def __init__(self, path: Path, file: h5py.File, frames: Sequence[str]) -> None:
        cache = file.id.get_mdc_config()
        cache.set_initial_size = True
        cache.initial_size = cache.min_size = cache.max_size = CACHE_BYTES
        file.id.set_mdc_config(cache)
        self._path, self._file = path, file
        self._groups = _groups(path, file, frames)
        first = self._dataset(0)
        self._shape = first.shape
        self.dimension = int(np.prod(first.shape))
        self.dtype = np.dtype(first.dtype)
        squeezed = f"{path.name}: shape {first.shape} is read as ({self.dimension},)"
        self.notes = () if len(first.shape) == 1 else (squeezed,)

    def _dataset(self, row: int) -> Any:
        # The low level is four times as fast, which counts for a hundred thousand images.
        group = self._groups[row]
        try:
            found = h5py.h5d.open(self._file.id, f"{group}/{DATASET}".encode())
        except (KeyError, TypeError) as error:
            what = f"group {group} lacks {DATASET}"
            raise fail(self._path, what, "extract it again with hloc") from error
        spec = load_spec("hloc")["dataset"]
        # One row or column of numbers is a descriptor too.
        n_long = sum(n != 1 for n in found.shape)
        if found.rank < 1 or n_long > spec["ndim"] or found.dtype.kind not in spec["kinds"]:
            what = f"{group}/{DATASET} has shape {found.shape} and dtype {found.dtype}"
            raise fail(self._path, what, f"expected {spec['shape']}")
        return found

    def read(self, rows: np.ndarray) -> np.ndarray:
        """Return (k, D) descriptors of frames, by their place in the list asked for.

        Raises:
            InputError: a descriptor is missing, damaged or of another length or kind.
        """
        block = np.empty((len(rows), self.dimension), self.dtype)
        for at, row in enumerate(rows):
            found = self._dataset(int(row))
            if found.shape != self._shape or found.dtype != self.dtype:
                what = (
                    f"{self._groups[int(row)]} has {np.prod(found.shape)} numbers of {found.dtype},"
                    f" but {self._groups[0]} has {self.dimension} of {self.dtype}"
                )
                raise fail(self._path, what, "use one network for all images")
            found.read(h5py.h5s.ALL, h5py.h5s.ALL, block[at].reshape(self._shape))
        return block


@contextmanager
def open_features(path: Path, frames: Sequence[str]) -> Iterator[Features]:
    """Open an hloc file and find the groups of some frames.

    Args:
        path: the .h5.
        frames: names of the images wanted; a group's name is the whole name or, where that is
            unique, ends alike.

    Raises:
        InputError: damaged file, or a frame without group or with several.
    """
    try:
        with h5py.File(path, "r") as file:
            yield Features(path, file, frames)
    except InputError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        what = f"is not a readable HDF5 file ({str(error).splitlines()[0][:80]})"
        raise fail(path, what, "extract the features again with hloc") from error


def _groups(path: Path, file: h5py.File, frames: Sequence[str]) -> list[str]:
    """Return the group of every frame."""
    groups = [name.strip("/") for name in frames]
    if all(name and name in file for name in groups):
        return groups
    seen: list[str] = []
    file.visit(seen.append)
    held = [name.removesuffix(f"/{DATASET}") for name in seen if name.endswith(f"/{DATASET}")]
    if not held:
        raise fail(path, f"no group holds {DATASET}", "point at hloc's global features")
    names = Names(held)
    return [_group(path, held, names.find(frame), frame) for frame in frames]


def _group(path: Path, held: Sequence[str], found: Sequence[int], frame: str) -> str:
    if len(found) == 1:
        return held[found[0]]
    if not found:
        raise fail(path, f"no descriptor of the frame {frame}", "extract all images of the session")
    what = f"frame {frame} could be {held[found[0]]} or {held[found[1]]}"
    raise fail(path, what, "keep the two sessions in two files")


N_BEST = 100
"""Candidates kept of a dense row, the paper's K."""

LARGEST = 1.0 + 1e-3
"""Rounding may lift a cosine so far."""

FIX_SCALE = "similarities are at most 1: store cosines (1 - d^2 / 2 of unit descriptors) or rescale"

FIX_ORDER = "store the best candidate first; larger = more alike, so turn distances round"


def read_lists(
    path: Path,
    sessions: tuple[Session, Session],
    kept: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " t"]],
) -> Lists:
    """Read what a frontend answered, for the frames that stay.

    Args:
        path: .npz, .csv, .txt or a dense .npy.
        sessions: map and query before sub-sampling.
        kept: rows of each session that stay.

    Raises:
        InputError: naming file, row and what to do.
    """
    check_begin(path)
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return _from_matrix(path, sessions, kept)
    if suffix == ".npz":
        index, similarity = _from_archive(path, sessions)
    elif suffix in (".csv", ".txt"):
        index, similarity = _from_table(path, sessions)
    else:
        what = f"is no known file of retrieval lists ({suffix or 'no ending'})"
        raise fail(path, what, "use .npz, .csv, .txt or a dense .npy; descriptors need two files")
    return _for_kept(index[kept[1]], similarity[kept[1]], kept[0], len(sessions[0].frames))


def _for_kept(index: np.ndarray, similarity: np.ndarray, kept: np.ndarray, n_map: int) -> Lists:
    """Drop candidates that do not stay, renumber the others and close the gaps."""
    # The last entry answers for -1, no candidate.
    number = np.full(n_map + 1, -1, np.int64)
    number[kept] = np.arange(len(kept))
    index = number[index]
    first = np.argsort(index < 0, axis=1, kind="stable")
    width = max(1, int((index >= 0).sum(axis=1).max(initial=0)))
    index = np.take_along_axis(index, first, axis=1)[:, :width]
    similarity = np.take_along_axis(similarity, first, axis=1)[:, :width]
    similarity = np.minimum(np.where(index >= 0, similarity, 0.0), 1.0)
    return Lists(index.astype(np.int32), similarity.astype(np.float32))


def _from_archive(
    path: Path, sessions: tuple[Session, Session]
) -> tuple[Int[np.ndarray, "t k"], Float[np.ndarray, "t k"]]:
    """Read index and similarity of the whole sessions."""
    arrays = map_archive(path, "retrievals")
    index, similarity = (np.asarray(arrays[name]) for name in ("index", "similarity"))
    check_kind(path, similarity.dtype)
    n_map, n_query = (len(session.frames) for session in sessions)
    if index.shape != similarity.shape:
        what = f"index {index.shape} and similarity {similarity.shape} differ"
        raise fail(path, what, "both are (T, K)")
    if len(index) != n_query:
        what = f"{len(index)} lists, but the whole query session has {n_query} frames"
        raise fail(path, what, "give one list per frame, before sub-sampling")
    index = index.astype(np.int64)
    similarity = np.where(index == -1, 0.0, similarity.astype(np.float64))
    running = np.minimum.accumulate(np.where(index >= 0, similarity, np.inf), axis=1)
    rises = np.zeros(index.shape, dtype=bool)
    rises[:, 1:] = (index[:, 1:] >= 0) & (similarity[:, 1:] > running[:, :-1] + 1e-6)
    for is_bad, what, fix in (
        ((index < -1) | (index >= n_map), "index", f"map rows are 0..{n_map - 1}, -1 = none"),
        (~np.isfinite(similarity), "not finite", "use index -1 for no candidate"),
        (similarity > LARGEST, "similarity", FIX_SCALE),
        (rises, "similarity rises", FIX_ORDER),
    ):
        if is_bad.any():
            row, rank = (int(at) for at in np.argwhere(is_bad)[0])
            value = index[row, rank] if what == "index" else similarity[row, rank]
            raise fail(path, f"row {row} (from 0), rank {rank}: {what} {value:g}", fix)
    return index, similarity


def has_scores(path: Path) -> bool:
    """Tell whether a .csv or .txt of retrieval lists has a third column."""
    lines = [line for line in read_text(path).splitlines() if not line.startswith("#")]
    return len(lines[0].split("," if path.suffix.lower() == ".csv" else None)) == 3


def _from_table(
    path: Path, sessions: tuple[Session, Session]
) -> tuple[Int[np.ndarray, "t k"], Float[np.ndarray, "t k"]]:
    """Read one row per query and candidate; a query without row has no candidate."""
    is_csv = path.suffix.lower() == ".csv"
    table = read_table(path, "retrieval_list" if is_csv else "retrieval_pairs")
    lines = _line_numbers(path, is_csv)
    map_row, query_row = (
        _rows_of(path, table[column], session, lines, column)
        for column, session in zip(("map", "query"), sessions, strict=True)
    )
    order = np.argsort(query_row, kind="stable")
    first = np.searchsorted(query_row[order], query_row[order], side="left")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - first
    if "similarity" in table:
        score = table["similarity"]
        rises = (rank[order][1:] > 0) & (np.diff(score[order]) > 1e-6)
        if rises.any():
            line = lines[order[int(np.argmax(rises)) + 1]]
            raise fail(path, f"row {line}: similarity rises down the list of a query", FIX_ORDER)
    else:
        score = 1.0 - rank / (rank.max() + 1)
    shape = (len(sessions[1].frames), int(rank.max()) + 1)
    index, similarity = np.full(shape, -1, np.int64), np.zeros(shape)
    index[query_row, rank], similarity[query_row, rank] = map_row, score
    return index, similarity


def _line_numbers(path: Path, is_csv: bool) -> Int[np.ndarray, " n"]:
    """Return the editor's line number of every data row."""
    lines = enumerate(read_text(path).rstrip().splitlines(), start=1)
    own = [number for number, line in lines if is_csv or not line.lstrip().startswith("#")]
    return np.array(own[is_csv:])


def _rows_of(
    path: Path, cells: np.ndarray, session: Session, lines: np.ndarray, column: str
) -> Int[np.ndarray, " n"]:
    """Turn names, or numbers counted from 0, into rows of a session."""
    n, names = len(session.frames), Names(session.frames)
    found = {cell: names.find(cell) for cell in set(cells)}
    named = np.array([found[cell][0] if len(found[cell]) == 1 else -1 for cell in cells])
    is_number = all(cell.isascii() and cell.isdigit() for cell in found)
    numbers = np.array([int(cell) for cell in cells]) if is_number else np.full(len(cells), -1)
    if is_number and np.all(named < 0):
        named = np.where(numbers < n, numbers, -1)
    elif is_number and np.all(numbers < n) and np.any(named != numbers):
        what = f"column {column}: the numbers may be names or rows of the session"
        raise fail(path, what, "store whole image names")
    if (wrong := np.flatnonzero(named < 0)).size:
        cell = cells[int(wrong[0])]
        several = len(found[cell]) > 1
        what = f"{cell!r} fits {len(found[cell]) if several else 'none'} of the {n} frames"
        where = f"row {lines[int(wrong[0])]}, column {column}"
        raise fail(path, f"{where}: {what}", "store whole relative names, or numbers from 0")
    return named


def _from_matrix(
    path: Path,
    sessions: tuple[Session, Session],
    kept: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " t"]],
) -> Lists:
    """Keep the best candidates of every row of a dense matrix, block by block."""
    matrix, said = two_axes(path, map_npy(path, "similarity"), (), "(T, M) float32")
    whole = (len(sessions[1].frames), len(sessions[0].frames))
    if matrix.shape == whole:
        columns, rows = kept
    elif matrix.shape == (len(kept[1]), len(kept[0])):
        columns, rows = np.arange(matrix.shape[1]), np.arange(matrix.shape[0])
    else:
        what = f"shape {matrix.shape}, but there are {whole[0]} query and {whole[1]} map frames"
        fix = "transpose it" if matrix.shape == whole[::-1] else (
            "give similarities of the whole sessions (queries x map), or descriptors of both"
        )  # fmt: skip
        raise fail(path, what, fix)
    index = np.empty((len(rows), min(N_BEST, len(columns))), np.int32)
    similarity = np.empty(index.shape, np.float32)
    done = 0
    for some in blocks(rows, 8 * matrix.shape[1]):
        with np.errstate(invalid="ignore"):
            part = np.asarray(matrix[some], np.float64)[:, columns]
        _check_matrix(path, part, some, columns)
        best = np.argpartition(-part, index.shape[1] - 1, axis=1)[:, : index.shape[1]]
        # By map row first, so that of equals the earlier one leads.
        best.sort(axis=1)
        values = np.take_along_axis(part, best, axis=1)
        order = np.argsort(-values, axis=1, kind="stable")
        index[done : done + len(some)] = np.take_along_axis(best, order, axis=1)
        similarity[done : done + len(some)] = np.take_along_axis(values, order, axis=1)
        done += len(some)
    return Lists(index, np.minimum(similarity, 1.0), said)


def _check_matrix(path: Path, part: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> None:
    for is_bad, what, fix in (
        (~np.isfinite(part), "not finite", "compute it again"),
        (part > LARGEST, "larger than 1", FIX_SCALE),
    ):
        if is_bad.any():
            row, column = (int(at) for at in np.argwhere(is_bad)[0])
            where = f"row {rows[row]}, column {columns[column]} (from 0)"
            raise fail(path, f"{where}: {part[row, column]:g} is {what}", fix)
