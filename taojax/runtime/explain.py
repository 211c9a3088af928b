"""One answer of a sealed run from inside: its path, who disagrees, where else it could be.

The path is followed again from the sealed files by the runtime's own function, so what is told is
what happened, and the sealed cost says whether it is.
"""

from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from taojax.config import VerdictConfig, from_toml
from taojax.core.belief import Places
from taojax.core.path import Window, along
from taojax.core.se2 import between, integrate, transform
from taojax.decisions import SILENT
from taojax.errors import InputError
from taojax.files.records import Run
from taojax.files.tables import MOTION, POSE, read_table, stacked
from taojax.runtime import hindsight
from taojax.runtime.maps import MapTables, map_tables

TOLERANCE = 1e-4
"""A recomputed cost may differ from the sealed one by so much: the rounding of sums on another
machine. Beyond it another path was followed, and nothing told would hold."""

N_PLACES = 5
"""Hypotheses told of, each at a place of its own."""


class WindowFrames(NamedTuple):
    """The frames around an answer on its path, in order."""

    frame: Int[np.ndarray, " n"]
    """Row of the query."""

    path_m: Float[np.ndarray, "n 2"]
    """Odometry, carried into the map by the answer."""

    anchor: Int[np.ndarray, " n"]
    """Map row that the frame is paired with, -1 without one."""

    cost: Float[np.ndarray, " n"]
    """Unweighted, 0 to 1."""

    weight: Float[np.ndarray, " n"]
    """Share of the frame in the cost of the answer."""

    is_inlier: Bool[np.ndarray, " n"]
    """It supports the answer; the others disagree."""


class Hypotheses(NamedTuple):
    """The answer, then the cheapest other places."""

    cost: Float[np.ndarray, " k"]
    """Of the path of each over the same frames, 0 to 1."""

    pose: Float[np.ndarray, "k 3"]
    """Where the robot is on each: x [m], y [m], theta [rad]."""


class Look(NamedTuple):
    """What stands behind one final answer."""

    frame: int
    status: str
    map_index: int
    """-1 where nothing is answered."""

    cost: float
    """Recomputed."""

    sealed: float
    """As delayed.csv has it."""

    window: WindowFrames
    hypotheses: Hypotheses
    candidate: Int[np.ndarray, " c"]
    """Map rows of the frame's candidates, best first, without the missing ones."""

    similarity: Float[np.ndarray, " c"]
    map_recall: float

    @property
    def gap(self) -> float:
        """Difference between the recomputed and the sealed cost, in units of the tolerance."""
        return abs(self.cost - self.sealed) / TOLERANCE


