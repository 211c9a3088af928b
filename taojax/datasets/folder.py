"""Sessions in, one data folder out: whole or not at all."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from taojax.datasets.trajectory import Trajectory
from taojax.errors import InputError
from taojax.files.atomic_write import locked_part
from taojax.files.tables import MOTION, POSE, table_text

__all__ = [
    "Descriptors", "Lists", "Session", "about_text", "map_parts", "origin_of", "stamped_text",
    "write_folder", "write_parts",
]  # fmt: skip

BLOCK_ROWS = 4096
"""Descriptors are copied so many at a time: a map may be larger than the memory."""

ORIGIN = re.compile(r"local origin: x = (\S+) m and y = (\S+) m ")
"""How the notes name what was subtracted."""

FAR_M = 1e5
"""Coordinates farther from the origin lose centimetres in float32."""


@dataclass(frozen=True)
class Session:
    """One drive through a place, as a data set tells it."""

    frames: tuple[str, ...]
    """(T,) names of the images, in time order; descriptors may be looked up by them."""

    poses: Trajectory
    """(T,) pose of every frame; of sessions of one data set in one frame (such as UTM)."""

    has_pose: bool = True
    """False: the data set holds no poses; `poses` is route progress along x."""

    notes: tuple[str, ...] = ()
    """Sentences that the report must repeat: frames left out, simulated parts, choices made."""

    listed: tuple[str, ...] = ()
    """Names of all images, where some have no pose: descriptors are made before anybody knows."""


@dataclass(frozen=True)
class Descriptors:
    """What frames look like; rows as in the sessions."""

    map_rows: Float[np.ndarray, "m d"]
    """(M, D), may be memory-mapped."""

    query_rows: Float[np.ndarray, "t d"]
    """(T, D), may be memory-mapped."""

    notes: tuple[str, ...] = ()
    """What was assumed of their files."""


@dataclass(frozen=True)
class Lists:
    """What a frontend answered; best first."""

    index: Int[np.ndarray, "t k"]
    """(T, K) rows of the map, -1 = no candidate."""

    similarity: Float[np.ndarray, "t k"]
    """(T, K) at most 1."""

    notes: tuple[str, ...] = ()
    """What was assumed of their file."""


def write_folder(  # noqa: PLR0913 - what a folder holds
    out: Path,
    mapped: Trajectory,
    query: tuple[Float[np.ndarray, " t"], Float[np.ndarray, "t 3"]],
    views: Descriptors | Lists,
    *,
    truth: Float[np.ndarray, "t 3"] | None,
    notes: Sequence[str],
    own_gap_m: float | None = None,
) -> None:
    """Write a data folder; it appears whole or not at all.

    Args:
        out: the folder to make.
        mapped: poses of the map frames, any origin; beyond `FAR_M` of it the first frame becomes
            the origin, and a note says so.
        query: stamps [s] and odometry (forward [m], left [m], yaw [rad]) of the query frames.
        views: descriptors or retrieval lists.
        truth: poses of the query frames in the frame of the map; None where nobody knows them.
        notes: go to about.toml, from there into the manifest and the report.
        own_gap_m: the drive is its own map, see `taojax.drive`; None = the map is another drive.

    Raises:
        InputError: `out` exists, cannot be written, or a value is not finite.
    """
    if out.exists():
        raise InputError(f"{out}: exists already; choose a new folder")
    # The truth of a drive that is its own map lies in a frame of its own.
    origin, moved = _origin(mapped.xyt, truth if own_gap_m is None else None)
    texts = {
        "map/poses.csv": stamped_text("map_poses", POSE, mapped.t_s, mapped.xyt - origin),
        "query/odometry.csv": stamped_text("query_odometry", MOTION, *query),
        "about.toml": about_text([*notes, *moved], own_gap_m),
    }
    if truth is not None:
        rows = truth - origin
        texts["truth/query_poses.csv"] = stamped_text("query_poses", POSE, query[0], rows)
    write_parts(out, texts, views_parts(views))


def about_text(notes: Iterable[str], own_gap_m: float | None = None) -> str:
    """Return about.toml with the sentences that the report repeats.

    Args:
        notes: the sentences.
        own_gap_m: of a drive that is its own map, metres; None = the map is another drive.
    """
    own_gap = "" if own_gap_m is None else f"own_gap_m = {own_gap_m}\n"
    return f"notes = {json.dumps(list(notes), ensure_ascii=False)}\n{own_gap}"


def views_parts(views: Descriptors | Lists) -> dict[str, np.ndarray | Lists]:
    """Return where descriptors or lists lie in a data folder."""
    if isinstance(views, Lists):
        return {"query/retrievals.npz": views}
    return {"map/descriptors.npy": views.map_rows, "query/descriptors.npy": views.query_rows}


def write_parts(
    out: Path, texts: Mapping[str, str], arrays: Mapping[str, np.ndarray | Lists]
) -> None:
    """Write files of a data folder: all of them or none.

    Args:
        out: a new folder, or one that lacks these files; its about.toml alone is replaced.
        texts: name below `out` -> text.
        arrays: name below `out` -> descriptors or lists.

    Raises:
        InputError: a file is there already, or nothing can be written.
    """
    names = [*texts, *arrays]
    for name in names:
        if name != "about.toml" and (out / name).exists():
            fix = "it is never overwritten: move it away, or choose a new folder"
            raise InputError(f"{out / name}: is there already; {fix}")
    try:
        with locked_part(out, is_folder=True) as part:
            for name in names:
                (part / name).parent.mkdir(exist_ok=True)
            for name, text in texts.items():
                (part / name).write_text(text, encoding="utf-8")
            for name, held in arrays.items():
                if isinstance(held, Lists):
                    np.savez(part / name, index=held.index, similarity=held.similarity)
                else:
                    _copy_rows(held, part / name)
            if out.exists():
                _move_in(part, out, names)
            else:
                part.rename(out)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); choose another folder"
        ) from error


def _move_in(part: Path, out: Path, names: Sequence[str]) -> None:
    """Move finished files into a folder, and out again where one of them does not fit."""
    moved: list[Path] = []
    try:
        # What the folder says of itself comes last.
        for name in sorted(names, key=lambda name: name == "about.toml"):
            (out / name).parent.mkdir(exist_ok=True)
            (part / name).replace(out / name)
            moved.append(out / name)
    except OSError:
        for path in moved:
            path.unlink(missing_ok=True)
        raise


def stamped_text(spec: str, names: Sequence[str], t_s: np.ndarray, rows: np.ndarray) -> str:
    """Return a table of stamped rows as CSV text.

    Args:
        spec: in data_specs/.
        names: columns behind `t_s`.
        t_s: (n,) seconds.
        rows: (n, columns).
    """
    return table_text(spec, dict(zip(("t_s", *names), (t_s, *rows.T), strict=True)))


def _origin(
    mapped: Float[np.ndarray, "m 3"], truth: Float[np.ndarray, "t 3"] | None
) -> tuple[Float[np.ndarray, "1 3"], tuple[str, ...]]:
    """Return what is subtracted from all poses, and what must be said of it."""
    poses = mapped if truth is None else np.concatenate([mapped, truth])
    if np.abs(poses[:, :2]).max() <= FAR_M:
        return np.zeros((1, 3)), ()
    x, y = mapped[0, :2]
    said = f"local origin: x = {x:.6f} m and y = {y:.6f} m were subtracted from all positions"
    return np.array([[x, y, 0.0]]), (said,)


def map_parts(mapped: Trajectory) -> tuple[str, tuple[str, ...]]:
    """Return map/poses.csv and what must be said of its origin."""
    origin, said = _origin(mapped.xyt, None)
    return stamped_text("map_poses", POSE, mapped.t_s, mapped.xyt - origin), said


def origin_of(notes: Sequence[str]) -> Float[np.ndarray, "1 3"]:
    """Return the local origin that a data folder's notes name; zeros where they name none."""
    found = [match for note in notes if (match := ORIGIN.search(note))]
    x, y = (float(found[0][1]), float(found[0][2])) if found else (0.0, 0.0)
    return np.array([[x, y, 0.0]])


def _copy_rows(rows: np.ndarray, path: Path) -> None:
    # Half precision stays: it is what the network wrote.
    kind = np.float16 if rows.dtype == np.float16 else np.float32
    out = np.lib.format.open_memmap(path, mode="w+", dtype=kind, shape=rows.shape)
    for start in range(0, len(rows), BLOCK_ROWS):
        out[start : start + BLOCK_ROWS] = rows[start : start + BLOCK_ROWS]
    out.flush()
