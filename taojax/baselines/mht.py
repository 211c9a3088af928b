"""Multi-hypothesis tracking: a tree of explanations of the candidate lists, bounded or not."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from taojax.baselines.models import Frames, clean, decay_rate, descriptor_distance, median_step_m

_SAMPLED = 512  # nodes from which the crowding of the map is estimated


class MhtParams(eqx.Module):
    """Defaults; lengths in median steps of the map, so that they fit maps of every scale."""

    width: int | None = 100
    """Leaves kept per frame; None keeps every leaf, up to `memory`."""

    n_scan: int | None = 10
    """Leaves that disagree with the best one so many frames ago are cut; None cuts none."""

    memory: int = 20_000
    """Leaves the unbounded form may hold before it, too, has to drop the worst."""

    sigma_steps: float = 2.0
    """Standard deviation of a right candidate about the predicted position."""

    gate_sigmas: float = 3.0
    """A leaf takes no candidate farther away than this."""

    detection: float = 0.9
    """Probability that a robot on the map has a right candidate in its gate."""

    delta: float = 5.0
    """Likelihood ratio between the best and the worst 2.5 % of the map, > 1."""

    birth: float = 1e-3
    """Probability of entering the map at a candidate, from off the map."""

    leave: float = 1e-2
    """Probability of leaving the map in one frame."""

    gain: float = 0.3
    """Share of the position residual that a hit corrects (steady-state Kalman gain)."""

    gain_heading: float = 0.1
    """Share of the heading residual that a hit corrects; reverse travel is judged reversed."""

    memory_frames: float = 50.0
    """Frames over which the usual descriptor distance of the lists is averaged."""


class MhtTrack(NamedTuple):
    """A `Track` with the size of the tree."""

    signal: Float[np.ndarray, " t"]
    """Larger = more likely off the map; always finite."""

    map_index: Int[np.ndarray, " t"]
    """Map row nearest to the best leaf, -1 without one."""

    pose: Float[np.ndarray, "t 3"]
    """x [m], y [m], theta [rad] of the best leaf; zero without one."""

    n_hypotheses: Int[np.ndarray, " t"]
    """Leaves held after the frame."""


class _Leaves(NamedTuple):
    """The open ends of the tree. The one explanation "off the map" is kept apart."""

    pose: Float[np.ndarray, "l 3"]
    score: Float[np.ndarray, " l"]
    """Log likelihood ratio to "off the map since the start"."""

    line: Int[np.ndarray, "l n"]
    """Numbers of the ancestors in the last frames, oldest first; -1 = off the map."""


class _List(NamedTuple):
    """One frame's candidates."""

    pose: Float[np.ndarray, "c 3"]
    score: Float[np.ndarray, " c"]
    """Log likelihood ratio of a right candidate at residual 0 to a chance one."""


def _take(leaves: _Leaves, chosen: np.ndarray) -> _Leaves:
    return _Leaves(*(leaf[chosen] for leaf in leaves))


