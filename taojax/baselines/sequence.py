"""Rivals that look at similarities and retrieved places alone: SeqSLAM window and SUE."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from taojax.baselines.models import Frames, Track, clean, descriptor_distance, track_of_nodes


class SeqSlamParams(eqx.Module):
    """Published defaults."""

    length: int = 10
    """Rows of the similarity matrix that a line runs through, newest included, frames."""

    velocities: tuple[float, ...] = (0.8, 0.9, 1.0, 1.1, 1.2)
    """Slopes tried, map rows per frame; negative ones would follow reverse travel."""

    guard: int = 10
    """Map rows on each side of the best line that cannot be second best."""


class SueParams(eqx.Module):
    """Published defaults."""

    sharpness: float = 350.0
    """Decay of a candidate's weight with its descriptor distance; made for the authors' own
    descriptors."""

    n_candidates: int = 10
    """Candidates whose positions are compared."""


@eqx.filter_jit
def _scan_seqslam(
    params: SeqSlamParams, difference: Float[Array, "t m"], is_there: Bool[Array, " t"]
) -> tuple[Float[Array, " t"], Int[Array, " t"]]:
    n = difference.shape[1]
    age = np.arange(params.length)[:, None, None]
    slope = np.asarray(params.velocities)[None, :, None]
    # Row i of the window is `age` frames old; a line through node m now was this far back then.
    place = np.arange(n)[None, None] - np.rint(age * slope).astype(int)
    is_on_map = jnp.asarray((place >= 0) & (place < n))
    place = jnp.asarray(np.clip(place, 0, n - 1) + age * n)

    def step(
        window: Float[Array, "w m"], frame: tuple[Float[Array, " m"], Bool[Array, ""]]
    ) -> tuple[Float[Array, "w m"], tuple[Float[Array, ""], Int[Array, ""]]]:
        newest, has_candidates = frame
        window = jnp.concatenate([newest[None], window[:-1]])
        along = jnp.where(is_on_map, window.reshape(-1)[place], 1.0)
        line = jnp.min(jnp.mean(along, axis=0), axis=0)
        best = jnp.argmin(line)
        is_other = jnp.abs(jnp.arange(n) - best) > params.guard
        second = jnp.min(jnp.where(is_other, line, jnp.inf))
        # A map inside the guard has no second place, and so nothing that is ambiguous.
        ratio = line[best] / jnp.where(jnp.isfinite(second) & (second > 0), second, 1.0)
        return window, (jnp.where(has_candidates, ratio, 1.0), best)

    # Frames before the start resemble nothing; they raise best and second best alike.
    start = jnp.ones((params.length, n), difference.dtype)
    return jax.lax.scan(step, start, (difference, is_there))[1]


def seqslam(frames: Frames, params: SeqSlamParams | None = None) -> Track:
    """Match the last frames to the best straight line through the similarity matrix.

    The map is compared with 1 - similarity as it is, without SeqSLAM's contrast enhancement of
    raw images: learned descriptors do not need it, and its ratio is undefined for negative values.

    Args:
        frames: map and log; the odometry is not used.
        params: published defaults when omitted.

    Returns:
        The signal is the mean difference along the best line over that along the best one outside
        the guard: 0 is a unique perfect match, 1 an ambiguous one or none. The match is reported
        for the newest frame, not for the middle of the window. `map_index` is the line's newest
        node, -1 without any candidate.

    Source:
        Milford and Wyeth, "SeqSLAM", ICRA 2012.
    """
    params = SeqSlamParams() if params is None else params
    frames = clean(frames)
    is_there = np.any(frames.rows != 0, axis=1)
    signal, node = _scan_seqslam(params, jnp.asarray(1.0 - frames.rows), jnp.asarray(is_there))
    node = np.where(is_there, np.asarray(node), -1)
    return track_of_nodes(frames.map_poses, np.asarray(signal), node)


def sue(frames: Frames, params: SueParams | None = None) -> Track:
    """Score a retrieval by the spread of the retrieved places, with the constant of its authors.

    Args:
        frames: map and log; only the candidate lists are used.
        params: published defaults when omitted.

    Returns:
        The signal is the mean of the weighted variances of x and y [m^2]; without a candidate it
        is that of the whole map. `map_index` is the top candidate.

    Source:
        Zaffar, Nan and Kooij, "On the estimation of image-matching uncertainty in visual place
        recognition", CVPR 2024.
    """
    params = SueParams() if params is None else params
    frames = clean(frames)
    index = frames.index[:, : params.n_candidates]
    distance = descriptor_distance(frames.similarity[:, : params.n_candidates].astype(float))
    distance = np.where(index >= 0, distance, np.inf)
    nearest = distance.min(axis=1, initial=np.inf, keepdims=True)
    has_any = np.isfinite(nearest)
    weight = np.exp(-params.sharpness * (distance - np.where(has_any, nearest, 0.0)))
    weight = weight / np.where(has_any, weight.sum(axis=1, keepdims=True), 1.0)
    # Centred on the top candidate, so that squares of large coordinates do not cancel.
    place = frames.map_poses[np.maximum(index, 0), :2]
    place = np.where(index[..., None] >= 0, place - place[:, :1], 0.0)
    mean = np.sum(weight[..., None] * place, axis=1, keepdims=True)
    variance = np.sum(weight[..., None] * (place - mean) ** 2, axis=1)
    everywhere = frames.map_poses[:, :2].var(axis=0).mean()
    signal = np.where(has_any[:, 0], variance.mean(axis=1), everywhere)
    top = index[:, 0] if index.shape[1] else np.full(len(index), -1)
    return track_of_nodes(frames.map_poses, signal.astype(np.float32), top)
