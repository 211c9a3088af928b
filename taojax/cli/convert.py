"""`taojax convert`: public data sets and users' own folders as data folders."""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from taojax.cli.common import check_seed, say
from taojax.cli.convert_flags import (
    ComplexUrban,
    Convert,
    Files,
    Folder,
    Formats,
    Kri,
    Mulran,
    Pair,
    Robotcar,
    Self,
    Sthereo,
    Vivid,
)
from taojax.errors import InputError, UsageError

if TYPE_CHECKING:
    from taojax.datasets.convert import Choices, Motion
    from taojax.datasets.files import MotionKind
    from taojax.datasets.folder import Session
    from taojax.datasets.reading import Reading
    from taojax.datasets.sessions import Matching

    Sessions = tuple[Session, Session | None]

__all__ = ["Convert", "make", "make_self", "motion_of", "reading_of", "run"]

Data = Pair | Folder | Files


def run(args: Convert) -> None:
    """Make the data folder and say what comes next."""
    out = args.data.out
    if isinstance(args.data, Self):
        make_self(args.data)
        say(f"wrote {out}; next: taojax audit {quote(str(out))}")
        return
    make(args.data)
    say(f"wrote {out}; next: taojax inspect {quote(str(out))}")


def make_self(data: Self) -> None:
    """Make the data folder of one drive and say what was found."""
    from taojax.cli.layout import check_folder
    from taojax.datasets.own_map import GAP_M, write_own_map

    check_seed(data.seed)
    gap_m = GAP_M if data.gap_m is None else data.gap_m
    if not gap_m > 0:
        raise UsageError(f"--gap-m {data.gap_m} must be positive")
    check_folder(data.folder)
    for note in write_own_map(data.folder, data.out, gap_m, seed=data.seed):
        say(f"note: {note}")


def make(data: Data) -> None:
    """Read the sessions, make the data folder and say what was found.

    Args:
        data: the flags of one data set.
    """
    _check_flags(data)
    _check_places(data)
    if isinstance(data, Files) and (data.map_poses is None or _is_map_alone(data)):
        _add(data)
        return
    read = partial(_READ[type(data)], data, _matching(data))
    # Whether a plain folder is one is asked before what its frames look like.
    plain = read() if isinstance(data, Folder) else None
    choices = _choices(data)
    from taojax.datasets.convert import make_folder

    sessions = plain or read()
    made = make_folder(data.out, sessions, choices)
    for side, n, way_m in zip(("map", "query"), made.n_frames, made.way_m, strict=True):
        say(f"{side}: {n:,} frames, {way_m:,.0f} m of way")
    for note in made.notes:
        say(f"note: {note}")


def _add(data: Files) -> None:
    """Make a folder of a map alone, or add a query or the truth to one that is there."""
    from taojax.datasets import edit
    from taojax.datasets.plain import read_session

    reading = reading_of(data, is_motion=False)
    out, truth = data.out, data.query_poses
    if data.map_poses is not None and data.map_descriptors is not None:
        mapped = read_session(data.map_poses, data.map_poses.parent, reading)
        added = edit.make_map(out, mapped, data.map_descriptors)
    elif truth is not None and (out / "query/odometry.csv").exists() and data.odometry is None:
        added = edit.add_truth(out, truth, reading, gate_s=data.gate_s, offset_s=data.clock_offset)
    else:
        # Odometry over odometry is refused before its views are asked for.
        query = None if truth is None else read_session(truth, truth.parent, reading)
        added = edit.add_query(out, query, _choices(data))
    say(f"added {', '.join(added.names)}")
    for note in added.notes:
        say(f"note: {note}")


def _is_map_alone(data: Files) -> bool:
    return data.odometry is None and data.query_poses is None and data.query_descriptors is None


def _check_flags(data: Data) -> None:
    """Refuse flags that contradict each other or ask for nothing."""
    if data.simulate_descriptors and (data.map_descriptors or data.query_descriptors):
        given = "--map-descriptors and --query-descriptors"
        raise UsageError(f"--simulate-descriptors replaces {given}; drop one")
    may_lack = isinstance(data, Files) and data.map_poses is None
    if data.query_descriptors is not None and data.map_descriptors is None and not may_lack:
        raise UsageError("--query-descriptors goes with --map-descriptors")
    if data.spacing_m is not None and (data.map_frames or data.query_frames):
        raise UsageError("--spacing-m chooses frames by metres; drop it or the numbers of frames")
    for name in ("map_frames", "query_frames", "spacing_m", "gate_s"):
        value = getattr(data, name)
        if value is not None and not value > 0:
            raise UsageError(f"--{name.replace('_', '-')} {value} must be positive")
    if not 0 <= data.least_matched <= 1:
        raise UsageError(f"--least-matched {data.least_matched} is a share from 0 to 1")
    check_seed(data.seed)
    _check_motion_flags(data)


