"""Pairwise consistency maximisation (PCM): the largest set of closures that odometry can join.

Mangelson, Dominic, Eustice & Vasudevan, Pairwise Consistent Measurement Set Maximization, ICRA
2018. Two closures are consistent if odometry, driven from the one, arrives at the other within its
uncertainty; a set is consistent if all of its pairs are.
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from taojax.graph.answers import DIRECTION_RAD, Closure
from taojax.graph.odometry import Chain, Walk, spread, walk

__all__ = ["Clique", "consistent", "exact_clique", "greedy_clique"]

GATE = 9.21
"""Largest squared Mahalanobis distance of a consistent pair: 99 % of chi^2, two dimensions."""


class Clique(NamedTuple):
    """A consistent set."""

    rows: list[int]
    """Ascending."""

    is_largest: bool
    """Proven; False where time ran out or nothing was proven."""


def _between_ends(chain: Chain, walked: Walk, closures: Sequence[Closure], i: int) -> np.ndarray:
    """Return how far odometry may have erred between the older ends of closures (c, 2, 2) [m^2].

    Where the map is the drive itself, it drifts as the drive does.
    """
    ends = np.array([c.tie.frame - chain.first for c in closures if c.tie is not None])
    spacings, by_turn = spread(walked, np.full(len(ends), ends[i]), ends)
    driven = chain.noise.angle_rad**2 * by_turn[:, :2, :2]
    driven[:, [0, 1], [0, 1]] += (chain.noise.share * chain.spacing_m) ** 2 * spacings[:, None]
    return driven


def _distances(
    chain: Chain, walked: Walk, closures: Sequence[Closure], rows: np.ndarray, i: int
) -> np.ndarray:
    """Return the squared Mahalanobis distances of all closures from where closure i leads."""
    own = closures[i]
    target = np.stack([c.pose[:2] for c in closures])
    known = np.stack([c.covariance[:2, :2] for c in closures]) + own.covariance[:2, :2]
    is_axial = not np.isfinite(own.covariance[2, 2])
    var_theta = DIRECTION_RAD**2 if is_axial else float(own.covariance[2, 2])
    start = walked.pose[rows[i]]
    spacings, by_turn = spread(walked, np.full(len(rows), rows[i]), rows)
    driven = chain.noise.angle_rad**2 * by_turn[:, :2, :2]
    driven[:, [0, 1], [0, 1]] += (chain.noise.share * chain.spacing_m) ** 2 * spacings[:, None]
    if own.tie is not None:
        known = known + _between_ends(chain, walked, closures, i)
    best = np.full(len(rows), np.inf)
    for heading in (own.pose[2], own.pose[2] + np.pi) if is_axial else (own.pose[2],):
        # Rotation from the axes of dead reckoning to those of the map.
        angle = heading - start[2]
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        way = (walked.pose[rows, :2] - start[:2]) @ turn.T
        gap = target - own.pose[:2] - way
        lever = np.stack([-way[:, 1], way[:, 0]], axis=1)
        total = known + turn @ driven @ turn.T
        total = total + var_theta * lever[:, :, None] * lever[:, None, :]
        solved = np.linalg.solve(total, gap[:, :, None])[:, :, 0]
        best = np.minimum(best, (gap * solved).sum(axis=1))
    return best


def consistent(chain: Chain, closures: Sequence[Closure]) -> Bool[np.ndarray, "c c"]:
    """Say which closures are consistent with which.

    Both directions must agree: from the earlier closure to the later and back. A closure without a
    heading may have been met in either direction of its map image. Closures of stretches that
    odometry does not join are consistent.

    Args:
        chain: odometry and its noise.
        closures: of frames of the chain.

    Returns:
        Symmetric, False on the diagonal.
    """
    n = len(closures)
    agree = np.zeros((n, n), bool)
    if not n:
        return agree
    walked = walk(chain)
    rows = np.array([closure.frame - chain.first for closure in closures])
    part = walked.part[rows]
    for i in range(n):
        apart = _distances(chain, walked, closures, rows, i)
        agree[i] = (part != part[i]) | (apart <= GATE)
    agree &= agree.T
    np.fill_diagonal(agree, False)
    return agree


def greedy_clique(agree: Bool[np.ndarray, "c c"]) -> Clique:
    """Return a large consistent set: always take the closure that leaves the most others.

    The heuristic of Pattabiraman et al., Fast algorithms for the maximum clique problem, 2015,
    started once from the closure with the most partners.
    """
    left, rows = np.ones(len(agree), bool), []
    while left.any():
        partners = np.where(left, (agree & left).sum(axis=1), -1)
        best = int(partners.argmax())
        rows.append(best)
        left &= agree[best]
    return Clique(sorted(rows), is_largest=False)


def _coloured(candidates: int, neighbours: Sequence[int]) -> list[tuple[int, int]]:
    """Return (row, colours so far) of all candidates; no two of one colour are consistent."""
    order, colour, left = [], 0, candidates
    while left:
        colour, free = colour + 1, left
        while free:
            bit = free & -free
            row = bit.bit_length() - 1
            order.append((row, colour))
            left ^= bit
            free &= ~(neighbours[row] | bit)
    return order


def exact_clique(agree: Bool[np.ndarray, "c c"], most_s: float) -> Clique:
    """Return the largest consistent set by branch and bound over colourings, as bit sets.

    Tomita & Kameda, An efficient branch-and-bound algorithm for finding a maximum clique, 2007.

    Args:
        agree: from `consistent`.
        most_s: give up after so many seconds, and return the largest set found.
    """
    n, stop = len(agree), time.monotonic() + most_s
    order = np.argsort(-agree.sum(axis=1), kind="stable")
    neighbours = [
        int("".join("1" if a else "0" for a in agree[i, order[::-1]]) or "0", 2) for i in order
    ]
    best = [int(np.flatnonzero(order == row)[0]) for row in greedy_clique(agree).rows]
    # Not recursive: a consistent set may be larger than Python's stack. One entry per member.
    chosen: list[int] = []
    stack = [(_coloured((1 << n) - 1, neighbours), (1 << n) - 1)]
    is_largest = True
    while stack:
        if time.monotonic() > stop:
            is_largest = False
            break
        waiting, candidates = stack[-1]
        if not waiting or len(chosen) + waiting[-1][1] <= len(best):
            stack.pop()
            if chosen:
                chosen.pop()
            continue
        row, _ = waiting.pop()
        stack[-1] = (waiting, candidates & ~(1 << row))
        chosen.append(row)
        inside = candidates & neighbours[row]
        if inside:
            stack.append((_coloured(inside, neighbours), inside))
            continue
        if len(chosen) > len(best):
            best = chosen.copy()
        chosen.pop()
    return Clique(sorted(int(order[row]) for row in best), is_largest)
