"""Global descriptors in an hloc file: one HDF5 group per image, read when asked for."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from taojax.datasets.frame_names import Names
from taojax.errors import InputError
from taojax.specs import fail, load_spec

__all__ = ["H5_SUFFIXES", "Features", "open_features"]

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
