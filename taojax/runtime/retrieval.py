"""Exact top-K place retrieval by cosine similarity, in bounded memory."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

QUERY_CHUNK = 64
"""Queries per matrix product. Fixed and padded, so that the bits of one frame's similarities do
not depend on how many frames come after it."""

MAP_BLOCK = 32_768
"""Map rows per block; bounds memory at MAP_BLOCK x D."""

N_KEPT = 100
"""Candidates kept per frame, the paper's K: recall@100 needs them whatever the branches."""


def normalise(descriptors: np.ndarray) -> np.ndarray:
    """Return float32 rows of unit length; a zero row stays zero and resembles nothing."""
    rows = np.asarray(descriptors, np.float32)
    # Scaling first keeps the squares of very large or very small rows inside float32.
    peak = np.max(np.abs(rows), axis=1, keepdims=True)
    rows = rows / np.where(peak > 0, peak, 1.0)
    norm = np.sqrt(np.sum(rows.astype(np.float64) ** 2, axis=1, keepdims=True))
    return (rows / np.where(norm > 0, norm, 1.0)).astype(np.float32)


@jax.jit
def similarities(
    map_rows: Float[Array, "m d"], query_rows: Float[Array, "b d"]
) -> Float[Array, "b m"]:
    """Return cosines of unit rows, clipped to [-1, 1].

    Full float32 also on accelerators whose default would be TF32 or bfloat16.
    """
    product = jnp.matmul(map_rows, query_rows.T, precision=jax.lax.Precision.HIGHEST)
    return jnp.clip(product, -1.0, 1.0).T


@functools.partial(jax.jit, static_argnames="k")
def _merge(
    best: Float[Array, "b kept"],
    where: Int[Array, "b kept"],
    rows: Float[Array, "b m"],
    start: Int[Array, ""],
    k: int,
) -> tuple[Float[Array, "b k"], Int[Array, "b k"]]:
    """Keep the k best of those found so far and of one more block."""
    similarity, index = jax.lax.top_k(rows, min(k, rows.shape[1]))
    # Earlier blocks come first: top_k then breaks ties by the lower map row.
    similarity = jnp.concatenate([best, similarity], axis=1)
    index = jnp.concatenate([where, index + start], axis=1)
    similarity, order = jax.lax.top_k(similarity, min(k, similarity.shape[1]))
    return similarity, jnp.take_along_axis(index, order, axis=1)


def retrieve(
    map_descriptors: np.ndarray, query_descriptors: np.ndarray, k: int = N_KEPT
) -> tuple[np.ndarray, np.ndarray]:
    """Find the k most similar map images of every query.

    Args:
        map_descriptors: `(M, D)`, any scale; may be memory-mapped.
        query_descriptors: `(T, D)`, any scale.
        k: candidates wanted.

    Returns:
        `(T, k)` int32 map rows and `(T, k)` float32 cosines, best first, ties by map row; where
        the map has fewer than k rows the rest is -1 and 0.
    """
    n_query = len(query_descriptors)
    queries = normalise(query_descriptors)
    padded = np.zeros((-(-n_query // QUERY_CHUNK) * QUERY_CHUNK, queries.shape[1]), np.float32)
    padded[:n_query] = queries
    best = [jnp.zeros((QUERY_CHUNK, 0))] * (len(padded) // QUERY_CHUNK)
    where = [jnp.zeros((QUERY_CHUNK, 0), jnp.int32)] * len(best)
    for start in range(0, len(map_descriptors), MAP_BLOCK):
        block = jnp.asarray(normalise(map_descriptors[start : start + MAP_BLOCK]))
        for i in range(len(best)):
            chunk = jnp.asarray(padded[i * QUERY_CHUNK : (i + 1) * QUERY_CHUNK])
            rows = similarities(block, chunk)
            best[i], where[i] = _merge(best[i], where[i], rows, jnp.asarray(start), k)
    index = np.full((n_query, k), -1, np.int32)
    similarity = np.zeros((n_query, k), np.float32)
    found = best[0].shape[1]
    index[:, :found] = np.concatenate(where)[:n_query]
    similarity[:, :found] = np.concatenate(best)[:n_query]
    return index, similarity
