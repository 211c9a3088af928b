"""The joint branches of a stream: what is remembered, and one frame's work."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from taojax.config import StreamConfig
from taojax.core.anchors import pool
from taojax.core.association import JointBranch, JointParams, JointWindow, joint_branch
from taojax.core.se2 import compose, inverse, transform
from taojax.core.sums import least, over_frames
from taojax.runtime.choice import Report, report
from taojax.runtime.maps import MapTables

GAMMA = 1.0
"""Cost of background similarity and of no support, the unit of the joint objective."""

DISTINCT_DELTAS = 3.0
"""Two branches are rivals, not one, when their poses lie farther apart than this."""


class JointState(eqx.Module):
    """Memory of the joint branches: rings of fixed shape, addressed by `slot`."""

    p: Float[Array, "n 2"]
    """Local positions; the newest is the origin."""

    listed: Int[Array, "n c"]
    """Anchors that the lists name, -1 = none."""

    similarity: Float[Array, "n c"]
    """Theirs, on the fixed scale."""

    pooled: UInt[Array, "n m"]
    """Place in the list of the best anchor around every anchor."""

    is_filled: Bool[Array, " n"]
    slot: Int[Array, ""]
    """Where the next frame goes."""

    carried: Float[Array, "2 3"]
    """Poses of the last best branch and of its challenger: two more seeds, so that a frame whose
    candidates all miss the place does not break a branch."""

    has_carried: Bool[Array, ""]


class JointReading(eqx.Module):
    """What one frame says."""

    best: JointBranch
    """The cheapest branch; frames in time order, newest last."""

    report: Report
    """The place to report, usually the best branch's."""

    rival: Float[Array, ""]
    """Cost of the cheapest branch somewhere else."""

    is_known: Bool[Array, ""]
    """Some frame so far had a candidate; without one the best branch is a guess."""

    is_filled: Bool[Array, " n"]
    """In time order."""

    p: Float[Array, "n 2"]
    """Local positions in time order."""


def init_joint(config: StreamConfig, n_anchors: int) -> JointState:
    """Return the memory before the first frame."""
    n, c = config.joint_window, config.branches
    return JointState(
        p=jnp.zeros((n, 2)),
        listed=jnp.full((n, c), -1, jnp.int32),
        similarity=jnp.zeros((n, c)),
        pooled=jnp.full((n, n_anchors), c, np.min_scalar_type(c)),
        is_filled=jnp.zeros(n, bool),
        slot=jnp.zeros((), jnp.int32),
        carried=jnp.zeros((2, 3)),
        has_carried=jnp.zeros((), bool),
    )


def joint_params(config: StreamConfig, tables: MapTables) -> JointParams:
    """Return the weights of the joint objective with length scales in metres of this map."""
    delta_m = config.delta_spacings * tables.spacing_m
    return JointParams(
        delta_m=delta_m,
        gamma=GAMMA,
        kappa=config.kappa_spacings * (tables.spacing_m / delta_m) ** 2,
    )


def seeds_of(
    config: StreamConfig, tables: MapTables, index: Int[Array, " c"], carried: Float[Array, "2 3"]
) -> Float[Array, "s 3"]:
    """Return the newest candidates' map poses in both travel directions, and the carried poses."""
    row = jnp.maximum(index[: config.joint_seeds], 0)
    theta = tables.grid.theta[row]
    ahead = jnp.concatenate([tables.grid.xy[row], theta[:, None]], axis=1)
    back = jnp.concatenate([tables.grid.xy[row], theta[:, None] + jnp.pi], axis=1)
    return jnp.concatenate([ahead, back, carried])


class Followed(eqx.Module):
    """Every hypothesis of one frame, followed through the window."""

    window: JointWindow
    """Frames at their places in the ring."""

    is_filled: Bool[Array, " n"]
    age: Int[Array, " n"]
    """Frames since, in the ring."""

    branches: JointBranch
    """Leading axis: newest candidates ahead, the same backwards, the two carried poses."""

    is_live: Bool[Array, " s"]
    """False for seeds that are none."""

    has_candidate: Bool[Array, ""]


