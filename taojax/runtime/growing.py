"""A drive that is its own map: the map of a frame is what lies so much way behind it.

The map grows in blocks. All frames of a block share one map: the frames that its first one knows,
with spacing, scale and correlation length taken from those alone. Each block is replayed after a
warm-up, and what follows it, up to the lag, makes its answers final. So nothing that an answer
rests on was seen later than the lag allows.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from taojax.config import Config, VerdictConfig
from taojax.core.anchors import AnchorGrid
from taojax.drive import known_frames
from taojax.risk import first_look
from taojax.runtime import hindsight
from taojax.runtime.frames import NO_CANDIDATES, Frame, StreamRecord
from taojax.runtime.maps import LEAST_ROWS, NEIGHBOURS, MapTables, capacity, map_tables
from taojax.runtime.observations import Observations
from taojax.runtime.retrieval import N_KEPT, retrieve
from taojax.runtime.stream import answered, literal, replay

BLOCK = 50
"""Frames that share a map: where one drives 2 m a frame the newest that they know is up to 100 m
older than the gap asks."""

WARM = 200
"""Frames before a block that it is replayed from: twice as many as any window looks back."""

LEAST_PADDED, GROWTH = 256, 4
"""Anchors that a map is padded to: so many, and so many times as many as that does not suffice.
Every size is compiled once."""

LEAST_CELLS, CELLS_GROWTH = 1_048_576, 16
"""The same for the cells of its grids; most drives fit the first size."""

FAR_M = 1e7
"""Where padding lies: nothing is ever near it [m]."""

NEVER_M2 = 1e12
"""Squared distance of a neighbour that is none [m^2]."""


class Block(NamedTuple):
    """Frames that share a map."""

    first: int
    end: int
    n_known: int
    """Frames of the drive, from the first, that are their map; 0 = none yet."""


def blocks(odometry: np.ndarray, gap_m: float) -> list[Block]:
    """Cut a drive into blocks.

    Args:
        odometry: `(T, 3)`.
        gap_m: see `drive.known_frames`.
    """
    known = known_frames(odometry, gap_m)
    starts = range(0, len(odometry), BLOCK)
    many = [int(known[at]) if known[at] >= LEAST_ROWS else 0 for at in starts]
    return [
        Block(at, min(at + BLOCK, len(odometry)), n) for at, n in zip(starts, many, strict=True)
    ]


def _padded_grid(grid: AnchorGrid, m: int) -> AnchorGrid:
    """Pad anchors and cells with some that nothing is near to and no list names."""
    n = grid.xy.shape[0]
    own = np.arange(n, m)
    neighbour = np.broadcast_to(np.arange(m), (NEIGHBOURS, m)).copy()
    away = np.full((NEIGHBOURS, m), NEVER_M2, np.float32)
    away[0] = 0.0
    b = grid.neighbour.shape[0]
    neighbour[:b, :n], away[:b, :n] = grid.neighbour, grid.neighbour_m2
    cells = grid.nearest.shape[1]
    more = capacity(cells, LEAST_CELLS, CELLS_GROWTH) - cells
    room = lambda leaf, fill: np.concatenate(
        [np.asarray(leaf), np.full((len(own), *leaf.shape[1:]), fill, np.float32)]
    )
    return AnchorGrid(
        xy=jnp.asarray(room(grid.xy, FAR_M)),
        theta=jnp.asarray(room(grid.theta, 0.0)),
        facing=jnp.asarray(room(grid.facing, np.sqrt(0.5))),
        nearest=jnp.asarray(np.pad(grid.nearest, [(0, 0), (0, more)], constant_values=-1)),
        shape=grid.shape,
        corner=grid.corner,
        cell_m=grid.cell_m,
        neighbour=jnp.asarray(neighbour, jnp.int32),
        neighbour_m2=jnp.asarray(away),
    )  # fmt: skip


def padded(tables: MapTables) -> MapTables:
    """Return the same map in arrays of one of few sizes: a map that grows is compiled rarely.

    Args:
        tables: of `n` anchors; the same numbers come out of the padded ones.
    """
    grid = tables.places.grid
    m = capacity(grid.xy.shape[0], LEAST_PADDED, GROWTH)
    return eqx.tree_at(lambda t: t.places.grid, tables, _padded_grid(grid, m))


def _older(index: np.ndarray, similarity: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return lists without the candidates from row n on; what stays moves up."""
    is_kept = (index >= 0) & (index < n)
    order = np.argsort(~is_kept, axis=1, kind="stable")
    kept = np.take_along_axis(is_kept, order, axis=1)
    return (
        np.where(kept, np.take_along_axis(index, order, axis=1), -1).astype(np.int32),
        np.where(kept, np.take_along_axis(similarity, order, axis=1), 0.0).astype(np.float32),
    )


