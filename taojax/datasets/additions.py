"""What is added to a data folder later: the query to a map, the truth to a query."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taojax.about import read_about
from taojax.datasets.convert import Choices, assemble, on_the_clock_of
from taojax.datasets.descriptors import read_side
from taojax.datasets.files import NUMBERED, read_poses
from taojax.datasets.folder import (
    FAR_M,
    Lists,
    Session,
    about_text,
    map_parts,
    origin_of,
    stamped_text,
    write_parts,
)  # fmt: skip
from taojax.datasets.plain import session_of
from taojax.datasets.reading import PLAIN, Reading
from taojax.datasets.trajectory import Trajectory, pose_at
from taojax.errors import InputError
from taojax.specs import fail
from taojax.tables import MOTION, POSE, read_table

__all__ = ["TRUTH", "Added", "add_query", "add_truth", "make_map", "truth_text"]

MAP, QUERY, TRUTH = "map/poses.csv", "query/odometry.csv", "truth/query_poses.csv"


class Added(NamedTuple):
    """What was written."""

    names: tuple[str, ...]
    notes: tuple[str, ...]


def make_map(out: Path, mapped: Session, views: Path) -> Added:
    """Make a data folder that holds the map alone, for a query that comes later.

    Args:
        out: the folder to make.
        mapped: the map.
        views: its descriptors.

    Raises:
        InputError: the folder is there, or the descriptors do not fit.
    """
    if out.exists():
        raise InputError(f"{out}: exists already; choose a new folder")
    rows, said = read_side(views, mapped.frames, np.arange(len(mapped.frames)))
    text, moved = map_parts(mapped.poses)
    notes = (*(f"map: {note}" for note in mapped.notes), *said, *moved)
    texts = {MAP: text, "about.toml": about_text(notes)}
    return _write(out, texts, {"map/descriptors.npy": rows}, notes)


def add_query(out: Path, query: Session | None, choices: Choices) -> Added:
    """Add a query to a folder that holds a map.

    Args:
        out: the folder.
        query: its true poses; None where odometry alone is known.
        choices: odometry, and `views`: the descriptors of the map that lie in the folder and those
            of the query, or lists.

    Raises:
        InputError: the folder has a query already, or something does not fit the map.
    """
    _check_new(out, QUERY)
    drive = read_poses(out / MAP)
    old, origin = read_about(out).notes, origin_of(read_about(out).notes)
    is_far = query is not None and np.abs(query.poses.xyt[:, :2]).max() > FAR_M
    if query is not None and (origin.any() or not is_far):
        poses = Trajectory(query.poses.t_s, query.poses.xyt - origin)
        query = Session(query.frames, poses, query.has_pose, query.notes, query.listed)
    mapped = _without_notes(session_of(drive))
    made = assemble(out, (mapped, query), choices)
    texts = {QUERY: stamped_text("query_odometry", MOTION, made.query.t_s, made.odometry)}
    if made.truth is not None and query is not None:
        texts[TRUTH] = stamped_text("query_poses", POSE, made.query.t_s, made.truth)
    texts["about.toml"] = about_text(dict.fromkeys([*old, *made.notes]))
    arrays: dict[str, np.ndarray | Lists] = {}
    if isinstance(made.views, Lists):
        arrays["query/retrievals.npz"] = made.views
    else:
        arrays["query/descriptors.npy"] = made.views.query_rows
        if not (out / "map/descriptors.npy").exists():
            arrays["map/descriptors.npy"] = made.views.map_rows
    return _write(out, texts, arrays, made.notes)


def add_truth(
    out: Path, poses: Path, reading: Reading = PLAIN, *, gate_s: float, offset_s: float | None
) -> Added:
    """Add true poses to a folder that holds a query.

    Args:
        out: the folder.
        poses: as `truth_text` has it, with all that follows.
        reading: what the user says of the file.
        gate_s: a frame farther than this from every true pose cannot be judged, seconds.
        offset_s: to add to the stamps of the true poses [s]; None: found where it can be found.

    Raises:
        InputError: there is a truth, a frame has no pose, or the poses lie elsewhere.
    """
    _check_new(out, TRUTH)
    text, more = truth_text(out, poses, reading, gate_s=gate_s, offset_s=offset_s)
    about = read_about(out)
    texts = {
        TRUTH: text,
        "about.toml": about_text(dict.fromkeys([*about.notes, *more]), about.own_gap_m),
    }
    return _write(out, texts, {}, more)


def truth_text(
    out: Path, poses: Path, reading: Reading = PLAIN, *, gate_s: float, offset_s: float | None
) -> tuple[str, tuple[str, ...]]:
    """Return truth/query_poses.csv for the query of a folder, and what was assumed of its poses.

    Args:
        out: the folder; nothing is written.
        poses: any file that `read_poses` takes, in the frame of the map before its origin was
            subtracted; stamped, or one row per frame.
        reading: what the user says of the file.
        gate_s: a frame farther than this from every true pose cannot be judged, seconds.
        offset_s: to add to the stamps of the true poses [s]; None: found where it can be found.

    Raises:
        InputError: a frame has no pose, or the poses lie elsewhere.
    """
    t_s = read_table(out / QUERY, "query_odometry")["t_s"]
    notes = read_about(out).notes
    frames = tuple(f"{row:06d}" for row in range(len(t_s)))
    own = (NUMBERED,) if np.array_equal(t_s, np.arange(len(t_s))) else ()
    session = Session(frames, Trajectory(t_s, np.zeros((len(t_s), 3))), False, own)
    drive = read_poses(poses, reading)
    source, said = on_the_clock_of(session, drive, poses, gate_s=gate_s, offset_s=offset_s)
    xyt, is_known = pose_at(source, t_s, gate_s)
    if not is_known.all():
        at = int(np.argmin(is_known))
        what = (
            f"knows {is_known.mean():.0%} of the {len(t_s)} query frames within {gate_s:g} s; frame"
            f" {at} (row {at + 2} of {out / QUERY}) is at {t_s[at]:.6f} s"
        )
        fix = "give the poses of the whole query, --clock-offset, or a wider --gate-s"
        raise fail(poses, what, fix)
    xyt = xyt - origin_of(notes)
    if (far := np.abs(xyt[:, :2]).max()) > FAR_M:
        what = f"lies {far / 1e3:.0f} km from the origin of {out / MAP}"
        raise fail(poses, what, "give true poses in the frame of the map")
    told = tuple(note for note in drive.notes if note != NUMBERED)
    more = tuple(f"truth: {note}" for note in (*told, *said))
    return stamped_text("query_poses", POSE, t_s, xyt), more


def _check_new(out: Path, name: str) -> None:
    if (out / name).exists():
        fix = "it is never overwritten: move it away, or choose a new folder"
        raise InputError(f"{out / name}: is there already; {fix}")


def _without_notes(session: Session) -> Session:
    """Return a session of which everything was said when the folder was made."""
    return Session(session.frames, session.poses, session.has_pose, (), session.listed)


def _write(
    out: Path,
    texts: Mapping[str, str],
    arrays: Mapping[str, np.ndarray | Lists],
    notes: tuple[str, ...],
) -> Added:
    write_parts(out, texts, arrays)
    names = tuple(name for name in (*texts, *arrays) if name != "about.toml")
    return Added(names, notes)
