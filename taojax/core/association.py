r"""Which anchor each past frame of a branch is paired with: joint association.

A branch starts at one hypothesis about the newest frame. Two half steps then alternate on one
truncated objective, dimensionless so that gamma and tau mean the same at every scale,

$$J = \sum_i w_i \min\bigl(\tau,\; \rho_\delta(|q_{b_i} - (R p_i + t)|) / \delta^2
  + \gamma (1 - s_{b_i})\bigr) + \kappa (1 - \cos(\theta - \theta_0)),$$

(a) every frame picks the anchor b_i that is cheapest at the present alignment, and (b) the
alignment is solved again in closed form with Huber (IRLS) weights over the frames that found
support. Neither can raise J: (a) keeps the old anchor where it is better, (b) minimises a quadratic
that lies above J and touches it at the present alignment. The weights are normalised over the whole
window once, and the velocity term stays out, because it would couple neighbours.

The map is static, so (a) costs two look-ups: a grid cell names the anchor nearest to a predicted
position, and a table made once per frame names the best anchor in that anchor's neighbourhood.
Everything is written for one branch; `vmap` adds the others.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.core.cost import huber, squared_residuals
from taojax.core.procrustes import AngleEvidence, fit_se2
from taojax.core.se2 import transform

ROUNDS = 1
"""Alternations per frame; a second one changed no result and doubles the work."""


class AnchorGrid(eqx.Module):
    """The static map, prepared for look-ups."""

    xy: Float[Array, "m 2"]
    """Anchor positions, map frame [m]."""

    theta: Float[Array, " m"]
    """Anchor headings [rad]."""

    facing: Float[Array, "m 2"]
    """The same as unit vectors."""

    nearest: Int[Array, " cells"]
    """Row-major grid: the anchor nearest to a cell's centre, -1 where none is in reach."""

    shape: Int[Array, "2"]
    """Cells along x and y."""

    corner: Float[Array, "2"]
    """Lower corner of the grid, map frame [m]."""

    cell_m: Float[Array, ""]
    """Edge of a cell [m]."""

    neighbour: Int[Array, "m b"]
    """Each anchor's nearest anchors, itself first."""

    neighbour_m2: Float[Array, "m b"]
    """Their squared distances [m^2]."""

    neighbour_cost: Float[Array, "m b"]
    """rho_delta of their distances over delta^2."""


class JointParams(eqx.Module):
    """Weights of the truncated objective; scalars, so that a sweep is one `vmap`."""

    delta_m: float | Float[Array, ""]
    """Huber threshold [m]."""

    gamma: float | Float[Array, ""]
    """Cost of background similarity, and truncation level tau: a perfect distance at background
    similarity is worth no more than no support. Dimensionless."""

    kappa: float | Float[Array, ""]
    """Weight of the heading prior, dimensionless."""


class JointWindow(eqx.Module):
    """What the frontend said in each window frame; the order of the frames does not matter."""

    p: Float[Array, "n 2"]
    """Local positions; the newest is the origin [m]."""

    weight: Float[Array, " n"]
    """Frame weights, summing to one; 0 for frames that are not there yet."""

    rows: Float[Array, "n m"]
    """Similarity of every anchor on the fixed scale: 0 background, 1 strong match."""

    pooled: Int[Array, "n m"]
    """Best anchor in every anchor's neighbourhood, from `pool`."""


class JointBranch(eqx.Module):
    """One hypothesis after the alternation."""

    cost: Float[Array, "*k"]
    """J, in [0, tau + 2 kappa]."""

    geom: Float[Array, "*k"]
    """Its residual part, truncated frames left out."""

    sim: Float[Array, "*k"]
    """Its similarity part, truncated frames left out."""

    T_map_odom: Float[Array, "*k 3"]
    """Alignment; as the newest local pose is the origin, also the robot's pose."""

    anchor: Int[Array, "*k n"]
    """Anchor of each frame, -1 without one."""

    frame_cost: Float[Array, "*k n"]
    """Truncated cost of each frame, unweighted."""

    is_inlier: Bool[Array, "*k n"]
    """Frames that are cheaper with their anchor than without."""


def pool(
    grid: AnchorGrid, gamma: float | Float[Array, ""], row: Float[Array, " m"]
) -> Int[Array, " m"]:
    """Name the best anchor in every anchor's neighbourhood, for one frame.

    Args:
        grid: the map.
        gamma: weight of similarity.
        row: `(m,)` similarity of every anchor on the fixed scale.

    Returns:
        `(m,)` anchors that minimise neighbour distance cost + gamma (1 - s).
    """
    cost = grid.neighbour_cost + gamma * (1.0 - row[grid.neighbour])
    best = jnp.argmin(cost, axis=1)
    return jnp.take_along_axis(grid.neighbour, best[:, None], axis=1)[:, 0]