def candidates(
    observations: Observations, cut: list[Block], *, progress: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the `(T, 100)` rows and similarities of every frame among those that it knows.

    Args:
        observations: of a drive that is its own map.
        cut: from `blocks`.
        progress: draw a bar on stderr.
    """
    total = len(observations.odometry)
    index = np.full((total, N_KEPT), -1, np.int32)
    similarity = np.zeros((total, N_KEPT), np.float32)
    for block in tqdm(cut, disable=not progress, leave=False, desc="looking up", unit="block"):
        rows, n = slice(block.first, block.end), block.n_known
        if not n:
            continue
        if observations.descriptors is not None:
            rows_of, queries = observations.descriptors
            index[rows], similarity[rows] = retrieve(rows_of[:n], queries[rows])
            continue
        lists = observations.retrievals
        assert lists is not None  # noqa: S101 - the reader has seen to one of them
        found = _older(lists.index[rows], lists.similarity[rows], n)
        width = min(N_KEPT, found[0].shape[1])
        index[rows, :width], similarity[rows, :width] = (part[:, :width] for part in found)
    return index, similarity


class Grown(NamedTuple):
    """What every frame of a drive says, NumPy."""

    record: StreamRecord
    now: dict[str, np.ndarray]
    """Causal columns of signals.csv."""

    delayed: dict[str, np.ndarray]
    tables: MapTables
    """Of the last block: what the manifest says of the map."""


class _Part(NamedTuple):
    record: StreamRecord
    both: hindsight.Both
    gap_m: np.ndarray


def _replayed(
    config: Config, tables: MapTables, log: tuple[np.ndarray, ...], rows: slice, n_stream: int
) -> _Part:
    """Replay a block with what lies around it.

    Args:
        config: settings.
        tables: its map, padded.
        log: odometry, lists and similarities of warm-up, block and what follows.
        rows: the block within them.
        n_stream: frames of warm-up and block, the same for every block.
    """
    n = rows.stop
    ahead = [np.concatenate([a[:n], np.repeat(a[n - 1 : n], n_stream - n, axis=0)]) for a in log]
    frames = Frame(*(jnp.asarray(a) for a in ahead))
    _, record = replay(literal(config), tables, frames)
    seen = hindsight.clean(tables, *log)
    both = hindsight.replay_both(config.verdict, tables, seen)
    return _Part(
        jax.tree.map(lambda leaf: np.asarray(leaf)[rows], record),
        jax.tree.map(lambda leaf: leaf[rows], both),
        np.full(rows.stop - rows.start, tables.places.gap_m, np.float32),
    )


def _nowhere(config: Config, n: int) -> _Part:
    """Return what frames say that have no map yet: a robot at rest which is offered no place."""
    tables = padded(map_tables(np.zeros((1, 3)), config.stream))
    still = WARM + BLOCK
    log = (
        np.zeros((still, 3), np.float32),
        np.full((still, N_KEPT), -1, np.int32),
        np.zeros((still, N_KEPT), np.float32),
    )
    last = _replayed(config, tables, log, slice(still - 1, still), still)
    part = jax.tree.map(lambda leaf: np.repeat(leaf, n, axis=0), last)
    is_silent = part.record.status == NO_CANDIDATES
    assert is_silent.all()  # noqa: S101 - else such a frame could be accepted
    return part


def _reach(config: VerdictConfig) -> int:
    """Return the most frames that a final answer may wait for."""
    return hindsight.LONGEST * max(config.lag, hindsight.block_frames(config))


def replay_growing(
    config: Config,
    observations: Observations,
    cut: list[Block],
    lists: tuple[np.ndarray, np.ndarray],
    *,
    progress: bool = False,
) -> Grown:
    """Answer a whole drive that is its own map, now and finally.

    Args:
        config: settings.
        observations: the drive; its map poses are its own odometry, added up.
        cut: from `blocks`.
        lists: from `candidates`.
        progress: draw a bar on stderr.
    """
    odometry = np.asarray(observations.odometry)
    parts, n_nowhere = [], sum(block.end - block.first for block in cut if not block.n_known)
    if n_nowhere:
        parts.append(_nowhere(config, n_nowhere))
    tables = map_tables(observations.map_xyt[:1], config.stream)
    for block in tqdm(cut, disable=not progress, leave=False, desc="scoring", unit="block"):
        n = block.n_known
        if not n:
            continue
        seen = observations.descriptors and observations.descriptors[0][:n]
        tables = map_tables(observations.map_xyt[:n], config.stream, seen)
        first, end = max(0, block.first - WARM), block.end + _reach(config.verdict)
        around = slice(first, end)
        log = (odometry[around], *_older(lists[0][around], lists[1][around], n))
        rows = slice(block.first - first, block.end - first)
        parts.append(_replayed(config, padded(tables), log, rows, WARM + BLOCK))
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    # A block's own replay knows its warm-up alone; the past is the whole drive's.
    still = hindsight.clean(tables, odometry, *lists).odometry
    now, final = (
        hindsight.recall_log(config.verdict, first, joined.gap_m, still, answers)
        for first, answers in zip(first_look(), joined.both, strict=True)
    )
    return Grown(
        answered(config, joined.record, now),
        hindsight.now_columns(now),
        hindsight.delayed_columns(final),
        tables,
    )
