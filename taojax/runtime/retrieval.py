"""Exact top-K place retrieval by cosine similarity, in bounded memory, over every device.

places = prepare(map_descriptors)                       # once per map that fits the devices
index, similarity = top_k(places, normalise(query))     # per frame, at the speed of memory
index, similarity = retrieve(map_descriptors, queries)  # a whole log; the map is read in blocks
"""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, Float, Int

from taojax.runtime.parallel import AXIS, CUT, WHOLE, device_mesh

QUERY_CHUNK = 64
"""Queries per matrix product. Fixed and padded, so that the bits of one frame's similarities do
not depend on how many frames come after it."""

MAP_BLOCK = 32_768
"""Map rows per block and device; bounds memory at two blocks of MAP_BLOCK x D on each, and one
more on the host."""

DENSE_QUERIES = 512
"""Queries per block where every similarity is kept."""

N_KEPT = 100
"""Candidates kept per frame, the paper's K: recall@100 needs them whatever the branches."""

CACHE_NUMBERS = 65_536
"""Numbers normalised at once: few enough to stay in a core's cache between the passes."""


class Places(eqx.Module):
    """A map made ready by `prepare`; stays on the devices between queries."""

    rows: Float[Array, "m d"]
    """Unit rows, cut over the mesh; zero rows at the end make the cuts equal."""

    n_places: int = eqx.field(static=True)
    """Rows that are places."""

    mesh: Mesh = eqx.field(static=True)


