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
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from taojax.core.anchors import AnchorGrid, look_up
from taojax.core.cost import huber, squared_residuals
from taojax.core.procrustes import AngleEvidence, fit_se2
from taojax.core.se2 import transform
from taojax.core.sums import over_frames

ROUNDS = 1
"""Alternations per frame; a second one changed no result and doubles the work."""


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

    listed: Int[Array, "n c"]
    """Anchors that each frame's list names; anything where its similarity is 0."""

    similarity: Float[Array, "n c"]
    """Theirs on the fixed scale: 1 strong match, 0 background, as for every anchor not named."""

    pooled: UInt[Array, "n m"]
    """Place in the list of the best anchor in every anchor's neighbourhood, from `pool`."""


class Pairing(eqx.Module):
    """The anchor of each frame and what it costs at one alignment."""

    anchor: Int[Array, " n"]
    """-1 without one."""

    q: Float[Array, "n 2"]
    """Its position, map frame [m]."""

    sim: Float[Array, " n"]
    """Its similarity cost gamma (1 - s)."""

    geom: Float[Array, " n"]
    """Its residual cost rho_delta / delta^2, infinite without an anchor."""

    r: Float[Array, " n"]
    """Its residual [m]."""


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


def evaluate(
    params: JointParams, window: JointWindow, pairing: Pairing, pose: Float[Array, "3"]
) -> Pairing:
    """Return the same pairs with their residuals at another alignment."""
    r = jnp.sqrt(squared_residuals(pose, window.p, pairing.q))
    # Without an anchor a frame must be truncated whatever its residual.
    geom = jnp.where(pairing.anchor >= 0, huber(r**2, params.delta_m), jnp.inf)
    return Pairing(pairing.anchor, pairing.q, pairing.sim, geom / params.delta_m**2, r)


def find(
    params: JointParams, grid: AnchorGrid, window: JointWindow, pose: Float[Array, "3"]
) -> Pairing:
    """Return the best anchor near each frame's predicted position."""
    near = look_up(grid, transform(pose[None], window.p))
    row = jnp.maximum(near, 0)
    frames, c = jnp.arange(near.shape[0]), window.listed.shape[1]
    place = window.pooled[frames, row].astype(jnp.int32)
    is_listed, place = place < c, jnp.minimum(place, c - 1)
    anchor = jnp.where(is_listed, window.listed[frames, place], row)
    similarity = jnp.where(is_listed, window.similarity[frames, place], 0.0)
    found = Pairing(
        anchor=jnp.where(near >= 0, anchor, -1),
        q=grid.xy[anchor],
        sim=params.gamma * (1.0 - similarity),
        geom=jnp.zeros_like(similarity),
        r=jnp.zeros_like(similarity),
    )
    return evaluate(params, window, found, pose)


def associate(
    params: JointParams,
    grid: AnchorGrid,
    window: JointWindow,
    old: Pairing,
    pose: Float[Array, "3"],
) -> Pairing:
    """Half step (a): give each frame the best anchor near its predicted position.

    The look-up is approximate, so the old anchor stays where it is cheaper.
    """
    new, old = find(params, grid, window, pose), evaluate(params, window, old, pose)
    keeps = old.geom + old.sim <= new.geom + new.sim
    return jax.tree.map(
        lambda a, b: jnp.where(keeps if a.ndim == 1 else keeps[:, None], a, b), old, new
    )


def refit(
    params: JointParams,
    window: JointWindow,
    pairing: Pairing,
    pose: Float[Array, "3"],
    theta0: Float[Array, ""],
) -> Float[Array, "3"]:
    """Half step (b): solve the alignment again over the frames that found support.

    Args:
        params: weights.
        window: what the frontend said.
        pairing: evaluated at `pose`.
        pose: the old alignment.
        theta0: heading of the prior.

    Returns:
        The minimiser of the Huber majoriser (IRLS weights min(1, delta / r)) plus heading prior;
        the old pose where no frame has support.
    """
    is_inlier = pairing.geom + pairing.sim < params.gamma
    r = jnp.maximum(pairing.r, params.delta_m)
    weight = jnp.where(is_inlier, window.weight / (r * params.delta_m), 0.0)
    prior = AngleEvidence(
        params.kappa * jnp.cos(theta0), params.kappa * jnp.sin(theta0), jnp.asarray(params.kappa)
    )
    fit = fit_se2(window.p, pairing.q, weight, prior=prior)
    return jnp.where(fit.is_degenerate, pose, fit.T_map_odom)


def objective(
    params: JointParams,
    window: JointWindow,
    pairing: Pairing,
    pose: Float[Array, "3"],
    theta0: Float[Array, ""],
) -> Float[Array, ""]:
    """Return J of a pairing evaluated at `pose`, which both half steps can only lower."""
    truncated = jnp.minimum(params.gamma, pairing.geom + pairing.sim)
    return over_frames(window.weight * truncated) + params.kappa * (1.0 - jnp.cos(pose[2] - theta0))


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
    pairing, pose = find(params, grid, window, seed), seed
    for _ in range(ROUNDS):
        pose = refit(params, window, pairing, pose, seed[2])
        pairing = associate(params, grid, window, pairing, pose)
    is_inlier = (pairing.geom + pairing.sim < params.gamma) & (window.weight > 0)
    supported = jnp.where(is_inlier, window.weight, 0.0)
    return JointBranch(
        cost=objective(params, window, pairing, pose, seed[2]),
        geom=over_frames(supported * jnp.where(is_inlier, pairing.geom, 0.0)),
        sim=over_frames(supported * pairing.sim),
        T_map_odom=pose,
        anchor=pairing.anchor,
        frame_cost=jnp.minimum(params.gamma, pairing.geom + pairing.sim),
        is_inlier=is_inlier,
    )
