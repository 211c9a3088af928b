"""Kidnap logs on disk: read a world or a data folder as source, write logs as a data folder."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taojax.about import read_about
from taojax.datasets.folder import stamped_text
from taojax.datasets.kidnap import LEVELS, TRIAL_FRAMES, WINDOW_FRAMES, Log, Source
from taojax.datasets.simulate import make_world, seen_places
from taojax.datasets.world import NOTE, WorldConfig
from taojax.errors import InputError
from taojax.specs import read_npy, read_npz, write_atomically
from taojax.tables import MOTION, POSE, read_table, stacked, table_text

__all__ = ["folder_source", "read_poses", "world_source", "write_logs"]


def world_source(config: WorldConfig, seed: int) -> Source:
    """Simulate a world to splice from, with the place whose appearance each frame saw."""
    world = make_world(config, seed)
    return Source(
        map_poses=world.map_poses,
        query_poses=world.query_poses,
        seen_m=seen_places(config, seed),
        map_views=world.map_descriptors,
        query_views=(world.query_descriptors,),
        notes=(NOTE,),
    )


def read_poses(path: Path, spec: str) -> np.ndarray:
    """Read a table as pose rows (t [s], x [m], y [m], theta [rad]).

    Args:
        path: the table.
        spec: its spec in data_specs/.

    Raises:
        InputError: the table is missing or malformed.
    """
    return stacked(read_table(path, spec), ("t_s", *POSE))


def folder_source(folder: Path) -> Source:
    """Read a data folder with truth to splice from.

    Args:
        folder: laid out as data_specs/README.md says; its odometry is not used.

    Raises:
        InputError: a file is missing or malformed, or views and poses differ in number.
    """
    map_poses = read_poses(folder / "map/poses.csv", "map_poses")
    query_poses = read_poses(folder / "truth/query_poses.csv", "query_poses")
    lists = folder / "query/retrievals.npz"
    map_views = None
    if lists.exists():
        arrays = read_npz(lists, "retrievals")
        path, views = lists, (arrays["index"], arrays["similarity"])
    else:
        path = folder / "query/descriptors.npy"
        views = (read_npy(path, "descriptors"),)
        map_views = read_npy(folder / "map/descriptors.npy", "descriptors")
    if len(views[0]) != len(query_poses):
        raise InputError(
            f"{path}: {len(views[0])} rows, but {folder / 'truth/query_poses.csv'} has"
            f" {len(query_poses)}; both must describe the same frames"
        )
    return Source(map_poses, query_poses, None, map_views, views, read_about(folder).notes)


def _said(source: Source, logs: Sequence[Log]) -> list[str]:
    """Return what the report must repeat."""
    n = sum(len(log.kidnaps) for log in logs)
    levels = dict.fromkeys(log.drift for log in logs)
    drift = ", ".join(
        f"{name} {100 * LEVELS[name].share:g} % and {LEVELS[name].yaw_deg:g} degrees"
        for name in levels
    )
    return [
        *source.notes,
        f"spliced: {len(logs)} logs of {TRIAL_FRAMES} frames with {n} simulated kidnaps; views are"
        " those of the source",
        f"simulated odometry: true motion plus drift; over {WINDOW_FRAMES} frames {drift}",
    ]


def write_logs(source: Source, logs: Sequence[Log], folder: Path) -> None:
    """Write logs one after another as a data folder with its truth.

    Args:
        source: that the logs were spliced from.
        logs: from `make_logs`.
        folder: where to; made where absent.

    Raises:
        InputError: the folder cannot be written.
    """
    rows = np.concatenate([log.rows for log in logs])
    dt_s = float(np.median(np.diff(source.query_poses[:, 0])))
    stamps = np.arange(len(rows)) * (dt_s if dt_s > 0 else 1.0)
    odometry = np.concatenate([log.odometry for log in logs])
    truth = source.query_poses[rows]
    files = {
        "map/poses.csv": stamped_text(
            "map_poses", POSE, source.map_poses[:, 0], source.map_poses[:, 1:]
        ),
        "query/odometry.csv": stamped_text("query_odometry", MOTION, stamps, odometry),
        "truth/query_poses.csv": stamped_text("query_poses", POSE, stamps, truth[:, 1:]),
        "truth/kidnaps.csv": table_text("kidnaps", _kidnaps(logs)),
        "truth/logs.csv": table_text("logs", _log_table(logs)),
        "about.toml": f"trial_frames = {TRIAL_FRAMES}\n"
        + f"notes = {json.dumps(_said(source, logs), ensure_ascii=False)}\n",
    }
    if source.seen_m is not None:
        seen = np.concatenate([source.seen_m[rows], truth[:, 3:]], axis=1)
        files["truth/seen_poses.csv"] = stamped_text("query_poses", POSE, stamps, seen)
    for name, text in files.items():
        write_atomically(folder / name, text)
    if source.map_views is None:
        index, similarity = (part[rows] for part in source.query_views)
        np.savez_compressed(folder / "query/retrievals.npz", index=index, similarity=similarity)
    else:
        # Half precision halves the folder and moves a cosine by less than a thousandth.
        np.save(folder / "map/descriptors.npy", np.asarray(source.map_views))
        views = np.asarray(source.query_views[0])
        np.save(folder / "query/descriptors.npy", views[rows].astype(np.float16))


def _kidnaps(logs: Sequence[Log]) -> dict[str, np.ndarray]:
    counts = [len(log.kidnaps) for log in logs]
    return {
        "log": np.repeat(np.arange(len(logs)), counts),
        "frame": np.concatenate([log.kidnaps for log in logs]),
        "step_m": np.concatenate([log.step_m for log in logs]),
    }


def _log_table(logs: Sequence[Log]) -> dict[str, np.ndarray]:
    return {
        "log": np.arange(len(logs)),
        "drift": np.array([log.drift for log in logs], dtype=object),
        "stretch_frames": np.array([log.stretch for log in logs]),
        "split": np.array([log.split for log in logs], dtype=object),
    }
