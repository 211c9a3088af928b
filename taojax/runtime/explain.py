"""One frame of a sealed run, looked at from inside: the window, its branches, what disagrees.

The run is replayed from its sealed files by the runtime's own `step`, so what is told is what
happened, and the frame's own row says whether it is.
"""

from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from tqdm import tqdm

from taojax.config import StreamConfig, from_toml
from taojax.errors import InputError
from taojax.records import Run
from taojax.runtime.frames import STATUSES, Frame, StreamRecord
from taojax.runtime.inside import Inside, joint_inside, rank_inside
from taojax.runtime.joint import DISTINCT_DELTAS, GAMMA
from taojax.runtime.maps import MapTables, map_tables
from taojax.runtime.stream import COMPILING, StreamState, cost_params, init, step
from taojax.tables import MOTION, POSE, read_table, stacked

TOLERANCE = 1e-4
"""A replayed `tao` may differ from the sealed one by so much of the larger of 1 and itself: the
rounding of sums on another machine. Beyond it another branch won, and nothing told would hold."""

N_BRANCHES = 5
"""Branches told of, each at a place of its own."""


class WindowFrames(NamedTuple):
    """The frames of a window on the cheapest branch, newest first."""

    frame: Int[np.ndarray, " n"]
    """Row of the query."""

    path_m: Float[np.ndarray, "n 2"]
    """Odometry, carried into the map by the branch."""

    anchor: Int[np.ndarray, " n"]
    """Map row that the frame is paired with, -1 without one."""

    cost: Float[np.ndarray, " n"]
    """Unweighted; at most `Look.no_support` under joint association."""

    weight: Float[np.ndarray, " n"]
    """Share of the frame in the cost of a branch."""

    is_inlier: Bool[np.ndarray, " n"]
    """It supports the branch; the others disagree."""


class Branches(NamedTuple):
    """Hypotheses, cheapest first, no two at one place."""

    cost: Float[np.ndarray, " k"]
    pose: Float[np.ndarray, "k 3"]
    """Where the robot is on each: x [m], y [m], theta [rad]."""

    source: tuple[str, ...]
    """What it was started from."""


class Look(NamedTuple):
    """What stands behind one row of signals.csv."""

    frame: int
    status: str
    map_index: int
    """-1 without a pose."""

    pose: Float[np.ndarray, "3"]
    """Reported pose; zero without one."""

    signals: dict[str, float]
    """Recomputed."""

    sealed: dict[str, float]
    """As signals.csv has them."""

    window: WindowFrames
    branches: Branches
    candidate: Int[np.ndarray, " c"]
    """Map rows of the newest frame's candidates, best first, without the missing ones."""

    similarity: Float[np.ndarray, " c"]
    no_support: float
    """What a frame costs that no anchor supports."""

    unit: str
    """Of the costs."""

    map_recall: float

    @property
    def gap(self) -> float:
        """Difference between the replayed and the sealed `tao`, in units of its tolerance."""
        got, want = self.signals["tao"], self.sealed["tao"]
        return abs(got - want) / (TOLERANCE * max(1.0, abs(want)))


def sealed_tables(folder: Path, run: Run, config: StreamConfig) -> MapTables:
    """Rebuild the map of a run from its sealed files.

    Args:
        folder: the run, named in messages.
        run: from `read_run`.
        config: its settings.

    Raises:
        InputError: the run was sealed before runs could be explained, or its map grew.
    """
    facts = run.manifest
    if "own_gap_m" in facts:
        what = "is one drive that closes on itself, whose frames no single map explains"
        raise InputError(f"{folder}: {what}; look at its report.html and at `taojax graph`")
    lacks = [name for name in ("map_scale", "map_recall", "trial_frames") if name not in facts]
    lacks += [] if "odometry.csv" in facts["sha256"] else ["odometry.csv"]
    if lacks:
        what = f"lacks {', '.join(lacks)}, sealed by newer versions"
        raise InputError(f"{folder}: {what}; score the data set again with `taojax score`")
    poses = stacked(run.map_poses, POSE)
    tables = map_tables(poses, config)
    names = ("map_scale", "map_recall", "evidence_unit_m")
    known = tuple(jnp.asarray(facts[name], jnp.float32) for name in names)
    return eqx.tree_at(lambda t: (t.scale, t.recall, t.places.unit_m), tables, known)


def _distinct(inside: Inside, apart_m: float, most: float, sources: list[str]) -> Branches:
    """Return the cheapest branches that are at places of their own."""
    cost, pose = (np.asarray(leaf, float) for leaf in (inside.branch_cost, inside.branch_pose))
    kept: list[int] = []
    for row in np.argsort(cost, kind="stable"):
        gaps = [np.hypot(*(pose[row, :2] - pose[other, :2])) for other in kept]
        # Beside the best one, a branch that nothing supports is none.
        is_live = np.isfinite(cost[row]) and (cost[row] < most or not kept)
        if is_live and all(gap > apart_m for gap in gaps):
            kept.append(int(row))
        if len(kept) == N_BRANCHES:
            break
    return Branches(cost[kept], pose[kept], tuple(sources[row] for row in kept))


