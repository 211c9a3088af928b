r"""The minimum of the true Huber objective of Eq. 1: what the closed form only approximates.

The closed form minimises a quadratic. Re-weighting every frame by min(1, delta / r) gives a
quadratic that lies above the Huber objective and touches it at the present alignment, so solving
it in closed form, again and again, can only lower the cost: iteratively re-weighted least squares
(IRLS). Its fixed points are the stationary points of Eq. 1, and optimistix looks for one.

No line search, no damping, no linear system: under `vmap` on a CPU it was faster than optimistix's
BFGS and Levenberg-Marquardt in every case tried, at the same optimum. `StreamConfig(refine=True)`
turns it on; a detector hardly gains by it (`python -m benchmarks refinement`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from taojax.core.cost import (
    MIN_PAIRS,
    Branch,
    BranchCost,
    CostParams,
    branch_cost,
    cost_terms,
    squared_residuals,
    step_pairs,
)
from taojax.core.procrustes import fit_se2, weighted_mean
from taojax.core.se2 import rotate, wrap

STATUSES = ("converged", "stalled", "degenerate", "not_finite")
CONVERGED, STALLED, DEGENERATE, NOT_FINITE = range(4)

TOLERANCE = 1e-5
"""Step at which the iteration stops, in radii of the window. The cost is flat at its minimum:
its relative error is far smaller. Part of the detector wherever the refined cost is the signal."""

MAX_STEPS = 64
"""A batch runs as long as its slowest branch; hopeless branches are the slow ones."""


class Refinement(eqx.Module):
    """A branch at the minimum of Eq. 1 nearest to its start."""

    T_map_odom: Float[Array, "*k 3"]
    """Alignment; a constant to `jax.grad`."""

    cost: Float[Array, "*k"]
    """Eq. 1 there, all terms, never above `start_cost` [m^2]; infinite if `not_finite`."""

    start_cost: Float[Array, "*k"]
    """Eq. 1 at the start [m^2]; infinite if `not_finite`."""

    status: Int[Array, "*k"]
    """Position in `STATUSES`. Stalled: the steps ran out, what was found so far is returned.
    Degenerate: the pairs do not determine the alignment, the start is returned."""

    n_steps: Int[Array, "*k"]
    """Closed-form solutions computed."""


def _solve(
    params: CostParams,
    p: Float[Array, "n 2"],
    branch: Branch,
    weight: Float[Array, " n"],
    start: Float[Array, "3"],
) -> tuple[Float[Array, "3"], Int[Array, ""], Int[Array, ""]]:
    """Iterate to a fixed point; returns alignment, status and number of steps.

    Works on the increment to the start, about the centre of the window, in units of its radius:
    float32 stays exact far from the origin, one tolerance fits shift and turn, and the angle
    stays away from the seam at pi.
    """
    is_on = branch.has_anchor & (weight > 0)
    w = jnp.where(is_on, weight, 0.0)
    centre = weighted_mean(p, w)
    target = rotate(start[2], centre) + start[:2]
    radius_m2 = jnp.sum(weighted_mean((p - centre[None, :]) ** 2, w))
    unit_m = jnp.sqrt(jnp.maximum(radius_m2, params.delta_m**2))
    x = (p - centre[None, :]) / unit_m
    gap = jnp.where(is_on[:, None], branch.q - target[None, :], 0.0) / unit_m
    y = rotate(jnp.broadcast_to(-start[2], is_on.shape), gap)
    delta = params.delta_m / unit_m
    steps = step_pairs(x, y, is_on, 2.0 * params.lambda_velocity)

    def again(pose: Float[Array, "3"], _: None) -> Float[Array, "3"]:
        r = jnp.sqrt(jnp.maximum(squared_residuals(pose, x, y), delta**2))
        return fit_se2(x, y, w * delta / r, steps).T_map_odom

    found = optx.fixed_point(
        again,
        optx.FixedPointIteration(TOLERANCE, TOLERANCE),
        jnp.zeros_like(start),
        max_steps=MAX_STEPS,
        throw=False,
    )
    theta = start[2] + found.value[2]
    shift = target + unit_m * rotate(start[2], found.value[:2])
    pose = jnp.concatenate([shift - rotate(theta, centre), wrap(theta)[None]])
    is_degenerate = fit_se2(x, y, w, steps).is_degenerate | (jnp.sum(is_on) < MIN_PAIRS)
    is_converged = found.result == optx.RESULTS.successful
    status = jnp.where(is_converged, CONVERGED, STALLED)
    return pose, jnp.where(is_degenerate, DEGENERATE, status), found.stats["num_steps"]


def refine(
    params: CostParams,
    p: Float[Array, "n 2"],
    branch: Branch,
    weight: Float[Array, " n"],
    start: Float[Array, "3"],
) -> Refinement:
    """Minimise Eq. 1 for one branch from a start, usually `branch_cost(...).T_map_odom`.

    Args:
        params: weights and length scales; the residual mask is not used.
        p: `(n, 2)` local trajectory in time order, last pose at the origin, metres.
        branch: one anchor per frame; `vmap` over branches and starts.
        weight: `(n,)` weights of the filled window frames, summing to one.
        start: `(3,)` alignment to start from.

    Returns:
        The alignment found, or the start where nothing better was found. The cost is
        differentiable in everything but the start, exactly at a minimum: its gradient is that of
        Eq. 1 at a fixed alignment (envelope theorem). The alignment has no gradient.

    Raises:
        Nothing, also under `vmap`: a branch that is not finite costs infinity and leaves the
        others alone.

    Source:
        Huber, Robust Statistics, 1981, section 7.8 (modified weights never raise the objective).
    """
    is_finite = jnp.isfinite(sum(cost_terms(params, p, branch, weight, start)))
    # Harmless numbers in place of bad ones: NaN times zero is NaN, and so is its gradient.
    p, weight, start = (jnp.where(is_finite, a, 0.0) for a in (p, weight, start))
    q, similarity = (jnp.where(is_finite, a, 0.0) for a in (branch.q, branch.similarity))
    branch = Branch(q, similarity, branch.has_anchor)
    # optimistix keeps its error in JAX's default precision and refuses to iterate in any other.
    problem = jax.tree.map(
        lambda a: a.astype(float) if eqx.is_inexact_array(a) else a,
        jax.lax.stop_gradient((params, p, branch, weight, start)),
    )
    pose, status, n_steps = _solve(*problem)
    start = jax.lax.stop_gradient(start)
    pose = pose.astype(start.dtype)
    start_cost = sum(cost_terms(params, p, branch, weight, start))
    cost = sum(cost_terms(params, p, branch, weight, pose))
    is_better = (cost < start_cost) & (status != DEGENERATE)
    return Refinement(
        T_map_odom=jnp.where(is_better, pose, start),
        cost=jnp.where(is_finite, jnp.where(is_better, cost, start_cost), jnp.inf),
        start_cost=jnp.where(is_finite, start_cost, jnp.inf),
        status=jnp.where(is_finite, status, NOT_FINITE).astype(jnp.int32),
        n_steps=n_steps.astype(jnp.int32),
    )


def refined_cost(
    params: CostParams, p: Float[Array, "n 2"], branch: Branch, weight: Float[Array, " n"]
) -> BranchCost:
    """Evaluate Eq. 1 of one branch at its true minimum; `branch_cost` is the start.

    Args:
        params: weights and length scales.
        p: `(n, 2)` local trajectory in time order, last pose at the origin, metres.
        branch: one anchor per frame.
        weight: `(n,)` weights of the filled window frames, summing to one.

    Returns:
        As `branch_cost`, its total never above that of the closed form but for rounding.
    """
    closed = branch_cost(params, p, branch, weight)
    pose = refine(params, p, branch, weight, closed.T_map_odom).T_map_odom
    q = jnp.where(branch.has_anchor[:, None], branch.q, 0.0)
    is_near = squared_residuals(pose, p, q) <= params.mask_m**2
    return BranchCost(
        *cost_terms(params, p, branch, weight, pose),
        T_map_odom=pose,
        is_inlier=branch.has_anchor & (weight > 0) & is_near,
        is_degenerate=closed.is_degenerate,
    )


def refined_costs(
    params: CostParams, p: Float[Array, "n 2"], branches: Branch, weight: Float[Array, " n"]
) -> BranchCost:
    """Evaluate several branches that trail the time axis, as `branch_cost` takes them."""
    found = jax.vmap(refined_cost, in_axes=(None, None, 1, None))(params, p, branches, weight)
    return eqx.tree_at(lambda cost: cost.is_inlier, found, found.is_inlier.T)
