"""One fixed scale for similarity: background -> 0, strong match -> 1.

Per-frame scaling would throw away the absolute level, which on real data says most, and a running
scale follows the robot off the map. So the scale comes from the map's own images where their
descriptors are known, and a list's similarities, which its author scaled, are taken as they are.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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


def view_map(descriptors: np.ndarray, xy: np.ndarray, spacing_m: float) -> MapView:
    """Return scale and recall as the map alone shows them.

    Args:
        descriptors: `(M, D)` of the map images, any scale.
        xy: `(M, 2)` their positions [m].
        spacing_m: median distance between neighbouring images.
    """
    chosen = np.unique(np.linspace(0, len(descriptors) - 1, SAMPLE).astype(int))
    chosen = np.sort(_spread_rows(xy)[chosen])
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


def correlation_gaps(descriptors: np.ndarray, xy: np.ndarray, gap_m: float) -> float:
    """Return how far the robot drives until an image looks new, as the map alone shows it.

    Args:
        descriptors: `(M, D)` of the map images, any scale.
        xy: `(M, 2)` their positions [m].
        gap_m: median distance between neighbouring images.

    Returns:
        The distance, in gaps, at which the mean similarity has lost half of what neighbours have
        above the background of the whole map; 64 where it never does.
    """
    chosen = np.unique(np.linspace(0, len(descriptors) - 1, SAMPLE).astype(int))
    chosen = _spread_rows(xy)[chosen]
    sample = jnp.asarray(normalise(descriptors[chosen]))
    low, total, count = 0.5, np.zeros(len(_EDGES) - 1), np.zeros(len(_EDGES) - 1)
    every, n_every = 0.0, 0
    for start in range(0, len(descriptors), 8192):
        block = normalise(descriptors[start : start + 8192])
        rows = np.asarray(similarities(jnp.asarray(block), sample))
        gap = np.asarray(xy)[chosen][:, None] - np.asarray(xy)[start : start + len(block)][None]
        away = np.hypot(gap[..., 0], gap[..., 1]) / gap_m
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