def _wrap(theta: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return (theta + np.pi) % (2.0 * np.pi) - np.pi


def _move(
    pose: Float[np.ndarray, "l 3"], odometry: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "l 3"]:
    """Drive every leaf by the odometry."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    moved = np.empty_like(pose)
    moved[:, 0] = pose[:, 0] + c * odometry[0] - s * odometry[1]
    moved[:, 1] = pose[:, 1] + s * odometry[0] + c * odometry[1]
    moved[:, 2] = pose[:, 2] + odometry[2]
    return moved


def _extend(params: MhtParams, leaves: _Leaves, found: _List, sigma_m: float) -> _Leaves:
    """Give every leaf a child per candidate in its gate, and one for a miss."""
    gap_x = found.pose[None, :, 0] - leaves.pose[:, None, 0]
    gap_y = found.pose[None, :, 1] - leaves.pose[:, None, 1]
    squared = gap_x**2 + gap_y**2
    parent, hit = np.nonzero(squared <= (params.gate_sigmas * sigma_m) ** 2)
    pose = leaves.pose[parent]
    pose[:, 0] += params.gain * gap_x[parent, hit]
    pose[:, 1] += params.gain * gap_y[parent, hit]
    turn = _wrap(found.pose[hit, 2] - pose[:, 2])
    turn -= np.where(np.abs(turn) > 0.5 * np.pi, np.copysign(np.pi, turn), 0.0)
    pose[:, 2] += params.gain_heading * turn
    residual = squared[parent, hit] / (2.0 * sigma_m**2)
    hit_score = np.log(params.detection) + found.score[hit] - residual
    miss_score = np.log(1.0 - params.detection)
    everyone = np.arange(len(leaves.score))
    return _Leaves(
        pose=np.concatenate([pose, leaves.pose]),
        score=np.concatenate([leaves.score[parent] + hit_score, leaves.score + miss_score]),
        line=leaves.line[np.concatenate([parent, everyone])],
    )


def _births(params: MhtParams, found: _List, off: float, depth: int) -> _Leaves:
    """Start a leaf at every candidate, facing along the drive and against it."""
    score = off + np.log(0.5 * params.birth * params.detection) + found.score
    turned = found.pose + np.array([[0.0, 0.0, np.pi]])
    return _Leaves(
        pose=np.concatenate([found.pose, turned]),
        score=np.concatenate([score, score]),
        line=np.full((2 * len(score), depth), -1),
    )


def _prune(params: MhtParams, leaves: _Leaves) -> _Leaves:
    """Cut leaves that disagree with the best one long ago, then the worst ones."""
    if params.n_scan is not None:
        oldest = leaves.line[:, 0]
        leaves = _take(leaves, oldest == oldest[np.argmax(leaves.score)])
    room = params.memory if params.width is None else params.width
    if len(leaves.score) > room:
        leaves = _take(leaves, np.argpartition(-leaves.score, room - 1)[:room])
    return leaves


def _crowding(map_poses: Float[np.ndarray, "m 3"], sigma_m: float) -> float:
    """Return how many map nodes a right candidate is spread over (median over the map)."""
    n = len(map_poses)
    sample = map_poses[np.linspace(0, n - 1, min(_SAMPLED, n)).astype(int)]
    squared = (sample[:, None, 0] - map_poses[None, :, 0]) ** 2
    squared += (sample[:, None, 1] - map_poses[None, :, 1]) ** 2
    return float(np.median(np.exp(-squared / (2.0 * sigma_m**2)).sum(axis=1)))


def _lists(params: MhtParams, frames: Frames, sigma_m: float) -> list[_List]:
    """Score every candidate against chance: by how many there are, and by its similarity."""
    distance = descriptor_distance(frames.similarity.astype(float))
    rate = decay_rate(descriptor_distance(frames.rows), params.delta)
    crowding = _crowding(frames.map_poses, sigma_m)
    usual, lists = None, []
    for t, index in enumerate(frames.index):
        is_there = index >= 0
        d = distance[t, is_there]
        if d.size:
            usual = d.mean() if usual is None else usual + (d.mean() - usual) / params.memory_frames
        prominence = rate[t] * ((0.0 if usual is None else usual) - d)
        rarity = np.log(len(frames.map_poses) / (max(d.size, 1) * crowding))
        lists.append(_List(frames.map_poses[index[is_there]], rarity + prominence))
    return lists


def mht(frames: Frames, params: MhtParams | None = None) -> MhtTrack:
    """Localise by the best explanation of all candidate lists so far.

    Args:
        frames: map and log.
        params: defaults when omitted. `width` and `n_scan` None give the unbounded form, whose
            tree grows by a constant factor per frame.

    Returns:
        The signal is the log likelihood ratio of "off the map" to the best leaf. The pose is that
        of the best leaf. `n_hypotheses` counts the leaves.

    Source:
        Reid, "An algorithm for tracking multiple targets", IEEE TAC 24(6), 1979; Blackman,
        "Multiple hypothesis tracking for multiple target tracking", IEEE AESM 19(1), 2004.
    """
    params = MhtParams() if params is None else params
    frames = clean(frames)
    n_frames, depth = len(frames.odometry), params.n_scan or 1
    sigma_m = params.sigma_steps * median_step_m(frames.map_poses)
    signal = np.full(n_frames, -np.log(params.birth))
    map_index, pose = np.full(n_frames, -1, np.int32), np.zeros((n_frames, 3))
    n_hypotheses = np.zeros(n_frames, np.int32)
    leaves, off = _Leaves(np.zeros((0, 3)), np.zeros(0), np.zeros((0, depth), int)), 0.0
    for t, found in enumerate(_lists(params, frames, sigma_m)):
        leaves = leaves._replace(pose=_move(leaves.pose, frames.odometry[t]))
        # All explanations that are off the map now have the same future: only the best counts.
        now_off = max(off, float(leaves.score.max(initial=-np.inf)) + np.log(params.leave))
        grown, born = _extend(params, leaves, found, sigma_m), _births(params, found, off, depth)
        leaves = _Leaves(*(np.concatenate(pair) for pair in zip(grown, born, strict=True)))
        off = now_off
        if not len(leaves.score):
            continue
        leaves = _prune(params, leaves)
        best = int(np.argmax(leaves.score))
        signal[t] = off - leaves.score[best]
        pose[t] = leaves.pose[best]
        map_index[t] = np.argmin(np.sum((frames.map_poses[:, :2] - pose[t, None, :2]) ** 2, axis=1))
        n_hypotheses[t] = len(leaves.score)
        numbers = np.arange(len(leaves.score))[:, None]
        # Scores are relative; taking out the common part keeps them small for ever.
        leaves = leaves._replace(
            score=leaves.score - off, line=np.concatenate([leaves.line[:, 1:], numbers], axis=1)
        )
        off = 0.0
    return MhtTrack(signal.astype(np.float32), map_index, pose.astype(np.float32), n_hypotheses)
