"""Splices kidnap logs, in memory and on disk: the robot is carried elsewhere, its odometry unaware.

A log is a row of stretches, each a run of consecutive frames that really followed one another in
the source. Logs for thresholds and logs whose kidnaps count are spliced from other frames. Into
the first frame of a stretch leads the motion that belonged to that frame: the robot believes that
it drove on. Views are those of the source; odometry is the true motion plus simulated drift.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from taojax.datasets.folder import stamped_text
from taojax.datasets.simulate import NOTE, WorldConfig, make_world, seen_places
from taojax.datasets.trajectory import motions
from taojax.errors import InputError
from taojax.files.dataset_info import read_about
from taojax.files.specs import read_npy, read_npz, write_atomically
from taojax.files.tables import MOTION, POSE, read_table, stacked, table_text

__all__ = [
    "LEVELS",
    "Drift",
    "Log",
    "Plan",
    "Source",
    "cut_rows",
    "folder_source",
    "in_map",
    "make_logs",
    "noisy_odometry",
    "read_poses",
    "splice",
    "world_source",
    "write_logs",
]

TRIAL_FRAMES = 160
"""Frames of a log."""

WINDOW_FRAMES = 20
"""Frames over which the end drift of a level is stated; a jump nearer to the end is no trial."""

FAR_M = 100.0
"""A kidnap carries the robot at least so far, metres, or ..."""

FAR_SHARE = 0.25
"""... this share of the map's longer side, if that is less."""

CALIBRATION_EVERY = 5
"""Every so many logs one is set apart for thresholds; its kidnaps are not counted."""

PARTS = (10, 8, 6, 4)
"""The in-map frames are cut into so many equal runs, and calibration logs are spliced from two of
them, half of a drive apart; fewer and longer ones where the first number leaves a side without a
stretch that is long enough and far enough away."""


class Drift(NamedTuple):
    """End drift over a window: root mean square, half of its variance white and half bias."""

    share: float
    """Of the translation alone, as a share of the distance driven; yaw bends the path on top."""

    yaw_deg: float
    """Of the heading, degrees per window."""


LEVELS: Mapping[str, Drift] = {
    "low": Drift(0.01, 0.5),
    "medium": Drift(0.07, 7.5),
    "high": Drift(0.18, 31.0),
}
"""Placed about what real recordings show over 20 frames: mit_corridor 1.0 % and 0.5 degrees,
tuc_corridor 6.9 % and 7.5 degrees, intel_lab 18.4 % and 31 degrees."""


@dataclass(frozen=True)
class Source:
    """What logs are spliced from; pose rows are (t [s], x [m], y [m], theta [rad])."""

    map_poses: Float[np.ndarray, "m 4"]
    query_poses: Float[np.ndarray, "t 4"]
    """True poses."""

    seen_m: Float[np.ndarray, "t 2"] | None
    """Where in the map a frame's appearance belongs; None where nobody knows."""

    map_views: np.ndarray | None
    """(M, D) descriptors of the map; None with retrieval lists."""

    query_views: tuple[np.ndarray, ...]
    """Descriptors (T, D), or lists: index (T, K) and similarity (T, K)."""

    notes: tuple[str, ...]


class Plan(NamedTuple):
    """How logs are cut."""

    n_trials: int
    """Counted kidnaps wanted per drift level."""

    stretch: tuple[int, int] = (30, 50)
    """Shortest and longest stretch, frames."""

    r_in_m: float = 10.0
    """A stretch stays within this distance of some map pose."""


