"""Poses without a data set of their own: single files, or folders that hold them beside the rest.

files         any names, each given on its own
contract      the same by default names: map/poses.csv with truth/query_poses.csv, query/poses.csv
              or query/odometry.csv alone
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

from taojax.datasets.describe import natural
from taojax.datasets.files import DERIVED, NUMBERED, read_poses
from taojax.datasets.folder import Session
from taojax.datasets.reading import PLAIN, Drive, Reading
from taojax.datasets.trajectory import Trajectory, headings
from taojax.errors import InputError
from taojax.files.specs import fail, load_spec, read_bytes
from taojax.files.tables import read_table

__all__ = ["found_in", "read_files", "read_plain", "read_session", "read_traverse", "session_of"]

SIDES = ("database", "queries")
IMAGES = (".jpg", ".jpeg", ".png")
STRUCTS = (".mat", ".db")
OTHER_NAMES = "rename them, or name every file on its own with `taojax convert files`"
TIME, ID = 13, 7
"""Fields of an image name, counted in parts between the @."""

LARGEST_M = 1e7
"""No UTM coordinate is larger."""

N_LISTED = 6
"""Files of a folder that a message names."""


def read_files(
    map_poses: Path, query_poses: Path | None, reading: Reading = PLAIN
) -> tuple[Session, Session | None]:
    """Read map and query sessions from one file of poses each.

    Args:
        map_poses: any file that `read_poses` takes.
        query_poses: the same; None where nobody knows the true poses.
        reading: what the user says of them.

    Returns:
        Map and query; None for a query that only its odometry knows.

    Raises:
        InputError: a file is malformed.
    """
    query = None if query_poses is None else read_session(query_poses, query_poses.parent, reading)
    return read_session(map_poses, map_poses.parent, reading), query


def read_plain(folder: Path) -> tuple[Session, Session | None]:
    """Read map and query sessions of a plain folder with poses.

    Args:
        folder: of one of the kinds above but single files and one drive, or a dbStruct itself.

    Returns:
        Map and query; None for a query that only its odometry knows.

    Raises:
        InputError: none or several of the kinds are there, or a file is malformed.
    """
    if folder.is_file() and folder.suffix.lower() in STRUCTS:
        return _db_struct(folder)
    if folder.is_file():
        fix = "name the folder, or every file on its own with `taojax convert files`"
        raise fail(folder, "is a file, no folder", fix)
    if not folder.is_dir():
        raise fail(folder, "no such folder", "point at another one")
    found: list[tuple[str, Any]] = []
    if (folder / "map/poses.csv").exists():
        found.append(("map/poses.csv", _contract))
    if all(_listed(folder, side) for side in SIDES):
        found.append((f"images of {' and '.join(SIDES)}", _named_images))
    files = sorted(p for p in folder.iterdir() if p.name != "Thumbs.db")
    structs = [path for path in files if path.suffix in STRUCTS]
    found += [(path.name, lambda _, path=path: _db_struct(path)) for path in structs]
    if len(found) > 1:
        what = f"holds {' and '.join(name for name, _ in found)}"
        raise fail(folder, what, "keep one kind, or point at the file")
    if not found:
        what = (
            "holds no poses: looked for map/poses.csv, database_images_paths.txt with"
            f" queries_images_paths.txt, or a dbStruct (.mat, .db), and found {found_in(folder)}"
        )
        raise fail(folder, what, OTHER_NAMES)
    return found[0][1](folder)


def found_in(folder: Path) -> str:
    """Name some of the files below a folder, for a message."""
    names, n_more = [], 0
    for place in (folder, *(p for p in sorted(folder.iterdir()) if p.is_dir())):
        inside = sorted(p for p in place.iterdir() if p.is_file() and not p.name.startswith("."))
        names += [path.relative_to(folder).as_posix() for path in inside[:N_LISTED]]
        n_more += max(0, len(inside) - N_LISTED)
    n_more += max(0, len(names) - N_LISTED)
    more = f" and {n_more:,} more" if n_more else ""
    return f"{', '.join(names[:N_LISTED]) or 'no files'}{more}"


def read_traverse(folder: Path) -> Session:
    """Read the poses of one drive.

    Args:
        folder: holds poses.csv, laid out as in a data folder, the coordinates of any origin.

    Raises:
        InputError: the file is missing or malformed.
    """
    path = folder / "poses.csv"
    if folder.is_file():
        fix = "name the folder, or every file on its own with `taojax convert files`"
        raise fail(folder, "is a file, no folder of a drive", fix)
    if folder.is_dir() and not path.exists():
        what = f"holds no poses.csv, but {found_in(folder)}"
        raise fail(folder, what, OTHER_NAMES)
    return read_session(path, folder)


def _contract(folder: Path) -> tuple[Session, Session | None]:
    places = [folder / "truth/query_poses.csv", folder / "query/poses.csv"]
    there = [path for path in places if path.exists()]
    mapped = read_session(folder / "map/poses.csv", folder / "map")
    if len(there) == 1:
        return mapped, read_session(there[0], folder / "query")
    if there:
        what = "holds both truth/query_poses.csv and query/poses.csv"
        raise fail(folder, what, "keep one, with the poses of the queries")
    if not (folder / "query/odometry.csv").exists():
        what = (
            "holds map/poses.csv, but neither of truth/query_poses.csv and query/poses.csv, nor"
            f" query/odometry.csv; found {found_in(folder)}"
        )
        raise fail(folder, what, OTHER_NAMES)
    return mapped, None


def read_session(path: Path, side: Path, reading: Reading = PLAIN) -> Session:
    """Read poses; the frames are the files in images/ where those are as many.

    Args:
        path: any file that `read_poses` takes.
        side: folder that may hold images/.
        reading: what the user says of the file.

    Returns:
        Frames in the order of time; where rows came late or twice, all rows of the file are listed.

    Raises:
        InputError: the file is malformed.
    """
    return session_of(read_poses(path, reading), _images(side / "images"))


def session_of(drive: Drive, images: Sequence[str] = (), *, has_pose: bool = True) -> Session:
    """Make a drive's poses frames, named by images where those are as many as rows.

    Args:
        drive: the poses.
        images: names, in the order of the rows.
        has_pose: False where the poses are what odometry believes.
    """
    n = drive.n_rows or len(drive.poses.t_s)
    names = tuple(images) if len(images) == n else tuple(f"{row:06d}" for row in range(n))
    rows = range(n) if drive.rows is None else drive.rows
    frames = tuple(names[int(row)] for row in rows)
    listed = names if frames != names else ()
    return Session(frames, drive.poses, has_pose, drive.notes, listed)


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
        keys = [(_part(parts, TIME), natural(_part(parts, ID))) for parts in fields]
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