def _sources(config: StreamConfig) -> list[str]:
    """Name what every branch was started from, in the runtime's order."""
    if config.association == "rank":
        return [f"candidate {rank + 1} of every list" for rank in range(config.branches)]
    n = min(config.joint_seeds, config.branches)
    ahead = [f"candidate {rank + 1}" for rank in range(n)]
    back = [f"{name}, driven the other way" for name in ahead]
    return [*ahead, *back, "best branch of the frame before", "challenger of the frame before"]


def _replayed(
    config: StreamConfig, tables: MapTables, frames: Frame, *, progress: bool
) -> tuple[StreamState, StreamState, Frame, StreamRecord]:
    """Replay frames in order; return the states around the last one, and the last one itself."""
    before = after = init(config, tables)
    record, frame = None, None
    # NumPy cuts a frame out faster than jax does.
    frames = jax.tree.map(np.asarray, frames)
    n = len(frames.odometry)
    with tqdm(total=n, unit="frame", disable=not progress, leave=False, desc=COMPILING) as bar:
        for t in range(n):
            frame = jax.tree.map(lambda leaf, t=t: jnp.asarray(leaf[t]), frames)
            before, (after, record) = after, step(config, tables, after, frame)
            bar.set_description_str("replaying", refresh=False)
            if t == 0:
                # The time of the compiler says nothing of the frames to come.
                bar.unpause()
            bar.update()
    if frame is None or record is None:
        raise InputError("nothing to replay; name a frame")
    return before, after, frame, record


def explain(folder: Path, run: Run, frame: int, *, progress: bool = False) -> Look:
    """Replay a sealed run up to one frame and look inside.

    Args:
        folder: the run.
        run: read from it by `read_run`.
        frame: row of signals.csv, from 0.
        progress: draw a bar on stderr.

    Returns:
        What stands behind that row. No later frame is looked at, and memory does not grow with the
        frames before.

    Raises:
        InputError: the run holds no such frame, or was sealed before runs could be explained.
    """
    n_frames = len(run.signals["frame"])
    if not 0 <= frame < n_frames:
        raise InputError(f"{folder}: holds no frame {frame}; name one of 0 to {n_frames - 1}")
    config = from_toml(folder / "config.toml").stream
    tables = sealed_tables(folder, run, config)
    table = read_table(folder / "odometry.csv", "query_odometry")
    motion = stacked(table, MOTION)
    # A folder of trials starts afresh with each.
    length = run.manifest["trial_frames"] or n_frames
    past = slice(frame // length * length, frame + 1)
    leaves = (motion.astype(np.float32), run.index, run.similarity)
    frames = Frame(*(jnp.asarray(leaf[past]) for leaf in leaves))
    before, after, newest, record = _replayed(config, tables, frames, progress=progress)
    inside = (
        rank_inside(config, tables, after, newest)
        if config.association == "rank"
        else joint_inside(config, tables, before, newest)
    )
    return _look(config, tables, run, frame, jax.tree.map(np.asarray, record), inside)


def _look(
    config: StreamConfig,
    tables: MapTables,
    run: Run,
    frame: int,
    record: StreamRecord,
    inside: Inside,
) -> Look:
    filled, params = np.flatnonzero(inside.is_filled), cost_params(config, tables)
    of_window = lambda leaf: np.asarray(leaf)[filled]
    number, anchor = frame - filled, of_window(inside.anchor)
    is_rank = config.association == "rank"
    if is_rank:
        anchor = np.where(anchor >= 0, run.index[number, np.maximum(anchor, 0)], -1)
    there = run.index[frame] >= 0
    apart_m = DISTINCT_DELTAS * float(params.delta_m)
    most = float(params.tau_missing) + float(params.gamma_similarity) if is_rank else GAMMA
    return Look(
        frame=frame,
        status=STATUSES[int(record.status)],
        map_index=int(record.map_index),
        pose=np.asarray(record.pose, float),
        signals={name: float(value) for name, value in record.signals.items()},
        sealed={name: float(run.signals[name][frame]) for name in record.signals},
        window=WindowFrames(
            number,
            of_window(inside.path_m).astype(float),
            anchor.astype(int),
            of_window(inside.cost).astype(float),
            of_window(inside.weight).astype(float),
            of_window(inside.is_inlier),
        ),
        branches=_distinct(inside, apart_m, np.inf if is_rank else most - 1e-3, _sources(config)),
        candidate=run.index[frame][there].astype(int),
        similarity=run.similarity[frame][there].astype(float),
        no_support=most,
        unit="m^2" if is_rank else "1",
        map_recall=float(tables.recall),
    )
