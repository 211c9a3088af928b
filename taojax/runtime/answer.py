"""What the best branch says of a frame, and whether it contradicts what was established."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.config import StreamConfig
from taojax.core.adaptive import adaptive_mean
from taojax.core.association import look_up
from taojax.core.cost import BranchCost, squared_residuals
from taojax.core.se2 import compose
from taojax.runtime.joint import JointReading
from taojax.runtime.maps import MapTables

ESTABLISHED_SHARE = 0.5
"""A branch is established when at least this share of the full window are its inliers."""

FRESH_FRAMES = 3
"""So many newest inliers in a row, far from the old alignment, are a kidnap."""


class Established(eqx.Module):
    """Memory of the last alignment that most of a full window agreed on."""

    pose: Float[Array, "3"]
    """Dead-reckoned from it; meaningless before the first."""

    ever: Bool[Array, ""]
    is_lost: Bool[Array, ""]
    """The robot was moved without odometry noticing, and no branch is established since."""


class Answer(NamedTuple):
    """What the best branch says of the newest frame, whatever the association."""

    pose: Float[Array, "3"]
    map_index: Int[Array, ""]
    share: Float[Array, ""]
    """Share of the filled window frames that are inliers."""

    is_fresh: Bool[Array, ""]
    """The newest frames are all inliers."""

    is_degenerate: Bool[Array, ""]
    is_known: Bool[Array, ""]
    """There is a hypothesis at all."""


def rank_answer(
    best: BranchCost, is_filled: Array, map_index: Array, has_candidates: Array
) -> Answer:
    """Return the answer of the best rank branch."""
    n_filled = jnp.sum(is_filled.astype(best.geom.dtype))
    return Answer(
        pose=best.T_map_odom,
        map_index=map_index,
        share=jnp.sum(best.is_inlier.astype(best.geom.dtype)) / n_filled,
        is_fresh=jnp.all(best.is_inlier[-FRESH_FRAMES:]),
        is_degenerate=best.is_degenerate,
        is_known=has_candidates,
    )


def joint_answer(tables: MapTables, reading: JointReading) -> Answer:
    """Return the answer of the best joint branch."""
    best = reading.best
    n_filled = jnp.sum(reading.is_filled.astype(best.cost.dtype))
    nearest = look_up(tables.grid, best.T_map_odom[None, :2])[0]
    return Answer(
        pose=best.T_map_odom,
        map_index=jnp.where(best.is_inlier[-1], best.anchor[-1], nearest),
        share=jnp.sum(best.is_inlier.astype(best.cost.dtype)) / n_filled,
        is_fresh=jnp.all(best.is_inlier[-FRESH_FRAMES:]),
        # The heading prior determines the angle; without any inlier the seed itself is the pose.
        is_degenerate=jnp.zeros((), bool),
        # The carried branch bridges a frame without candidates.
        is_known=reading.is_known,
    )


def joint_terms(
    config: StreamConfig, delta_m: float | Array, tables: MapTables, reading: JointReading
) -> dict[str, Array]:
    """Return the columns of the joint signal, in units of the Huber threshold squared."""
    best = reading.best
    q = tables.grid.xy[jnp.maximum(best.anchor, 0)]
    turn = jnp.concatenate([jnp.zeros(2), best.T_map_odom[2:]])
    mismatch = squared_residuals(turn, jnp.diff(reading.p, axis=0), jnp.diff(q, axis=0))
    pair = (best.is_inlier[1:] & best.is_inlier[:-1]).astype(mismatch.dtype)
    mean = jnp.sum(pair * mismatch) / jnp.maximum(jnp.sum(pair), 1.0)
    return {
        "tao": adaptive_mean(best.frame_cost[::-1], reading.is_filled[::-1]),
        "tao_geom": best.geom,
        # A term to look at; it couples neighbours, so it is no part of the joint objective.
        "tao_vel": config.lambda_velocity * mean / delta_m**2,
        "tao_sim": best.sim,
        "tao_window": best.cost,
        "tao_rival": reading.rival,
    }


def init_established() -> Established:
    """Return the memory before anything was established."""
    return Established(jnp.zeros(3), jnp.zeros((), bool), jnp.zeros((), bool))


def watch(
    seen: Established,
    odometry: Float[Array, "3"],
    answer: Answer,
    has_pose: Bool[Array, ""],
    is_full: Bool[Array, ""],
    mask_m: float | Float[Array, ""],
) -> Established:
    """Follow the last established alignment and notice when fresh evidence contradicts it.

    Args:
        seen: memory.
        odometry: motion into this frame.
        answer: of the best branch.
        has_pose: the answer may be used.
        is_full: the window is full; a half-empty one establishes nothing.
        mask_m: farther than this from the dead-reckoned pose is another place.
    """
    predicted = compose(seen.pose, odometry)
    is_established = has_pose & is_full & (answer.share >= ESTABLISHED_SHARE)
    gap = answer.pose[:2] - predicted[:2]
    is_far = jnp.hypot(gap[0], gap[1]) > mask_m
    is_noticed = seen.ever & has_pose & answer.is_fresh & is_far
    return Established(
        pose=jnp.where(is_established, answer.pose, predicted),
        ever=seen.ever | is_established,
        is_lost=~is_established & (seen.is_lost | is_noticed),
    )
