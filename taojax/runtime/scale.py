"""One fixed, causal scale for similarity: background -> 0, strong match -> 1.

Per-frame scaling would throw away the absolute level, which on real data says most. The scale comes
from the map's own images where their descriptors are known, and from running statistics of past
answers where only retrieval lists are.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from taojax.runtime.retrieval import normalise, similarities

N_BINS = 512
"""Resolution of the running quantile: similarities in [-1, 1] to 1/256."""

STRONG_QUANTILE = 0.75
"""Of the map images' best other map image."""

RUNNING_QUANTILE = 0.99
"""Of the past top-1 similarities, where the map says nothing."""

LEAST_RANGE = 0.02
"""Strong match and background never count as closer than this."""

BACKGROUND_RANK = 100
"""The background is the similarity of the 100th best image, the paper's K."""

SAMPLE = 512
"""Map images that vote on the scale, evenly spaced."""


class ScaleState(eqx.Module):
    """Running statistics of past answers."""

    background_sum: Float[Array, ""]
    n: Float[Array, ""]
    top1_counts: Float[Array, " bins"]


def init_scale() -> ScaleState:
    """Return statistics of no answers."""
    return ScaleState(jnp.zeros(()), jnp.zeros(()), jnp.zeros(N_BINS))


def map_scale(descriptors: np.ndarray) -> np.ndarray:
    """Return background and strong similarity as the map alone shows them.

    Args:
        descriptors: `(M, D)` of the map images, any scale.

    Returns:
        `(2,)` background: mean similarity of the 100th best other map image (of the median one in
        small maps); strong: 75 % quantile of the best other map image.
    """
    chosen = np.unique(np.linspace(0, len(descriptors) - 1, SAMPLE).astype(int))
    sample = jnp.asarray(normalise(descriptors[chosen]))
    parts = []
    for start in range(0, len(descriptors), 8192):
        block = jnp.asarray(normalise(descriptors[start : start + 8192]))
        parts.append(np.asarray(similarities(block, sample)))
    rows = np.concatenate(parts, axis=1)
    rows[np.arange(len(chosen)), chosen] = -np.inf
    ranked = -np.sort(-rows, axis=1)
    rank = max(1, min(BACKGROUND_RANK, len(descriptors) // 2)) - 1
    return np.array([ranked[:, rank].mean(), np.quantile(ranked[:, 0], STRONG_QUANTILE)])


def rescale(
    state: ScaleState, known: Float[Array, "2"], row: Float[Array, " m"]
) -> tuple[ScaleState, Float[Array, " m"]]:
    """Put one frame's similarities on the fixed scale.

    Args:
        state: statistics of the frames before.
        known: `(2,)` the map's own background and strong similarity; NaN where unknown.
        row: `(m,)` raw similarities; NaN = not among the candidates.

    Returns:
        Statistics with this frame, and `(m,)` values in [0, 1]; 0 for anchors not listed.
    """
    is_listed = ~jnp.isnan(row)
    top1 = jnp.max(jnp.where(is_listed, row, -1.0))
    lowest = jnp.min(jnp.where(is_listed, row, 1.0))
    heard = jnp.any(is_listed).astype(row.dtype)
    bin_of_top1 = jnp.clip((top1 + 1.0) * (N_BINS / 2), 0, N_BINS - 1).astype(jnp.int32)
    state = ScaleState(
        state.background_sum + heard * lowest,
        state.n + heard,
        state.top1_counts.at[bin_of_top1].add(heard),
    )
    share = jnp.cumsum(state.top1_counts) / jnp.maximum(state.n, 1.0)
    strong = (jnp.argmax(share >= RUNNING_QUANTILE).astype(row.dtype) + 0.5) * (2 / N_BINS) - 1.0
    background = state.background_sum / jnp.maximum(state.n, 1.0)
    low = jnp.where(jnp.isnan(known[0]), background, known[0])
    high = jnp.where(jnp.isnan(known[1]), strong, known[1])
    scaled = jnp.clip((row - low) / jnp.maximum(high - low, LEAST_RANGE), 0.0, 1.0)
    return state, jnp.where(is_listed, scaled, 0.0)
