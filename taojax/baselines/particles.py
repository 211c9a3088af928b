"""Monte Carlo localisation over the plane, with and without random-particle injection."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key
from sklearn.neighbors import KDTree

from taojax.baselines.frames import Frames, Track, clean
from taojax.baselines.models import (
    decay_rate,
    descriptor_distance,
    motion_variances,
    rot_trans_rot,
)
from taojax.core.se2 import compose

_CELLS = 128  # per side of the look-up grid
_HEADING_SD_RAD = 0.1  # around the map's heading when particles are scattered
_TINY = 1e-30
_STORED = 8  # anchors remembered per cell; the nearest three are picked among them


class ParticleParams(eqx.Module):
    """Published defaults."""

    n_particles: int = 1000
    """P, at least 1."""

    alphas: tuple[float, float, float, float] = (0.5, 0.1, 0.2, 2.0)
    """Odometry noise: turn from turn, turn from drive [rad^2/m^2], drive from drive, drive from
    turn [m^2/rad^2]."""

    least_variance: float = 1e-3
    """Floor of the noise variances [rad^2 or m^2]."""

    n_near: int = 3
    """Map poses that a particle is weighed by, at most 8."""

    near_rate: float = 0.2
    """Decay of a map pose's say with its distance [1/m]."""

    delta: float = 5.0
    """Likelihood ratio between the best and the worst 2.5 % of the map, > 1."""

    least_effective: float = 0.5
    """Resample when the effective share of particles falls below this."""

    injection: bool = False
    """Replace a share max(0, 1 - w_fast / w_slow) of the particles by random ones."""

    slow: float = 0.05
    """Weight of the newest frame in w_slow."""

    fast: float = 0.5
    """Weight of the newest frame in w_fast."""

    score_m: float = 0.0
    """Radius of the mass around the estimate [m]; 0 means six times the map's median step."""

    seed: int = 0
    """Seeds the particles."""


class _Map(NamedTuple):
    """The map and a grid that finds the anchors near a point without a search."""

    poses: Float[Array, "m 3"]
    near: Int[Array, "c c s"]
    low: Float[Array, "2"]
    cell_m: Float[Array, "2"]
    spacing_m: Float[Array, ""]


class _Frame(NamedTuple):
    """One frame as the filter sees it."""

    motion: Float[Array, "*t 3"]
    deviation: Float[Array, "*t 3"]
    log_likelihood: Float[Array, "*t m"]
    number: Int[Array, "*t"]


class _Cloud(NamedTuple):
    """The belief."""

    pose: Float[Array, "p 3"]
    log_weight: Float[Array, " p"]
    slow: Float[Array, ""]
    fast: Float[Array, ""]


def _map_of(poses: Float[np.ndarray, "m 3"]) -> _Map:
    xy = poses[:, :2]
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1e-3)
    low, high = low - margin, high + margin
    cell = (high - low) / _CELLS
    axes = [low[i] + (np.arange(_CELLS) + 0.5) * cell[i] for i in range(2)]
    centre = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    n_stored = min(_STORED, len(xy))
    near = KDTree(xy).query(centre, k=n_stored, return_distance=False)
    steps = np.hypot(*np.diff(xy, axis=0).T) if len(xy) > 1 else np.ones(1)
    steps = steps[steps > 1e-6]
    return _Map(
        poses=jnp.asarray(poses, jnp.float32),
        near=jnp.asarray(near.reshape(_CELLS, _CELLS, n_stored), jnp.int32),
        low=jnp.asarray(low, jnp.float32),
        cell_m=jnp.asarray(cell, jnp.float32),
        spacing_m=jnp.asarray(np.median(steps) if steps.size else 1.0, jnp.float32),
    )


def _scatter(world: _Map, key: Key[Array, ""], n: int) -> Float[Array, "p 3"]:
    """Draw particles around map poses, facing along the drive or against it."""
    place, jitter, side = jax.random.split(key, 3)
    node = jax.random.randint(place, (n,), 0, world.poses.shape[0])
    spread = jnp.stack([world.spacing_m, world.spacing_m, jnp.asarray(_HEADING_SD_RAD)])
    noise = jax.random.normal(jitter, (n, 3)) * spread[None]
    turned = jnp.pi * jax.random.bernoulli(side, 0.5, (n,)).astype(noise.dtype)
    return (world.poses[node] + noise).at[:, 2].add(turned)


