"""The map, prepared once: how alike its images look, spacing, anchors, the grid of the filter."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from taojax.config import StreamConfig
from taojax.core.anchors import AnchorGrid
from taojax.core.belief import Places
from taojax.errors import InputError
from taojax.risk import LIST_RECALL
from taojax.runtime.retrieval import normalise, similarities

LIST_SCALE = (0.0, 1.0)
"""Background and strong similarity of retrieval lists without map descriptors."""

STRONG_QUANTILE = 0.75
"""Of the map images' best other map image."""

BACKGROUND_SHARE, STRONG_SHARE = 0.7, 0.9
"""Another session resembles the map less than the map itself does: both ends of the scale are drawn
by so much from the map's mean similarity."""

LEAST_RANGE = 0.02
"""Strong match and background never count as closer than this."""

BACKGROUND_RANK = 100
"""The background is the similarity of the 100th best image, the paper's K."""

NEAR_SPACINGS = 9.0
"""An image within so many map spacings shows the same place."""

SAMPLE = 512
"""Map images that vote on the scale, evenly spaced."""


class MapView(NamedTuple):
    """What a map's own images say of the frontend."""

    scale: np.ndarray
    """(2,) background: mean similarity of the 100th best other map image (of the median one in
    small maps); strong: 75 % quantile of the best other map image."""

    recall: float
    """Share of images whose most similar other image lies nearby: how far this map tells its own
    places apart."""


def _sample_rows(xy: np.ndarray) -> Int[np.ndarray, " s"]:
    """Return `SAMPLE` rows at most, spread over the map whatever the order of its rows."""
    return _spread_rows(xy)[np.unique(np.linspace(0, len(xy) - 1, SAMPLE).astype(int))]