class Log(NamedTuple):
    """One spliced log of `TRIAL_FRAMES` frames."""

    rows: Int[np.ndarray, " n"]
    """Frames of the source."""

    odometry: Float[np.ndarray, "n 3"]
    """Forward [m], left [m], yaw [rad]; row 0 is zero."""

    kidnaps: Int[np.ndarray, " k"]
    """First frames after a jump, all of them."""

    step_m: Float[np.ndarray, " k"]
    """Metres truly driven into each of these frames, after the robot was put down."""

    drift: str
    stretch: int
    """Middle of the range of stretch lengths, frames."""

    split: str
    """calibration or test."""

    @property
    def n_counted(self) -> int:
        """Kidnaps that count: of test logs, not in the last `WINDOW_FRAMES` frames."""
        late = TRIAL_FRAMES - WINDOW_FRAMES
        return int((self.kidnaps <= late).sum()) if self.split == "test" else 0


def in_map(source: Source, r_in_m: float) -> Bool[np.ndarray, " t"]:
    """Tell which query frames truly lie within `r_in_m` of some map pose."""
    map_m = source.map_poses[:, 1:3]
    gap = [
        np.min(np.sum((map_m - place[None]) ** 2, axis=1)) for place in source.query_poses[:, 1:3]
    ]
    return np.array(gap) <= r_in_m**2


def far_m(source: Source) -> float:
    """Return how far a kidnap carries the robot at least, metres."""
    return min(FAR_M, FAR_SHARE * float(np.ptp(source.map_poses[:, 1:3], axis=0).max()))


def window_m(source: Source) -> float:
    """Return the usual distance driven in a window, metres: the unit of the drift levels."""
    step = np.hypot(*np.diff(source.query_poses[:, 1:3], axis=0).T)
    moving = step[step > 1e-6]
    return WINDOW_FRAMES * (float(np.median(moving)) if moving.size else 1.0)


