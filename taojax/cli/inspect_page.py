"""What `taojax inspect` says of files, clocks, drives, descriptors, lists and the truth."""

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from taojax.runtime.inspection import (
    SITES,
    Radii,
    Views,
    chance,
    clock,
    histogram,
    map_shape,
    matched_share,
    near_m,
    step_m,
    steps,
    views,
)

if TYPE_CHECKING:
    from taojax.audit.labels import Truth
    from taojax.runtime.inspection import Clock, Found, MapShape, Norms, Radii, Views


def scale_of(odometry: Float[np.ndarray, "t 3"], true_xy: Float[np.ndarray, "t 2"]) -> float | None:
    """Return odometry over truth, the median over the steps that truly move; None without any.

    Args:
        odometry: (T, 3) forward [m], left [m], yaw [rad]; row 0 is ignored.
        true_xy: (T, 2) true positions [m].
    """
    length, true = np.hypot(odometry[1:, 0], odometry[1:, 1]), step_m(true_xy)
    moves = true > max(1e-6, 0.25 * float(np.quantile(true, 0.9)))
    return float(np.median(length[moves] / true[moves])) if moves.any() else None


def drift_m(
    odometry: Float[np.ndarray, "t 3"], true_xy: Float[np.ndarray, "t 2"], n_frames: int
) -> float:
    """Measure how far odometry strays from the truth over a window.

    Args:
        odometry: (T, 3) forward [m], left [m], yaw [rad]; row 0 is ignored.
        true_xy: (T, 2) true positions [m].
        n_frames: of a window.

    Returns:
        Median over all windows of the root mean square distance after the best rigid alignment [m].
    """
    theta = np.cumsum(np.r_[0.0, odometry[1:, 2]])
    step = (odometry[1:, 0] + 1j * odometry[1:, 1]) * np.exp(1j * theta[:-1])
    # Points of the plane are complex numbers: aligning is then one product.
    own, true = (
        windows - windows.mean(axis=1, keepdims=True)
        for windows in (
            np.lib.stride_tricks.sliding_window_view(points, min(n_frames, len(points)))
            for points in (np.cumsum(np.r_[0.0, step]), true_xy[:, 0] + 1j * true_xy[:, 1])
        )
    )
    spread = (np.abs(own) ** 2 + np.abs(true) ** 2).sum(axis=1)
    rest = spread - 2.0 * np.abs((own.conj() * true).sum(axis=1))
    return float(np.median(np.sqrt(np.maximum(rest, 0.0) / own.shape[1])))


@dataclass(frozen=True)
class Places:
    """Where the queries truly are, against the map."""

    near_m: float
    """Radius that counts as the same place."""

    nearest_m: Float[np.ndarray, " t"]
    """From every query to the nearest map pose."""

    right: float
    """Of the queries that have a map pose within `near_m`: share whose best match is one; NaN where
    there is none."""

    chance: float
    """The same for a random answer."""


def places(
    seen: Views, map_xy: Float[np.ndarray, "m 2"], true_xy: Float[np.ndarray, "t 2"], reach_m: float
) -> Places:
    """Hold best matches against the true positions.

    Args:
        seen: from `views`.
        map_xy: (M, 2) [m].
        true_xy: (T, 2) of the queries [m].
        reach_m: what counts as the same place.
    """
    nearest_m, _ = KDTree(map_xy).query(true_xy)
    there = nearest_m[seen.rows] <= reach_m
    gap = map_xy[seen.best[there]] - true_xy[seen.rows[there]]
    is_right = np.hypot(gap[:, 0], gap[:, 1]) <= reach_m
    right = float(is_right.mean()) if is_right.size else float("nan")
    return Places(reach_m, np.asarray(nearest_m), right, chance(map_xy, reach_m))


WINDOW = 20
"""Frames over which the drift of odometry is told: the default window."""

NO_MOTION = float("inf")
"""The drift of odometry that cannot be motion from frame to frame."""

UNITS = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}


@dataclasses.dataclass
class Page:
    """What is printed, and what the user should know before a long run."""

    lines: list[str] = dataclasses.field(default_factory=list)
    warnings: list[str] = dataclasses.field(default_factory=list)
    title: str | None = None
    """Of a section in which nothing has been said yet."""

    def head(self, title: str) -> None:
        """Begin a section."""
        self.title = title

    def say(self, label: str, text: str) -> None:
        """Add an aligned line."""
        self.add(f"  {label:<26}{text}".rstrip())

    def add(self, line: str) -> None:
        """Add a line, below its title where it is the first."""
        self.lines += [line] if self.title is None else ["", self.title, line]
        self.title = None

    def warn(self, is_so: bool, text: str) -> None:
        """Note a warning where there is reason."""
        if is_so:
            self.warnings.append(text)

    def end(self, verdict: str, command: str = "") -> None:
        """Add the warnings, the verdict and a command to copy."""
        self.head("warnings")
        for text in self.warnings:
            self.add(f"  - {text}")
        n = len(self.warnings)
        count = f" ({n} warning{'s' if n > 1 else ''})" if n else ""
        self.lines += ["", f"{verdict}{count}"]
        if command:
            self.lines[-1] += ":"
            self.lines += ["", command]


