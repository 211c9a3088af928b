"""Reads all of a data folder but its truth and collects every problem, not only the first."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from taojax.about import read_about
from taojax.errors import InputError
from taojax.runtime.inspection import Norms, norms
from taojax.runtime.observations import Observations, descriptor_names, load_observations
from taojax.specs import fail, read_npy, read_npz
from taojax.tables import read_table

__all__ = ["Found", "check"]

T = TypeVar("T")


@dataclass
class Found:
    """A data folder as far as it can be read; None is what cannot."""

    files: dict[str, str] = field(default_factory=dict)
    """Name -> what it holds; blank where it cannot be read."""

    problems: dict[str, str] = field(default_factory=dict)
    """Name -> the one line on what is wrong with it."""

    map_t: np.ndarray | None = None
    map_xyt: np.ndarray | None = None
    """(M, 3)."""

    query_t: np.ndarray | None = None
    odometry: np.ndarray | None = None
    """(T, 3)."""

    norms: dict[str, Norms] = field(default_factory=dict)
    """Of each file of descriptors."""

    observations: Observations | None = None
    """All of it, where nothing is wrong."""

    def attempt(self, name: str, read: Callable[[], T]) -> T | None:
        """Read a file, or note what is wrong with it."""
        try:
            return read()
        except InputError as error:
            self.files.setdefault(name, "")
            self.problems.setdefault(name, str(error))
            return None


def check(folder: Path) -> Found:
    """Read every file of a data folder but the truth.

    Args:
        folder: laid out as data_specs/README.md says.

    Raises:
        InputError: there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such data folder; see data_specs/README.md for the layout")
    found = Found()
    found.map_t, found.map_xyt = _table(found, folder, "map/poses.csv", "map_poses")
    found.query_t, found.odometry = _table(found, folder, "query/odometry.csv", "query_odometry")
    if (folder / "query/retrievals.npz").exists():
        _lists(found, folder, "query/retrievals.npz")
    else:
        names = found.attempt("descriptors", lambda: descriptor_names(folder)) or ()
        for name, stamps in zip(names, (found.map_t, found.query_t), strict=False):
            _descriptors(found, folder, name, stamps)
    if (folder / "about.toml").exists():
        found.files["about.toml"] = "notes"
        n_query = None if found.query_t is None else len(found.query_t)
        found.attempt("about.toml", lambda: read_about(folder, n_query))
    try:
        found.observations = load_observations(folder)
    except InputError as error:
        # It stops at the first; what is new goes to the file that it names.
        own = (name for name in found.files if str(error).startswith(f"{folder / name}:"))
        found.problems.setdefault(next(own, "descriptors"), str(error))
    return found


def _table(
    found: Found, folder: Path, name: str, spec: str
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return stamps and the three other columns."""
    table = found.attempt(name, lambda: read_table(folder / name, spec))
    if table is None:
        return None, None
    found.files[name] = f"{len(table['t_s']):,} rows"
    return table["t_s"], np.stack([table[column] for column in list(table)[1:]], axis=1)


def _lists(found: Found, folder: Path, name: str) -> None:
    arrays = found.attempt(name, lambda: read_npz(folder / name, "retrievals"))
    if arrays is not None:
        found.files[name] = f"{_shape(arrays['index'])} candidates"


def _descriptors(found: Found, folder: Path, name: str, stamps: np.ndarray | None) -> None:
    array = found.attempt(name, lambda: read_npy(folder / name, "descriptors"))
    if array is None:
        return
    found.files[name] = f"{_shape(array)} {array.dtype}"
    if stamps is not None and len(array) != len(stamps):
        what = f"{len(array)} rows for {len(stamps)} frames"
        found.problems[name] = str(fail(folder / name, what, "store one row per frame"))
    measured = found.attempt(name, lambda: norms(array, str(folder / name)))
    found.norms |= {} if measured is None else {name: measured}


def _shape(array: np.ndarray) -> str:
    return " x ".join(f"{n:,}" for n in array.shape)
