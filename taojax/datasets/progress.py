"""Route progress: a data folder from two drives along one route of which nobody knows the poses.

Every frame stands at (progress along the route, 0). The map is thinned and loses two stretches; the
queries stay one uninterrupted drive. Odometry made from row numbers would be the truth, so it is
simulated with stated noise.

Source:
    The paper's Table 3 (IRSLAM-KRI transfer check).
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Shaped

from taojax.datasets.folder import Descriptors, write_folder
from taojax.datasets.trajectory import Trajectory, every
from taojax.errors import ConfigError, InputError

__all__ = [
    "ProgressConfig", "Route", "along", "retained", "route_of_matches", "route_of_shares",
    "write_progress",
]  # fmt: skip

LEAST_ANCHORS = 3
"""A map of fewer is refused by its spec."""


@dataclass(frozen=True)
class ProgressConfig:
    """What the protocol leaves open."""

    row_m: float = 1.0
    """Length of one row of the map on the route, metres; 1 where nobody knows it, and every
    "metre" of the folder is a row."""

    n_anchors: int | None = None
    """Map frames kept, evenly by number, before stretches are deleted; None keeps all."""

    deleted: tuple[tuple[float, float], ...] = ((0.165, 0.335), (0.665, 0.835))
    """(start, end) as shares of the query drive: the map loses what these queries drive along, one
    stretch in each half, so that calibration and test both leave the map."""

    scale_bias: float = 0.05
    """Constant relative error of the simulated odometry."""

    step_noise: float = 0.10
    """Standard deviation of its relative error from step to step."""

    def __post_init__(self) -> None:
        """Refuse impossible settings while the caller's line is on the stack."""
        if not self.row_m > 0:
            raise ConfigError(f"row_m must be positive, got {self.row_m}")
        if self.n_anchors is not None and self.n_anchors < LEAST_ANCHORS:
            raise ConfigError(f"n_anchors must be at least {LEAST_ANCHORS}, got {self.n_anchors}")
        for start, end in self.deleted:
            if not 0.0 <= start < end <= 1.0:
                raise ConfigError(f"deleted ({start}, {end}) must be shares that rise in [0, 1]")


@dataclass(frozen=True)
class Route:
    """Two drives along one route, frames in the order driven; progress counts rows of the map."""

    map_views: Float[np.ndarray, "m d"]
    """(M, D) descriptors, may be memory-mapped."""

    query_views: Float[np.ndarray, "t d"]
    """(T, D)."""

    map_rows: Float[np.ndarray, " m"]
    """(M,) progress of every map frame, rows."""

    query_rows: Float[np.ndarray, " t"]
    """(T,) true progress of every query frame, rows."""

    notes: tuple[str, ...] = ()
    """Sentences that the report must repeat."""


def route_of_shares(
    map_views: Float[np.ndarray, "m d"], query_views: Float[np.ndarray, "t d"]
) -> Route:
    """Take the same share of both drives for the same place.

    With as many query as map frames that is: same row, same place.

    Args:
        map_views: (M, D) descriptors.
        query_views: (T, D) descriptors.
    """
    n_map, n_query = len(map_views), len(query_views)
    rows = np.linspace(0.0, n_map - 1.0, n_query)
    note = "truth: the same share of both drives is taken for the same place"
    return Route(map_views, query_views, np.arange(float(n_map)), rows, (note,))


def route_of_matches(
    map_views: Float[np.ndarray, "m d"],
    query_views: Float[np.ndarray, "t d"],
    matches: Bool[np.ndarray, "rows columns"],
) -> Route:
    """Give every query the progress that a match matrix implies.

    Of several matched rows the one is taken that makes the drive smoothest (least sum of squared
    steps over the whole drive). A query without a match lies between its neighbours; before the
    first and after the last match nothing is known, and those queries are left out.

    Args:
        map_views: (M, D) descriptors.
        query_views: (T, D) descriptors.
        matches: (M, T) True where a map frame shows the place of a query.

    Raises:
        InputError: the matrix has another shape, or fewer than two queries have a match.
    """
    n_map, n_query = len(map_views), len(query_views)
    if matches.shape != (n_map, n_query):
        raise InputError(
            f"matches: shape {matches.shape}, but there are {n_map} map and {n_query} query "
            "frames; give one row per map frame and one column per query"
        )
    known = np.flatnonzero(matches.any(axis=0))
    if len(known) < 2:
        raise InputError(
            f"matches: {len(known)} queries have a match, at least 2 are needed; is it transposed?"
        )
    rows = _smoothest([np.flatnonzero(matches[:, query]).astype(float) for query in known])
    at = np.arange(known[0], known[-1] + 1)
    n_several = int((matches.sum(axis=0) > 1).sum())
    notes = [
        f"truth from a match matrix: {n_several} of {n_query} queries match several map frames; "
        "the smoothest drive decides"
    ]
    if n_between := len(at) - len(known):
        notes.append(f"{n_between} queries without a match lie between their neighbours")
    if n_left := n_query - len(at):
        notes.append(f"{n_left} queries before the first or after the last match are left out")
    progress = np.interp(at, known, rows)
    return Route(map_views, query_views[at], np.arange(float(n_map)), progress, tuple(notes))


