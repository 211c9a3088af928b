"""Discrete Bayes filters over the map's nodes that use no odometry."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from taojax.baselines.models import (
    Frames,
    Track,
    clean,
    decay_rate,
    descriptor_distance,
    track_of_nodes,
)

_TINY = 1e-30  # keeps logarithms of empty states finite in float32


class TopologicalParams(eqx.Module):
    """Published defaults."""

    step_back: int = 2
    """Farthest move against the driving order in one frame, nodes."""

    step_ahead: int = 9
    """Farthest move along the driving order in one frame, nodes."""

    delta: float = 5.0
    """Likelihood ratio between the best and the worst 2.5 % of the map, > 1."""

    score_nodes: int = 12
    """The score is the mass within so many nodes of the best one; the public parameters say 6."""


class VirtualPlaceParams(eqx.Module):
    """Published defaults."""

    leave: float = 0.1
    """Probability of going from a node to the virtual place in one frame."""

    stay: float = 0.9
    """Probability of staying in the virtual place; the rest goes to all nodes alike."""

    spread: tuple[float, ...] = (0.36, 0.30, 0.16, 0.062, 0.0151, 0.00255, 0.000324)
    """Relative weight of the node itself, its neighbours, their neighbours, ..."""

    no_contrast: float = 2.0
    """Likelihood of the virtual place where the similarities have no spread."""


def _shifted(values: Float[Array, " m"], offset: int) -> Float[Array, " m"]:
    """Move values `offset` places up; what leaves the array is dropped."""
    n = values.shape[0]
    if abs(offset) >= n:
        return jnp.zeros_like(values)
    padded = jnp.pad(values, (max(offset, 0), max(-offset, 0)))
    return padded[max(-offset, 0) :][:n]


def _spread(
    belief: Float[Array, " m"], offsets: range, weights: tuple[float, ...]
) -> Float[Array, " m"]:
    """Share each node's mass among the nodes at `offsets`; what passes the map's ends is lost."""
    moves = zip(offsets, weights, strict=True)
    return sum((weight * _shifted(belief, offset) for offset, weight in moves), 0.0 * belief)


def _mass_away(place: Float[Array, " m"], node: Int[Array, ""], nodes: int) -> Float[Array, ""]:
    is_away = jnp.abs(jnp.arange(place.shape[0]) - node) > nodes
    return jnp.sum(jnp.where(is_away, place, 0.0))


@eqx.filter_jit
def _scan_topological(
    params: TopologicalParams,
    distance: Float[Array, "t m"],
    rate: Float[Array, " t"],
    is_first: Bool[Array, " t"],
) -> tuple[Float[Array, " t"], Int[Array, " t"]]:
    offsets = range(-params.step_back, params.step_ahead + 1)
    weights = (1.0 / len(offsets),) * len(offsets)

    def step(
        belief: Float[Array, " m"],
        frame: tuple[Float[Array, " m"], Float[Array, ""], Bool[Array, ""]],
    ) -> tuple[Float[Array, " m"], tuple[Float[Array, ""], Int[Array, ""]]]:
        distance, rate, is_first = frame
        moved = jnp.where(is_first, belief, _spread(belief, offsets, weights))
        # Mass that runs past the map's end is lost and not piled up on its last node, which would
        # make a robot that has left the map look certain.
        belief = jax.nn.softmax(jnp.log(jnp.maximum(moved, _TINY)) - rate * distance)
        node = jnp.argmax(belief)
        return belief, (_mass_away(belief, node, params.score_nodes), node)

    n = distance.shape[1]
    return jax.lax.scan(step, jnp.full(n, 1.0 / n), (distance, rate, is_first))[1]


def topological(frames: Frames, params: TopologicalParams | None = None) -> Track:
    """Localise on the nodes of the map by a Bayes filter that assumes steady forward travel.

    Args:
        frames: map and log; the odometry is not used.
        params: published defaults when omitted.

    Returns:
        The signal is the posterior mass farther than `score_nodes` from the best node, in [0, 1].
        `map_index` is the best node, -1 until a frame tells nodes apart.

    Source:
        Xu, Suenderhauf and Milford, "Probabilistic visual place recognition for hierarchical
        localization", IEEE RA-L 6(2), 2021.
    """
    params = TopologicalParams() if params is None else params
    frames = clean(frames)
    distance = descriptor_distance(frames.rows)
    rate = decay_rate(distance, params.delta)
    is_first = jnp.arange(len(rate)) == 0
    signal, node = _scan_topological(
        params, jnp.asarray(distance), jnp.asarray(rate, jnp.float32), is_first
    )
    node = np.where(rate > 0, np.asarray(node), -1)
    return track_of_nodes(frames.map_poses, np.asarray(signal), node)


class _Likelihood(NamedTuple):
    """What one frame says of the nodes and of the virtual place."""

    nodes: Float[Array, " m"]
    virtual: Float[Array, ""]


def _contrast(params: VirtualPlaceParams, row: Float[Array, " m"]) -> _Likelihood:
    """Score nodes by how far they stand out of the frame's own similarities."""
    is_there = row > 0
    count = jnp.maximum(jnp.sum(is_there), 1).astype(row.dtype)
    mean = jnp.sum(jnp.where(is_there, row, 0.0)) / count
    spread = jnp.sqrt(jnp.sum(jnp.where(is_there, (row - mean) ** 2, 0.0)) / count)
    # Equal similarities differ by rounding; a ratio of that would be noise.
    has_spread = spread > 1e-6
    nodes = (row - spread) / jnp.where(mean > 0, mean, 1.0)
    virtual = mean / jnp.where(has_spread, spread, 1.0) + 1.0
    return _Likelihood(
        nodes=jnp.where(has_spread & is_there & (row > mean + spread), nodes, 1.0),
        virtual=jnp.where(has_spread, virtual, params.no_contrast),
    )


