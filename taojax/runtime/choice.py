"""Which place is reported: the long memory's favourite, until the newest frames contradict it.

A branch that explains the whole window best is right as long as the robot moves as odometry says.
After a kidnap it is the last to know: half of its memory has to be forgotten first. So every other
branch collects evidence over the newest frames, and takes over when it has enough.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.core.association import JointBranch, JointParams, JointWindow, Pairing, refit
from taojax.core.cost import squared_residuals
from taojax.core.sums import first, least, over_frames, running

JUMP_FRAMES = 25
"""A jump lies at most so many frames back where a map tells all its places apart, fewer elsewhere;
by then the long memory has noticed it by itself."""

PAST_FRAMES = 15
"""Frames before a jump that tell how reliably the favourite found support."""

MOST_RELIABLE = 0.95
"""Share of supported frames that nobody is believed to exceed."""

LEAST_SLOPE = 0.2
"""Evidence of one unsupported frame against a favourite that rarely finds support anyway."""

JUMP_EVIDENCE = 4.0
"""Evidence that makes a jump where a map tells all its places apart, in nats; more elsewhere."""

LOCAL_DELTAS = 3.0
"""Branches nearer than this to the reported one are the same place, known more or less exactly."""

LOCAL_FRAMES = 1.5
"""Memory that picks the most exact of them, frames."""

TIE = 1e-5
"""Costs over `LOCAL_FRAMES` that differ by less are the same: where no new frame supports a branch,
rounding would choose, and other versions of JAX round otherwise."""

POSE_FRAMES = 2.0
"""Memory of the reported pose, frames: it must not lag behind where odometry drifts."""


class Report(eqx.Module):
    """What is said of the newest frame."""

    pose: Float[Array, "3"]
    anchor: Int[Array, ""]
    """The newest frame's anchor, -1 where it supports nothing."""

    is_jump: Bool[Array, ""]
    """The newest frames contradict the favourite: the robot was moved, or it was wrong."""

    stale: Float[Array, ""]
    """Frames since the reported branch was last supported by one."""

    challenger: Float[Array, "3"]
    """Pose of the branch with most evidence for a jump, worth following."""


def jump_evidence(
    frame_cost: Float[Array, "k n"],
    is_inlier: Bool[Array, " n"],
    is_filled: Bool[Array, " n"],
    favourite: Int[Array, ""],
    recall: Float[Array, ""],
) -> Float[Array, " k"]:
    """Sum what the newest frames say for every branch and against the favourite.

    Args:
        frame_cost: `(k, n)` truncated costs of all branches, newest first.
        is_inlier: `(n,)` frames that support the favourite, newest first.
        is_filled: `(n,)` frames that exist.
        favourite: row of the branch that the whole window favours.
        recall: how far this map tells its own places apart, from `map_recall`.

    Returns:
        `(k,)` nats: cost saved since the likeliest moment of a jump, in units of what an
        unsupported frame says against a favourite that found support as often as it did before,
        scaled by `recall`.
    """
    n = min(JUMP_FRAMES, frame_cost.shape[1])
    saved = frame_cost[favourite][None, :n] - frame_cost[:, :n]
    saved = jnp.where(is_filled[None, :n], saved, 0.0)
    counted = jnp.stack([is_filled, is_inlier & is_filled]).astype(frame_cost.dtype)
    total, good = running(counted)
    start = jnp.arange(n)
    stop = jnp.minimum(start + PAST_FRAMES, total.shape[0] - 1)
    share = (good[stop] - good[start] + 1.0) / (total[stop] - total[start] + 2.0)
    slope = jnp.maximum(jnp.log(MOST_RELIABLE / (1.0 - share)), LEAST_SLOPE)
    evidence = recall * slope[None] * running(saved)
    is_recent = start.astype(recall.dtype) < JUMP_FRAMES * recall
    return jnp.max(jnp.where(is_recent[None], evidence, -jnp.inf), axis=1)


