"""Every frame-level signal, one function each: larger means more likely off the map.

Each takes one frame's candidates, best first. `is_there` marks the candidates that exist; a
missing one has similarity 0.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.core.procrustes import weighted_mean
from taojax.core.sums import over_frames

WINDOWS = (5, 10, 20)
"""Lengths of the windowed top-1 signals, frames."""

SUE_CANDIDATES = 10
SUE_SHARPNESS = 20.0
"""Weights of the spatial spread: softmax(20 s) over the top 10."""


def top1(similarity: Float[Array, " k"]) -> Float[Array, ""]:
    """Return 1 - similarity of the best candidate; 1 without one."""
    return 1.0 - similarity[0]


def windowed_means(history: Float[Array, " w"], n_seen: Int[Array, ""]) -> Float[Array, " l"]:
    """Return the means of a signal over its last frames, one per length in `WINDOWS`.

    Args:
        history: oldest first, newest last.
        n_seen: how many entries are filled, from the end.
    """
    age = jnp.arange(history.shape[0])[::-1, None]
    lengths = jnp.minimum(jnp.asarray(WINDOWS), n_seen)
    is_in = (age < lengths[None]).astype(history.dtype)
    return over_frames(is_in * history[:, None]) / jnp.maximum(lengths.astype(history.dtype), 1.0)


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
    # -sum p log p with p = w / total, where log w is the logit.
    total, energy = over_frames(jnp.stack([weight, weight * jnp.where(is_there, logits, 0.0)], 1))
    safe = jnp.where(total > 0, total, 1.0)
    nats = jnp.maximum(jnp.log(safe) - energy / safe, 0.0)
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
    # Relative to the best candidate, so that far-off map coordinates cost no digits.
    offset = positions[:n] - positions[:1]
    mean = weighted_mean(offset, weight)
    across, up = weighted_mean((offset - mean[None]) ** 2, weight)
    return across + up