def files(page: Page, found: "Found", *, has_truth: bool) -> None:
    """List what is there and every problem."""
    page.head("files")
    for name in dict.fromkeys([*found.files, *found.problems]):
        state = "BAD" if name in found.problems else "ok"
        page.say(name, f"{state:<5}{found.files.get(name, '')}")
    if not has_truth:
        page.say("truth/query_poses.csv", "none: can be scored, not audited; added by `taojax"
                 " convert files THIS_FOLDER --query-poses FILE`")  # fmt: skip
    for note in found.observations.notes if found.observations else ():
        page.say("note", note)
    page.head("problems")
    for line in found.problems.values():
        page.add(f"  - {line}")


def clocks(page: Page, found: "Found", truth: "Truth | None") -> float | None:
    """Describe the stamps; return the share of query stamps that the truth knows."""
    page.head("time")
    if found.map_t is not None and found.map_xyt is not None:
        _clock(page, "map", len(found.map_t), clock(found.map_t, step_m(found.map_xyt)))
        for row in np.flatnonzero(np.diff(found.map_t) < 0)[:1]:
            where = f"map/poses.csv: time runs backwards into row {row + 3}"
            page.warn(True, f"{where}; rows are taken to be in driving order")
    if found.query_t is None or found.odometry is None:
        return None
    steps_m = np.hypot(found.odometry[1:, 0], found.odometry[1:, 1])
    _clock(page, "query", len(found.query_t), clock(found.query_t, steps_m))
    if truth is None:
        return None
    matched, inside = matched_share(found.query_t, truth.t_s)
    page.say(
        "truth", f"knows {share(matched)} of the query stamps; {share(inside)} lie in its time span"
    )
    page.warn(
        matched < 0.99,
        f"the truth knows only {share(matched)} of the query stamps: is each of its rows the pose"
        " of that query frame?",
    )
    return matched


def share(value: float) -> str:
    """Return a share in percent."""
    return f"{100.0 * value:.0f} %"


def _clock(page: Page, label: str, n: int, of: "Clock") -> None:
    if of.duration_s is None:
        page.say(label, f"{n:,} frames, row numbers {of.first:,.0f} to {of.last:,.0f}")
        return
    every_s = of.step * of.duration_s / (of.last - of.first) if of.last > of.first else 0.0
    page.say(label, f"{n:,} frames in {of.duration_s:,.0f} s, one every {every_s:.3g} s")
    page.warn(
        of.unit != "s",
        f"stamps of the {label} seem to be {UNITS.get(of.unit)}; t_s is meant in seconds",
    )


def drive(page: Page, found: "Found") -> "MapShape | None":
    """Describe how the map was driven."""
    if found.map_xyt is None:
        return None
    shape = map_shape(found.map_xyt)
    wide_m, high_m = shape.size_m
    page.head("map")
    page.say("way driven", f"{shape.way_m:,.0f} m, within {wide_m:,.0f} m x {high_m:,.0f} m")
    page.say("spacing", f"{shape.spacing_m:.2f} m median, {shape.p95_m:.2f} m at 95 %")
    longest = ", ".join(f"{metres:.1f} m into row {at + 2}" for at, metres in shape.gaps[:3])
    page.say("gaps", f"{len(shape.gaps)}, the longest {longest}" if longest else "none")
    page.say(
        "revisits",
        f"{share(shape.again)} of the way is driven more than once,"
        f" {share(shape.again_opposed)} in both directions",
    )
    if np.isfinite(shape.heading_rad):
        off = float(np.degrees(shape.heading_rad))
        page.say("headings", f"{off:.0f} deg off the direction of travel (median)")
        page.warn(
            off > 45,
            f"map headings are {off:.0f} deg off the direction of travel: theta_rad is"
            " counter-clockwise from x in radians, not a compass heading or degrees",
        )
    page.warn(
        max(shape.size_m) < 1.0,
        f"the map is {max(shape.size_m):.2g} m long: are its coordinates degrees or kilometres?",
    )
    return shape


