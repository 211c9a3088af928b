"""How far back to look: the longest memory that the newest frames do not contradict.

A seam of the map wants a short memory, a noisy frontend a long one. Lepski's rule takes both: means
over growing windows are compared, and the last one is kept whose confidence interval still meets
those of all shorter windows.

Source:
    Lepski, Theory of Probability and its Applications 35(3), 1991; as intersection of confidence
    intervals: Katkovnik, IEEE Transactions on Signal Processing 47(9), 1999.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from taojax.core.sums import running

LENGTHS = (2, 3, 5, 8, 13, 20, 30, 45, 60)
"""Windows compared, frames, about half an octave apart."""

WIDTH = 1.2
"""Half width of an interval for one frame of an even bet, in units of the cost's range."""

LEAST_SPREAD = 0.05
"""Spread of a frame's cost is never taken for smaller, in units of the even bet's."""


def adaptive_mean(
    newest_first: Float[Array, " n"], is_filled: Bool[Array, " n"]
) -> Float[Array, ""]:
    """Average costs in [0, 1] over the longest window that stays consistent.

    Args:
        newest_first: `(n,)` truncated frame costs, dimensionless.
        is_filled: `(n,)` frames that exist; a prefix.

    Returns:
        The mean over the chosen window. Intervals shrink with the root of the window, and with the
        variance m (1 - m) that a mean m leaves to a cost in [0, 1].
    """
    costs = jnp.where(is_filled, newest_first, 0.0)
    total, n_filled = running(costs), running(is_filled.astype(costs.dtype))[-1]
    low, high = jnp.full((), -jnp.inf), jnp.full((), jnp.inf)
    kept, is_alive = newest_first[0], jnp.ones((), bool)
    for length in LENGTHS:
        n = jnp.minimum(float(length), n_filled)
        mean = total[jnp.maximum(n.astype(jnp.int32) - 1, 0)] / n
        shrunk = (mean * n + 0.5) / (n + 1.0)
        spread = jnp.maximum((4.0 * shrunk * (1.0 - shrunk)) ** 2, LEAST_SPREAD)
        half = WIDTH * spread / jnp.sqrt(n)
        is_alive &= (mean - half <= high) & (mean + half >= low)
        low = jnp.where(is_alive, jnp.maximum(low, mean - half), low)
        high = jnp.where(is_alive, jnp.minimum(high, mean + half), high)
        kept = jnp.where(is_alive, mean, kept)
    return kept