def _smoothest(rows: list[np.ndarray]) -> Float[np.ndarray, " t"]:
    """Choose one row of each list so that the squared steps between them sum to the least."""
    cost, before = np.zeros(len(rows[0])), []
    for old, new in pairwise(rows):
        total = cost[:, None] + (new[None] - old[:, None]) ** 2
        before.append(np.argmin(total, axis=0))
        cost = total.min(axis=0)
    chosen = [int(np.argmin(cost))]
    for choice in reversed(before):
        chosen.append(int(choice[chosen[-1]]))
    return np.array([row[at] for row, at in zip(rows, reversed(chosen), strict=True)])


def retained(route: Route, config: ProgressConfig) -> Shaped[np.ndarray, " k"]:
    """Name the map frames that stay: evenly thinned, without the deleted stretches.

    Args:
        route: two drives.
        config: how many anchors, which stretches.

    Returns:
        Their rows in `route.map_views`, in the order driven.

    Raises:
        InputError: too few stay.
    """
    n_map, n_query = len(route.map_rows), len(route.query_rows)
    rows = every(n_map, n_map if config.n_anchors is None else config.n_anchors)
    stays = np.ones(len(rows), dtype=bool)
    for low, high in _stretches(route.query_rows, config):
        stays &= (route.map_rows[rows] < low) | (route.map_rows[rows] > high)
    if int(stays.sum()) < LEAST_ANCHORS:
        raise InputError(
            f"the deleted stretches leave {int(stays.sum())} of {len(rows)} anchors for "
            f"{n_query} queries; choose shorter ones"
        )
    return rows[stays]


def _stretches(query_rows: np.ndarray, config: ProgressConfig) -> list[tuple[float, float]]:
    """Return lowest and highest progress along each deleted stretch, rows."""
    found = []
    for shares in config.deleted:
        first, last = (round(share * (len(query_rows) - 1)) for share in shares)
        driven = query_rows[first : last + 1]
        found.append((float(driven.min()), float(driven.max())))
    return found


def along(
    progress_m: Float[np.ndarray, " t"], config: ProgressConfig, seed: int
) -> Float[np.ndarray, "t 3"]:
    """Simulate odometry along the route.

    Args:
        progress_m: (T,) true progress, metres.
        config: scale bias and noise per step.
        seed: of the noise.

    Returns:
        (T, 3) forward [m], left [m], yaw [rad]; row 0, left and yaw are zero.
    """
    error = config.step_noise * np.random.default_rng(seed).standard_normal(len(progress_m))
    forward = np.diff(progress_m, prepend=progress_m[:1]) * (1.0 + config.scale_bias + error)
    return np.stack([forward, np.zeros_like(forward), np.zeros_like(forward)], axis=1)


def write_progress(out: Path, route: Route, config: ProgressConfig, *, seed: int = 0) -> None:
    """Write two drives as a data folder whose positions are route progress.

    Args:
        out: the folder to make.
        route: two drives along one route.
        config: unit, thinning, deleted stretches and noise.
        seed: of the odometry noise.

    Raises:
        InputError: too few anchors stay, or `out` cannot be made.
    """
    kept = retained(route, config)
    map_m, query_m = route.map_rows[kept] * config.row_m, route.query_rows * config.row_m
    write_folder(
        out,
        Trajectory(kept.astype(float), _along_x(map_m)),
        (np.arange(float(len(query_m))), along(query_m, config, seed)),
        Descriptors(route.map_views[kept], route.query_views),
        truth=_along_x(query_m),
        notes=(*_notes(route, config, len(kept), seed), *route.notes),
    )


def _along_x(progress_m: np.ndarray) -> Float[np.ndarray, "n 3"]:
    return np.stack([progress_m, np.zeros_like(progress_m), np.zeros_like(progress_m)], axis=1)


def _notes(route: Route, config: ProgressConfig, n_kept: int, seed: int) -> list[str]:
    """Say what was simulated, thinned and deleted."""
    gone = "; ".join(f"{low:g} to {high:g}" for low, high in _stretches(route.query_rows, config))
    unit = "one row of the map" if config.row_m == 1.0 else f"{config.row_m:g} m per row of the map"
    return [
        f"simulated odometry: true progress with a scale bias of {config.scale_bias:.0%} and "
        f"{config.step_noise:.0%} noise per step, seed {seed}",
        f"route progress: positions are (progress, 0), their unit is {unit}",
        f"sparse map: {n_kept} of {len(route.map_rows)} frames; deleted rows: {gone or 'none'}",
    ]
