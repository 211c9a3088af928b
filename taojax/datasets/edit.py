"""Changes to a data folder: deleted map stretches, and a query or a truth that is added later."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from taojax.datasets.convert import Choices, assemble, on_the_clock_of
from taojax.datasets.descriptors import read_side
from taojax.datasets.files import NUMBERED, read_poses
from taojax.datasets.folder import (  # fmt: skip
    FAR_M,
    Lists,
    Session,
    about_text,
    map_parts,
    origin_of,
    stamped_text,
    write_parts,
)
from taojax.datasets.plain import session_of
from taojax.datasets.reading import PLAIN, Reading
from taojax.datasets.simulate import World
from taojax.datasets.trajectory import Trajectory, pose_at
from taojax.errors import InputError
from taojax.files.dataset_info import read_about
from taojax.files.specs import fail
from taojax.files.tables import MOTION, POSE, read_table

__all__ = [
    "SCENARIOS",
    "TRUTH",
    "Added",
    "add_query",
    "add_truth",
    "delete_from_folder",
    "delete_map_segments",
    "kept_by_segments",
    "make_map",
    "scenario",
    "truth_text",
]

Segments = Sequence[tuple[float, float]]

CLEARANCE_M = 20.0
"""A query within 10 m of a deleted stretch is then more than 10 m from every frame that stays."""

SCENARIO_SEGMENTS_M: dict[str, tuple[tuple[float, float], ...]] = {
    "full": (),
    # Four short gaps, two of them on road that is driven twice.
    "default": ((200.0, 395.0), (1040.0, 1235.0), (2450.0, 2650.0), (2960.0, 3160.0)),
    # Two long gaps, each driven once: one in the first half of the queries, one in the second.
    "h3": ((1900.0, 2567.0), (2900.0, 3567.0)),
    # One long gap that is driven twice.
    "h4": ((180.0, 875.0),),
}

SCENARIOS = tuple(SCENARIO_SEGMENTS_M)
"""Names of the scenarios; `full` deletes nothing."""


def kept_by_segments(
    map_xy_m: Float[np.ndarray, "m 2"], segments: Segments, clearance_m: float = CLEARANCE_M
) -> Bool[np.ndarray, " m"]:
    """Tell which map frames stay when stretches of the drive are deleted.

    Args:
        map_xy_m: positions of the map frames in the order driven.
        segments: (start, end) in metres driven since the first map frame.
        clearance_m: frames this near to a deleted one, on any pass, are deleted too.

    Returns:
        True for the frames that stay.

    Raises:
        InputError: if a range is empty of map frames or no frame stays.
    """
    steps = np.diff(map_xy_m, axis=0)
    driven_m = np.concatenate([[0.0], np.cumsum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2))])
    stays = np.ones(len(map_xy_m), dtype=bool)
    for start_m, end_m in segments:
        within = (driven_m >= start_m) & (driven_m <= end_m)
        if not within.any():
            raise InputError(
                f"no map frame between {start_m:g} m and {end_m:g} m: the map is driven "
                f"{driven_m[-1]:.0f} m; choose a range inside it"
            )
        for center in map_xy_m[within]:
            away = map_xy_m - center[None, :]
            stays &= away[:, 0] ** 2 + away[:, 1] ** 2 > clearance_m**2
    if not stays.any():
        raise InputError("the segments delete the whole map: choose shorter ones")
    return stays


def delete_map_segments(
    world: World, segments: Segments, clearance_m: float = CLEARANCE_M
) -> World:
    """Delete stretches of a world's map on every pass.

    Args:
        world: the world; it stays as it is.
        segments: (start, end) in metres driven since the first map frame.
        clearance_m: frames this near to a deleted one are deleted too.

    Returns:
        A world whose map lacks those frames.

    Raises:
        InputError: if a range is empty of map frames or no frame stays.
    """
    stays = kept_by_segments(world.map_poses[:, 1:3], segments, clearance_m)
    return replace(
        world, map_poses=world.map_poses[stays], map_descriptors=world.map_descriptors[stays]
    )


def scenario(world: World, name: str) -> World:
    """Apply one of the named map-out scenarios.

    Args:
        world: a world with its full map.
        name: one of `SCENARIOS`.

    Returns:
        The world with the scenario's map.

    Raises:
        InputError: if there is no such scenario or the map is too short for it.
    """
    if name not in SCENARIO_SEGMENTS_M:
        raise InputError(f"no scenario {name!r}: choose one of {', '.join(SCENARIOS)}")
    return delete_map_segments(world, SCENARIO_SEGMENTS_M[name])


def delete_from_folder(source: Path, destination: Path, segments: Segments) -> None:
    """Write a copy of a data folder whose map lacks stretches.

    Args:
        source: a data folder with descriptors or with retrieval lists; it stays as it is.
        destination: the new folder.
        segments: (start, end) in metres driven since the first map frame.

    Raises:
        InputError: if the destination exists, a range is empty of map frames or no frame stays.
    """
    if destination.exists():
        raise InputError(f"{destination} exists: choose a new folder")
    header, *rows = (source / "map" / "poses.csv").read_text(encoding="utf-8").splitlines()
    rows = [row for row in rows if row.strip()]
    poses = np.array([row.split(",") for row in rows], dtype=np.float64)
    stays = kept_by_segments(poses[:, 1:3], segments)

    shutil.copytree(source, destination)
    kept_rows = [row for row, stay in zip(rows, stays, strict=True) if stay]
    with open(destination / "map" / "poses.csv", "w", newline="\n", encoding="utf-8") as file:
        file.write("\n".join([header, *kept_rows]) + "\n")
    descriptors = Path("map", "descriptors.npy")
    if (source / descriptors).exists():
        np.save(destination / descriptors, np.load(source / descriptors)[stays])
    retrievals = Path("query", "retrievals.npz")
    if (source / retrievals).exists():
        _renumber(source / retrievals, destination / retrievals, stays)


def _renumber(source: Path, destination: Path, stays: np.ndarray) -> None:
    """Rewrite retrieval lists for a shorter map, deleted candidates dropped."""
    with np.load(source) as lists:
        index, similarity = lists["index"], lists["similarity"]
    # The last entry answers for index -1, no candidate.
    number = np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1)
    index = number[index].astype(np.int32)
    similarity = np.where(index >= 0, similarity, 0.0).astype(np.float32)
    # A stable sort moves the gaps to the end and keeps best first.
    order = np.argsort(index < 0, axis=1, kind="stable")
    np.savez(
        destination,
        index=np.take_along_axis(index, order, axis=1),
        similarity=np.take_along_axis(similarity, order, axis=1),
    )


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
