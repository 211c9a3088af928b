"""Sessions in, one data folder out: whole or not at all."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from taojax.datasets.trajectory import Trajectory
from taojax.errors import InputError
from taojax.parts import locked_part
from taojax.tables import MOTION, POSE, table_text

__all__ = ["Descriptors", "Lists", "Session", "stamped_text", "write_folder"]

BLOCK_ROWS = 4096
"""Descriptors are copied so many at a time: a map may be larger than the memory."""

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


@dataclass(frozen=True)
class Lists:
    """What a frontend answered; best first."""

    index: Int[np.ndarray, "t k"]
    """(T, K) rows of the map, -1 = no candidate."""

    similarity: Float[np.ndarray, "t k"]
    """(T, K) at most 1."""


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
    try:
        with locked_part(out, is_folder=True) as part:
            for name in ("map", "query", *(("truth",) if truth is not None else ())):
                (part / name).mkdir()
            # The truth of a drive that is its own map lies in a frame of its own.
            origin, moved = _origin(mapped.xyt, truth if own_gap_m is None else None)
            files = {
                "map/poses.csv": stamped_text("map_poses", POSE, mapped.t_s, mapped.xyt - origin),
                "query/odometry.csv": stamped_text("query_odometry", MOTION, *query),
                "about.toml": f"notes = {json.dumps([*notes, *moved], ensure_ascii=False)}\n"
                + ("" if own_gap_m is None else f"own_gap_m = {own_gap_m}\n"),
            }
            if truth is not None:
                files["truth/query_poses.csv"] = stamped_text(
                    "query_poses", POSE, query[0], truth - origin
                )
            for name, text in files.items():
                (part / name).write_text(text, encoding="utf-8")
            _write_views(views, part)
            part.rename(out)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); choose another folder"
        ) from error


def _write_views(views: Descriptors | Lists, folder: Path) -> None:
    if isinstance(views, Lists):
        path = folder / "query/retrievals.npz"
        np.savez(path, index=views.index, similarity=views.similarity)
        return
    _copy_rows(views.map_rows, folder / "map/descriptors.npy")
    _copy_rows(views.query_rows, folder / "query/descriptors.npy")


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


def _copy_rows(rows: np.ndarray, path: Path) -> None:
    # Half precision stays: it is what the network wrote.
    kind = np.float16 if rows.dtype == np.float16 else np.float32
    out = np.lib.format.open_memmap(path, mode="w+", dtype=kind, shape=rows.shape)
    for start in range(0, len(rows), BLOCK_ROWS):
        out[start : start + BLOCK_ROWS] = rows[start : start + BLOCK_ROWS]
    out.flush()