def _check_motion_flags(data: Data) -> None:
    """Refuse flags of odometry where none is given."""
    own = ("plane", "time_unit", "quaternion", "angles", "columns", "decimal", "clock_offset")
    own = () if isinstance(data, Files) else own
    for name in ("odometry_kind", "times", "topic", *own):
        if data.odometry is None and getattr(data, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} goes with --odometry")


def _check_places(data: Data) -> None:
    """Refuse files and folders that are not given or not there, before questions on the rest."""
    if isinstance(data, Files):
        _check_parts(data)
    flags = ("map", "query", "folder", "map_poses", "query_poses", "odometry", "times",
             "map_descriptors", "query_descriptors")  # fmt: skip
    for name in flags:
        path = getattr(data, name, None)
        if path is not None and not path.exists():
            is_flag = name not in ("query", "folder") and not (
                name == "map" and isinstance(data, Pair)
            )
            label = f" (--{name.replace('_', '-')})" if is_flag else ""
            raise InputError(f"{path}: no such file or folder{label}; point at another one")


def _check_parts(data: Files) -> None:
    """Refuse single files that make no folder together, and none that lies in OUT already."""
    has_map = (data.out / "map/poses.csv").exists()
    if data.map_poses is None and not has_map:
        held = "holds no map/poses.csv" if data.out.exists() else "is not there yet"
        raise UsageError(f"{data.out} {held}: give --map-poses")
    if data.map_poses is not None and has_map:
        fix = "leave --map-poses away to add to this folder, or choose a new one"
        raise InputError(f"{data.out}: exists already and holds map/poses.csv; {fix}")
    if _is_map_alone(data) and (data.map_poses is None or data.map_descriptors is None):
        raise UsageError("what is known of the query? Give --odometry, --query-poses or both")


def reading_of(flags: Formats, *, is_motion: bool) -> "Reading":
    """Return what the user says of files of poses or, with its own flags, of the odometry."""
    from taojax.datasets.reading import Reading

    columns = tuple(name.strip() for name in (flags.columns or "").split(",") if name.strip())
    return Reading(
        times=flags.times if is_motion else None,
        topic=flags.topic if is_motion else None,
        plane=flags.plane,
        time_unit=flags.time_unit,
        quaternion=flags.quaternion,
        angles=flags.angles,
        columns=columns,
        decimal=flags.decimal,
        is_shared=not is_motion,
    )


def _motion(data: Data) -> "Motion | None":
    """Return the odometry that was asked for, else the data set's own, if any."""
    from taojax.datasets.convert import recorded_odometry

    if data.odometry is not None:
        return motion_of(data.odometry, data)
    own = {Folder: "folder", Files: None}.get(type(data), "query")
    return None if own is None else recorded_odometry(getattr(data, own))


def motion_of(path: Path, flags: Formats) -> "Motion":
    """Return the odometry of a file, of the kind that the flags or the file say.

    Raises:
        InputError: text that does not say what it holds.
        UsageError: an array, of which only the user can say it.
    """
    from taojax.datasets.convert import Motion

    reading = reading_of(flags, is_motion=True)
    if (kind := flags.odometry_kind or _kind_of(path, reading)) is None:
        refusal = UsageError if path.suffix.lower() == ".npy" else InputError
        raise refusal(
            f"{path} does not say what it holds; add --odometry-kind: steps (motion from"
            " frame to frame), poses (where odometry believes to be), bag, or the program that"
            " wrote it; or --columns with the names of its columns"
        )
    return Motion(path, kind, reading, flags.clock_offset)


def _kind_of(path: Path, reading: "Reading") -> "MotionKind | None":
    from taojax.datasets.files import kind_of

    return kind_of(path, reading)


def _views(data: Data) -> "tuple[Path, Path | None] | None":
    """Return the files of descriptors or lists; None: they are simulated."""
    from taojax.datasets.convert import recorded_views

    if data.simulate_descriptors:
        return None
    if data.map_descriptors is not None:
        return data.map_descriptors, data.query_descriptors
    held = data.out / "map/descriptors.npy"
    if isinstance(data, Files) and data.query_descriptors is not None and held.is_file():
        return held, data.query_descriptors
    own = recorded_views(data.folder, data.map) if isinstance(data, Folder) else None
    if own is None:
        looked = ""
        if isinstance(data, Folder):
            looked = f"{data.folder} holds no map/descriptors.npy with query/descriptors.npy,"
            looked += " database_descriptors.npy with queries_descriptors.npy, or"
            looked += " query/retrievals.npz; "
            if data.map is not None:
                looked = f"{data.map} and {data.folder} hold no descriptors.npy each; "
        raise UsageError(
            f"what do the frames look like? {looked}give --map-descriptors and"
            " --query-descriptors, or --simulate-descriptors"
        )
    return own


