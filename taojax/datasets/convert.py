"""From two sessions of any data set to one data folder: frames, odometry, views."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from taojax.datasets.clocks import offset_of
from taojax.datasets.descriptors import goes_by_name, read_views, view_notes
from taojax.datasets.files import NUMBERED, MotionKind, read_motion
from taojax.datasets.folder import FAR_M, Descriptors, Lists, Session, write_folder
from taojax.datasets.odometry import LEAST_COVERED, odometry_at, simulated
from taojax.datasets.plain import session_of
from taojax.datasets.reading import PLAIN, Drive, Reading
from taojax.datasets.simulate import WorldConfig, describe_routes
from taojax.datasets.trajectory import Trajectory, driven_m, every, motions, pose_at, spaced
from taojax.errors import InputError
from taojax.files.specs import fail

__all__ = [
    "Assembled",
    "Choices",
    "Made",
    "Motion",
    "assemble",
    "make_folder",
    "on_the_clock_of",
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

    reading: Reading = PLAIN
    """What the user says of the file."""

    offset_s: float | None = None
    """To add to its stamps [s]; None: found where it can be found."""


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

    views_order: Literal["rows", "time"] | None = None
    """What rows of descriptors follow where those of the poses came late; None: refused there."""

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
    made = assemble(out, given, choices)
    write_folder(
        out, made.mapped, (made.query.t_s, made.odometry), made.views, truth=made.truth,
        notes=made.notes,
    )  # fmt: skip
    way_m = tuple(float(driven_m(drive.xyt)[-1]) for drive in (made.mapped, made.query))
    return Made((len(made.mapped.t_s), len(made.query.t_s)), (way_m[0], way_m[1]), made.notes)


class Assembled(NamedTuple):
    """All that goes into a data folder."""

    mapped: Trajectory
    query: Trajectory
    """Where odometry alone is known, what it believes."""

    odometry: Float[np.ndarray, "t 3"]
    views: Descriptors | Lists
    truth: Float[np.ndarray, "t 3"] | None
    notes: tuple[str, ...]


def assemble(out: Path, given: tuple[Session, Session | None], choices: Choices) -> Assembled:
    """Choose frames, read odometry off its file and bring views to the frames.

    Args:
        out: the data folder, for messages.
        given: as `make_folder` has it.
        choices: the same.

    Raises:
        InputError: as `make_folder`, but for `out`.
    """
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
    if given[1] is not None and given[1].has_pose and drive is not None:
        odometry, turned = _of_one_hand(odometry, query.xyt, drive, choices)
        moved += turned
    views, seen = _views(sessions, kept, (mapped, query), choices)
    own = () if given[1] is None or drive is None else drive.notes
    own = tuple(note for note in own if note != NUMBERED)
    notes = tuple(dict.fromkeys((*_notes(sessions, kept), *own, *moved, *views.notes, *seen)))
    return Assembled(mapped, query, odometry, views, query.xyt if is_known else None, notes)


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
    return read_motion(motion.path, motion.kind, motion.reading)


def _only_driven(drive: Drive | None) -> Session:
    """Return the session of a query of which odometry alone is known."""
    if drive is None:
        raise InputError(
            "the query has neither poses nor odometry; give --query-poses, --odometry or both"
        )
    return session_of(drive, has_pose=False)


def _odometry(
    session: Session, query: Trajectory, choices: Choices, drive: Drive | None
) -> tuple[Float[np.ndarray, "t 3"], tuple[str, ...]]:
    if (motion := choices.motion) is None or drive is None:
        steps, said = simulated(query.xyt, choices.seed)
        along = "" if session.has_pose else ", along the route progress"
        return steps, (f"{said}{along}",)
    source, paired = on_the_clock_of(
        session, drive, motion.path, gate_s=choices.gate_s, offset_s=motion.offset_s
    )
    steps, said = odometry_at(source, query.t_s, choices.gate_s, str(motion.path))
    named = f"odometry from {motion.path.name} ({motion.kind})"
    return steps, (named, *paired, *(() if said is None else (said,)))


def on_the_clock_of(
    session: Session, drive: Drive, path: Path, *, gate_s: float, offset_s: float | None = None
) -> tuple[Trajectory, tuple[str, ...]]:
    """Bring a drive onto the clock of a session's frames.

    Args:
        session: the frames.
        drive: poses on any clock, or without stamps.
        path: where the drive comes from.
        gate_s: how far a pose may be from a frame, seconds.
        offset_s: what the user wants added to the drive's stamps; None finds it.

    Returns:
        Poses on the clock of the frames, and what was assumed.

    Raises:
        InputError: no stamps and other counts.
    """
    poses, frames_s = drive.poses, session.poses.t_s
    n_rows, is_numbered = len(poses.t_s), NUMBERED in session.notes
    if offset_s is not None and drive.has_stamps:
        shifted = Trajectory(poses.t_s + offset_s, poses.xyt)
        return shifted, (f"{path.name}: {offset_s:.6f} s are added to its stamps, as you say",)
    if drive.has_stamps and not is_numbered:
        return _shifted(frames_s, drive, path, gate_s)
    without = "the query frames have" if drive.has_stamps else f"{path.name} has"
    rows = _paired_rows(session, n_rows)
    if rows is not None:
        said = f"{path.name}: paired with the query frames row by row, as {without} no time stamps"
        return Trajectory(frames_s, poses.xyt[rows]), (said,)
    has_gaps = bool((np.diff(poses.t_s) != 1).any())
    if not drive.has_stamps and is_numbered and has_gaps:
        said = f"{path.name}: its row numbers are those of the query frames"
        return poses, (said,)
    what = f"{n_rows} rows {'with' if drive.has_stamps else 'without'} stamps, but the query has"
    what += f" {len(frames_s)} frames{' without' if is_numbered else ''}"
    raise fail(path, what, "store one row per frame, or stamps in a first column of both")


def _paired_rows(session: Session, n_rows: int) -> Int[np.ndarray, " t"] | None:
    """Return the row of each frame in a file of as many rows as there are frames, else None."""
    if n_rows == len(session.frames):
        return np.arange(n_rows)
    if n_rows == len(session.listed):
        row_of = {name: row for row, name in enumerate(session.listed)}
        return np.array([row_of[name] for name in session.frames])
    return None


def _shifted(
    frames_s: np.ndarray, drive: Drive, path: Path, gate_s: float
) -> tuple[Trajectory, tuple[str, ...]]:
    """Shift a clock that covers hardly any frame, where counts and intervals agree."""
    poses = drive.poses
    if pose_at(poses, frames_s, gate_s)[1].mean() >= LEAST_COVERED:
        return poses, ()
    offset = offset_of(poses.t_s, frames_s, gate_s)
    if offset is None:
        return poses, ()
    said = (
        f"{path.name}: its clock is {abs(offset):.6f} s {'behind' if offset > 0 else 'ahead of'}"
        " that of the frames, found by equal counts and intervals, and is set right"
    )
    return Trajectory(poses.t_s + offset, poses.xyt), (said,)


MIRRORED = -0.7
"""Turns that go so much against the true ones are turns of a mirrored frame."""


def _of_one_hand(
    odometry: Float[np.ndarray, "t 3"],
    truth: Float[np.ndarray, "t 3"],
    drive: Drive,
    choices: Choices,
) -> tuple[Float[np.ndarray, "t 3"], tuple[str, ...]]:
    """Hold left and right of the odometry against the true poses.

    Returns:
        The odometry, mirrored where its format leaves open which side is left; else as it is, with
        a warning where it turns the other way.
    """
    own, true = odometry[1:, 2], motions(truth)[1:, 2]
    size = float(np.sqrt((own**2).sum() * (true**2).sum()))
    if size < 0.01 or float((own * true).sum()) > MIRRORED * size or choices.motion is None:
        return odometry, ()
    name = choices.motion.path.name
    if not drive.has_handedness:
        said = "it turns against the true poses, so that the camera's y is up; else add --plane xz"
        return odometry * np.array([[1.0, -1.0, -1.0]]), (f"{name}: laid flat as xz-up: {said}",)
    said = "turns left where the true poses turn right; check the sign of yaw and of y"
    return odometry, (f"{name}: warning: {said}",)


def _views(
    sessions: tuple[Session, Session],
    kept: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " t"]],
    drives: tuple[Trajectory, Trajectory],
    choices: Choices,
) -> tuple[Descriptors | Lists, tuple[str, ...]]:
    if choices.views is not None:
        files = choices.views[0], choices.views[1] or choices.views[0]
        whole = [
            _with_all(*side, choices.views_order)
            for side in zip(files, sessions, kept, strict=True)
        ]
        views = read_views(*choices.views, (whole[0][0], whole[1][0]), (whole[0][1], whole[1][1]))
        return views, view_notes(*choices.views)
    # The simulation measures distances: a local origin keeps them exact.
    origin = np.array([[*drives[0].xyt[0, :2], 0.0]])
    rows = [np.column_stack([drive.t_s, drive.xyt - origin]) for drive in drives]
    seen = describe_routes(rows[0], rows[1], WorldConfig(), choices.seed)
    said = f"simulated descriptors, seed {choices.seed}: what the frames look like is not recorded"
    return Descriptors(*seen), (said,)


def _with_all(
    path: Path, session: Session, kept: Int[np.ndarray, " k"], order: str | None
) -> tuple[Session, Int[np.ndarray, " k"]]:
    """Return a session of all images, also those without a pose, and the kept ones' rows in it."""
    if not session.listed or session.listed == session.frames:
        return session, kept
    row_of = {name: row for row, name in enumerate(session.listed)}
    place = np.array([row_of[name] for name in session.frames], np.int64)
    if (late := np.flatnonzero(np.diff(place) < 0)).size and not goes_by_name(path):
        if order == "time":
            return Session(session.frames, session.poses, session.has_pose), kept
        if order is None:
            at = int(late[0])
            what = (
                f"data rows {place[at + 1] + 1} and {place[at] + 1} of its poses came late: its"
                " rows may follow those, or the time"
            )
            raise fail(path, what, "add --descriptors-order rows or --descriptors-order time")
    return Session(session.listed, session.poses, session.has_pose), place[kept]


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
