"""How far the frontend can be trusted, measured before anything is scored."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from taojax.runtime.observations import Observations
from taojax.runtime.retrieval import normalise, retrieve
from taojax.runtime.scale import NEAR_SPACINGS, view_map

__all__ = ["Views", "chance", "histogram", "near_m", "views"]

N_QUERIES, N_PAIRS = 1000, 64
"""Queries whose best match is looked up; rows of each side that pair with one another."""


@dataclass(frozen=True)
class Views:
    """How alike the two sessions look."""

    rows: Int[np.ndarray, " q"]
    """Queries looked at."""

    best: Int[np.ndarray, " q"]
    """Map row of the best match of each, -1 = none."""

    best_similarity: Float[np.ndarray, " q"]
    others: Float[np.ndarray, " p"]
    """Similarities of random pairs; of lists, those of all candidates behind the best."""

    own_recall: float | None
    """Share of map images whose most similar other image lies nearby; None for lists."""


def views(observations: Observations, xy: Float[np.ndarray, "m 2"], spacing_m: float) -> Views:
    """Look at best matches, random pairs and the map's likeness to itself.

    Args:
        observations: a folder in which nothing is wrong.
        xy: (M, 2) map positions [m].
        spacing_m: of the map.
    """
    if observations.retrievals is not None:
        index, similarity = observations.retrievals.index, observations.retrievals.similarity
        rows = np.flatnonzero(index[:, 0] >= 0)
        others = similarity[:, 1:][index[:, 1:] >= 0]
        return Views(rows, index[rows, 0], similarity[rows, 0], others, None)
    of_map, of_query = observations.descriptors or (np.zeros((0, 0)), np.zeros((0, 0)))
    rows = _spread(len(of_query), N_QUERIES)
    index, similarity = retrieve(of_map, of_query[rows], 1)
    pairs = [normalise(side[_spread(len(side), N_PAIRS)]) for side in (of_query, of_map)]
    recall = view_map(of_map, xy, spacing_m).recall
    return Views(rows, index[:, 0], similarity[:, 0], (pairs[0] @ pairs[1].T).ravel(), recall)


def _spread(n: int, n_kept: int) -> Int[np.ndarray, " k"]:
    return np.unique(np.linspace(0, n - 1, min(n, n_kept)).astype(int))


def near_m(spacing_m: float) -> float:
    """Return the radius within which the runtime takes two map images for one place [m]."""
    return NEAR_SPACINGS * spacing_m


def chance(map_xy: Float[np.ndarray, "m 2"], reach_m: float) -> float:
    """Return the share of other map images within a radius of one: what blind guessing hits."""
    rows = _spread(len(map_xy), 512)
    gap = map_xy[rows][:, None] - map_xy[None]
    return float((np.sum(gap**2, axis=2) <= reach_m**2).sum(axis=1).mean() - 1) / len(map_xy)


def histogram(
    a: Float[np.ndarray, " p"], b: Float[np.ndarray, " q"], n_bins: int = 12
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return common edges and the share of each sample in every bin."""
    low, high = (float(end(np.concatenate([a, b]))) for end in (np.min, np.max))
    edges = np.linspace(low, max(high, low + 1e-6), n_bins + 1)
    shares = [np.histogram(x, edges)[0] / max(1, len(x)) for x in (a, b)]
    return edges, shares[0], shares[1]