def follow(
    config: StreamConfig,
    tables: MapTables,
    state: JointState,
    odometry: Float[Array, "3"],
    index: Int[Array, " c"],
    scaled: Float[Array, " c"],
) -> Followed:
    """Take one frame into the window and follow every hypothesis through it.

    Args:
        config: settings.
        tables: the map.
        state: memory before the frame.
        odometry: motion into this frame, finite.
        index: `(c,)` candidates, best first, -1 = none.
        scaled: `(c,)` their similarities on the fixed scale.
    """
    n, slot = config.joint_window, state.slot
    p = transform(inverse(odometry)[None], state.p).at[slot].set(0.0)
    listed = state.listed.at[slot].set(index)
    similarity = state.similarity.at[slot].set(scaled)
    params = joint_params(config, tables)
    best_near = pool(tables.grid, params.gamma, params.delta_m, index, scaled)
    pooled = state.pooled.at[slot].set(best_near)
    is_filled = state.is_filled.at[slot].set(True)
    age = jnp.mod(slot - jnp.arange(n), n)
    decay = jnp.where(is_filled, jnp.exp(-age.astype(p.dtype) / config.memory_frames), 0.0)
    window = JointWindow(p, decay / over_frames(decay), listed, similarity, pooled)

    carried = compose(state.carried, jnp.broadcast_to(odometry, (2, 3)))
    seeds = seeds_of(config, tables, index, carried)
    n_lists = min(config.joint_seeds, index.shape[0])
    is_seed = index[:n_lists] >= 0
    # Without any candidate and history the first anchor is as good a guess as any.
    is_live = jnp.concatenate([is_seed, is_seed, jnp.repeat(state.has_carried, 2)])
    branches = jax.vmap(joint_branch, in_axes=(None, None, None, 0))(
        params, tables.grid, window, seeds
    )
    is_live = is_live | ~jnp.any(is_live)
    return Followed(window, is_filled, age, branches, is_live, jnp.any(is_seed))


def joint_step(
    config: StreamConfig,
    tables: MapTables,
    state: JointState,
    odometry: Float[Array, "3"],
    index: Int[Array, " c"],
    scaled: Float[Array, " c"],
) -> tuple[JointState, JointReading]:
    """Advance all joint branches by one frame.

    Args:
        config: settings.
        tables: the map.
        state: memory.
        odometry: motion into this frame, finite.
        index: `(c,)` candidates, best first, -1 = none.
        scaled: `(c,)` their similarities on the fixed scale.

    Returns:
        The memory and the reading.
    """
    n, params = config.joint_window, joint_params(config, tables)
    seen = follow(config, tables, state, odometry, index, scaled)
    branches, window = seen.branches, seen.window
    # The challenger answers for jumps alone: one more guess would make every place look better.
    cost = jnp.where(seen.is_live, branches.cost, jnp.inf).at[-1].set(jnp.inf)
    winner = least(cost)
    best: JointBranch = jax.tree.map(lambda leaf: leaf[winner], branches)
    gap = branches.T_map_odom[:, :2] - best.T_map_odom[None, :2]
    is_elsewhere = gap[:, 0] ** 2 + gap[:, 1] ** 2 > (DISTINCT_DELTAS * params.delta_m) ** 2
    rival = jnp.minimum(GAMMA, jnp.min(jnp.where(is_elsewhere, cost, GAMMA)))
    said = report(
        params, tables.grid.xy, window, branches, winner, seen.is_live, seen.age, tables.recall
    )

    # The ring read from its oldest slot to its newest.
    order = jnp.mod(state.slot + 1 + jnp.arange(n), n)
    in_time = eqx.tree_at(
        lambda b: (b.anchor, b.frame_cost, b.is_inlier),
        best,
        (best.anchor[order], best.frame_cost[order], best.is_inlier[order]),
    )
    has_carried = state.has_carried | seen.has_candidate
    state = JointState(
        p=window.p,
        listed=window.listed,
        similarity=window.similarity,
        pooled=window.pooled,
        is_filled=seen.is_filled,
        slot=jnp.mod(state.slot + 1, n),
        carried=jnp.stack([best.T_map_odom, said.challenger]),
        has_carried=has_carried,
    )
    return state, JointReading(
        in_time, said, rival, has_carried, seen.is_filled[order], window.p[order]
    )
