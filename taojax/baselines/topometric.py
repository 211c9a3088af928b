"""The topometric filter with an off-map state: the closest published peer."""

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
    off_map_distance,
    track_of_nodes,
    whitening,
)

_TINY = 1e-30  # keeps logarithms of empty states finite in float32


class TopometricParams(eqx.Module):
    """Published defaults."""

    prior_off: float = 0.3
    """Probability of starting off the map."""

    delta: float = 3.0
    """Likelihood ratio between the best and the worst 2.5 % of the map, > 1."""

    off_rank: int = 21
    """The off-map likelihood is that of the off_rank-th least likely node."""

    n_steps: int = 10
    """Farthest node ahead that one motion can reach, nodes."""

    alphas: tuple[float, float, float, float] = (0.5, 0.1, 0.2, 2.0)
    """Odometry noise: turn from turn, turn from drive [rad^2/m^2], drive from drive, drive from
    turn [m^2/rad^2]."""

    least_variance: float = 1e-3
    """Floor of the noise variances [rad^2 or m^2]."""

    jitter: float = 1e-4
    """Added to the odometry covariance, so that standing still is not singular [m^2 or rad^2]."""

    most_mahalanobis: float = 9.0
    """Squared Mahalanobis distances are clipped here."""

    least_leave: float = 0.02
    """Smallest probability of leaving the map in one frame."""

    stay_off: float = 0.8
    """Probability of staying off the map; the rest returns to any node alike."""

    score_nodes: int = 6
    """The score is the mass within so many nodes of the best one."""

    both_directions: bool = False
    """Also follow the map driven backwards. The original loses reverse travel; off by default,
    because that is what was published."""


class Segments(NamedTuple):
    """Where the next nodes lie as seen from each node, as pieces of the driven line.

    The last axes are direction, steps ahead, and place in the chain of that direction; a chain of
    direction 1 runs from the last node to the first.
    """

    start: Float[np.ndarray | Array, "3 d s m"]
    """Relative pose of the piece's beginning [m, m, rad]."""

    extent: Float[np.ndarray | Array, "3 d s m"]
    """Its end minus its beginning."""

    is_there: Bool[np.ndarray | Array, "d s m"]
    """False where the chain ends before."""


def _chain(
    poses: Float[np.ndarray, "m 3"], n_steps: int
) -> tuple[Float[np.ndarray, "3 s m"], Float[np.ndarray, "3 s m"], Bool[np.ndarray, "s m"]]:
    """Return start, extent and existence of the segments along one chain of poses."""
    n = len(poses)
    # Unwrapped along the drive, so that the midpoint of two headings is the one between them.
    x, y, theta = poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2])
    other = np.arange(n)[None, :] + np.arange(n_steps + 2)[:, None]
    is_node = other < n
    other = np.minimum(other, n - 1)
    dx, dy = x[other] - x[None], y[other] - y[None]
    c, s = np.cos(theta)[None], np.sin(theta)[None]
    relative = np.stack([c * dx + s * dy, c * dy - s * dx, theta[other] - theta[None]])
    middle = 0.5 * (relative[:, 1:] + relative[:, :-1])
    # The piece of a node reaches half way to its neighbours; a drive begins and ends at a node.
    start = np.concatenate([np.zeros((3, 1, n)), middle[:, :-1]], axis=1)
    end = np.where(is_node[None, 1:], middle, relative[:, :-1])
    is_there = is_node[:-1]
    # A piece beyond the end of the chain has no extent and lies where the robot is: what it draws
    # in the normalised transition leaves the map.
    start, end = np.where(is_there[None], start, 0.0), np.where(is_there[None], end, 0.0)
    return start, end - start, is_there


def map_segments(
    map_poses: Float[np.ndarray, "m 3"], n_steps: int, *, both_directions: bool
) -> Segments:
    """Cut the driven line into the pieces that odometry is compared with.

    Args:
        map_poses: `(M, 3)` x [m], y [m], theta [rad], driving order.
        n_steps: nodes ahead that one motion can reach.
        both_directions: add the chain of the map driven backwards.
    """
    chains = [map_poses]
    if both_directions:
        chains.append(map_poses[::-1] + np.array([[0.0, 0.0, np.pi]]))
    parts = [_chain(chain, n_steps) for chain in chains]
    return Segments(*(np.stack(leaves, axis=-3) for leaves in zip(*parts, strict=True)))


class _Frame(NamedTuple):
    """One frame as the filter sees it."""

    odometry: Float[Array, "*t 3"]
    whiten: Float[Array, "*t 3 3"]
    distance: Float[Array, "*t m"]
    off_distance: Float[Array, "*t"]
    rate: Float[Array, "*t"]
    is_first: Bool[Array, "*t"]


def _squared_mahalanobis(segments: Segments, frame: _Frame, most: float) -> Float[Array, "d s m"]:
    """Return the clipped squared distance from the odometry to every segment."""
    w, turn = frame.whiten, 2.0 * jnp.pi

    def whitened(
        x: Float[Array, "d s m"], y: Float[Array, "d s m"], theta: Float[Array, "d s m"]
    ) -> tuple[Float[Array, "d s m"], Float[Array, "d s m"], Float[Array, "d s m"]]:
        # Spelled out: a float32 matmul may run in TF32 on recent GPUs.
        return (
            w[0, 0] * x,
            w[1, 0] * x + w[1, 1] * y,
            w[2, 0] * x + w[2, 1] * y + w[2, 2] * theta,
        )

    dx, dy, dtheta = (frame.odometry[i] - segments.start[i] for i in range(3))
    gap = whitened(dx, dy, dtheta - turn * jnp.round(dtheta / turn))
    along = whitened(*segments.extent)
    length = sum(a * a for a in along)
    share = sum(a * g for a, g in zip(along, gap, strict=True)) / jnp.maximum(length, _TINY)
    share = jnp.clip(share, 0.0, 1.0)
    squared = sum((g - share * a) ** 2 for a, g in zip(along, gap, strict=True))
    return jnp.minimum(squared, most)


