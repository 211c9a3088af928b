"""What a recording tells of itself before anything is scored: radii, descriptors, steps, clocks."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from taojax.errors import InputError
from taojax.files.dataset_info import read_about
from taojax.files.specs import fail, read_npy, read_npz
from taojax.files.tables import read_table
from taojax.runtime.maps import NEAR_SPACINGS, map_spacing_m, view_map
from taojax.runtime.observations import Observations, descriptor_names, load_observations
from taojax.runtime.retrieval import normalise, retrieve

__all__ = [
    "SECONDS",
    "SITES",
    "Clock",
    "Found",
    "MapShape",
    "Norms",
    "Radii",
    "Steps",
    "Views",
    "chance",
    "check",
    "clock",
    "histogram",
    "map_shape",
    "matched_share",
    "near_m",
    "norms",
    "step_m",
    "steps",
    "suggest_radii",
    "views",
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


class Site(NamedTuple):
    """A kind of place and the radii that are usual there [m]."""

    name: str
    below_m: float
    """Longer side of its map."""

    r_in_m: float
    r_out_m: float


SITES = (
    Site("rooms", 40.0, 1.5, 3.0),
    Site("a corridor or yard", 300.0, 5.0, 10.0),
    Site("a street", math.inf, 10.0, 10.0),
)

STEPS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Round numbers; times powers of ten."""

PROGRESS = 2.0, 10.0
"""In map spacings, where positions are progress along a line, as the paper has it in rows."""


class Radii(NamedTuple):
    """What to hand to `--r-in` and `--r-out` [m], and why."""

    r_in_m: float
    r_out_m: float
    why: str


def suggest_radii(shape: MapShape, stray_m: float | None = None) -> Radii:
    """Propose radii for a map.

    Args:
        shape: of the map.
        stray_m: drift of the odometry, where it is known: no closure is placed better than
            that, nor better than the map is dense.
    """
    if min(shape.size_m) == 0.0 and max(shape.size_m) > 0.0:
        r_in_m, r_out_m = (_round_up(times * shape.spacing_m) for times in PROGRESS)
        return Radii(r_in_m, r_out_m, "positions along a line: 2 and 10 map spacings")
    long_m = max(shape.size_m)
    site = next(site for site in SITES if long_m < site.below_m)
    why = f"a map of {long_m:.0f} m is taken for {site.name}"
    floors = {"the map's spacing": shape.spacing_m, "the drift of odometry": stray_m or 0.0}
    name = max(floors, key=floors.__getitem__)
    if (least_m := floors[name]) <= site.r_in_m:
        return Radii(site.r_in_m, site.r_out_m, why)
    r_in_m = _round_up(least_m)
    r_out_m = max(r_in_m, min(2.0 * r_in_m, SITES[-1].r_out_m))
    return Radii(r_in_m, r_out_m, f"{why}, raised to {name}")


def _round_up(least: float) -> float:
    """Return the next round number."""
    power = 10.0 ** math.floor(math.log10(least))
    return next((s * power for s in STEPS if s * power >= least * (1 - 1e-6)), 10.0 * power)


N_QUERIES, N_PAIRS = 1000, 64
"""Queries whose best match is looked up; rows of each side that pair with one another."""


@dataclass(frozen=True)
class Views:
    """How alike the two sessions look."""

    rows: Int[np.ndarray, " q"]
    """Queries looked at."""

    best: Int[np.ndarray, " q"]
    """Map row of the best match of each, -1 = none."""

    best_similarity: Float[np.ndarray, " q"]
    others: Float[np.ndarray, " p"]
    """Similarities of random pairs; of lists, those of all candidates behind the best."""

    own_recall: float | None
    """Share of map images whose most similar other image lies nearby; None for lists."""


def views(observations: Observations, xy: Float[np.ndarray, "m 2"], spacing_m: float) -> Views:
    """Look at best matches, random pairs and the map's likeness to itself.

    Args:
        observations: a folder in which nothing is wrong.
        xy: (M, 2) map positions [m].
        spacing_m: of the map.
    """
    if observations.retrievals is not None:
        index, similarity = observations.retrievals.index, observations.retrievals.similarity
        rows = np.flatnonzero(index[:, 0] >= 0)
        others = similarity[:, 1:][index[:, 1:] >= 0]
        return Views(rows, index[rows, 0], similarity[rows, 0], others, None)
    of_map, of_query = observations.descriptors or (np.zeros((0, 0)), np.zeros((0, 0)))
    rows = _spread(len(of_query), N_QUERIES)
    index, similarity = retrieve(of_map, of_query[rows], 1)
    pairs = [normalise(side[_spread(len(side), N_PAIRS)]) for side in (of_query, of_map)]
    recall = view_map(of_map, xy, spacing_m).recall
    return Views(rows, index[:, 0], similarity[:, 0], (pairs[0] @ pairs[1].T).ravel(), recall)


