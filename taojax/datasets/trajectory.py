"""A drive as stamped poses in the plane: associate, interpolate, thin, difference.

Everything is float64: a UTM coordinate or a UNIX stamp does not fit a float32.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from taojax.errors import InputError

__all__ = [
    "Trajectory",
    "driven_m",
    "every",
    "headings",
    "integrate",
    "motions",
    "pose_at",
    "spaced",
]


class Trajectory(NamedTuple):
    """Stamped poses in one frame; stamps rise."""

    t_s: Float[np.ndarray, " n"]
    """(n,) seconds; UNIX time keeps a quarter of a microsecond."""

    xyt: Float[np.ndarray, "n 3"]
    """(n, 3) x [m], y [m], theta [rad, counter-clockwise from x]."""


def wrap(angle: np.ndarray) -> np.ndarray:
    """Return the same angle in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def motions(poses: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    """Return the true motion into each frame, in body axes of the frame before; row 0 is zero.

    Args:
        poses: rows (x [m], y [m], theta [rad]).

    Returns:
        Forward [m], left [m], yaw [rad] in (-pi, pi].
    """
    step, theta = np.diff(poses[:, :2], axis=0), poses[:-1, 2]
    out = np.zeros((len(poses), 3))
    out[1:, 0] = np.cos(theta) * step[:, 0] + np.sin(theta) * step[:, 1]
    out[1:, 1] = np.cos(theta) * step[:, 1] - np.sin(theta) * step[:, 0]
    out[1:, 2] = np.angle(np.exp(1j * np.diff(poses[:, 2])))
    return out


def integrate(odometry: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    """Chain motions into poses in the frame of the first; the inverse of `motions`.

    Args:
        odometry: (T, 3) forward [m], left [m], yaw [rad]; row 0 is ignored.

    Returns:
        (T, 3) poses; theta is not wrapped.
    """
    moved = np.concatenate([np.zeros((1, 3)), odometry[1:]])
    theta = np.cumsum(moved[:, 2])
    before = theta - moved[:, 2]
    c, s = np.cos(before), np.sin(before)
    step = np.stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1]], axis=1)
    return np.concatenate([np.cumsum(step, axis=0), theta[:, None]], axis=1)


def headings(xy: Float[np.ndarray, "n 2"], least_m: float = 0.5) -> Float[np.ndarray, " n"]:
    """Derive where a drive heads from where it goes.

    Args:
        xy: (n, 2) positions [m], in the order driven.
        least_m: a frame takes its heading from the nearest frames at least this far before and
            behind it, so that one standing still keeps the heading it arrived with.

    Returns:
        (n,) theta [rad]; zero where the drive never moves.
    """
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    at = np.arange(len(xy))
    before = np.maximum(np.searchsorted(way, way - least_m, side="right") - 1, 0)
    behind = np.minimum(np.searchsorted(way, way + least_m, side="left"), len(xy) - 1)
    step = xy[np.maximum(behind, at)] - xy[np.minimum(before, at)]
    return np.arctan2(step[:, 1], step[:, 0])


def pose_at(
    drive: Trajectory, t_s: Float[np.ndarray, " t"], gate_s: float, *, interpolated: bool = True
) -> tuple[Float[np.ndarray, "t 3"], Bool[np.ndarray, " t"]]:
    """Give stamps their poses.

    Args:
        drive: at least one pose.
        t_s: (T,) stamps on the same clock.
        gate_s: a pose farther than this in time is none; between two poses that are more than
            twice this apart nothing is interpolated.
        interpolated: linear between the poses around (theta along the shorter arc), instead of
            the nearest pose.

    Returns:
        (T, 3) poses and (T,) whether there is one; a stamp without pose has that of the nearest.
    """
    n = len(drive.t_s)
    behind = np.clip(np.searchsorted(drive.t_s, t_s), 1, max(n - 1, 1))
    behind = np.minimum(behind, n - 1)
    before = np.maximum(behind - 1, 0)
    span = drive.t_s[behind] - drive.t_s[before]
    share = np.where(span > 0, (t_s - drive.t_s[before]) / np.where(span > 0, span, 1.0), 0.0)
    nearest = np.where(share > 0.5, behind, before)
    is_matched = np.abs(drive.t_s[nearest] - t_s) <= gate_s
    if not interpolated:
        return drive.xyt[nearest], is_matched
    step = drive.xyt[behind] - drive.xyt[before]
    step[:, 2] = wrap(step[:, 2])
    smooth = drive.xyt[before] + np.clip(share, 0.0, 1.0)[:, None] * step
    is_between = (span <= 2.0 * gate_s) & (share >= 0.0) & (share <= 1.0)
    return np.where(is_between[:, None], smooth, drive.xyt[nearest]), is_matched


def driven_m(xyt: Float[np.ndarray, "n _"]) -> Float[np.ndarray, " n"]:
    """Return the way driven up to every pose [m]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xyt[:, :2], axis=0).T))])


def every(n_frames: int, n_kept: int) -> Int[np.ndarray, " k"]:
    """Choose frames evenly by number, all of them where there are too few."""
    if n_kept >= n_frames:
        return np.arange(n_frames)
    return np.unique(np.round(np.linspace(0, n_frames - 1, n_kept)).astype(np.int64))


def spaced(xyt: Float[np.ndarray, "n _"], spacing_m: float) -> Int[np.ndarray, " k"]:
    """Choose frames that each lie at least a distance of way behind the last one chosen.

    Raises:
        InputError: the spacing is not positive.
    """
    if not spacing_m > 0:
        raise InputError(f"a spacing of {spacing_m:g} m chooses no frames; it must be positive")
    way, chosen = driven_m(xyt), [0]
    while (ahead := int(np.searchsorted(way, way[chosen[-1]] + spacing_m))) < len(way):
        chosen.append(ahead)
    return np.array(chosen, dtype=np.int64)