def odometry(
    page: Page, found: "Found", truth: "Truth | None", shape: "MapShape | None"
) -> float | None:
    """Describe the robot's motion and hold it against the truth, else against the map.

    Returns:
        How far it strays from the truth over a window [m], where that is known; `NO_MOTION` where
        it cannot be motion at all.
    """
    if found.odometry is None:
        return None
    is_known = truth is not None and len(truth.t_s) == len(found.odometry)
    moved = steps(found.odometry)
    page.head("odometry")
    other, scale, drift, what = "", None, None, "the truth"
    if truth is not None and is_known:
        scale = scale_of(found.odometry, truth.xy_m)
        drift = drift_m(found.odometry, truth.xy_m, WINDOW)
    if truth is not None and scale is not None:
        other = f", truth {step_m(truth.xy_m).sum():,.0f} m; {scale:.2f} of the truth (median step)"
    elif shape is not None and shape.way_m > 0:
        scale, what = moved.way_m / shape.way_m, "the way of the map"
        other = f", the map {shape.way_m:,.0f} m"
    page.say("way driven", f"{moved.way_m:,.0f} m{other}")
    largest = f"{moved.largest_m:.2f} m into row {moved.largest_row + 2}"
    page.say("steps", f"{moved.median_m:.2f} m median, the longest {largest}")
    if drift is not None:
        page.say("drift", f"{drift:.2g} m from the truth over {WINDOW} frames (median)")
    is_off = scale is not None and not 1 / 3 <= scale <= 3
    page.warn(
        is_off,
        f"odometry is {scale or 0:.3g} times {what}: are its rows metres from frame to frame, or"
        " poses (`taojax convert files --odometry-kind poses`)?",
    )
    times = moved.largest_m / moved.median_m if moved.median_m > 0 else 0.0
    page.warn(times > 20, f"odometry jumps: {largest} is {times:.0f} times the median step")
    page.warn(
        moved.sideways > 0.5,
        "the robot moves more to the side than ahead: are dx_m (forward) and dy_m (left) swapped?",
    )
    page.warn(
        moved.largest_yaw_rad > 1.01 * np.pi,
        f"a frame turns by {moved.largest_yaw_rad:.0f} rad: is dtheta_rad in degrees?",
    )
    # The way of the map is a hint alone: a drive may be shorter.
    return NO_MOTION if is_off and truth is not None else drift


def radii(page: Page, proposed: Radii, nearest_m: "np.ndarray | None") -> str:
    """Propose radii and say what they make of the frames; return them as flags."""
    rooms, hall, street = (f"{site.r_in_m:g}/{site.r_out_m:g}" for site in SITES)
    flags = f"--r-in {proposed.r_in_m:g} --r-out {proposed.r_out_m:g}"
    page.head("radii")
    page.say("suggested", f"{flags}: {proposed.why}")
    page.say(
        "the rule",
        f"by the longer side of the map: {rooms} below {SITES[0].below_m:g} m,"
        f" {hall} below {SITES[1].below_m:g} m, else {street}",
    )
    if nearest_m is None:
        return flags
    n_in, n_out = (
        int((nearest_m <= proposed.r_in_m).sum()),
        int((nearest_m > proposed.r_out_m).sum()),
    )
    grey = (
        f", {len(nearest_m) - n_in - n_out:,} between" if proposed.r_out_m > proposed.r_in_m else ""
    )
    page.say("with these", f"{n_in:,} frames are in-map, {n_out:,} map-out{grey}")
    calibration, test = np.array_split(nearest_m > proposed.r_out_m, 2)
    for half, is_out in (("first half, which calibrates", calibration), ("second half", test)):
        page.warn(
            n_out > 0 and not is_out.any(),
            f"the {half}, holds no frame off the map: an audit cannot measure what is accepted"
            " there; record a drive that leaves the map in both halves",
        )
    return flags


BARELY, CLEAR = 0.04, 0.7
"""A recall so little above chance says that rows are mixed up; one above the other is good."""

BAR = 28
"""Characters of the longest bar."""


def lengths(page: Page, found: "Found") -> None:
    """Describe the lengths of descriptors and of lists."""
    page.head("descriptors" if found.norms else "retrieval lists")
    for name, of in found.norms.items():
        _norms(page, name, of)
    lists = found.observations.retrievals if found.observations else None
    if lists is None or found.map_t is None:
        return
    n = (lists.index >= 0).sum(axis=1)
    named = len(np.unique(lists.index[lists.index >= 0])) / len(found.map_t)
    page.say("candidates", f"{n.min()} to {n.max()} per query, median {np.median(n):.0f}")
    page.say("empty lists", f"{(n == 0).sum()} of {len(n):,}")
    page.say("map rows ever named", share(named))
    empty, median = float(np.mean(n == 0)), float(np.median(n))
    page.warn(empty > 0.2, f"{share(empty)} of the lists are empty: odometry has to bridge them")
    page.warn(
        0 < median < 5,
        f"lists hold {median:.0f} candidates (median): a true place that is not among them"
        " cannot be found",
    )


