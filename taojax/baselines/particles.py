"""Monte Carlo localisation over the plane, with and without random-particle injection.

In NumPy: a thousand particles are a few kilobytes per frame, which the compiler does not speed up,
and numpy's generator gives the same particles under every version of JAX.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from taojax.baselines.models import (
    Frames,
    Track,
    clean,
    decay_rate,
    descriptor_distance,
    median_step_m,
    motion_variances,
    rot_trans_rot,
)

_CELLS = 128  # per side of the look-up grid
_STORED = 8  # anchors remembered per cell; the nearest few are picked among them
_HEADING_SD_RAD = 0.1  # around the map's heading when particles are scattered
_TINY = 1e-300  # keeps logarithms and ratios of vanishing weights finite


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

    score_steps: float = 6.0
    """Radius of the mass around the estimate, in median steps of the map."""

    seed: int = 0
    """Seeds the particles."""


class _Map(NamedTuple):
    """The map and a grid that finds the anchors near a point without a search."""

    poses: Float[np.ndarray, "m 3"]
    near: Int[np.ndarray, "c s"]
    low: Float[np.ndarray, "2"]
    cell_m: Float[np.ndarray, "2"]
    step_m: float


def _map_of(poses: Float[np.ndarray, "m 3"]) -> _Map:
    xy = poses[:, :2]
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1e-3)
    low, high = low - margin, high + margin
    cell = (high - low) / _CELLS
    x, y = (low[i] + (np.arange(_CELLS) + 0.5) * cell[i] for i in range(2))
    centre = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    # Slow to import, and most runs ask for no rival.
    from sklearn.neighbors import KDTree

    near = KDTree(xy).query(centre, k=min(_STORED, len(xy)), return_distance=False)
    return _Map(poses, near, low, cell, median_step_m(poses))


def _scatter(world: _Map, rng: np.random.Generator, n: int) -> Float[np.ndarray, "p 3"]:
    """Draw particles around map poses, facing along the drive or against it."""
    spread = np.array([world.step_m, world.step_m, _HEADING_SD_RAD])
    pose = world.poses[rng.integers(len(world.poses), size=n)]
    pose = pose + rng.standard_normal((n, 3)) * spread[None]
    pose[:, 2] += np.pi * rng.integers(2, size=n)
    return pose


def _move(
    pose: Float[np.ndarray, "p 3"],
    motion: Float[np.ndarray, "3"],
    deviation: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "p 3"]:
    """Drive every particle by its own noisy copy of turn, drive, turn."""
    noise = deviation[:, None] * rng.standard_normal((3, len(pose)))
    first, drive, second = motion[:, None] + noise
    course = pose[:, 2] + first
    x, y = pose[:, 0] + drive * np.cos(course), pose[:, 1] + drive * np.sin(course)
    return np.stack([x, y, course + second], axis=1)


def _votes(
    params: ParticleParams,
    world: _Map,
    pose: Float[np.ndarray, "p 3"],
    log_likelihood: Float[np.ndarray, " m"],
) -> Float[np.ndarray, " p"]:
    """Return the sum over the nearest map poses of exp(-rate distance) p(z | node).

    The likelihoods are relative to that of the best node.
    """
    cell = ((pose[:, :2] - world.low[None]) / world.cell_m[None]).astype(int)
    np.clip(cell, 0, _CELLS - 1, out=cell)
    near = world.near[cell[:, 0] * _CELLS + cell[:, 1]]
    gap = world.poses[near, :2] - pose[:, None, :2]
    distance = np.hypot(gap[..., 0], gap[..., 1])
    n_near = min(params.n_near, near.shape[1])
    nearest = np.argpartition(distance, n_near - 1, axis=1)[:, :n_near]
    distance = np.take_along_axis(distance, nearest, axis=1)
    node = np.take_along_axis(near, nearest, axis=1)
    return np.exp(log_likelihood[node] - params.near_rate * distance).sum(axis=1)


def _estimate(
    pose: Float[np.ndarray, "p 3"], weight: Float[np.ndarray, " p"], radius_m: float
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the mean pose around the heaviest particle, and the weight away from there.

    A mean over all would lie between the modes of the cloud.
    """
    heavy = pose[np.argmax(weight)]
    is_near = np.sum((pose[:, :2] - heavy[None, :2]) ** 2, axis=1) <= radius_m**2
    share, near = weight[is_near], pose[is_near]
    xy = share @ near[:, :2] / share.sum()
    theta = np.arctan2(share @ np.sin(near[:, 2]), share @ np.cos(near[:, 2]))
    return np.append(xy, theta), float(weight[~is_near].sum())


