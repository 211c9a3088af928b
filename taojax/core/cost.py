"""The trajectory-anchor cost of one branch (paper, Eq. 1), term by term.

A branch is one anchor per window frame. Its cost is Eq. 1 at the closed-form alignment; the
off-map signal of a frame is the minimum over its branches.

The function of one branch is what counts; `jax.vmap(branch_cost, in_axes=(None, None, 1, None))`
lifts it. The same lines also take the branches at once, behind the time axis: a trailing axis that
broadcasts. It exists for speed alone. A window of 20 frames and 100 branches takes 40 us so on one
core, 45 under that `vmap` and 58 with the branches in front, because XLA vectorises over what lies
innermost, and `vmap` moves it away. A test holds both forms together bit for bit.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from taojax.core.procrustes import RigidFit, VectorPairs, fit_se2
from taojax.core.reductions import broadcast_frames, sum_over_frames

MIN_PAIRS = 3
"""Fewer supported frames than this do not determine an alignment worth trusting."""


class CostParams(eqx.Module):
    """The weights and length scales of Eq. 1; scalars, so that a sweep is one `vmap`."""

    lambda_velocity: float | Float[Array, ""]
    """Weight of the velocity term, dimensionless."""

    gamma_similarity: float | Float[Array, ""]
    """Weight of the similarity term [m^2]."""

    tau_missing: float | Float[Array, ""]
    """Geometric cost of a frame without a candidate [m^2]."""

    delta_m: float | Float[Array, ""]
    """Huber threshold [m]."""

    mask_m: float | Float[Array, ""]
    """Residual mask [m]: frames beyond it do not take part in the second fit."""


class Branch(eqx.Module):
    """One hypothesis followed through the window, in time order; several trail the time axis."""

    q: Float[Array, "n *k 2"]
    """Anchor of each frame, map frame [m]; anything finite where `has_anchor` is false."""

    similarity: Float[Array, "n *k"]
    """Frontend similarity of each anchor, at most 1."""

    has_anchor: Bool[Array, "n *k"]
    """False where the frontend gave this branch no candidate."""


class BranchCost(eqx.Module):
    """Eq. 1 at its minimiser, and what stands behind it."""

    geom: Float[Array, "*k"]
    """Sum of w rho_delta(residual) [m^2]."""

    vel: Float[Array, "*k"]
    """lambda mean |dq - R dp|^2 [m^2]."""

    sim: Float[Array, "*k"]
    """gamma sum of w (1 - s) [m^2]."""

    T_map_odom: Float[Array, "*k 3"]
    """Alignment: the window's local frame in the map."""

    is_inlier: Bool[Array, "n *k"]
    """Frames with an anchor within the residual mask of the alignment."""

    is_degenerate: Bool[Array, "*k"]
    """The pairs do not determine the alignment; the terms are finite all the same."""

    @property
    def total(self) -> Float[Array, "*k"]:
        """The minimised cost, C_TAO [m^2]."""
        return self.geom + self.vel + self.sim


def huber(squared: Float[Array, "*b"], delta_m: float | Float[Array, ""]) -> Float[Array, "*b"]:
    """Return Huber's rho of a residual given squared: r^2/2, linear beyond delta [m^2].

    Taking the square keeps the gradient at r = 0 finite.
    """
    is_outside = squared > delta_m**2
    r = jnp.sqrt(jnp.where(is_outside, squared, 1.0))
    return jnp.where(is_outside, delta_m * (r - 0.5 * delta_m), 0.5 * squared)


def squared_residuals(
    T_map_odom: Float[Array, "3"], p: Float[Array, "n 2"], q: Float[Array, "n 2"]
) -> Float[Array, " n"]:
    """Return |q - (R p + t)|^2 of each frame [m^2]."""
    return _squared(_turn(T_map_odom), p, q - T_map_odom[None, :2])


def _turn(T_map_odom: Float[Array, "3"]) -> Float[Array, "2"]:
    return jnp.stack([jnp.cos(T_map_odom[2]), jnp.sin(T_map_odom[2])])


def _squared(
    turn: Float[Array, "*k 2"], x: Float[Array, "n *#k 2"], y: Float[Array, "n *k 2"]
) -> Float[Array, "n *k"]:
    """Return |y - R x|^2 of each frame [m^2]."""
    c, s, x0, x1 = turn[None, ..., 0], turn[None, ..., 1], x[..., 0], x[..., 1]
    return (y[..., 0] - (c * x0 - s * x1)) ** 2 + (y[..., 1] - (s * x0 + c * x1)) ** 2


def _steps(x: Float[Array, "n *k 2"]) -> Float[Array, "n *k 2"]:
    """Return the step into each frame; zero into the first."""
    return jnp.concatenate([jnp.zeros_like(x[:1]), x[1:] - x[:-1]])


class Terms(NamedTuple):
    """Eq. 1 at one alignment, term by term [m^2]."""

    geom: Float[Array, ""]
    vel: Float[Array, ""]
    sim: Float[Array, ""]