def view_map(descriptors: np.ndarray, xy: np.ndarray, spacing_m: float) -> MapView:
    """Return scale and recall as the map alone shows them.

    Args:
        descriptors: `(M, D)` of the map images, any scale.
        xy: `(M, 2)` their positions [m].
        spacing_m: median distance between neighbouring images.
    """
    chosen = np.sort(_sample_rows(xy))
    sample = jnp.asarray(normalise(descriptors[chosen]))
    parts = []
    for start in range(0, len(descriptors), 8192):
        block = jnp.asarray(normalise(descriptors[start : start + 8192]))
        parts.append(np.asarray(similarities(block, sample)))
    rows = np.concatenate(parts, axis=1)
    mean = rows.mean()
    rows[np.arange(len(chosen)), chosen] = -np.inf
    gap = np.asarray(xy)[chosen] - np.asarray(xy)[np.argmax(rows, axis=1)]
    is_near = np.hypot(gap[:, 0], gap[:, 1]) <= NEAR_SPACINGS * spacing_m
    ranked = -np.sort(-rows, axis=1)
    rank = max(1, min(BACKGROUND_RANK, len(descriptors) // 2)) - 1
    background = mean + BACKGROUND_SHARE * (ranked[:, rank].mean() - mean)
    strong = mean + STRONG_SHARE * (np.quantile(ranked[:, 0], STRONG_QUANTILE) - mean)
    return MapView(np.array([background, strong]), float(is_near.mean()))


def rescale(scale: Float[Array, "2"], similarity: Float[Array, "*t c"]) -> Float[Array, "*t c"]:
    """Put similarities on the fixed scale.

    Args:
        scale: `(2,)` background and strong similarity.
        similarity: `(c,)` raw; a leading time axis where there are several frames.

    Returns:
        Values in [0, 1].
    """
    scaled = (similarity - scale[0]) / jnp.maximum(scale[1] - scale[0], LEAST_RANGE)
    return jnp.clip(scaled, 0.0, 1.0)


def correlation_gaps(descriptors: np.ndarray, xy: np.ndarray, spacing_m: float) -> float:
    """Return how far the robot drives until an image looks new, as the map alone shows it.

    Args:
        descriptors: `(M, D)` of the map images, any scale.
        xy: `(M, 2)` their positions [m].
        spacing_m: median distance between neighbouring images.

    Returns:
        The distance, in gaps, at which the mean similarity has lost half of what neighbours have
        above the background of the whole map; 64 where it never does.
    """
    chosen = _sample_rows(xy)
    sample = jnp.asarray(normalise(descriptors[chosen]))
    low, total, count = 0.5, np.zeros(len(_EDGES) - 1), np.zeros(len(_EDGES) - 1)
    every, n_every = 0.0, 0
    for start in range(0, len(descriptors), 8192):
        block = normalise(descriptors[start : start + 8192])
        rows = np.asarray(similarities(jnp.asarray(block), sample))
        gap = np.asarray(xy)[chosen][:, None] - np.asarray(xy)[start : start + len(block)][None]
        away = np.hypot(gap[..., 0], gap[..., 1]) / spacing_m
        bins = np.digitize(away, _EDGES) - 1
        is_in = (away >= low) & (bins >= 0) & (bins < len(total))
        total += np.bincount(bins[is_in], weights=rows[is_in], minlength=len(total))
        count += np.bincount(bins[is_in], minlength=len(total))
        every, n_every = every + float(rows.sum()), n_every + rows.size
    mean = total / np.maximum(count, 1)
    background, known = every / max(n_every, 1), count > 0
    if not known[0] or mean[0] <= background:
        return 1.0
    low_at = np.flatnonzero(known & (mean - background < 0.5 * (mean[0] - background)))
    return float(_EDGES[low_at[0]]) if low_at.size else float(_EDGES[-1])


_EDGES = np.array([0.5, 1.5, 2.5, 3.5, 4.5, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 64.0])


def _spread_rows(xy: np.ndarray) -> np.ndarray:
    """Return the rows by distance from the centre: the same images whatever the rows' order."""
    centred = np.asarray(xy) - np.mean(xy, axis=0)
    return np.argsort(np.hypot(centred[:, 0], centred[:, 1]), kind="stable")


NEIGHBOURS = 12
"""Anchors that mass spreads to from each anchor."""

PER_CELL = 4
"""Anchors that a cell of the filter's grid lists at most. On eight recorded maps .5 % of the cells
in reach are near to more, and list those that most of the cell is near to."""

PROBES = 4
"""Positions along each edge of a cell, its ends included, that are asked for their nearest
anchor."""

PLACES_REACH = 4.0
"""A cell of the filter's grid knows an anchor within so many gaps: twice as far as a transition
may come from."""

IN_ORDER = 0.25
"""Rows whose median step is longer than so much of the map's extent are in no driving order: of
shuffled rows it is about the extent itself, of a drive of twenty images a twentieth of it."""

LEAST_ROWS = 20
"""Maps of fewer rows are taken to be in driving order."""

MOST_UNIT = 4.0
"""A whole piece of evidence takes at most so many gaps of way, however slowly the map changes."""

MAX_CELLS = 1500
"""Cells along the longer side at most; a larger map gets coarser cells, not more memory."""

LEAST_CELLS, CELLS_GROWTH = 16_384, 2
"""Cells that a grid is padded to: so many, and so many times as many as that does not suffice. Maps
of as many rows share compiled programs."""


class MapTables(eqx.Module):
    """What `step` needs to know of the map; made once by `map_tables`."""

    spacing_m: Float[Array, ""]
    """Median distance between neighbouring anchors; the unit of all length scales."""

    extent_m: Float[Array, ""]
    """Root mean square distance of the anchors from their centre: how little is known of a place
    without any candidate."""

    scale: Float[Array, "2"]
    """Background and strong similarity."""

    recall: Float[Array, ""]
    """How far the map tells its own places apart, 0 to 1."""

    places: Places
    """The anchors and what the filter knows of them: its unit of length needs no driving order."""


def map_spacing_m(xy: np.ndarray) -> float:
    """Return the median step between consecutive map positions while the robot was moving.

    Args:
        xy: `(M, 2)` metres; in any order, but only driving order tells steps from gaps.

    Returns:
        Metres; steps below a quarter of the 90 % quantile are standstill and do not count.
        1 where the map never moves. Where the rows are in no driving order, `gap_m`.
    """
    steps = np.hypot(*np.diff(np.asarray(xy, float), axis=0).T)
    steps = steps[steps > 1e-6]
    if not steps.size:
        return 1.0
    step = float(np.median(steps[steps >= 0.25 * np.quantile(steps, 0.9)]))
    extent = float(np.sqrt(np.mean(np.sum((xy - np.mean(xy, axis=0)) ** 2, axis=1))))
    is_driven = len(xy) < LEAST_ROWS or step <= IN_ORDER * extent
    return step if is_driven else gap_m(xy)


def gap_m(xy: np.ndarray) -> float:
    """Return the median distance from a map position to the nearest other one.

    Args:
        xy: `(M, 2)` metres, any order.

    Returns:
        Metres; distances below a quarter of the 90 % quantile are standstill or a second pass and
        do not count. 1 where all positions are one.
    """
    nearest = KDTree(xy).query(xy, k=min(2, len(xy)))[0].reshape(len(xy), -1)[:, -1]
    nearest = nearest[nearest > 1e-6]
    if not nearest.size:
        return 1.0
    return float(np.median(nearest[nearest >= 0.25 * np.quantile(nearest, 0.9)]))


def capacity(n: int, least: int, growth: int) -> int:
    """Return the size that n entries are padded to: `least`, times `growth` until they fit."""
    while least < n:
        least *= growth
    return least


def _listed(tree: KDTree, centres: np.ndarray, cell_m: float, reach: float, n: int) -> np.ndarray:
    """Return `(n, cells)` anchors that may be the nearest one to a position in each cell."""
    k = min(NEIGHBOURS, tree.n)
    found = tree.query(centres, k=k, distance_upper_bound=reach)
    distance, near = (np.reshape(part, (-1, k)) for part in found)
    known = np.flatnonzero(np.isfinite(distance[:, 0]))
    edge = np.linspace(-0.5, 0.5, PROBES) * cell_m
    probes = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    cells = np.full((n, len(centres)), -1, np.int32)
    for start in range(0, len(known), 4096):
        at = known[start : start + 4096]
        away = np.asarray(tree.data)[np.minimum(near[at], tree.n - 1)] - centres[at, None]
        apart = np.sum(away**2, axis=2)[:, :, None] - 2.0 * away @ probes.T
        apart = np.where(near[at][:, :, None] < tree.n, apart, np.inf)
        votes = np.sum(np.argmin(apart, axis=1)[:, None] == np.arange(k)[:, None], axis=2)
        order = np.argsort(-votes, axis=1, kind="stable")[:, :n]
        # After them what is nearest to the centre: a probe does not see all that lies beside it.
        anchors = np.take_along_axis(near[at], order, 1)
        cells[: order.shape[1], at] = np.where(anchors < tree.n, anchors, -1).T
    return cells


def _grid(poses: np.ndarray, spacing_m: float) -> AnchorGrid:
    xy = poses[:, :2]
    tree = KDTree(xy)
    reach = PLACES_REACH * spacing_m
    low, high = xy.min(axis=0) - reach, xy.max(axis=0) + reach
    cell_m = max(spacing_m, float((high - low).max()) / MAX_CELLS)
    shape = np.ceil((high - low) / cell_m).astype(int) + 1
    centres = [low[axis] + (np.arange(shape[axis]) + 0.5) * cell_m for axis in (0, 1)]
    points = np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1).reshape(-1, 2)
    is_coarse = cell_m > spacing_m
    # From the corner of a coarse cell an anchor must be found as from that of a fine one.
    reach += np.sqrt(0.5) * (cell_m - spacing_m)
    listed = _listed(tree, points, cell_m, reach, NEIGHBOURS if is_coarse else PER_CELL)
    # Padded, because every length of this table is compiled for anew.
    room = capacity(len(points), LEAST_CELLS, CELLS_GROWTH) - len(points)
    gap, neighbour = tree.query(xy, k=min(NEIGHBOURS, len(xy)))
    gap, neighbour = gap.reshape(len(xy), -1).T, neighbour.reshape(len(xy), -1).T
    return AnchorGrid(
        xy=jnp.asarray(xy, jnp.float32),
        theta=jnp.asarray(poses[:, 2], jnp.float32),
        facing=jnp.asarray(np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], 1), jnp.float32),
        nearest=jnp.asarray(np.pad(listed, [(0, 0), (0, room)], constant_values=-1)),
        shape=jnp.asarray(shape, jnp.int32),
        corner=jnp.asarray(low, jnp.float32),
        cell_m=jnp.asarray(cell_m, jnp.float32),
        neighbour=jnp.asarray(neighbour, jnp.int32),
        neighbour_m2=jnp.asarray(gap**2, jnp.float32),
    )


