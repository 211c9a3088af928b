"""The inside of one step: the window on the best branch, and every branch that was followed.

`step` keeps only what a row of signals needs. Here the same functions are called once more on the
states around a frame, and nothing is thrown away.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.config import StreamConfig
from taojax.core.cost import Branch, huber, squared_residuals
from taojax.core.se2 import transform
from taojax.core.sums import least
from taojax.runtime.frames import Frame
from taojax.runtime.joint import follow, joint_step
from taojax.runtime.maps import MapTables
from taojax.runtime.scale import rescale
from taojax.runtime.stream import StreamState, clean, cost_params, rank_costs, window_weight


class Inside(NamedTuple):
    """One frame's window and branches; window frames newest first."""

    is_filled: Bool[Array, " n"]
    """False for frames before the start."""

    path_m: Float[Array, "n 2"]
    """Odometry, carried into the map by the best branch."""

    anchor: Int[Array, " n"]
    """What each frame is paired with, -1 = nothing: the map row under joint association, the place
    in the frame's list under rank association."""

    cost: Float[Array, " n"]
    """Unweighted cost of each frame."""

    weight: Float[Array, " n"]
    is_inlier: Bool[Array, " n"]
    """Frames that support the branch."""

    branch_cost: Float[Array, " k"]
    """Infinite for seeds that are none."""

    branch_pose: Float[Array, "k 3"]
    """Where the robot is on each branch."""


@jax.jit
def joint_inside(
    config: StreamConfig, tables: MapTables, before: StreamState, frame: Frame
) -> Inside:
    """Look inside a joint step.

    Args:
        config: settings.
        tables: the map.
        before: the state that the step started from.
        frame: what it was given.
    """
    assert before.memory is not None  # noqa: S101 - for the type checker: joint streams have one
    odometry, index, similarity = clean(config, tables, frame)
    scaled, old = rescale(tables.scale, similarity), before.memory.joint
    seen = follow(config, tables, old, odometry, index, scaled)
    best = joint_step(config, tables, old, odometry, index, scaled)[1].best
    # The challenger answers for jumps alone, as in `joint_step`.
    is_told = seen.is_live.at[-1].set(False)
    n = config.joint_window
    order = jnp.mod(old.slot - jnp.arange(n), n)
    return Inside(
        is_filled=seen.is_filled[order],
        path_m=transform(best.T_map_odom[None], seen.window.p[order]),
        anchor=best.anchor[::-1],
        cost=best.frame_cost[::-1],
        weight=seen.window.weight[order],
        is_inlier=best.is_inlier[::-1],
        branch_cost=jnp.where(is_told, seen.branches.cost, jnp.inf),
        branch_pose=seen.branches.T_map_odom,
    )


@jax.jit
def rank_inside(
    config: StreamConfig, tables: MapTables, after: StreamState, frame: Frame
) -> Inside:
    """Look inside a rank step.

    Args:
        config: settings.
        tables: the map.
        after: the state that the step led to; its window holds all there is to know.
        frame: what it was given.
    """
    is_there = clean(config, tables, frame)[1] >= 0
    params = cost_params(config, tables)
    weight = window_weight(after.weight, after.is_filled)
    branch = Branch(jnp.swapaxes(after.q, 1, 2), after.similarity, after.has_anchor)
    costs = rank_costs(config, params, after.p, branch, weight)
    best = least(jnp.where(is_there | ~jnp.any(is_there), costs.total, jnp.inf))
    pose, has = costs.T_map_odom[best], after.has_anchor[:, best]
    q = after.q[:, :, best]
    squared = squared_residuals(pose, after.p, q)
    rho = jnp.where(has, huber(squared, params.delta_m), params.tau_missing)
    similarity = jnp.where(has, after.similarity[:, best], 0.0)
    own = rho + params.gamma_similarity * (1.0 - similarity)
    newest = lambda leaf: leaf[::-1]
    return Inside(
        is_filled=newest(after.is_filled),
        path_m=newest(transform(pose[None], after.p)),
        anchor=newest(jnp.where(has, best, -1)),  # the branch, until the lists name the map row
        cost=newest(own),
        weight=newest(weight),
        is_inlier=newest(costs.is_inlier[:, best]),
        branch_cost=jnp.where(is_there, costs.total, jnp.inf),
        branch_pose=costs.T_map_odom,
    )
