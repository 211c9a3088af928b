"""Measures of a data folder before anything is scored: clocks, drives and lengths of descriptors.

Pure functions of arrays; what they mean is said elsewhere.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from taojax.errors import InputError
from taojax.runtime.maps import map_spacing_m

__all__ = [
    "SECONDS",
    "Clock",
    "MapShape",
    "Norms",
    "Steps",
    "clock",
    "map_shape",
    "matched_share",
    "norms",
    "step_m",
    "steps",
]

UNIX = {"ns": 1e17, "us": 1e14, "ms": 1e11, "s": 1e8}
"""Unit -> the least UNIX time in it that is later than the seventies."""

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

SPEEDS_MPS = 0.02, 60.0
"""What robots and cars drive at."""

ROW_STEP = 10.0
"""Whole numbers with smaller steps count rows, of which some may have been left out."""

GAP_SPACINGS = 5.0
"""A step of the map longer than so many spacings is a gap."""

REVISIT_SPACINGS, REVISIT_WAY = 3.0, 10.0
"""A place is met again within so many spacings of another, so many times as far along the way."""


@dataclass(frozen=True)
class Norms:
    """Lengths of descriptors; they are brought to 1 on loading."""

    least: float
    median: float
    largest: float
    zero: Int[np.ndarray, " z"]
    """Rows of length zero."""


def norms(rows: Float[np.ndarray, "n d"], name: str = "descriptors") -> Norms:
    """Measure descriptors block by block.

    Args:
        rows: (n, d), may be memory-mapped.
        name: of the file, for the message.

    Raises:
        InputError: a row is not finite.
    """
    length = np.empty(len(rows))
    step = max(1, (8 << 20) // (rows.itemsize * rows.shape[1]))
    for start in range(0, len(rows), step):
        with np.errstate(over="ignore", invalid="ignore"):
            part = np.asarray(rows[start : start + step], np.float64)
            length[start : start + step] = np.sqrt(np.einsum("nd,nd->n", part, part))
    if (bad := np.flatnonzero(~np.isfinite(length))).size:
        what = f"row {int(bad[0])} (from 0) is not finite, {bad.size} such rows in all"
        raise InputError(f"{name}: {what}; drop the frames or compute them again")
    return Norms(
        float(length.min()),
        float(np.median(length)),
        float(length.max()),
        np.flatnonzero(length == 0),
    )


@dataclass(frozen=True)
class Clock:
    """Stamps, and what unit they seem to have."""

    first: float
    last: float
    step: float
    """Median of the steps that are not zero; 0 where time stands still."""

    unit: str
    """s, ms, us, ns or rows."""

    @property
    def duration_s(self) -> float | None:
        """Seconds from first to last; None for row numbers."""
        return (self.last - self.first) * SECONDS[self.unit] if self.unit in SECONDS else None


def clock(t: Float[np.ndarray, " n"], step_m: Float[np.ndarray, " m"]) -> Clock:
    """Guess the unit of stamps: by size where they are UNIX time, else by the speed they imply.

    Args:
        t: (n,) stamps.
        step_m: (n - 1,) metres driven between them.
    """
    dt = np.diff(t)
    step = float(np.median(dt[dt > 0])) if (dt > 0).any() else 0.0
    unit = next((name for name, least in UNIX.items() if abs(t[0]) >= least), None)
    is_moving = (dt > 0) & (step_m > 1e-6)
    if unit is None and 1.0 <= step < ROW_STEP and np.all(t == np.round(t)):
        unit = "rows"
    elif unit is None:
        speed = float(np.median(step_m[is_moving] / dt[is_moving])) if is_moving.any() else 1.0
        low, high = SPEEDS_MPS
        fits = (name for name, unit_s in SECONDS.items() if low <= speed / unit_s <= high)
        unit = next(fits, "s")
    return Clock(float(t[0]), float(t[-1]), step, unit)


def matched_share(
    t: Float[np.ndarray, " n"], other: Float[np.ndarray, " m"]
) -> tuple[float, float]:
    """Compare two clocks.

    Args:
        t: (n,) stamps.
        other: (m,) stamps.

    Returns:
        Share of `t` that has one of `other` within half a median step, and share of `t` that lies
        between the first and the last of `other`.
    """
    dt = np.diff(t)
    tolerance = 0.5 * float(np.median(dt[dt > 0])) if (dt > 0).any() else 0.0
    ordered = np.sort(other)
    at = np.clip(np.searchsorted(ordered, t), 1, max(1, len(ordered) - 1))
    before, behind = ordered[at - 1], ordered[np.minimum(at, len(ordered) - 1)]
    gap = np.minimum(np.abs(t - before), np.abs(t - behind))
    inside = (t >= ordered[0]) & (t <= ordered[-1])
    return float(np.mean(gap <= tolerance * (1 + 1e-9))), float(inside.mean())


@dataclass(frozen=True)
class MapShape:
    """How a map was driven."""

    way_m: float
    size_m: tuple[float, float]
    spacing_m: float
    """Median while moving."""

    p95_m: float
    gaps: tuple[tuple[int, float], ...]
    """(row from 0, metres into it) of the longest first."""

    heading_rad: float
    """Median angle between theta and the direction of travel; NaN where nothing moves."""

    again: float
    """Share of the way on which a place is met that is met elsewhere on the way too."""

    again_opposed: float
    """Share of the way on which such a place is also met driving the opposite way."""


def step_m(xy: Float[np.ndarray, "n _"]) -> Float[np.ndarray, " m"]:
    """Return the length of every step of a drive [m]."""
    return np.hypot(*np.diff(xy[:, :2], axis=0).T)


def map_shape(xyt: Float[np.ndarray, "m 3"]) -> MapShape:
    """Measure a map's drive.

    Args:
        xyt: (M, 3) poses in driving order.
    """
    length, spacing_m = step_m(xyt), map_spacing_m(xyt[:, :2])
    wide = np.flatnonzero(length > GAP_SPACINGS * spacing_m)
    wide = wide[np.argsort(-length[wide], kind="stable")]
    again, opposed = _met_again(xyt, spacing_m)
    size = np.ptp(xyt[:, :2], axis=0)
    return MapShape(
        way_m=float(length.sum()),
        size_m=(float(size[0]), float(size[1])),
        spacing_m=spacing_m,
        p95_m=float(np.quantile(length, 0.95)),
        gaps=tuple((int(at) + 1, float(length[at])) for at in wide),
        heading_rad=_heading_gap(xyt, length, spacing_m),
        again=again,
        again_opposed=opposed,
    )


def _turned(angle: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * angle)))


def _heading_gap(xyt: np.ndarray, length: np.ndarray, spacing_m: float) -> float:
    """Compare the heading halfway between two frames with the way between them."""
    moves = (length > 0.25 * spacing_m) & (length < GAP_SPACINGS * spacing_m)
    if not moves.any():
        return float("nan")
    way = np.diff(xyt[:, :2], axis=0)[moves]
    before, behind = np.exp(1j * xyt[:-1, 2][moves]), np.exp(1j * xyt[1:, 2][moves])
    return float(np.median(_turned(np.arctan2(way[:, 1], way[:, 0]) - np.angle(before + behind))))


def _met_again(xyt: np.ndarray, spacing_m: float) -> tuple[float, float]:
    """Return the shares of the way that is driven again, and in the opposite direction."""
    way = np.concatenate([[0.0], np.cumsum(step_m(xyt))])
    # One frame per spacing: standing still must not count.
    _, rows = np.unique(np.floor(way / spacing_m), return_index=True)
    reach_m = REVISIT_SPACINGS * spacing_m
    tree = KDTree(xyt[rows, :2])
    again, opposed = np.zeros(len(rows), bool), np.zeros(len(rows), bool)
    for at, near in enumerate(tree.query_ball_point(xyt[rows, :2], reach_m)):
        own = rows[at]
        others = rows[np.array(near)]
        others = others[np.abs(way[others] - way[own]) > REVISIT_WAY * reach_m]
        again[at] = others.size > 0
        opposed[at] = np.any(_turned(xyt[others, 2] - xyt[own, 2]) > 0.75 * np.pi)
    return float(again.mean()), float(opposed.mean())


@dataclass(frozen=True)
class Steps:
    """How far odometry says the robot went."""

    way_m: float
    median_m: float
    largest_m: float
    largest_row: int
    """From 0."""

    sideways: float
    """Share of the motion that is not along the body axis."""

    largest_yaw_rad: float


def steps(odometry: Float[np.ndarray, "t 3"]) -> Steps:
    """Measure odometry.

    Args:
        odometry: (T, 3) forward [m], left [m], yaw [rad]; row 0 is ignored.
    """
    moved = odometry[1:]
    length = np.hypot(moved[:, 0], moved[:, 1])
    moving = length[length > 1e-6]
    return Steps(
        way_m=float(length.sum()),
        median_m=float(np.median(moving)) if moving.size else 0.0,
        largest_m=float(length.max()),
        largest_row=int(np.argmax(length)) + 1,
        sideways=float(np.abs(moved[:, 1]).sum() / max(np.abs(moved[:, :2]).sum(), 1e-9)),
        largest_yaw_rad=float(np.abs(moved[:, 2]).max()),
    )
