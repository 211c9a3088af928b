"""The paper's own formulation of the literal cost: einsum and one batched SVD, NumPy and JAX.

What `core.cost.branch_cost` computes with one `atan2` per branch, written as the paper's section
3.1 describes it. Only the benchmark runs it: it is the rival in speed.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from taojax.core.cost import MIN_PAIRS, CostParams


def _pairs(has: Any, like: Any) -> Any:
    """Return 1 for every pair of consecutive frames that both take part."""
    return (has[:, 1:] & has[:, :-1]).astype(like.dtype)


def _rigid(  # noqa: PLR0913 - steps are handed in, so that they are taken once
    xp: Any, p: Any, q: Any, dp: Any, dq: Any, weight: Any, pair: Any, lambda_velocity: Any
) -> Any:
    """Return rotations `(k, 2, 2)` and shifts `(k, 2)` of K weighted alignments."""
    total, n_pairs = weight.sum(1, keepdims=True), pair.sum(1, keepdims=True)
    share = weight / xp.where(total > 0, total, 1.0)
    p_mean, q_mean = share @ p, xp.einsum("kn,knd->kd", share, q)
    x, y = p[None] - p_mean[:, None], q - q_mean[:, None]
    tied = 2.0 * lambda_velocity * pair / xp.where(n_pairs > 0, n_pairs, 1.0)
    # Two factors each: an einsum over weights, x and y at once takes twice as long.
    h = xp.einsum("kni,knj->kij", share[..., None] * x, y)
    h = h + xp.einsum("kni,knj->kij", tied[..., None] * dp[None], dq)
    u, _, vt = xp.linalg.svd(h)
    flip = xp.where(xp.linalg.det(h) < 0, -1.0, 1.0).astype(p.dtype)
    v = xp.swapaxes(vt, 1, 2) * xp.stack([xp.ones_like(flip), flip], 1)[:, None]
    r = v @ xp.swapaxes(u, 1, 2)
    return r, q_mean - xp.einsum("kij,kj->ki", r, p_mean)


def _squared(xp: Any, p: Any, q: Any, r: Any, t: Any) -> Any:
    gap = q - p[None] @ xp.swapaxes(r, 1, 2) - t[:, None]
    return xp.einsum("knd,knd->kn", gap, gap)


def _costs(xp: Any, params: CostParams, p: Any, q: Any, similarity: Any, has: Any) -> Any:
    n = p.shape[0]
    weight = xp.where(has, xp.asarray(1.0 / n, p.dtype), xp.zeros((), p.dtype))
    q = xp.where(has[..., None], q, xp.zeros((), p.dtype))
    dp, dq = p[1:] - p[:-1], q[:, 1:] - q[:, :-1]
    pair, lambda_velocity = _pairs(has, p), params.lambda_velocity
    r, t = _rigid(xp, p, q, dp, dq, weight, pair, lambda_velocity)
    near = has & (_squared(xp, p, q, r, t) <= params.mask_m**2)
    near_weight = weight * near.astype(p.dtype)
    r_near, t_near = _rigid(xp, p, q, dp, dq, near_weight, _pairs(near, p), lambda_velocity)
    is_few = near.sum(1) < MIN_PAIRS
    r = xp.where(is_few[:, None, None], r, r_near)
    t = xp.where(is_few[:, None], t, t_near)
    squared = _squared(xp, p, q, r, t)
    root = xp.sqrt(squared)
    linear = params.delta_m * (root - 0.5 * params.delta_m)
    rho = xp.where(root <= params.delta_m, 0.5 * squared, linear)
    geom = xp.where(has, rho, params.tau_missing).mean(1)
    turned = _squared(xp, dp, dq, r, xp.zeros_like(t))
    n_pairs = pair.sum(1)
    vel = (pair * turned).sum(1) / xp.where(n_pairs > 0, n_pairs, 1.0)
    sim = 1.0 - xp.where(has, similarity, xp.zeros((), p.dtype)).mean(1)
    return geom + lambda_velocity * vel + params.gamma_similarity * sim


def numpy_cost(
    params: CostParams,
    p: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, "k n 2"],
    similarity: Float[np.ndarray, "k n"],
    has_anchor: Bool[np.ndarray, "k n"],
) -> Float[np.ndarray, " k"]:
    """Evaluate Eq. 1 for K branches with `np.einsum` and `np.linalg.svd`.

    Args:
        params: weights and length scales.
        p: `(n, 2)` local trajectory, metres, equal weights.
        q: `(k, n, 2)` anchors, metres.
        similarity: `(k, n)`, at most 1.
        has_anchor: `(k, n)`.

    Returns:
        `(k,)` costs, m^2.

    Source:
        Paper, section 3.1.
    """
    return _costs(np, params, p, q, similarity, has_anchor)


@jax.jit
def svd_cost(
    params: CostParams,
    p: Float[Array, "n 2"],
    q: Float[Array, "k n 2"],
    similarity: Float[Array, "k n"],
    has_anchor: Bool[Array, "k n"],
) -> Float[Array, " k"]:
    """Evaluate the same, jitted; arguments as in `numpy_cost`."""
    return _costs(jnp, params, p, q, similarity, has_anchor)