def since_support(is_inlier: Bool[Array, " n"]) -> Float[Array, ""]:
    """Return the frames before the first inlier, newest first; their number without any."""
    n = is_inlier.shape[0]
    return jnp.min(jnp.where(is_inlier, jnp.arange(n), n)).astype(jnp.float32)


def _fading(age: Int[Array, " n"], is_filled: Bool[Array, " n"], frames: float) -> Array:
    weight = jnp.where(is_filled, jnp.exp(-age.astype(jnp.float32) / frames), 0.0)
    return weight / over_frames(weight)


def _pose_now(
    params: JointParams,
    xy: Float[Array, "m 2"],
    window: JointWindow,
    anchor: Int[Array, " n"],
    frame_cost: Float[Array, " n"],
    pose: Float[Array, "3"],
) -> Float[Array, "3"]:
    """Solve a branch's alignment once more with the weights of `window`."""
    q = xy[jnp.maximum(anchor, 0)]
    r = jnp.sqrt(squared_residuals(pose, window.p, q))
    pairing = Pairing(anchor, q, jnp.zeros_like(frame_cost), frame_cost, r)
    return refit(params, window, pairing, pose, pose[2])


def report(  # noqa: PLR0913 - one argument per thing looked at
    params: JointParams,
    xy: Float[Array, "m 2"],
    window: JointWindow,
    branches: JointBranch,
    favourite: Int[Array, ""],
    is_live: Bool[Array, " k"],
    age: Int[Array, " n"],
    recall: Float[Array, ""],
) -> Report:
    """Choose the branch to report and pin its pose down.

    Args:
        params: weights.
        xy: `(m, 2)` anchors [m].
        window: what the frontend said, in ring order.
        branches: all hypotheses, in ring order.
        favourite: row of the cheapest.
        is_live: `(k,)` rows that are hypotheses at all.
        age: `(n,)` frames since, 0 = newest.
        recall: how far this map tells its own places apart, from `map_recall`.
    """
    n = age.shape[0]
    is_filled = window.weight > 0
    newest_first = first(age == 0) - jnp.arange(n)
    in_turn = jnp.mod(newest_first, n)
    evidence = jump_evidence(
        branches.frame_cost[:, in_turn],
        branches.is_inlier[favourite][in_turn],
        is_filled[in_turn],
        favourite,
        recall,
    )
    evidence = jnp.where(is_live, evidence, -jnp.inf)
    challenger = least(-evidence)
    is_jump = evidence[challenger] > JUMP_EVIDENCE
    chosen = jnp.where(is_jump, challenger, favourite)

    gap = branches.T_map_odom - branches.T_map_odom[chosen][None]
    is_near = gap[:, 0] ** 2 + gap[:, 1] ** 2 < (LOCAL_DELTAS * params.delta_m) ** 2
    is_same = is_near & (jnp.cos(gap[:, 2]) > 0) & is_live
    local = over_frames(_fading(age, is_filled, LOCAL_FRAMES)[:, None] * branches.frame_cost.T)
    local = jnp.where(is_same, local, jnp.inf)
    exact = jnp.where(local[chosen] <= jnp.min(local) + TIE, chosen, least(local))
    short = eqx.tree_at(lambda w: w.weight, window, _fading(age, is_filled, POSE_FRAMES))

    def now(row: Array) -> Float[Array, "3"]:
        anchor, cost = branches.anchor[row], branches.frame_cost[row]
        return _pose_now(params, xy, short, anchor, cost, branches.T_map_odom[row])

    # Together: two matrix products of two columns are cheaper than four sums.
    exactly, challenging = jax.vmap(now)(jnp.stack([exact, challenger]))
    inlier = branches.is_inlier[exact][in_turn]
    return Report(
        pose=exactly,
        anchor=jnp.where(inlier[0], branches.anchor[exact][in_turn[0]], -1),
        is_jump=is_jump,
        stale=since_support(inlier),
        challenger=challenging,
    )