def look_up(grid: AnchorGrid, xy: Float[Array, "*n 2"]) -> Int[Array, "*n"]:
    """Return the anchor nearest to each position, -1 where none is in reach."""
    x = jnp.floor((xy[..., 0] - grid.corner[0]) / grid.cell_m)
    y = jnp.floor((xy[..., 1] - grid.corner[1]) / grid.cell_m)
    width, height = grid.shape[0].astype(xy.dtype), grid.shape[1].astype(xy.dtype)
    is_on = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    # Clip before the cast: a float beyond int32 has no defined integer.
    column = jnp.where(is_on, x, 0.0).astype(jnp.int32)
    row = jnp.where(is_on, y, 0.0).astype(jnp.int32)
    return jnp.where(is_on, grid.nearest[column * grid.shape[1] + row], -1)


def _frame_costs(
    params: JointParams,
    grid: AnchorGrid,
    window: JointWindow,
    anchor: Int[Array, " n"],
    pose: Float[Array, "3"],
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """Return residual cost, similarity cost and squared residual [m^2] of each frame."""
    row = jnp.maximum(anchor, 0)
    squared = squared_residuals(pose, window.p, grid.xy[row])
    geom = huber(squared, params.delta_m) / params.delta_m**2
    similarity = window.rows[jnp.arange(anchor.shape[0]), row]
    # Without an anchor a frame must be truncated whatever its residual.
    geom = jnp.where(anchor >= 0, geom, jnp.inf)
    return geom, params.gamma * (1.0 - similarity), squared


def associate(
    params: JointParams,
    grid: AnchorGrid,
    window: JointWindow,
    anchor: Int[Array, " n"],
    pose: Float[Array, "3"],
) -> Int[Array, " n"]:
    """Half step (a): give each frame the best anchor near its predicted position.

    The look-up is approximate, so the old anchor stays where it is cheaper.
    """
    near = look_up(grid, transform(jnp.broadcast_to(pose, (*window.p.shape[:1], 3)), window.p))
    frames = jnp.arange(near.shape[0])
    found = jnp.where(near >= 0, window.pooled[frames, jnp.maximum(near, 0)], -1)
    old_geom, old_sim, _ = _frame_costs(params, grid, window, anchor, pose)
    new_geom, new_sim, _ = _frame_costs(params, grid, window, found, pose)
    return jnp.where(old_geom + old_sim <= new_geom + new_sim, anchor, found)


def refit(
    params: JointParams,
    grid: AnchorGrid,
    window: JointWindow,
    anchor: Int[Array, " n"],
    pose: Float[Array, "3"],
    theta0: Float[Array, ""],
) -> Float[Array, "3"]:
    """Half step (b): solve the alignment again over the frames that found support.

    Returns:
        The minimiser of the Huber majoriser (IRLS weights min(1, delta / r)) plus heading prior;
        the old pose where no frame has support.
    """
    geom, sim, squared = _frame_costs(params, grid, window, anchor, pose)
    is_inlier = geom + sim < params.gamma
    r = jnp.sqrt(jnp.maximum(squared, params.delta_m**2))
    weight = jnp.where(is_inlier, window.weight * params.delta_m / r, 0.0) / params.delta_m**2
    prior = AngleEvidence(
        params.kappa * jnp.cos(theta0), params.kappa * jnp.sin(theta0), jnp.asarray(params.kappa)
    )
    fit = fit_se2(window.p, grid.xy[jnp.maximum(anchor, 0)], weight, prior)
    return jnp.where(fit.is_degenerate, pose, fit.T_map_odom)


def objective(
    params: JointParams,
    grid: AnchorGrid,
    window: JointWindow,
    anchor: Int[Array, " n"],
    pose: Float[Array, "3"],
    theta0: Float[Array, ""],
) -> Float[Array, ""]:
    """Return J, the truncated objective that both half steps can only lower."""
    geom, sim, _ = _frame_costs(params, grid, window, anchor, pose)
    truncated = jnp.minimum(params.gamma, geom + sim)
    return jnp.sum(window.weight * truncated) + params.kappa * (1.0 - jnp.cos(pose[2] - theta0))


def joint_branch(
    params: JointParams, grid: AnchorGrid, window: JointWindow, seed: Float[Array, "3"]
) -> JointBranch:
    """Follow one hypothesis through the window.

    Args:
        params: weights.
        grid: the map.
        window: what the frontend said.
        seed: `(3,)` hypothesis of the newest frame's pose: x [m], y [m], theta [rad].

    Returns:
        The branch after a fixed number of alternations; finite for every finite input.
    """
    anchor = jnp.full(window.p.shape[:1], -1, jnp.int32)
    pose = seed
    for _ in range(ROUNDS):
        anchor = associate(params, grid, window, anchor, pose)
        pose = refit(params, grid, window, anchor, pose, seed[2])
    anchor = associate(params, grid, window, anchor, pose)
    geom, sim, _ = _frame_costs(params, grid, window, anchor, pose)
    is_inlier = (geom + sim < params.gamma) & (window.weight > 0)
    supported = jnp.where(is_inlier, window.weight, 0.0)
    return JointBranch(
        cost=objective(params, grid, window, anchor, pose, seed[2]),
        geom=jnp.sum(supported * jnp.where(is_inlier, geom, 0.0)),
        sim=jnp.sum(supported * sim),
        T_map_odom=pose,
        anchor=anchor,
        frame_cost=jnp.minimum(params.gamma, geom + sim),
        is_inlier=is_inlier,
    )
