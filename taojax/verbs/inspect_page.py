"""What `taojax inspect` says of files, clocks and drives."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from taojax.runtime.inspection import clock, map_shape, matched_share, step_m, steps
from taojax.runtime.radii import SITES, Radii
from taojax.verbs.inspect_truth import drift_m, scale_of

if TYPE_CHECKING:
    from taojax.audit.truth import Truth
    from taojax.runtime.checkup import Found
    from taojax.runtime.inspection import Clock, MapShape

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
        page.say("truth/query_poses.csv", "none: can be scored, not audited")
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