def map_tables(
    poses: np.ndarray, config: StreamConfig | None = None, descriptors: np.ndarray | None = None
) -> MapTables:
    """Prepare a map for `step`.

    Args:
        poses: `(M, 3)` x [m], y [m], theta [rad] of every map image, driving order.
        config: changes nothing: the tables serve every setting.
        descriptors: `(M, D)` of the map images; they fix the similarity scale and the recall,
            which are 0 to 1 and 0.75 when omitted.

    Raises:
        InputError: arrays of a wrong shape, or poses that are not finite.
    """
    poses = np.asarray(poses, float)
    if poses.ndim != 2 or poses.shape[1] != 3 or not len(poses) or not np.isfinite(poses).all():
        raise InputError(f"poses: expected (M, 3) finite numbers, got {poses.shape}")
    if descriptors is not None and np.shape(descriptors)[:-1] != (len(poses),):
        raise InputError(f"descriptors: expected ({len(poses)}, D), got {np.shape(descriptors)}")
    spacing_m = map_spacing_m(poses[:, :2])
    view = MapView(np.array(LIST_SCALE), LIST_RECALL)
    if descriptors is not None:
        view = view_map(descriptors, poses[:, :2], spacing_m)
    centred = poses[:, :2] - poses[:, :2].mean(axis=0)
    step_m, unit = gap_m(poses[:, :2]), 1.0
    if descriptors is not None:
        unit = float(np.clip(correlation_gaps(descriptors, poses[:, :2], step_m), 1.0, MOST_UNIT))
    return MapTables(
        places=Places(
            grid=_grid(poses, step_m),
            gap_m=jnp.asarray(step_m, jnp.float32),
            unit_m=jnp.asarray(unit * step_m, jnp.float32),
            n_known=jnp.asarray(len(poses), jnp.float32),
        ),
        spacing_m=jnp.asarray(spacing_m, jnp.float32),
        extent_m=jnp.asarray(np.sqrt(np.mean(np.sum(centred**2, axis=1))), jnp.float32),
        scale=jnp.asarray(view.scale, jnp.float32),
        recall=jnp.asarray(view.recall, jnp.float32),
    )