def _norms(page: Page, name: str, of: "Norms") -> None:
    side = "query" if "quer" in name else "map"
    page.say(f"length, {side}", f"{of.least:.3g} to {of.largest:.3g}, median {of.median:.3g}")
    is_sane = 1e-6 < of.median < 1e6 and of.largest < 1e9
    page.warn(
        not is_sane,
        f"{name}: rows of length {of.least:.3g} to {of.largest:.3g}: damaged, or bytes swapped?",
    )
    page.warn(
        is_sane and not 0.9 < of.median < 1.1,
        f"{name}: rows have a length of {of.median:.3g}; they are brought to 1 on loading",
    )
    for row in of.zero[:1]:
        where = f"{name}: {of.zero.size} row(s) of zeros, the first is row {row} (from 0)"
        page.warn(True, f"{where}; they resemble nothing")


def likeness(
    page: Page, found: "Found", truth: "Truth | None", shape: "MapShape", radii: "Radii"
) -> np.ndarray | None:
    """Say how far the frontend tells places apart and, with truth, how often it is right.

    Returns:
        (T,) metres from every query to the nearest map pose, where they are known.
    """
    if found.observations is None:
        return None
    xy, reach_m = found.observations.map_xyt[:, :2], near_m(shape.spacing_m)
    seen, blind = views(found.observations, xy, shape.spacing_m), chance(xy, reach_m)
    near = f"within {reach_m:.3g} m (9 spacings)"
    if (recall := seen.own_recall) is not None:
        page.say("map with itself", f"{share(recall)} of the images look most like one {near};"
                 f" by chance {share(blind)}")  # fmt: skip
        page.warn(
            recall <= blind + BARELY,
            "the map's images hardly look like their neighbours: do the rows of its descriptors"
            " follow map/poses.csv, or is it too sparse?",
        )
        page.warn(
            blind + BARELY < recall < CLEAR,
            f"descriptors tell apart only {share(recall)} of the map's own places:"
            " expect abstentions",
        )
    nearest_m = None
    if truth is not None and len(truth.t_s) == len(found.observations.t_s):
        where = places(seen, xy, truth.xy_m, reach_m)
        nearest_m = where.nearest_m
        _best_matches(page, where)
        _distances(page, nearest_m, radii)
    _similarities(page, seen)
    return nearest_m


def _best_matches(page: Page, where: "Places") -> None:
    if np.isfinite(where.right):
        page.say(
            "best match",
            f"{share(where.right)} lie within {where.near_m:.3g} m of the true position where the"
            f" map has an image there; by chance {share(where.chance)}",
        )
        page.warn(
            where.right <= where.chance + BARELY,
            "best matches are hardly more often right than by chance: do the rows of the query's"
            " descriptors follow query/odometry.csv?",
        )


def _distances(page: Page, nearest: np.ndarray, radii: "Radii") -> None:
    page.head("true positions")
    page.say(
        "nearest map pose",
        f"{np.median(nearest):.1f} m median, {np.quantile(nearest, 0.95):.1f} m at 95 %, at most"
        f" {nearest.max():.1f} m",
    )
    out_m = radii.r_out_m
    out = float(np.mean(nearest > out_m))
    page.say("off the map", f"{share(out)} of the queries lie farther than {out_m:g} m from it")
    page.warn(
        out == 0,
        f"every query lies within {out_m:g} m of the map: nothing is map-out and AUROC is not"
        " defined; choose a smaller --r-out, or cut the map",
    )
    page.warn(
        out == 1,
        f"no query lies within {out_m:g} m of the map: are map and truth in one frame?",
    )


def _similarities(page: Page, seen: "Views") -> None:
    """Draw how alike best matches and other pairs are."""
    if not len(seen.best_similarity) or not len(seen.others):
        return
    edges, best, others = histogram(seen.best_similarity, seen.others)
    name = "random pairs" if seen.own_recall is not None else "other candidates"
    top = max(best.max(), others.max())
    page.head("similarity")
    page.say("", f"{'best match':<{BAR + 2}}{name}")
    for low, high, a, b in list(zip(edges[:-1], edges[1:], best, others, strict=True))[::-1]:
        bars = [_bar(share / top) for share in (a, b)]
        page.say(f"{low:6.3f} to {high:6.3f}", f"{bars[0]:<{BAR + 2}}{bars[1]}")
    page.warn(
        float(np.median(seen.best_similarity)) <= float(np.quantile(seen.others, 0.9))
        and seen.own_recall is not None,
        "best matches are hardly more alike than random pairs",
    )


def _bar(share: float) -> str:
    """Return a bar; any share but none shows."""
    return "#" * int(np.ceil(share * BAR))
