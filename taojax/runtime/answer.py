"""What the best branch says of a frame."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.config import StreamConfig
from taojax.core.adaptive import adaptive_mean
from taojax.core.anchors import look_up
from taojax.core.cost import BranchCost, squared_residuals
from taojax.core.sums import over_frames
from taojax.runtime.choice import since_support
from taojax.runtime.joint import JointReading
from taojax.runtime.maps import MapTables


class Answer(NamedTuple):
    """What the best branch says of the newest frame, whatever the association."""

    pose: Float[Array, "3"]
    map_index: Int[Array, ""]
    share: Float[Array, ""]
    """Share of the filled window frames that are inliers."""

    stale: Float[Array, ""]
    """Frames since the branch was last supported by one."""

    is_lost: Bool[Array, ""]
    """The newest frames contradict what the window says: the robot was moved without odometry
    noticing, and no branch is established since."""

    is_degenerate: Bool[Array, ""]
    is_known: Bool[Array, ""]
    """There is a hypothesis at all."""


def _share(is_inlier: Bool[Array, " n"], is_filled: Bool[Array, " n"]) -> Float[Array, ""]:
    n_in, n = over_frames(jnp.stack([is_inlier, is_filled], axis=1).astype(jnp.float32))
    return n_in / n


def rank_answer(
    costs: BranchCost, best: Array, is_filled: Array, map_index: Array, has_candidates: Array
) -> Answer:
    """Return the answer of the best rank branch."""
    is_inlier = costs.is_inlier[:, best]
    return Answer(
        pose=costs.T_map_odom[best],
        map_index=map_index,
        share=_share(is_inlier, is_filled),
        stale=since_support(is_inlier[::-1]),
        is_lost=jnp.zeros((), bool),  # the literal cost knows no jumps
        is_degenerate=costs.is_degenerate[best],
        is_known=has_candidates,
    )


def joint_answer(tables: MapTables, reading: JointReading) -> Answer:
    """Return the answer of the best joint branch."""
    best, said = reading.best, reading.report
    nearest = look_up(tables.grid, said.pose[:2])
    return Answer(
        pose=said.pose,
        map_index=jnp.where(said.anchor >= 0, said.anchor, nearest),
        share=_share(best.is_inlier, reading.is_filled),
        stale=said.stale,
        is_lost=said.is_jump,
        # The heading prior determines the angle; without any inlier the seed itself is the pose.
        is_degenerate=jnp.zeros((), bool),
        # The carried branch bridges a frame without candidates.
        is_known=reading.is_known,
    )


def joint_terms(
    config: StreamConfig,
    delta_m: float | Array,
    tables: MapTables,
    reading: JointReading,
    elsewhere: Float[Array, ""],
) -> dict[str, Array]:
    """Return the columns of the joint signal, in units of the Huber threshold squared.

    Args:
        config: settings.
        delta_m: Huber threshold, metres.
        tables: the map.
        reading: of this frame.
        elsewhere: what the recursive filter says.
    """
    best = reading.best
    q = tables.grid.xy[jnp.maximum(best.anchor, 0)]
    turn = jnp.concatenate([jnp.zeros(2), best.T_map_odom[2:]])
    mismatch = squared_residuals(turn, jnp.diff(reading.p, axis=0), jnp.diff(q, axis=0))
    pair = (best.is_inlier[1:] & best.is_inlier[:-1]).astype(mismatch.dtype)
    total, n_pairs = over_frames(jnp.stack([pair * mismatch, pair], axis=1))
    align = adaptive_mean(best.frame_cost[::-1], reading.is_filled[::-1])
    # A filter multiplies answers, so one confused place undoes it: it counts as much as a whole
    # window of answers is free of confusion on this map.
    return {
        "tao": align + tables.recall**config.window * elsewhere,
        "tao_align": align,
        "tao_geom": best.geom,
        # A term to look at; it couples neighbours, so it is no part of the joint objective.
        "tao_vel": config.lambda_velocity * total / jnp.maximum(n_pairs, 1.0) / delta_m**2,
        "tao_sim": best.sim,
        "tao_window": best.cost,
        "tao_rival": reading.rival,
        "recursive": elsewhere,
    }
