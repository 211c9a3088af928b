"""Ways in which a sound array, archive or HDF5 file becomes a hostile one."""

import io
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from benchmarks.reliability_mutate import BYTES, Rng, pick, text_file


class Canary:
    """Unpickled, it creates a file."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str, str]]:
        return open, (self.path, "w")


def _saved(array: np.ndarray) -> bytes:
    held = io.BytesIO()
    np.save(held, array, allow_pickle=True)
    return held.getvalue()


def _array(array: np.ndarray, rng: Rng, canary: Path) -> bytes:
    """Return one changed array as an npy file."""
    kind = int(rng.integers(9))
    if kind == 0:
        types = (
            "<f2",
            ">f4",
            "<f8",
            "<i4",
            "<u8",
            "<c8",
            "?",
            "S8",
            "U4",
            "<M8[s]",
            "f4,f4",
            "<f16",
        )
        with np.errstate(all="ignore"):
            try:
                return _saved(array.astype(str(pick(rng, types))))
            except (TypeError, ValueError):
                return _saved(np.zeros(array.shape, "V3"))
    if kind == 1:
        return _saved(np.array([Canary(canary)], dtype=object))
    if kind == 2:
        return pickle.dumps(Canary(canary))
    if kind == 3:
        shapes = (
            array.T,
            array[:0],
            array[:1],
            array.ravel(),
            array[None],
            array[:, :0] if array.ndim > 1 else array,
        )
        return _saved(np.asarray(pick(rng, shapes)))
    if kind == 4 and array.size and array.dtype.kind in "fiu":
        values = (
            (np.nan, np.inf, -np.inf, 3e38, 1e-45, 2.0, -1.0)
            if array.dtype.kind == "f"
            else (2**31 - 1, 0, 99)
        )
        changed = array.copy()
        changed.flat[int(rng.integers(array.size))] = pick(rng, values)
        return _saved(changed)
    if kind == 5:
        return _saved(np.zeros_like(array))
    if kind == 6:
        return _saved(np.asfortranarray(array))
    raw = _saved(array)
    if kind == 7:
        # The header claims another shape than the data have.
        claim = str(
            pick(
                rng,
                (
                    "(10**9,)",
                    "(9999999999, 4)",
                    "(-1, 4)",
                    "(2**62, 2**62)",
                    "()",
                    "None",
                    "(1e3, 4)",
                ),
            )
        )
        start = raw.index(b"'shape':") + 8
        end = raw.index(b"}", start)
        claim = claim.replace("10**9", "1000000000").replace("2**62", str(2**62))
        return raw[:start] + f" {claim}, ".ljust(end - start).encode()[: end - start] + raw[end:]
    return pick(rng, BYTES)(raw, rng)


def npy_file(raw: bytes, rng: Rng, canary: Path) -> bytes:
    """Change dtype, shape, values or header of an array; or plant a pickle."""
    if rng.random() < 0.25:
        return pick(rng, BYTES)(raw, rng)
    return _array(np.load(io.BytesIO(raw)), rng, canary)


def npz_file(raw: bytes, rng: Rng, canary: Path) -> bytes:
    """Change, drop, rename, repeat or blow up the members of an archive."""
    if rng.random() < 0.25:
        return pick(rng, BYTES)(raw, rng)
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, held = str(pick(rng, list(members))), io.BytesIO()
    kind = int(rng.integers(7))
    if kind <= 2:
        array = np.load(io.BytesIO(members[name]))
        members[name] = _array(array, rng, canary)
    elif kind == 3:
        del members[name]
    elif kind == 4:
        members[str(pick(rng, ("../escape.npy", "/tmp/escape.npy", "index", "x.npy", "/")))] = (
            members.pop(name)
        )
    method = zipfile.ZIP_DEFLATED if rng.random() < 0.5 else zipfile.ZIP_STORED
    if kind == 5:
        # A bomb of a few kilobytes; its declared size is what it unpacks to.
        shape, method = (pick(rng, (1, 8, 64)) << 18, 4), zipfile.ZIP_DEFLATED
        members[name] = _saved(np.zeros(shape, np.float32))
    with zipfile.ZipFile(held, "w", method) as archive:
        for own, data in members.items():
            archive.writestr(own, data)
    data = held.getvalue()
    return _claimed(data, rng) if kind == 6 else data


def _claimed(data: bytes, rng: Rng) -> bytes:
    """Rewrite sizes, method or flags in the central directory."""
    at = data.index(b"PK\x01\x02") + pick(rng, (8, 10, 20, 24, 42))
    value = pick(rng, (0, 1, 14, 99, 2**31 - 1, 2**32 - 1))
    width = (
        2
        if data[at - 8 : at - 4] == b"PK\x01\x02" or data[at - 10 : at - 6] == b"PK\x01\x02"
        else 4
    )
    return data[:at] + (value % 2 ** (8 * width)).to_bytes(width, "little") + data[at + width :]


def h5_file(raw: bytes, rng: Rng) -> bytes:
    """Change one data set of an HDF5 file, or its bytes."""
    if rng.random() < 0.5:
        return pick(rng, BYTES)(raw, rng)
    held = io.BytesIO(raw)
    with h5py.File(held, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = str(pick(rng, names))
        del file[name]
        one = np.ones(8, np.float32)
        values = (
            one * 0, one * np.nan, one.reshape(2, 4), one[:3], one[:0], one[0], one.astype(">f8"),
            one.astype(int), one.astype(float) * 1e300, "text", np.array([b"a"] * 8),
            h5py.SoftLink("/nowhere"), h5py.SoftLink("/"), h5py.ExternalLink("/etc/passwd", "/"),
        )  # fmt: skip
        if rng.random() < 0.8:
            file[name] = pick(rng, values)
    return held.getvalue()


def changed(path: Path, raw: bytes, rng: Rng, canary: Path) -> bytes:
    """Return the changed bytes of a file, as its ending suggests."""
    suffix = path.suffix
    if suffix == ".npy":
        return npy_file(raw, rng, canary)
    if suffix == ".npz":
        return npz_file(raw, rng, canary)
    if suffix == ".h5":
        return h5_file(raw, rng)
    if suffix in (".mat", ".db", ".bag"):
        return pick(rng, BYTES)(raw, rng)
    return text_file(raw, rng, suffix)