def step_pairs(
    p: Float[Array, "n 2"],
    q: Float[Array, "n *k 2"],
    is_on: Bool[Array, "n *k"],
    total: float | Float[Array, "*k"] = 1.0,
) -> VectorPairs:
    """Pair the steps of p with those of q; a step whose both ends take part shares the weight.

    Args:
        p: `(n, 2)` local trajectory, metres.
        q: `(n, 2)` or `(n, k, 2)` anchors, metres.
        is_on: frames that take part.
        total: sum of the weights.

    Returns:
        n pairs, the first of which weighs nothing.
    """
    both = jnp.concatenate([jnp.zeros_like(is_on[:1]), is_on[1:] & is_on[:-1]]).astype(p.dtype)
    share = both * (total / jnp.maximum(sum_over_frames(both), 1.0))[None]
    return VectorPairs(_steps(broadcast_frames(p, both)), _steps(q), share)


def cost_terms(
    params: CostParams,
    p: Float[Array, "n 2"],
    branch: Branch,
    weight: Float[Array, " n"],
    T_map_odom: Float[Array, "3"],
) -> Terms:
    """Evaluate Eq. 1 at any alignment, over all frames, without residual mask.

    Args:
        params: weights and length scales.
        p: `(n, 2)` local trajectory in time order, metres.
        branch: one anchor per frame.
        weight: `(n,)` weights of the window frames, summing to one.
        T_map_odom: the alignment.

    Returns:
        The three terms; their sum is what `branch_cost` reports as `total` at its own alignment.
    """
    squared = squared_residuals(T_map_odom, p, _clean(branch))
    return _terms(params, p, branch, weight, _turn(T_map_odom), squared)


def _clean(branch: Branch) -> Float[Array, "n *k 2"]:
    # A masked-out anchor must not reach the arithmetic: 0 * inf is NaN, and so is its gradient.
    return jnp.where(branch.has_anchor[..., None], branch.q, 0.0)


def _terms(
    params: CostParams,
    p: Float[Array, "n 2"],
    branch: Branch,
    weight: Float[Array, " n"],
    turn: Float[Array, "*k 2"],
    squared: Float[Array, "n *k"],
) -> Terms:
    rho = jnp.where(branch.has_anchor, huber(squared, params.delta_m), params.tau_missing)
    own = broadcast_frames(weight, rho)
    steps = step_pairs(p, _clean(branch), branch.has_anchor & (own > 0))
    similarity = jnp.where(branch.has_anchor, branch.similarity, 0.0)
    return Terms(
        geom=sum_over_frames(own * rho),
        vel=params.lambda_velocity * sum_over_frames(steps.weight * _squared(turn, *steps[:2])),
        sim=params.gamma_similarity * sum_over_frames(own * (1.0 - similarity)),
    )


def branch_cost(
    params: CostParams, p: Float[Array, "n 2"], branch: Branch, weight: Float[Array, " n"]
) -> BranchCost:
    """Evaluate Eq. 1 at its closed-form minimiser, for one branch or for several at once.

    The fit is repeated once without the frames outside the residual mask, if at least three stay.
    The cost is always taken over all frames of the window: dropping a frame from the fit must
    never make a branch look better.

    Args:
        params: weights and length scales.
        p: `(n, 2)` local trajectory in time order, last pose at the origin, metres.
        branch: one anchor per frame; several branches trail the time axis, the fast form of
            `vmap` over this function.
        weight: `(n,)` weights of the filled window frames, summing to one; 0 for frames that are
            not there yet. Frames without an anchor keep their weight and cost tau + gamma.

    Returns:
        The three terms, the alignment, the inliers, and whether the window is degenerate. Finite
        for every finite input, and so are the gradients.

    Source:
        Paper, Eq. 1 and the residual mask of section 3.1. The mean in the velocity term keeps the
        meaning of lambda when the window changes.
    """
    q = _clean(branch)
    supported = jnp.where(branch.has_anchor, broadcast_frames(weight, branch.has_anchor), 0.0)
    local = broadcast_frames(p, supported)

    def fit(own: Float[Array, "n *k"]) -> RigidFit:
        # The factor 2 is the 1/2 in rho: Eq. 1 weighs |dq - R dp|^2, not half of it. The fit
        # itself takes its weights as they sum, so the steps must share as much.
        steps = step_pairs(p, q, own > 0, 2.0 * params.lambda_velocity * sum_over_frames(own))
        return fit_se2(p, q, own, steps)

    first = fit(supported)
    is_near = _squared(first.turn, local, q - first.shift[None]) <= params.mask_m**2
    masked = jnp.where(is_near, supported, 0.0)
    second = fit(masked)
    keep_first = (_count(masked > 0, p) < MIN_PAIRS) | second.is_degenerate
    shift = jnp.where(keep_first[..., None], first.shift, second.shift)
    turn = jnp.where(keep_first[..., None], first.turn, second.turn)
    is_degenerate = first.is_degenerate | (_count(supported > 0, p) < MIN_PAIRS)

    squared = _squared(turn, local, q - shift[None])
    terms = _terms(params, p, branch, weight, turn, squared)
    return BranchCost(
        geom=terms.geom,
        vel=terms.vel,
        sim=terms.sim,
        T_map_odom=RigidFit(shift, turn, is_degenerate).T_map_odom,
        is_inlier=(supported > 0) & (squared <= params.mask_m**2),
        is_degenerate=is_degenerate,
    )


def _count(is_on: Bool[Array, "n *k"], like: Array) -> Float[Array, "*k"]:
    return sum_over_frames(is_on.astype(like.dtype))