def _chi2_cdf_3(x: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Return the chi-square distribution with three degrees of freedom."""
    root = jnp.sqrt(0.5 * x)
    return jax.lax.erf(root) - 2.0 / jnp.sqrt(jnp.pi) * root * jnp.exp(-0.5 * x)


def _predict(
    params: TopometricParams,
    segments: Segments,
    belief: Float[Array, "d m"],
    off: Float[Array, ""],
    frame: _Frame,
) -> tuple[Float[Array, "d m"], Float[Array, ""]]:
    """Move the belief by one odometry reading; the chains never exchange mass directly."""
    squared = _squared_mahalanobis(segments, frame, params.most_mahalanobis)
    weight = jnp.exp(-0.5 * squared)
    best = jnp.min(jnp.where(segments.is_there, squared, params.most_mahalanobis), axis=1)
    leave = jnp.clip(_chi2_cdf_3(best), params.least_leave, 1.0)
    staying = belief * (1.0 - leave) / jnp.sum(weight, axis=1)
    moving = staying[:, None] * weight
    n_chains, n_steps, n = moving.shape
    # Skewed by one place per step ahead, so that one sum over the steps moves all of it.
    room = jnp.pad(moving, ((0, 0), (0, 0), (0, n_steps))).reshape(n_chains, -1)
    room = room[:, :-n_steps].reshape(n_chains, n_steps, n + n_steps - 1).sum(axis=1)
    past_end = jnp.sum(room[:, n:])
    returning = (1.0 - params.stay_off) * off / (n_chains * n)
    stays_off = params.stay_off * off
    return room[:, :n] + returning, stays_off + jnp.sum(belief * leave) + past_end


def _step(
    params: TopometricParams,
    segments: Segments,
    carry: tuple[Float[Array, "d m"], Float[Array, ""]],
    frame: _Frame,
) -> tuple[tuple[Float[Array, "d m"], Float[Array, ""]], tuple[Float[Array, ""], Int[Array, ""]]]:
    """Take in one frame; returns the mass away from the best node, and that node."""
    moved, moved_off = _predict(params, segments, *carry, frame)
    belief = jnp.where(frame.is_first, carry[0], moved)
    off = jnp.where(frame.is_first, carry[1], moved_off)
    chains = [frame.distance, frame.distance[::-1]][: belief.shape[0]]
    # In logarithms: exp(-lam d) of a whole map can underflow in float32.
    log_nodes = jnp.log(jnp.maximum(belief, _TINY)) - frame.rate * jnp.stack(chains)
    log_off = jnp.log(jnp.maximum(off, _TINY)) - frame.rate * frame.off_distance
    top = jnp.maximum(jnp.max(log_nodes), log_off)
    belief, off = jnp.exp(log_nodes - top), jnp.exp(log_off - top)
    total = jnp.sum(belief) + off
    belief, off = belief / total, off / total
    place = belief[0] if belief.shape[0] == 1 else belief[0] + belief[1, ::-1]
    node = jnp.argmax(place)
    is_away = jnp.abs(jnp.arange(place.shape[0]) - node) > params.score_nodes
    # The mass outside is summed, not taken as 1 - inside, which rounds to 0 in float32.
    return (belief, off), (jnp.sum(jnp.where(is_away, place, 0.0)) + off, node)


@eqx.filter_jit
def _scan(
    params: TopometricParams, segments: Segments, frames: _Frame
) -> tuple[Float[Array, " t"], Int[Array, " t"]]:
    n_chains, _, n = segments.is_there.shape
    belief = jnp.full((n_chains, n), (1.0 - params.prior_off) / (n_chains * n))
    start = belief, jnp.asarray(params.prior_off)
    return jax.lax.scan(lambda c, f: _step(params, segments, c, f), start, frames)[1]


def topometric(frames: Frames, params: TopometricParams | None = None) -> Track:
    """Localise on the nodes of the map, or off it, by a Bayes filter that odometry moves.

    Args:
        frames: map and log.
        params: published defaults when omitted.

    Returns:
        The signal is the posterior mass farther than `score_nodes` from the best node, off-map
        mass included, in [0, 1]. `map_index` is the best node, -1 until a frame tells nodes apart.

    Source:
        Xu, Fischer, Suenderhauf and Milford, "Probabilistic appearance-invariant topometric
        localization with new place awareness", IEEE RA-L 6(4), 2021.
    """
    params = TopometricParams() if params is None else params
    frames = clean(frames)
    segments = map_segments(
        frames.map_poses, params.n_steps, both_directions=params.both_directions
    )
    distance = descriptor_distance(frames.rows)
    rate = decay_rate(distance, params.delta)
    whiten = whitening(frames.odometry, params.alphas, params.least_variance, params.jitter)
    as_float = lambda x: jnp.asarray(x, jnp.float32)
    signal, node = _scan(
        params,
        Segments(as_float(segments.start), as_float(segments.extent), segments.is_there),
        _Frame(
            odometry=as_float(frames.odometry),
            whiten=as_float(whiten),
            distance=as_float(distance),
            off_distance=as_float(off_map_distance(distance, params.off_rank)),
            rate=as_float(rate),
            is_first=jnp.arange(len(rate)) == 0,
        ),
    )
    node = np.where(rate > 0, np.asarray(node), -1)
    return track_of_nodes(frames.map_poses, np.asarray(signal), node)