@eqx.filter_jit
def _scan_virtual_place(
    params: VirtualPlaceParams, rows: Float[Array, "t m"]
) -> tuple[Float[Array, " t"], Int[Array, " t"]]:
    reach = len(params.spread) - 1
    offsets = range(-reach, reach + 1)
    weights = tuple(params.spread[abs(offset)] for offset in offsets)
    n = rows.shape[1]
    # A node near the map's end has fewer neighbours; they take its whole mass all the same.
    reach_of = _spread(jnp.ones(n), offsets, weights)

    def step(
        carry: tuple[Float[Array, " m"], Float[Array, ""]], row: Float[Array, " m"]
    ) -> tuple[
        tuple[Float[Array, " m"], Float[Array, ""]], tuple[Float[Array, ""], Int[Array, ""]]
    ]:
        belief, virtual = carry
        new = (1.0 - params.stay) * virtual / n
        moved = (1.0 - params.leave) * _spread(belief / reach_of, offsets, weights) + new
        virtual = params.leave * jnp.sum(belief) + params.stay * virtual
        likelihood = _contrast(params, row)
        belief, virtual = moved * likelihood.nodes, virtual * likelihood.virtual
        inside = jnp.sum(belief)
        # Log odds rank as the posterior does, and do not round to 1 in float32.
        log_odds = jnp.log(virtual) - jnp.log(inside)
        total = inside + virtual
        return (belief / total, virtual / total), (log_odds, jnp.argmax(belief))

    start = jnp.zeros(n), jnp.ones(())
    return jax.lax.scan(step, start, rows)[1]


def virtual_place(frames: Frames, params: VirtualPlaceParams | None = None) -> Track:
    """Localise on the nodes or in one virtual place that stands for everywhere else.

    Args:
        frames: map and log; the odometry is not used. The rows must be dense for the contrast of
            a frame to mean anything.
        params: published defaults when omitted.

    Returns:
        The signal is the log odds of the virtual place. `map_index` is the best node, -1 while no
        frame had any similarity.

    Source:
        Labbe and Michaud, "Appearance-based loop closure detection for online large-scale and
        long-term operation", IEEE T-RO 29(3), 2013, and the released RTAB-Map.
    """
    params = VirtualPlaceParams() if params is None else params
    frames = clean(frames)
    signal, node = _scan_virtual_place(params, jnp.asarray(frames.rows))
    is_informed = np.logical_or.accumulate((frames.rows > 0).any(axis=1))
    node = np.where(is_informed, np.asarray(node), -1)
    return track_of_nodes(frames.map_poses, np.asarray(signal), node)
