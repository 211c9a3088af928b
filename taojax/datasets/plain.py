"""Folders without a data set of their own: poses beside whatever the user has.

contract      map/poses.csv with truth/query_poses.csv or query/poses.csv
image names   database_images_paths.txt, queries_images_paths.txt or the image folders database/
              and queries/; positions in the names, as VPR-methods-evaluation wants them
dbStruct      one .mat or .db of NetVLAD and seqNet
traverse      poses.csv and perhaps odometry.csv: one drive
"""

import io
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from taojax.datasets.folder import Session
from taojax.datasets.trajectory import Trajectory, headings, integrate
from taojax.errors import InputError
from taojax.specs import fail, load_spec, read_bytes
from taojax.tables import read_table

__all__ = ["read_plain", "read_traverse"]

SIDES = ("database", "queries")
IMAGES = (".jpg", ".jpeg", ".png")
TIME, ID = 13, 7
"""Fields of an image name, counted in parts between the @."""

LARGEST_M = 1e7
"""No UTM coordinate is larger."""

DERIVED = "headings are derived from positions"
NUMBERED = "no time stamps: row numbers stand for seconds"


def read_plain(folder: Path) -> tuple[Session, Session]:
    """Read map and query sessions of a plain folder with poses.

    Args:
        folder: of one of the first three kinds above, or a dbStruct file itself.

    Raises:
        InputError: none or several of the kinds are there, or a file is malformed.
    """
    if folder.is_file():
        return _db_struct(folder)
    if not folder.is_dir():
        raise fail(folder, "no such folder", "point at another one")
    found: list[tuple[str, Any]] = []
    if (folder / "map/poses.csv").exists():
        found.append(("map/poses.csv", _contract))
    if all(_listed(folder, side) for side in SIDES):
        found.append((f"images of {' and '.join(SIDES)}", _named_images))
    files = sorted(p for p in folder.iterdir() if p.name != "Thumbs.db")
    structs = [path for path in files if path.suffix in (".mat", ".db")]
    found += [(path.name, lambda _, path=path: _db_struct(path)) for path in structs]
    if len(found) != 1:
        what = f"holds {' and '.join(name for name, _ in found) or 'no poses'}"
        fix = "keep one kind, or point at the file" if found else (
            "expected map/poses.csv, database_images_paths.txt with queries_images_paths.txt, or a"
            " dbStruct (.mat, .db)"
        )  # fmt: skip
        raise fail(folder, what, fix)
    return found[0][1](folder)


def read_traverse(folder: Path) -> tuple[Session, Trajectory | None]:
    """Read one drive.

    Args:
        folder: holds poses.csv and perhaps odometry.csv, both laid out as in a data folder, the
            coordinates of any origin.

    Returns:
        The session, and its odometry chained into poses in the frame of its first stamp; None
        where there is no odometry.

    Raises:
        InputError: a file is malformed.
    """
    session = _posed(folder / "poses.csv", folder)
    path = folder / "odometry.csv"
    if not path.exists():
        return session, None
    table = read_table(path, "query_odometry")
    steps = np.stack([table[name] for name in ("dx_m", "dy_m", "dtheta_rad")], axis=1)
    return session, Trajectory(table["t_s"], integrate(steps))


def _contract(folder: Path) -> tuple[Session, Session]:
    places = [folder / "truth/query_poses.csv", folder / "query/poses.csv"]
    there = [path for path in places if path.exists()]
    if len(there) != 1:
        what = "both" if there else "neither of"
        what = f"holds {what} truth/query_poses.csv and query/poses.csv"
        raise fail(folder, what, "keep one, with the poses of the queries")
    return _posed(folder / "map/poses.csv", folder / "map"), _posed(there[0], folder / "query")


def _posed(path: Path, side: Path) -> Session:
    """Read poses; the frames are the files in images/ where those are as many."""
    table = read_table(path, "plain_poses")
    xy = np.stack([table["x_m"], table["y_m"]], axis=1)
    theta = table["theta_rad"] if "theta_rad" in table else headings(xy)
    notes = () if "theta_rad" in table else (f"{path.name}: {DERIVED}",)
    images = _images(side / "images")
    if len(images) != len(xy):
        images = [f"{row:06d}" for row in range(len(xy))]
    return Session(
        tuple(images), Trajectory(table["t_s"], np.column_stack([xy, theta])), notes=notes
    )


def _images(folder: Path) -> list[str]:
    """Return the images below a folder by relative name, sorted."""
    files = (p for p in folder.rglob("*") if p.suffix.lower() in IMAGES)
    return sorted(path.relative_to(folder).as_posix() for path in files)


def _listed(folder: Path, side: str) -> bool:
    """Tell whether there are images with positions in their names."""
    listed = (folder / f"{side}_images_paths.txt").exists()
    return listed or any("@" in path.name for path in (folder / side).rglob("*"))