def normalise(descriptors: np.ndarray) -> np.ndarray:
    """Return float32 rows of unit length; a zero row stays zero and resembles nothing."""
    unit = np.empty(descriptors.shape, np.float32)
    n_rows = max(1, CACHE_NUMBERS // descriptors.shape[1])
    for start in range(0, len(unit), n_rows):
        part = slice(start, start + n_rows)
        rows = np.asarray(descriptors[part], np.float32)
        # Scaling first keeps the squares of very large or very small rows inside float32.
        peak = np.max(np.abs(rows), axis=1, keepdims=True)
        rows = rows / np.where(peak > 0, peak, 1.0)
        norm = np.sqrt(np.sum(np.square(rows, dtype=np.float64), axis=1, keepdims=True))
        unit[part] = rows / np.where(norm > 0, norm, 1.0)
    return unit


@jax.jit
def similarities(
    map_rows: Float[Array, "m d"], query_rows: Float[Array, "b d"]
) -> Float[Array, "b m"]:
    """Return cosines of unit rows, clipped to [-1, 1].

    Full float32 also on accelerators whose default would be TF32 or bfloat16.
    """
    product = jnp.matmul(map_rows, query_rows.T, precision=jax.lax.Precision.HIGHEST)
    return jnp.clip(product, -1.0, 1.0).T


def dense(map_descriptors: np.ndarray, query_descriptors: np.ndarray) -> np.ndarray:
    """Return `(T, M)` cosines of every query with every map image, a block of queries at a time.

    Args:
        map_descriptors: `(M, D)`, any scale.
        query_descriptors: `(T, D)`.
    """
    rows, n = jnp.asarray(normalise(map_descriptors)), DENSE_QUERIES
    parts = [
        np.asarray(similarities(rows, jnp.asarray(normalise(query_descriptors[at : at + n]))))
        for at in range(0, len(query_descriptors), n)
    ]
    return np.concatenate(parts)


def prepare(map_descriptors: np.ndarray, mesh: Mesh | None = None) -> Places:
    """Normalise a map once and leave it on the devices.

    Args:
        map_descriptors: `(M, D)`, any scale; may be memory-mapped: each process reads only the
            rows of its own devices.
        mesh: from `device_mesh`, all devices of all processes when omitted.

    Returns:
        What `top_k` and `retrieve` ask; float32, `4 M D` bytes over all devices.
    """
    mesh = device_mesh() if mesh is None else mesh
    n_rows = -(-len(map_descriptors) // mesh.size)

    def own_rows(part: Any) -> np.ndarray:
        unit = normalise(map_descriptors[part[0]])
        lacking = n_rows - len(unit)
        return np.pad(unit, ((0, lacking), (0, 0))) if lacking else unit

    shape = (n_rows * mesh.size, map_descriptors.shape[1])
    rows = jax.make_array_from_callback(shape, NamedSharding(mesh, CUT), own_rows)
    return Places(rows, len(map_descriptors), mesh)


def _best(
    index: Int[Array, "b c"], similarity: Float[Array, "b c"], k: int
) -> tuple[Int[Array, "b k"], Float[Array, "b k"]]:
    """Keep the k best of some candidates; of equal ones those that come first."""
    similarity, order = jax.lax.top_k(similarity, min(k, similarity.shape[1]))
    return jnp.take_along_axis(index, order, axis=1), similarity


@jax.jit(static_argnames="k")
def top_k(
    places: Places, queries: Float[Array, "b d"], k: int = N_KEPT
) -> tuple[Int[Array, "b kept"], Float[Array, "b kept"]]:
    """Find the k most similar places of a few queries: the best of each device, then of all.

    Args:
        places: from `prepare`.
        queries: `(B, D)` unit rows, from `normalise`, the same in every process; each device
            needs room for `4 B M / devices` bytes.
        k: candidates wanted.

    Returns:
        `(B, min(k, M))` int32 map rows and float32 cosines, best first, ties by map row.
    """

    def own_best(
        rows: Float[Array, "m d"], queries: Float[Array, "b d"]
    ) -> tuple[Int[Array, "b kept"], Float[Array, "b kept"]]:
        n = len(rows)
        first = n * jax.lax.axis_index(AXIS)
        similarity = similarities(rows, queries)
        if n * places.mesh.size > places.n_places:
            is_place = first + jnp.arange(n, dtype=jnp.int32) < places.n_places
            similarity = jnp.where(is_place[None], similarity, -jnp.inf)
        similarity, index = jax.lax.top_k(similarity, min(k, n))
        # In the order of the devices, which is the order of the map rows.
        together = lambda own: jax.lax.all_gather(own, AXIS, axis=1, tiled=True)
        return _best(together(index + first), together(similarity), min(k, places.n_places))

    # The check of what varies does not know that a gathered array is the same everywhere.
    over_devices = jax.shard_map(
        own_best, mesh=places.mesh, in_specs=(CUT, WHOLE), out_specs=WHOLE, check_vma=False
    )
    return over_devices(places.rows, queries)


@jax.jit(static_argnames="k")
def _merge(
    kept: tuple[Int[Array, "b kept"], Float[Array, "b kept"]],
    found: tuple[Int[Array, "b found"], Float[Array, "b found"]],
    start: Int[Array, ""],
    k: int,
) -> tuple[Int[Array, "b both"], Float[Array, "b both"]]:
    """Add what one more block of the map has, whose first row is `start`."""
    index = jnp.concatenate([kept[0], found[0] + start], axis=1)
    return _best(index, jnp.concatenate([kept[1], found[1]], axis=1), k)


def _blocks(map_descriptors: np.ndarray | Places, mesh: Mesh) -> Iterator[tuple[int, Places]]:
    """Yield first row and block of a map that may be larger than the devices."""
    if isinstance(map_descriptors, Places):
        yield 0, map_descriptors
        return
    step = MAP_BLOCK * mesh.size
    for start in range(0, len(map_descriptors), step):
        yield start, prepare(map_descriptors[start : start + step], mesh)


def retrieve(
    map_descriptors: np.ndarray | Places,
    query_descriptors: np.ndarray,
    k: int = N_KEPT,
    *,
    mesh: Mesh | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the k most similar map images of every query.

    Args:
        map_descriptors: `(M, D)`, any scale; may be memory-mapped. Or from `prepare`.
        query_descriptors: `(T, D)`, any scale, the same in every process.
        k: candidates wanted.
        mesh: from `device_mesh`, all devices of all processes when omitted; a prepared map has
            its own.

    Returns:
        `(T, k)` int32 map rows and `(T, k)` float32 cosines, best first, ties by map row; where
        the map has fewer than k rows the rest is -1 and 0. The same in every process.
    """
    mesh = device_mesh() if mesh is None else mesh
    n_query, width = query_descriptors.shape
    queries = np.zeros((-(-n_query // QUERY_CHUNK), QUERY_CHUNK, width), np.float32)
    queries.reshape(-1, width)[:n_query] = normalise(query_descriptors)
    kept = []
    for start, block in _blocks(map_descriptors, mesh):
        # The next block was read while the devices worked; waiting here bounds the memory.
        jax.block_until_ready(kept)
        found = [top_k(block, chunk, k) for chunk in queries]
        if kept:
            pairs = zip(kept, found, strict=True)
            kept = [_merge(old, new, np.int32(start), k) for old, new in pairs]
        else:
            kept = found
    index = np.full((queries.shape[0], QUERY_CHUNK, k), -1, np.int32)
    similarity = np.zeros(index.shape, np.float32)
    for chunk, (rows, cosines) in enumerate(kept):
        index[chunk, :, : rows.shape[1]] = rows
        similarity[chunk, :, : rows.shape[1]] = cosines
    return index.reshape(-1, k)[:n_query], similarity.reshape(-1, k)[:n_query]
