"""From two sessions of any data set to one data folder: frames, odometry, views."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from taojax.datasets.descriptors import read_views, view_notes
from taojax.datasets.files import NUMBERED, Drive, MotionKind, read_motion
from taojax.datasets.folder import FAR_M, Descriptors, Lists, Session, write_folder
from taojax.datasets.odometry import odometry_at, simulated
from taojax.datasets.simulate import WorldConfig, describe_routes
from taojax.datasets.trajectories import Plane
from taojax.datasets.trajectory import Trajectory, driven_m, every, spaced
from taojax.errors import InputError
from taojax.specs import fail

__all__ = [
    "Choices",
    "Made",
    "Motion",
    "make_folder",
    "recorded_odometry",
    "recorded_views",
]

N_MAP, N_QUERY = 2000, 1000
"""Frames of the paper's protocol."""

LEAST_FRAMES = 3
"""A data folder has at least so many frames on each side."""

WHEELS = "sensor_data/encoder.csv", "sensor_data/fog.csv", "calibration/EncoderParameter.txt"


@dataclass(frozen=True)
class Motion:
    """Where the odometry of the query comes from."""

    path: Path
    """File of a trajectory, of steps or of wheel counts."""

    kind: MotionKind
    """Its format, as `read_motion` names it."""

    times: Path | None = None
    """Stamps of a format that has none."""

    plane: Plane | None = None
    """Which two axes are the ground, in a format of 3-D poses."""

    topic: str | None = None
    """Of a bag."""


@dataclass(frozen=True)
class Choices:
    """What a user may choose of a data folder."""

    n_map: int | None = N_MAP
    """Map frames, evenly by number; None keeps all."""

    n_query: int | None = N_QUERY
    """Query frames, evenly by number; None keeps all."""

    spacing_m: float | None = None
    """Keep a frame every so many metres of way instead, on both sides; standing counts once."""

    gate_s: float = 0.5
    """Odometry farther than this from a frame in time does not know it, seconds."""

    motion: Motion | None = None
    """None: odometry is simulated from the poses."""

    views: tuple[Path, Path | None] | None = None
    """Descriptors of map and query, or one file that answers for both; None: simulated."""

    seed: int = 0
    """Of everything that is simulated."""


class Made(NamedTuple):
    """What a data folder came to be."""

    n_frames: tuple[int, int]
    """Map and query frames."""

    way_m: tuple[float, float]
    """Metres driven by each."""

    notes: tuple[str, ...]
    """As written to about.toml."""


def recorded_odometry(folder: Path) -> Motion | None:
    """Return the odometry that lies in a sequence folder, None where there is none.

    Args:
        folder: of a RobotCar traverse, a Complex Urban sequence or a drive of one's own.
    """
    files: dict[str, MotionKind] = {
        "vo/vo.csv": "robotcar-vo",
        "odometry.csv": "steps",
        "query/odometry.csv": "steps",
    }
    for name, kind in files.items():
        if (folder / name).is_file():
            return Motion(folder / name, kind)
    return Motion(folder, "wheels") if all((folder / name).is_file() for name in WHEELS) else None


def recorded_views(folder: Path, mapped: Path | None = None) -> tuple[Path, Path | None] | None:
    """Return the descriptors or lists that lie in a plain folder, None where there are none.

    Args:
        folder: holds both sides, as VPR-methods-evaluation or a data folder has them.
        mapped: the folder of the map drive, where `folder` is one of the query drive alone.
    """
    pairs: list[tuple[Path, Path | None]] = [
        (folder / "database_descriptors.npy", folder / "queries_descriptors.npy"),
        (folder / "map/descriptors.npy", folder / "query/descriptors.npy"),
        (folder / "query/retrievals.npz", None),
    ]
    if mapped is not None:
        pairs = [(mapped / "descriptors.npy", folder / "descriptors.npy")]
    return next((pair for pair in pairs if all(p is None or p.is_file() for p in pair)), None)


def make_folder(out: Path, given: tuple[Session, Session | None], choices: Choices) -> Made:
    """Write the data folder of a map session and a query session.

    Args:
        out: the folder to make; it appears whole or not at all.
        given: map and query, in one frame; without a query session its frames are the rows of the
            odometry, and nobody knows the true poses.
        choices: which frames stay, and where odometry and views come from.

    Returns:
        What was made.

    Raises:
        InputError: `out` is taken, a side has fewer than three frames, the sessions lie apart, or
            odometry or views do not fit.
    """
    if out.exists():
        raise InputError(f"{out}: exists already; choose a new folder")
    drive = None if choices.motion is None else _read(choices.motion)
    sessions = given[0], given[1] or _only_driven(drive)
    kept = (
        _chosen(sessions[0], choices.n_map, choices.spacing_m, "map"),
        _chosen(sessions[1], choices.n_query, choices.spacing_m, "query"),
    )
    mapped, query = (
        Trajectory(session.poses.t_s[rows], session.poses.xyt[rows])
        for session, rows in zip(sessions, kept, strict=True)
    )
    # Progress along a route is the truth where no session has poses.
    is_known = sessions[1].has_pose or not sessions[0].has_pose
    if is_known:
        _check_one_place(mapped, query)
    elif choices.motion is None or choices.views is None:
        raise InputError(
            f"{out}: nothing can be simulated for a query without poses; give --odometry and views"
        )
    odometry, moved = _odometry(sessions[1], query, choices, drive)
    views, seen = _views(sessions, kept, (mapped, query), choices)
    notes = (*_notes(sessions, kept), *moved, *seen)
    truth = query.xyt if is_known else None
    write_folder(out, mapped, (query.t_s, odometry), views, truth=truth, notes=notes)
    way_m = tuple(float(driven_m(drive.xyt)[-1]) for drive in (mapped, query))
    return Made((len(mapped.t_s), len(query.t_s)), (way_m[0], way_m[1]), notes)