def _named_images(folder: Path) -> tuple[Session, Session]:
    sessions, zones = [], {}
    for side in SIDES:
        path = folder / f"{side}_images_paths.txt"
        if path.exists():
            names = read_table(path, "image_paths")["path"].tolist()
            if (at := next((i for i, n in enumerate(names[1:]) if n < names[i]), None)) is not None:
                # Their writer sorts, and rows of descriptors go by name.
                raise fail(
                    path, f"row {at + 2}: is not sorted by name", "sort lines and rows alike"
                )
        else:
            path = folder / side
            names = _images(path)
        fields = [name.split("@") for name in names]
        for row, (name, parts) in enumerate(zip(names, fields, strict=True), start=1):
            _check_position(path, row, name, parts)
            # Blank or missing where the data set has no zones.
            if zone := "".join(parts[3:5]) if len(parts) > ID else "":
                zones.setdefault(zone, f"{path}: row {row}")
        sessions.append(_session_of_names(path, names, fields))
    if len(zones) > 1:
        (first, _), (other, where) = list(zones.items())[:2]
        raise InputError(
            f"{where}: UTM zone {other}, but other images lie in {first};"
            " project all positions to one zone"
        )
    return sessions[0], sessions[1]


def _check_position(path: Path, row: int, name: str, parts: Sequence[str]) -> None:
    try:
        east_m, north_m = float(parts[1]), float(parts[2])
    except (IndexError, ValueError):
        east_m = north_m = np.nan
    if not np.hypot(east_m, north_m) <= LARGEST_M:
        what = f"row {row}: no position in {name[:80]!r}"
        raise fail(path, what, "names hold @utm_east@utm_north@...@.jpg, metres")


def _session_of_names(path: Path, names: Sequence[str], fields: Sequence[list[str]]) -> Session:
    """Put images in driving order: as listed, else by the times and numbers in their names."""
    if len(names) < 3:
        raise fail(path, f"{len(names)} images", "at least 3 are needed")
    xy = np.array([[float(parts[1]), float(parts[2])] for parts in fields])
    order, said = np.arange(len(xy)), "images are taken in the order of their names"
    if not _is_drive(xy):
        keys = [(_part(parts, TIME), _natural(_part(parts, ID))) for parts in fields]
        order = np.array(sorted(range(len(xy)), key=keys.__getitem__))
        said = "images are put in the order of the times and numbers in their names"
    if not _is_drive(xy[order]):
        what = "the images in the order of their names are no drive: most steps cross the map"
        raise fail(path, what, "name them in driving order, or write poses.csv")
    xy = xy[order]
    poses = Trajectory(np.arange(float(len(xy))), np.column_stack([xy, headings(xy)]))
    return Session(tuple(names[int(at)] for at in order), poses, notes=(said, NUMBERED, DERIVED))


def _part(parts: Sequence[str], at: int) -> str:
    return parts[at] if at < len(parts) else ""


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts 9 before 10."""
    words = "".join(c if c.isdecimal() else " " + c + " " for c in text).split()
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words]


def _is_drive(xy: Float[np.ndarray, "n 2"]) -> bool:
    """Tell a drive from a shuffle: its steps are short against the way between any two frames."""
    step_m = np.hypot(*np.diff(xy, axis=0).T).mean()
    shuffled = xy[np.random.default_rng(0).permutation(len(xy))]
    any_m = np.hypot(*np.diff(shuffled, axis=0).T).mean()
    return bool(step_m <= (0.1 + 30.0 / len(xy)) * any_m)


def _db_struct(path: Path) -> tuple[Session, Session]:
    struct = _load_struct(path)
    sessions = []
    for names_field, utm_field in (("dbImageFns", "utmDb"), ("qImageFns", "utmQ")):
        names = [str(name).strip() for name in np.atleast_1d(struct[names_field])]
        xy = _positions(path, utm_field, struct[utm_field], len(names))
        poses = Trajectory(np.arange(float(len(xy))), np.column_stack([xy, headings(xy)]))
        sessions.append(Session(tuple(names), poses, notes=(NUMBERED, DERIVED)))
    return sessions[0], sessions[1]


def _load_struct(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    spec = load_spec("seqnet")
    raw = io.BytesIO(read_bytes(path))
    try:
        held = loadmat(raw, simplify_cells=True, appendmat=False)
    except (ValueError, TypeError, KeyError, IndexError, OSError, EOFError, OverflowError,
            NotImplementedError, MemoryError, UnboundLocalError, MatReadError,
            zlib.error) as error:  # fmt: skip
        lines = str(error).splitlines() or [type(error).__name__]
        raise fail(
            path, f"is not a MATLAB v5 file ({lines[0][:80]})", "save it with -v7"
        ) from error
    struct = held.get(spec["struct"])
    if not isinstance(struct, dict):
        raise fail(path, f"holds no struct {spec['struct']}", "expected one of NetVLAD or seqNet")
    for field in spec["fields"]:
        if field["name"] not in struct:
            what = f"{spec['struct']} lacks {field['name']} ({field['about']})"
            raise fail(path, what, "add it, or write poses.csv")
    return struct


def _positions(path: Path, field: str, utm: Any, n: int) -> Float[np.ndarray, "n 2"]:
    """Return positions of a dbStruct, which are columns; rows where only that fits."""
    array = np.asarray(utm)
    if array.dtype.kind in "iuf" and array.shape in ((2, n), (n, 2)) and n >= 3:
        xy = (array.T if array.shape == (2, n) else array).astype(np.float64)
        wrong = ~(np.abs(xy).max(axis=1) <= LARGEST_M)
        if not wrong.any():
            return xy
        row = int(np.argmax(wrong))
        raise fail(path, f"{field}: image {row} (from 0) has no position", "store metres")
    what = f"{field} has shape {array.shape} for {n} images"
    raise fail(path, what, "expected (2, N), at least 3 images")