def _move(pose: Float[Array, "p 3"], frame: _Frame, key: Key[Array, ""]) -> Float[Array, "p 3"]:
    """Drive every particle by its own noisy copy of the odometry."""
    noise = jax.lax.optimization_barrier(jax.random.normal(key, pose.shape))
    drawn = frame.motion[None] + frame.deviation[None] * noise
    first, drive, second = drawn.T
    step = jnp.stack([drive * jnp.cos(first), drive * jnp.sin(first), first + second], axis=-1)
    return compose(pose, step)


def _log_weights(
    params: ParticleParams, world: _Map, pose: Float[Array, "p 3"], frame: _Frame
) -> Float[Array, " p"]:
    """Return the log of the sum over the nearest map poses of exp(-rate distance) p(z | node)."""
    cell = jnp.floor((pose[:, :2] - world.low[None]) / world.cell_m[None]).astype(jnp.int32)
    cell = jnp.clip(cell, 0, _CELLS - 1)
    near = world.near[cell[:, 0], cell[:, 1]]
    gap = world.poses[near, :2] - pose[:, None, :2]
    distance = jax.lax.optimization_barrier(jnp.sqrt(jnp.sum(gap**2, axis=-1)))
    farthest = jnp.zeros_like(distance[:, :1])
    for _ in range(min(params.n_near, near.shape[1])):
        # One pass per neighbour is much faster than a sort; equal distances count as one.
        beyond = jnp.where(distance > farthest, distance, jnp.inf)
        farthest = jnp.min(beyond, axis=1, keepdims=True)
    vote = frame.log_likelihood[near] - params.near_rate * distance
    return jax.nn.logsumexp(jnp.where(distance <= farthest, vote, -jnp.inf), axis=1)


def _resample(
    cloud: _Cloud, weight: Float[Array, " p"], is_due: Bool[Array, ""], key: Key[Array, ""]
) -> _Cloud:
    """Draw particles in proportion to their weight with one random offset (systematic)."""
    n = weight.shape[0]
    comb = (jnp.arange(n, dtype=weight.dtype) + jax.random.uniform(key)) / n
    total = jnp.cumsum(weight)
    chosen = jnp.clip(jnp.searchsorted(total / total[-1], comb), 0, n - 1)
    return cloud._replace(
        pose=jnp.where(is_due, cloud.pose[chosen], cloud.pose),
        log_weight=jnp.where(is_due, -jnp.log(float(n)), cloud.log_weight),
    )


