"""Every frame-level signal, one function each: larger means more likely off the map.

Each takes one frame's candidates, best first. `is_there` marks the candidates that exist; a
missing one has similarity 0.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

WINDOWS = (5, 10, 20)
"""Lengths of the windowed top-1 signals, frames."""

SUE_CANDIDATES = 10
SUE_SHARPNESS = 20.0
"""Weights of the spatial spread: softmax(20 s) over the top 10."""


def top1(similarity: Float[Array, " k"]) -> Float[Array, ""]:
    """Return 1 - similarity of the best candidate; 1 without one."""
    return 1.0 - similarity[0]


def windowed(history: Float[Array, " w"], n_seen: Int[Array, ""], length: int) -> Float[Array, ""]:
    """Return the mean of a signal over its last frames.

    Args:
        history: oldest first, newest last.
        n_seen: how many entries are filled, from the end.
        length: frames to average, at most len(history).
    """
    age = jnp.arange(history.shape[0])[::-1]
    is_in = (age < length) & (age < n_seen)
    count = jnp.sum(is_in.astype(history.dtype))
    return jnp.sum(jnp.where(is_in, history, 0.0)) / jnp.maximum(count, 1.0)


def margin(similarity: Float[Array, " k"]) -> Float[Array, ""]:
    """Return -(s_1 - s_2); a missing second candidate counts as similarity 0."""
    second = similarity[1] if similarity.shape[0] > 1 else jnp.zeros_like(similarity[0])
    return -(similarity[0] - second)


def entropy(
    similarity: Float[Array, " k"],
    is_there: Bool[Array, " k"],
    temperature: float | Float[Array, ""],
) -> Float[Array, ""]:
    """Return the entropy of the softmax of the similarities [nat]; log K without candidates."""
    logits = (similarity - similarity[0]) / temperature
    weight = jnp.where(is_there, jnp.exp(logits), 0.0)
    total = jnp.sum(weight)
    share = weight / jnp.where(total > 0, total, 1.0)
    nats = -jnp.sum(jnp.where(share > 0, share * jnp.log(jnp.where(share > 0, share, 1.0)), 0.0))
    return jnp.where(total > 0, nats, jnp.log(float(similarity.shape[0])))


def velocity(
    position: Float[Array, "2"],
    previous: Float[Array, "2"],
    has_both: Bool[Array, ""],
    odometry: Float[Array, "3"],
) -> Float[Array, ""]:
    """Return the absolute difference between the top-1 step and the odometry step [m].

    0 while there is no pair of top-1 positions to compare.
    """
    retrieved = jnp.hypot(position[0] - previous[0], position[1] - previous[1])
    driven = jnp.hypot(odometry[0], odometry[1])
    return jnp.where(has_both, jnp.abs(retrieved - driven), 0.0)


def sue(
    positions: Float[Array, "k 2"], similarity: Float[Array, " k"], is_there: Bool[Array, " k"]
) -> Float[Array, ""]:
    """Return the weighted variance of the top-10 positions, x and y summed [m^2].

    Source:
        Spatial uncertainty estimation, CVPR 2024; constants of data_specs/signals.toml.
    """
    n = min(SUE_CANDIDATES, similarity.shape[0])
    logits = SUE_SHARPNESS * (similarity[:n] - similarity[0])
    weight = jnp.where(is_there[:n], jnp.exp(logits), 0.0)
    total = jnp.sum(weight)
    weight = weight / jnp.where(total > 0, total, 1.0)
    # Relative to the best candidate, so that far-off map coordinates cost no digits.
    offset = positions[:n] - positions[:1]
    mean = jnp.sum(weight[:, None] * offset, axis=0, keepdims=True)
    return jnp.sum(weight[:, None] * (offset - mean) ** 2)