def sealed_tables(folder: Path, run: Run) -> MapTables:
    """Rebuild the map of a run from its sealed files.

    Args:
        folder: the run, named in messages.
        run: from `read_run`.

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
    tables = map_tables(stacked(run.map_poses, POSE))
    names = ("map_scale", "map_recall", "evidence_unit_m")
    known = tuple(jnp.asarray(facts[name], jnp.float32) for name in names)
    return eqx.tree_at(lambda t: (t.scale, t.recall, t.places.unit_m), tables, known)


def _around(
    config: VerdictConfig, places: Places, seen: hindsight.Seen, at: int
) -> tuple[Window, Int[np.ndarray, " n"]]:
    """Return the window of a final answer, seen from its frame, and the rows in it."""
    odometry, n = np.asarray(seen.odometry), hindsight.block_frames(config)
    first, last = at // n * n, at
    if config.lag:
        ahead = hindsight.reach(config, places, odometry).ahead[first]
        last = min(first + int(ahead), len(odometry) - 1)
    rows = np.arange(max(0, first - hindsight.reach_frames(config)), last + 1)
    frames = np.cumsum(np.asarray(hindsight.frame_pace(places, jnp.asarray(odometry)), float))
    driven = np.hypot(odometry[:, 0], odometry[:, 1]).astype(float)
    way = np.cumsum(driven) / float(places.gap_m)
    rows = rows[np.abs(frames[rows] - frames[at]) <= config.window_frames + 1e-3]
    # Poses in the frame of the answered one, forwards and backwards from it.
    poses = np.asarray(integrate(jnp.asarray(odometry[rows])))
    here = poses[np.searchsorted(rows, at)]
    local = between(jnp.broadcast_to(jnp.asarray(here), poses.shape), jnp.asarray(poses))[:, :2]
    listed = slice(0, hindsight.LISTED)
    return Window(
        xy=local,
        way_gaps=jnp.asarray(np.abs(way[rows] - way[at]), jnp.float32),
        index=jnp.asarray(seen.index[rows, listed]),
        scaled=jnp.asarray(seen.scaled[rows, listed]),
        weight=jnp.asarray(np.minimum(1.0, driven[rows] / float(places.unit_m)), jnp.float32),
    ), rows


def _elsewhere(
    cost: Float[np.ndarray, " k"], pose: Float[np.ndarray, "k 3"], apart_m: float
) -> Hypotheses:
    """Return the first hypothesis and the cheapest others that are at places of their own."""
    kept = [0]
    for row in np.argsort(cost, kind="stable"):
        gaps = [np.hypot(*(pose[row, :2] - pose[other, :2])) for other in kept]
        # What no frame supports is no hypothesis.
        if cost[row] < 1.0 - TOLERANCE and all(gap > apart_m for gap in gaps):
            kept.append(int(row))
        if len(kept) == N_PLACES:
            break
    return Hypotheses(cost[kept], pose[kept])


def explain(folder: Path, run: Run, frame: int) -> Look:
    """Follow the final answer of a frame once more.

    Args:
        folder: the run.
        run: read from it by `read_run`.
        frame: row of delayed.csv, from 0.

    Returns:
        What stands behind that answer: frames before it, and after it up to the lag.

    Raises:
        InputError: the run holds no such frame, or was sealed before runs could be explained.
    """
    n_frames = len(run.signals["frame"])
    if not 0 <= frame < n_frames:
        raise InputError(f"{folder}: holds no frame {frame}; name one of 0 to {n_frames - 1}")
    config = from_toml(folder / "config.toml").verdict
    tables = sealed_tables(folder, run)
    motion = stacked(read_table(folder / "odometry.csv", "query_odometry"), MOTION)
    # A folder of trials starts afresh with each.
    length = run.manifest["trial_frames"] or n_frames
    start = frame // length * length
    log = slice(start, start + length)
    seen = hindsight.clean(
        tables, motion[log].astype(np.float32), run.index[log], run.similarity[log]
    )
    places = tables.places
    window, rows = _around(config, places, seen, frame - start)
    answer = np.array([run.delayed[name][frame] for name in POSE])
    listed = seen.index[frame - start, : hindsight.LISTED]
    anchors = stacked(run.map_poses, POSE)[listed[listed >= 0]]
    turned = anchors + np.array([0.0, 0.0, np.pi])
    tried = jnp.asarray(np.concatenate([answer[None], anchors, turned]), jnp.float32)
    follow = lambda pose: along(config, places.grid.xy, places.gap_m, pose, window)
    paths = jax.jit(jax.vmap(follow))(tried)
    price, weight = np.asarray(paths.price, float), np.asarray(window.weight, float)
    share = weight / max(weight.sum(), 1e-9)
    cost = price @ share
    has_answer = run.signals["status"][frame] not in SILENT
    carried = np.asarray(transform(paths.pose[0][None], window.xy), float)
    there = run.index[frame] >= 0
    return Look(
        frame=frame,
        status=str(run.signals["status"][frame]),
        map_index=int(run.delayed["map_index"][frame]) if has_answer else -1,
        cost=float(cost[0]),
        sealed=float(run.delayed["cost"][frame]),
        window=WindowFrames(
            rows + start,
            carried,
            np.asarray(paths.anchor[0], int),
            price[0],
            share,
            np.asarray(paths.is_inlier[0]),
        ),
        hypotheses=_elsewhere(
            cost, np.asarray(tried, float), float(config.place_gaps * places.gap_m)
        ),
        candidate=run.index[frame][there].astype(int),
        similarity=run.similarity[frame][there].astype(float),
        map_recall=float(tables.recall),
    )
