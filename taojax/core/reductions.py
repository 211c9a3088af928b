"""Sums over frames and first minima, spelled so that XLA runs them fast on a CPU.

Every `jnp.sum`, `jnp.argmin` or `jnp.cumsum` is a reduction with a little program of its own. XLA
keeps books on each instruction of such a program in every call of a compiled function (about 2 us
for a sum, 10 for an argmin, whatever their size), and fuses several of them into loops that it
cannot vectorise. A step held 180 of them, and half of its time went there. A matrix product is one
library call. All products are asked for in full precision: recent GPUs would use TF32.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def sum_over_frames(x: Float[Array, "n *k"]) -> Float[Array, "*k"]:
    """Sum over the leading axis."""
    return jnp.tensordot(jnp.ones(x.shape[0], x.dtype), x, 1, precision="highest")


def first_argmin(x: Float[Array, " n"]) -> Int[Array, ""]:
    """Return where the first smallest value is; there is no NaN."""
    return first_true(x == jnp.min(x))


def first_true(is_it: Bool[Array, " n"]) -> Int[Array, ""]:
    """Return the first true position, the last position without any."""
    n = is_it.shape[0]
    return jnp.min(jnp.where(is_it, jnp.arange(n), n - 1))


def broadcast_frames(
    frames: Float[Array, "n *c"], like: Float[Array, "n *k"] | Bool[Array, "n *k"]
) -> Array:
    """Give frames axes of length one where `like` has its branches, so that they broadcast."""
    ones = (1,) * (like.ndim - 1)
    return frames.reshape(frames.shape[:1] + ones + frames.shape[1:])