def _resample(weight: Float[np.ndarray, " p"], rng: np.random.Generator) -> Int[np.ndarray, " p"]:
    """Choose particles in proportion to their weight with one random offset (systematic)."""
    n = len(weight)
    comb = (np.arange(n) + rng.random()) / n
    total = np.cumsum(weight)
    return np.minimum(np.searchsorted(total / total[-1], comb), n - 1)


def particles(frames: Frames, params: ParticleParams | None = None) -> Track:
    """Localise by a cloud of poses that odometry moves and appearance weighs.

    Args:
        frames: map and log.
        params: published defaults when omitted.

    Returns:
        The signal is the weight farther than `score_steps` from the heaviest particle, in [0, 1];
        with injection, where scattered particles dilute that mass on purpose, minus the log of
        the mean unnormalised weight. The pose is the mean around the heaviest particle and
        `map_index` the map row nearest to it, -1 until a frame tells nodes apart.

    Source:
        Dellaert et al., ICRA 1999; the measurement model of Xu, Suenderhauf and Milford, IEEE RA-L
        6(2), 2021; injection from Thrun, Burgard and Fox, "Probabilistic Robotics", 2005, section
        8.3.5.
    """
    params = ParticleParams() if params is None else params
    frames = clean(frames)
    n, n_frames = params.n_particles, len(frames.odometry)
    distance = descriptor_distance(frames.rows)
    rate = decay_rate(distance, params.delta)
    motion = rot_trans_rot(frames.odometry)
    deviation = np.sqrt(motion_variances(motion, params.alphas, params.least_variance))
    world = _map_of(frames.map_poses)
    radius_m = params.score_steps * world.step_m

    rng = np.random.default_rng(params.seed)
    pose, weight = _scatter(world, rng, n), np.full(n, 1.0 / n)
    slow = fast = 0.0
    signal, node, estimate = np.zeros(n_frames), np.full(n_frames, -1), np.zeros((n_frames, 3))
    for t in range(n_frames):
        if t:
            pose = _move(pose, motion[t], deviation[t], rng)
        log_likelihood = -rate[t] * distance[t]
        best = log_likelihood.max()
        weight = weight * _votes(params, world, pose, log_likelihood - best)
        total = weight.sum()
        # A cloud so far from every map pose that nothing explains the frame keeps its belief.
        weight = weight / total if total > _TINY else np.full(n, 1.0 / n)
        log_mean = np.log(max(total, _TINY)) + best
        estimate[t], away = _estimate(pose, weight, radius_m)
        signal[t] = -log_mean if params.injection else away
        node[t] = np.argmin(np.sum((world.poses[:, :2] - estimate[t, None, :2]) ** 2, axis=1))

        vote = np.exp(log_mean)
        slow = slow + params.slow * (vote - slow) if t else vote
        fast = fast + params.fast * (vote - fast) if t else vote
        share = max(0.0, 1.0 - fast / max(slow, _TINY)) if params.injection else 0.0
        if share > 0 or 1.0 / np.sum(weight**2) < params.least_effective * n:
            pose, weight = pose[_resample(weight, rng)], np.full(n, 1.0 / n)
        is_new = rng.random(n) < share
        if is_new.any():
            pose[is_new] = _scatter(world, rng, int(is_new.sum()))
    is_there = rate > 0
    return Track(
        signal=signal.astype(np.float32),
        map_index=np.where(is_there, node, -1).astype(np.int32),
        pose=np.where(is_there[:, None], estimate, 0.0).astype(np.float32),
    )
