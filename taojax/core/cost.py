"""The trajectory-anchor cost of one branch (paper, Eq. 1), term by term.

A branch is one anchor per window frame. Its cost is Eq. 1 at the closed-form alignment; the
off-map signal of a frame is the minimum over its branches (`vmap` adds them).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from taojax.core.procrustes import RigidFit, angle_evidence, fit_se2
from taojax.core.se2 import rotate

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
    """One hypothesis followed through the window, in time order; a leading axis under `vmap`."""

    q: Float[Array, "*k n 2"]
    """Anchor of each frame, map frame [m]; anything finite where `has_anchor` is false."""

    similarity: Float[Array, "*k n"]
    """Frontend similarity of each anchor, at most 1."""

    has_anchor: Bool[Array, "*k n"]
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

    is_inlier: Bool[Array, "*k n"]
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
    turned = rotate(T_map_odom[2], p)
    return jnp.sum((q - turned - T_map_odom[None, :2]) ** 2, axis=-1)


def _steps(x: Float[Array, "n 2"]) -> Float[Array, "n-1 2"]:
    return x[1:] - x[:-1]


def _normalised(weight: Float[Array, " n"]) -> Float[Array, " n"]:
    total = jnp.sum(weight)
    return weight / jnp.where(total > 0, total, 1.0)


def _fit(
    p: Float[Array, "n 2"],
    q: Float[Array, "n 2"],
    weight: Float[Array, " n"],
    lambda_velocity: float | Float[Array, ""],
) -> RigidFit:
    """Minimise the quadratic surrogate of Eq. 1 over the frames that have weight."""
    pair = pair_weights(weight > 0, p)
    # The factor 2 is the 1/2 in rho: Eq. 1 weighs |dq - R dp|^2, not half of it.
    velocity = angle_evidence(_steps(p), _steps(q), 2.0 * lambda_velocity * pair)
    return fit_se2(p, q, _normalised(weight), velocity)


class Terms(NamedTuple):
    """Eq. 1 at one alignment, term by term [m^2]."""

    geom: Float[Array, ""]
    vel: Float[Array, ""]
    sim: Float[Array, ""]


def pair_weights(is_on: Bool[Array, " n"], like: Float[Array, "n 2"]) -> Float[Array, " n-1"]:
    """Share the velocity term among the consecutive pairs of which both frames take part."""
    return _normalised((is_on[1:] & is_on[:-1]).astype(like.dtype))


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
    q = jnp.where(branch.has_anchor[:, None], branch.q, 0.0)
    rho = huber(squared_residuals(T_map_odom, p, q), params.delta_m)
    rho = jnp.where(branch.has_anchor, rho, params.tau_missing)
    pair = pair_weights(branch.has_anchor & (weight > 0), p)
    turn_only = jnp.concatenate([jnp.zeros(2, p.dtype), T_map_odom[2:]])
    mismatch = squared_residuals(turn_only, _steps(p), _steps(q))
    similarity = jnp.where(branch.has_anchor, branch.similarity, 0.0)
    return Terms(
        geom=jnp.sum(weight * rho),
        vel=params.lambda_velocity * jnp.sum(pair * mismatch),
        sim=params.gamma_similarity * jnp.sum(weight * (1.0 - similarity)),
    )


def branch_cost(
    params: CostParams, p: Float[Array, "n 2"], branch: Branch, weight: Float[Array, " n"]
) -> BranchCost:
    """Evaluate Eq. 1 for one branch at its closed-form minimiser.

    The fit is repeated once without the frames outside the residual mask, if at least three stay.
    The cost is always taken over all frames of the window: dropping a frame from the fit must
    never make a branch look better.

    Args:
        params: weights and length scales.
        p: `(n, 2)` local trajectory in time order, last pose at the origin, metres.
        branch: one anchor per frame.
        weight: `(n,)` weights of the filled window frames, summing to one; 0 for frames that are
            not there yet. Frames without an anchor keep their weight and cost tau + gamma.

    Returns:
        The three terms, the alignment, the inliers, and whether the window is degenerate. Finite
        for every finite input, and so are the gradients.

    Source:
        Paper, Eq. 1 and the residual mask of section 3.1. The mean in the velocity term keeps the
        meaning of lambda when the window changes.
    """
    supported = jnp.where(branch.has_anchor, weight, 0.0)
    # A masked-out anchor must not reach the arithmetic: 0 * inf is NaN, and so is its gradient.
    q = jnp.where(branch.has_anchor[:, None], branch.q, 0.0)
    first = _fit(p, q, supported, params.lambda_velocity)
    is_near = squared_residuals(first.T_map_odom, p, q) <= params.mask_m**2
    masked = jnp.where(is_near, supported, 0.0)
    second = _fit(p, q, masked, params.lambda_velocity)
    keep_first = (jnp.sum(masked > 0) < MIN_PAIRS) | second.is_degenerate
    T_map_odom = jnp.where(keep_first, first.T_map_odom, second.T_map_odom)
    is_degenerate = first.is_degenerate | (jnp.sum(supported > 0) < MIN_PAIRS)

    terms = cost_terms(params, p, branch, weight, T_map_odom)
    is_near = squared_residuals(T_map_odom, p, q) <= params.mask_m**2
    return BranchCost(
        geom=terms.geom,
        vel=terms.vel,
        sim=terms.sim,
        T_map_odom=T_map_odom,
        is_inlier=(supported > 0) & is_near,
        is_degenerate=is_degenerate,
    )