def _spread(n: int, n_kept: int) -> Int[np.ndarray, " k"]:
    return np.unique(np.linspace(0, n - 1, min(n, n_kept)).astype(int))


def near_m(spacing_m: float) -> float:
    """Return the radius within which the runtime takes two map images for one place [m]."""
    return NEAR_SPACINGS * spacing_m


def chance(map_xy: Float[np.ndarray, "m 2"], reach_m: float) -> float:
    """Return the share of other map images within a radius of one: what blind guessing hits."""
    rows = _spread(len(map_xy), 512)
    gap = map_xy[rows][:, None] - map_xy[None]
    return float((np.sum(gap**2, axis=2) <= reach_m**2).sum(axis=1).mean() - 1) / len(map_xy)


def histogram(
    a: Float[np.ndarray, " p"], b: Float[np.ndarray, " q"], n_bins: int = 12
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return common edges and the share of each sample in every bin."""
    low, high = (float(end(np.concatenate([a, b]))) for end in (np.min, np.max))
    edges = np.linspace(low, max(high, low + 1e-6), n_bins + 1)
    shares = [np.histogram(x, edges)[0] / max(1, len(x)) for x in (a, b)]
    return edges, shares[0], shares[1]


T = TypeVar("T")


@dataclass
class Found:
    """A data folder as far as it can be read; None is what cannot."""

    files: dict[str, str] = field(default_factory=dict)
    """Name -> what it holds; blank where it cannot be read."""

    problems: dict[str, str] = field(default_factory=dict)
    """Name -> the one line on what is wrong with it."""

    map_t: np.ndarray | None = None
    map_xyt: np.ndarray | None = None
    """(M, 3)."""

    query_t: np.ndarray | None = None
    odometry: np.ndarray | None = None
    """(T, 3)."""

    norms: dict[str, Norms] = field(default_factory=dict)
    """Of each file of descriptors."""

    observations: Observations | None = None
    """All of it, where nothing is wrong."""

    def attempt(self, name: str, read: Callable[[], T]) -> T | None:
        """Read a file, or note what is wrong with it."""
        try:
            return read()
        except InputError as error:
            self.files.setdefault(name, "")
            self.problems.setdefault(name, str(error))
            return None


def check(folder: Path) -> Found:
    """Read every file of a data folder but the truth.

    Args:
        folder: laid out as data_specs/README.md says.

    Raises:
        InputError: there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such data folder; see data_specs/README.md for the layout")
    found = Found()
    found.map_t, found.map_xyt = _table(found, folder, "map/poses.csv", "map_poses")
    found.query_t, found.odometry = _table(found, folder, "query/odometry.csv", "query_odometry")
    if (folder / "query/retrievals.npz").exists():
        _lists(found, folder, "query/retrievals.npz")
    else:
        names = found.attempt("descriptors", lambda: descriptor_names(folder)) or ()
        for name, stamps in zip(names, (found.map_t, found.query_t), strict=False):
            _descriptors(found, folder, name, stamps)
    if (folder / "about.toml").exists():
        found.files["about.toml"] = "notes"
        n_query = None if found.query_t is None else len(found.query_t)
        found.attempt("about.toml", lambda: read_about(folder, n_query))
    try:
        found.observations = load_observations(folder)
    except InputError as error:
        # It stops at the first; what is new goes to the file that it names.
        own = (name for name in found.files if str(error).startswith(f"{folder / name}:"))
        found.problems.setdefault(next(own, "descriptors"), str(error))
    return found


def _table(
    found: Found, folder: Path, name: str, spec: str
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return stamps and the three other columns."""
    table = found.attempt(name, lambda: read_table(folder / name, spec))
    if table is None:
        return None, None
    found.files[name] = f"{len(table['t_s']):,} rows"
    return table["t_s"], np.stack([table[column] for column in list(table)[1:]], axis=1)


def _lists(found: Found, folder: Path, name: str) -> None:
    arrays = found.attempt(name, lambda: read_npz(folder / name, "retrievals"))
    if arrays is not None:
        found.files[name] = f"{_shape(arrays['index'])} candidates"


def _descriptors(found: Found, folder: Path, name: str, stamps: np.ndarray | None) -> None:
    array = found.attempt(name, lambda: read_npy(folder / name, "descriptors"))
    if array is None:
        return
    found.files[name] = f"{_shape(array)} {array.dtype}"
    if stamps is not None and len(array) != len(stamps):
        what = f"{len(array)} rows for {len(stamps)} frames"
        found.problems[name] = str(fail(folder / name, what, "store one row per frame"))
    measured = found.attempt(name, lambda: norms(array, str(folder / name)))
    found.norms |= {} if measured is None else {name: measured}


def _shape(array: np.ndarray) -> str:
    return " x ".join(f"{n:,}" for n in array.shape)