def noisy_odometry(
    motion: Float[np.ndarray, "n 3"], drift: Drift, distance_m: float, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Add drift to true motion: white noise per step, a constant scale and a constant yaw bias.

    The white part of a step has a standard deviation in proportion to the root of its length. The
    signs of the two constants are drawn once per call.

    Args:
        motion: forward [m], left [m], yaw [rad] per step; row 0 is not used.
        drift: root mean square end drift over `distance_m`.
        distance_m: metres driven in a window.
        rng: of the noise.

    Returns:
        The odometry; row 0 is zero.
    """
    length = np.hypot(motion[:, 0], motion[:, 1])
    half, yaw = np.sqrt(0.5), np.radians(drift.yaw_deg)
    scale, turn = rng.choice((-1.0, 1.0), 2) * half * np.array([drift.share, yaw / distance_m])
    # Two axes share the variance of the translation.
    white_m = half * drift.share * distance_m / np.sqrt(2.0 * distance_m)
    white_rad = half * yaw / np.sqrt(distance_m)
    noise = rng.standard_normal(motion.shape) * np.sqrt(length)[:, None]
    noise *= np.array([[white_m, white_m, white_rad]])
    noise[:, :2] += scale * motion[:, :2]
    noise[:, 2] += turn * length
    out = motion + noise
    out[0] = 0.0
    return out


def _room(inside: Bool[np.ndarray, " t"]) -> Int[np.ndarray, " t"]:
    """Return how many consecutive in-map frames begin at each frame; frame 0 has no motion."""
    room = np.zeros(len(inside) + 1, int)
    for i in range(len(inside) - 1, 0, -1):
        room[i] = room[i + 1] + 1 if inside[i] else 0
    return room[:-1]


def _goes_on(source: Source, room: Int[np.ndarray, " t"], plan: Plan) -> bool:
    """Tell whether from every end of a stretch some other one lies far enough away."""
    place, low = source.query_poses[:, 1:3], plan.stretch[0]
    starts = place[room >= low]
    behind = np.zeros(len(room), int)
    for i in range(1, len(room)):
        behind[i] = behind[i - 1] + 1 if room[i] else 0
    ends, least_m = place[behind >= low], far_m(source)
    return len(starts) > 0 and all(
        np.hypot(*(starts - end[None]).T).max() >= least_m for end in ends
    )


def cut_rows(source: Source, plan: Plan) -> dict[str, Bool[np.ndarray, " t"]]:
    """Cut the in-map frames in two, so that no threshold has seen a frame that it is tried on.

    Args:
        source: where logs are spliced from.
        plan: lengths and radius.

    Returns:
        `calibration` and `test` -> the frames that such logs may hold; none is in both.

    Raises:
        InputError: no cut of `PARTS` leaves stretches on both sides.
    """
    inside = in_map(source, plan.r_in_m)
    number = np.cumsum(inside) - 1
    for parts in PARTS:
        part = number * parts // max(1, int(inside.sum()))
        for first in range(parts // 2):
            chosen = inside & ((part == first) | (part == first + parts // 2))
            sides = {"calibration": chosen, "test": inside & ~chosen}
            if all(_goes_on(source, _room(side), plan) for side in sides.values()):
                return sides
    raise InputError(_too_small(source, plan))


def _too_small(source: Source, plan: Plan) -> str:
    return (
        f"no stretch of {plan.stretch[0]} in-map frames lies {far_m(source):.0f} m or more from the"
        f" one before (in-map: truth within {plan.r_in_m:g} m of a map pose), or not apart from"
        " those that thresholds are frozen on; give a longer recording that visits more of its"
        " map, or a larger --r-in"
    )


def splice(
    source: Source, room: Int[np.ndarray, " t"], plan: Plan, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " k"]]:
    """Draw stretches until a log is full.

    Args:
        source: where from.
        room: consecutive frames that begin at each frame of it and may be taken.
        plan: lengths and radius.
        rng: draws lengths and places.

    Returns:
        Rows of the source and the first frames after the jumps.

    Raises:
        InputError: no stretch is long enough and far enough away.
    """
    place, least_m = source.query_poses[:, 1:3], far_m(source)
    rows, jumps = np.zeros(0, int), []
    low, high = plan.stretch
    while len(rows) < TRIAL_FRAMES:
        is_far = np.ones(len(place), bool)
        if len(rows):
            is_far = np.hypot(*(place - place[rows[-1]][None]).T) >= least_m
        longest = int(min(high, room[is_far].max(initial=0)))
        if longest < low:
            raise InputError(_too_small(source, plan))
        length = int(rng.integers(low, longest + 1))
        start = int(rng.choice(np.flatnonzero(is_far & (room >= length))))
        if len(rows):
            jumps.append(len(rows))
        rows = np.concatenate([rows, np.arange(start, start + length)])
    return rows[:TRIAL_FRAMES], np.array(jumps, int)


def make_logs(
    source: Source, plan: Plan, seed: int, levels: Sequence[str] = tuple(LEVELS)
) -> list[Log]:
    """Splice logs until enough kidnaps are counted; every level gets the same kidnaps.

    Logs of the levels take turns, so that any first part of the list holds as much of each.

    Args:
        source: where from.
        plan: how many and how.
        seed: the same source, plan and seed give the same logs.
        levels: keys of `LEVELS`.

    Returns:
        The logs. Of every five per level the first is for calibration, and shares no frame of the
        source with the others; jumps in the last `WINDOW_FRAMES` frames are in `kidnaps` but do
        not count.

    Raises:
        InputError: the source has too few in-map stretches.
    """
    rng = np.random.default_rng([seed, 1])
    true_motion, unit_m = motions(source.query_poses[:, 1:]), window_m(source)
    rooms = {split: _room(side) for split, side in cut_rows(source, plan).items()}
    length = np.hypot(true_motion[:, 0], true_motion[:, 1])
    logs: list[Log] = []
    n_counted, number = 0, 0
    while n_counted < plan.n_trials:
        split = "test" if number % CALIBRATION_EVERY else "calibration"
        rows, jumps = splice(source, rooms[split], plan, rng)
        for level in levels:
            odometry = noisy_odometry(true_motion[rows], LEVELS[level], unit_m, rng)
            middle = sum(plan.stretch) // 2
            logs.append(Log(rows, odometry, jumps, length[rows[jumps]], level, middle, split))
        n_counted += logs[-1].n_counted
        number += 1
    return logs


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