def _choices(data: Data) -> "Choices":
    views = _views(data)
    from taojax.datasets.convert import N_MAP, N_QUERY, Choices

    # The rows of plain files are what its owner chose already.
    usual = (N_MAP, N_QUERY) if isinstance(data, Pair) else (None, None)
    return Choices(
        n_map=data.map_frames or usual[0],
        n_query=data.query_frames or usual[1],
        spacing_m=data.spacing_m,
        gate_s=data.gate_s,
        motion=_motion(data),
        views=views,
        views_order=data.descriptors_order,
        seed=data.seed,
    )


def _matching(data: Data) -> "Matching":
    from taojax.datasets.sessions import Matching

    return Matching(data.gate_s, data.pose == "interpolated", data.least_matched)


def _sthereo(data: Sthereo, matching: "Matching") -> "Sessions":
    from taojax.datasets.public_sets import check_sensors, read_sthereo

    is_local = data.poses == "local"
    mapped, query = (
        read_sthereo(source, camera=data.camera, is_local=is_local, matching=matching)
        for source in (data.map, data.query)
    )
    for source in (data.map, data.query):
        if sound := check_sensors(source):
            say(f"{source}: checked against their specs: {', '.join(sound)}")
    return mapped, query


def _kri(data: Kri, matching: "Matching") -> "Sessions":
    from taojax.datasets.convert import N_MAP
    from taojax.datasets.public_sets import read_kri

    read = partial(read_kri, camera=data.camera, variant=data.variant, route_m=data.route_m)
    # The unit is a row of the map that is made, not of the sequence it is thinned from.
    n_rows = min(len(read(data.map).frames), data.map_frames or N_MAP)
    return read(data.map, n_rows=n_rows), read(data.query, n_rows=n_rows)


def _mulran(data: Mulran, matching: "Matching") -> "Sessions":
    from taojax.datasets.public_sets import read_mulran

    read = partial(read_mulran, frames=data.frames, matching=matching)
    return read(data.map), read(data.query)


def _complex_urban(data: ComplexUrban, matching: "Matching") -> "Sessions":
    from taojax.datasets.public_sets import read_complex_urban

    read = partial(read_complex_urban, frames=data.frames, matching=matching)
    return read(data.map), read(data.query)


def _robotcar(data: Robotcar, matching: "Matching") -> "Sessions":
    from taojax.datasets.public_sets import read_robotcar

    read = partial(read_robotcar, camera=data.camera, gps=data.gps, matching=matching)
    return read(data.map), read(data.query)


def _vivid(data: Vivid, matching: "Matching") -> "Sessions":
    from taojax.datasets.public_sets import read_vivid

    read = partial(read_vivid, images=data.frames, matching=matching)
    return read(data.map), read(data.query)


def _folder(data: Folder, matching: "Matching") -> "Sessions":
    from taojax.datasets.plain import read_plain, read_traverse
    from taojax.files.dataset_info import read_about

    if data.map is None and (data.folder / "poses.csv").is_file():
        raise UsageError(f"{data.folder} is one drive: name the folder of the map drive with --map")
    if data.map is None:
        mapped, query = read_plain(data.folder)
    else:
        mapped, query = read_traverse(data.map), read_traverse(data.folder)
    notes = read_about(data.folder).notes if data.folder.is_dir() else ()
    if query is None:
        return dataclasses.replace(mapped, notes=(*mapped.notes, *notes)), None
    return mapped, dataclasses.replace(query, notes=(*query.notes, *notes))


def _files(data: Files, matching: "Matching") -> "Sessions":
    from taojax.datasets.plain import read_files

    if data.map_poses is None:
        raise UsageError("give --map-poses")
    return read_files(data.map_poses, data.query_poses, reading_of(data, is_motion=False))


_READ: dict[type, Callable[[Any, "Matching"], "Sessions"]] = {
    Sthereo: _sthereo,
    Kri: _kri,
    Mulran: _mulran,
    ComplexUrban: _complex_urban,
    Robotcar: _robotcar,
    Vivid: _vivid,
    Folder: _folder,
    Files: _files,
}