def _chosen(
    session: Session, n_frames: int | None, spacing_m: float | None, side: str
) -> Int[np.ndarray, " k"]:
    n = len(session.frames)
    rows = (
        spaced(session.poses.xyt, spacing_m)
        if spacing_m is not None and n
        else every(n, n if n_frames is None else n_frames)
    )
    if len(rows) < LEAST_FRAMES:
        what = f"{len(rows)} of the {n} {side} frames stay, at least {LEAST_FRAMES} are needed"
        raise InputError(f"{what}; give more frames or a smaller --spacing-m")
    return rows


def _check_one_place(mapped: Trajectory, query: Trajectory) -> None:
    origin = mapped.xyt[0, :2]
    for side, drive in (("map", mapped), ("query", query)):
        far_m = np.hypot(*(drive.xyt[:, :2] - origin[None]).T)
        if far_m.max() > FAR_M:
            raise InputError(
                f"a {side} frame lies {far_m.max() / 1e3:.0f} km from the first map frame; give two"
                " sessions of one place and one UTM zone"
            )


def _read(motion: Motion) -> Drive:
    return read_motion(
        motion.path, motion.kind, times=motion.times, plane=motion.plane, topic=motion.topic
    )


def _only_driven(drive: Drive | None) -> Session:
    """Return the session of a query of which odometry alone is known."""
    if drive is None:
        raise InputError(
            "the query has neither poses nor odometry; give --query-poses, --odometry or both"
        )
    names = tuple(f"{row:06d}" for row in range(len(drive.poses.t_s)))
    return Session(names, drive.poses, False, drive.notes)


def _odometry(
    session: Session, query: Trajectory, choices: Choices, drive: Drive | None
) -> tuple[Float[np.ndarray, "t 3"], tuple[str, ...]]:
    if (motion := choices.motion) is None or drive is None:
        steps, said = simulated(query.xyt, choices.seed)
        along = "" if session.has_pose else ", along the route progress"
        return steps, (f"{said}{along}",)
    source = _on_the_clock_of(session, drive, motion.path)
    steps, said = odometry_at(source, query.t_s, choices.gate_s)
    named = f"odometry from {motion.path.name} ({motion.kind})"
    return steps, (named,) if said is None else (named, said)


def _on_the_clock_of(session: Session, drive: Drive, path: Path) -> Trajectory:
    """Pair odometry and frames row by row where one of them has no stamps."""
    n_frames, n_rows = len(session.frames), len(drive.poses.t_s)
    if drive.has_stamps and NUMBERED not in session.notes:
        return drive.poses
    if n_frames == n_rows:
        return Trajectory(session.poses.t_s, drive.poses.xyt)
    if path.suffix.lower() == ".npy" and not drive.has_stamps:
        what = f"{n_rows} rows without stamps, but the query has {n_frames} frames"
        raise fail(path, what, "store one row per frame, or stamps in a first column")
    return drive.poses


def _views(
    sessions: tuple[Session, Session],
    kept: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " t"]],
    drives: tuple[Trajectory, Trajectory],
    choices: Choices,
) -> tuple[Descriptors | Lists, tuple[str, ...]]:
    if choices.views is not None:
        whole = [_with_all(*side) for side in zip(sessions, kept, strict=True)]
        views = read_views(*choices.views, (whole[0][0], whole[1][0]), (whole[0][1], whole[1][1]))
        return views, view_notes(*choices.views)
    # The simulation measures distances: a local origin keeps them exact.
    origin = np.array([[*drives[0].xyt[0, :2], 0.0]])
    rows = [np.column_stack([drive.t_s, drive.xyt - origin]) for drive in drives]
    seen = describe_routes(rows[0], rows[1], WorldConfig(), choices.seed)
    said = f"simulated descriptors, seed {choices.seed}: what the frames look like is not recorded"
    return Descriptors(*seen), (said,)


def _with_all(
    session: Session, kept: Int[np.ndarray, " k"]
) -> tuple[Session, Int[np.ndarray, " k"]]:
    """Return a session of all images, also those without a pose, and the kept ones' rows in it."""
    if len(session.listed) in (0, len(session.frames)):
        return session, kept
    row_of = {name: row for row, name in enumerate(session.listed)}
    rows = np.array([row_of[session.frames[row]] for row in kept], np.int64)
    return Session(session.listed, session.poses, session.has_pose), rows


def _notes(
    sessions: tuple[Session, Session],
    kept: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " t"]],
) -> tuple[str, ...]:
    """Return what the sessions say, each once, and how they were thinned."""
    said = []
    for side, session, rows in zip(("map", "query"), sessions, kept, strict=True):
        said += [f"{side}: {note}" for note in session.notes]
        if len(rows) < len(session.frames):
            said.append(f"{side}: {len(rows):,} of {len(session.frames):,} frames kept")
    return tuple(dict.fromkeys(said))