def _step(
    params: ParticleParams, world: _Map, cloud: _Cloud, frame: _Frame
) -> tuple[_Cloud, tuple[Float[Array, ""], Int[Array, ""], Float[Array, "3"]]]:
    """Take in one frame; returns signal, nearest node and estimate."""
    key = jax.random.fold_in(jax.random.key(params.seed), frame.number)
    moving, drawing, choosing, placing = jax.random.split(key, 4)
    n = params.n_particles
    pose = jnp.where(frame.number > 0, _move(cloud.pose, frame, moving), cloud.pose)
    # Without the barriers XLA fuses the random numbers into every use and draws them again.
    pose = jax.lax.optimization_barrier(pose)
    log_vote = jax.lax.optimization_barrier(_log_weights(params, world, pose, frame))
    log_weight = cloud.log_weight + log_vote
    log_total = jax.nn.logsumexp(log_weight)
    log_weight = log_weight - log_total
    weight = jnp.exp(log_weight)

    # The estimate is the mean of the particles around the heaviest: the cloud may have many modes.
    heavy = pose[jnp.argmax(weight)]
    radius = params.score_m if params.score_m > 0 else 6.0 * world.spacing_m
    gap = pose[:, :2] - heavy[None, :2]
    is_near = jnp.sum(gap**2, axis=-1) <= radius**2
    share = jnp.where(is_near, weight, 0.0)
    total = jnp.sum(share)
    xy = heavy[:2] + jnp.sum(share[:, None] * jnp.where(is_near[:, None], gap, 0.0), 0) / total
    heading = jnp.arctan2(
        jnp.sum(share * jnp.sin(pose[:, 2])), jnp.sum(share * jnp.cos(pose[:, 2]))
    )
    estimate = jnp.concatenate([xy, heading[None]])
    node = jnp.argmin(jnp.sum((world.poses[:, :2] - xy[None]) ** 2, axis=-1))

    mean_vote = jnp.exp(log_total)
    slow = jnp.where(
        frame.number > 0, cloud.slow + params.slow * (mean_vote - cloud.slow), mean_vote
    )
    fast = jnp.where(
        frame.number > 0, cloud.fast + params.fast * (mean_vote - cloud.fast), mean_vote
    )
    effective = 1.0 / jnp.sum(weight**2)
    lag = jnp.clip(1.0 - fast / jnp.maximum(slow, _TINY), 0.0, 1.0)
    injected = lag if params.injection else jnp.zeros_like(lag)
    is_due = (effective < params.least_effective * n) | (injected > 0)
    moved = _resample(_Cloud(pose, log_weight, slow, fast), weight, is_due, drawing)
    is_new = jax.random.uniform(choosing, (n,)) < injected
    fresh = _scatter(world, placing, n)
    moved = moved._replace(pose=jnp.where(is_new[:, None], fresh, moved.pose))
    return moved, (_signal(weight, is_near, log_total, fast), node, estimate)


def _signal(weight, is_near, log_total, fast):
    import os

    k = os.environ.get("SIG", "mass")
    if k == "mass":
        return jnp.sum(jnp.where(is_near, 0.0, weight))
    if k == "vote":
        return -log_total
    if k == "fast":
        return -jnp.log(jnp.maximum(fast, _TINY))


@eqx.filter_jit
def _scan(
    params: ParticleParams, world: _Map, frames: _Frame
) -> tuple[Float[Array, " t"], Int[Array, " t"], Float[Array, "t 3"]]:
    n = params.n_particles
    pose = _scatter(world, jax.random.key(params.seed), n)
    start = _Cloud(pose, jnp.full(n, -jnp.log(float(n))), jnp.zeros(()), jnp.zeros(()))
    return jax.lax.scan(lambda c, f: _step(params, world, c, f), start, frames)[1]


def particles(frames: Frames, params: ParticleParams | None = None) -> Track:
    """Localise by a cloud of poses that odometry moves and appearance weighs.

    Args:
        frames: map and log.
        params: published defaults when omitted.

    Returns:
        The signal is the weight farther than `score_m` from the heaviest particle, in [0, 1]. The
        pose is the mean of the particles around that one, `map_index` the map row nearest to it,
        -1 until a frame tells nodes apart.

    Source:
        Dellaert et al., ICRA 1999; the measurement model of Xu, Suenderhauf and Milford, IEEE RA-L
        6(2), 2021; injection from Thrun, Burgard and Fox, "Probabilistic Robotics", 2005, section
        8.3.5.
    """
    params = ParticleParams() if params is None else params
    frames = clean(frames)
    distance = descriptor_distance(frames.rows)
    rate = decay_rate(distance, params.delta)
    motion = rot_trans_rot(frames.odometry)
    deviation = np.sqrt(motion_variances(motion, params.alphas, params.least_variance))
    signal, node, pose = _scan(
        params,
        _map_of(frames.map_poses),
        _Frame(
            motion=jnp.asarray(motion, jnp.float32),
            deviation=jnp.asarray(deviation, jnp.float32),
            log_likelihood=jnp.asarray(-rate[:, None] * distance, jnp.float32),
            number=jnp.arange(len(rate)),
        ),
    )
    is_there = rate > 0
    return Track(
        signal=np.asarray(signal),
        map_index=np.where(is_there, np.asarray(node), -1).astype(np.int32),
        pose=np.where(is_there[:, None], np.asarray(pose), 0.0).astype(np.float32),
    )
