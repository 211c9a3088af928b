"""How a robot that was carried elsewhere comes back: frames and metres to the basin.

Frames count from the first frame after the jump, which is 1. A trial that ends before it has
recovered, at the next jump or at the end of the log, is a failure: it counts as infinite in every
quantile.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from taojax.audit.labels import nearest_map_distance

Z_95 = 1.959964
"""Two-sided 95 % point of the normal distribution."""


class Track(NamedTuple):
    """What one method said of every frame, held against the truth."""

    error_m: Float[np.ndarray, " t"]
    """Distance from the pose to the truth, metres; infinite without a pose."""

    signal: Float[np.ndarray, " t"]
    """Larger = more likely off the map; NaN where the method was not run."""

    may_accept: Bool[np.ndarray, " t"]
    """The method itself does not abstain: its status is ok and its pose fresh."""

    level: float | None = None
    """Threshold of the signal where the method brings its own; None = frozen on calibration
    frames."""


class Event(NamedTuple):
    """One kidnap or one re-entry."""

    start: int
    """First frame after it."""

    end: int
    """One past the last frame that belongs to it."""

    step_m: float
    """Metres driven into the first frame."""


class Outcome(NamedTuple):
    """How one event ended; infinite = not before its end."""

    frames: float
    """Until the pose is in the basin and stays."""

    metres: float
    """Driven until then."""

    wrong_frames: float
    """Accepted frames with a pose outside the basin."""

    notice_frames: float
    """Until the first frame that is not accepted, if no right pose was accepted before."""

    again_frames: float
    """Until the first accepted frame with a right pose."""


def jumps_to_events(
    start: Int[np.ndarray, " k"],
    step_m: Float[np.ndarray, " k"],
    log_end: Int[np.ndarray, " k"],
    least_frames: int,
) -> list[Event]:
    """Turn jumps into events that end at the next jump or with their log.

    Args:
        start: first frames after the jumps, growing.
        step_m: metres driven into them.
        log_end: one past the last frame of each jump's log.
        least_frames: a jump with fewer frames up to the end of its log is no event.
    """
    after = np.append(start[1:], np.iinfo(int).max)
    return [
        Event(int(a), int(min(b, end)), float(step))
        for a, b, end, step in zip(start, after, log_end, step_m, strict=True)
        if end - a >= least_frames
    ]


def reentries(
    query_m: Float[np.ndarray, "t 2"],
    map_m: Float[np.ndarray, "m 2"],
    r_in_m: float,
    least_frames: int,
) -> list[Event]:
    """Find where a robot that wandered off the map comes back to it by itself.

    Args:
        query_m: true positions, metres.
        map_m: positions of the map images, metres.
        r_in_m: in-map means at most this far from one of them.
        least_frames: shorter visits are no events.
    """
    inside = nearest_map_distance(query_m, map_m) <= r_in_m
    edge = np.diff(np.concatenate([inside[:1], inside, [False]]).astype(int))
    starts, ends = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)
    ends = ends[1:] if inside[0] else ends
    step = np.hypot(*np.diff(query_m, axis=0).T)
    return [
        Event(int(a), int(b), float(step[a - 1]))
        for a, b in zip(starts, ends, strict=True)
        if b - a >= least_frames
    ]


def _first(flags: Bool[np.ndarray, " n"]) -> float:
    """Return the number, from 1, of the first true flag."""
    return float(np.argmax(flags)) + 1.0 if flags.any() else np.inf


def frames_to_recovery(right: Bool[np.ndarray, " n"], stay_frames: int) -> float:
    """Return the number, from 1, of the first frame from which `stay_frames` in a row are right."""
    if len(right) < stay_frames:
        return np.inf
    windows = np.lib.stride_tricks.sliding_window_view(right, stay_frames)
    return _first(np.asarray(windows.all(axis=1)))


def outcome(
    track: Track,
    query_m: Float[np.ndarray, "t 2"],
    event: Event,
    threshold: float,
    *,
    basin_m: float,
    stay_frames: int,
) -> Outcome:
    """Measure one event.

    Args:
        track: of one method.
        query_m: true positions, metres.
        event: what happened, and until when it counts.
        threshold: accepted means signal <= threshold where the method may accept.
        basin_m: a pose within this distance of the truth is right.
        stay_frames: so many right frames in a row are a recovery.
    """
    cut = slice(event.start, event.end)
    right = track.error_m[cut] <= basin_m
    accepted = track.may_accept[cut] & (track.signal[cut] <= threshold)
    frames = frames_to_recovery(right, stay_frames)
    metres = np.inf
    if np.isfinite(frames):
        path = query_m[event.start : event.start + int(frames)]
        metres = event.step_m + float(np.hypot(*np.diff(path, axis=0).T).sum())
    again, refused = _first(accepted & right), _first(~accepted)
    return Outcome(
        frames=frames,
        metres=metres,
        wrong_frames=float((accepted & ~right).sum()) if np.isfinite(threshold) else np.nan,
        notice_frames=refused if refused < again else np.inf,
        again_frames=again,
    )


def quantile(values: Float[np.ndarray, " n"], share: float) -> float:
    """Return an observed value with at least `share` of all at or below it; NaN if infinite."""
    if not len(values):
        return float("nan")
    found = float(np.quantile(values, share, method="inverted_cdf"))
    return found if np.isfinite(found) else float("nan")


def wilson(count: int, n: int) -> tuple[float, float]:
    """Return the 95 % Wilson interval of a share; NaN without trials.

    Source:
        Wilson, "Probable inference, the law of succession, and statistical inference", JASA 1927.
    """
    if not n:
        return float("nan"), float("nan")
    share, z2 = count / n, Z_95**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = Z_95 / (1 + z2 / n) * np.sqrt(share * (1 - share) / n + z2 / (4 * n**2))
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def recovered_within(frames: Float[np.ndarray, " n"], most_frames: int) -> Float[np.ndarray, "f 3"]:
    """Return the share recovered within 1..most_frames with its 95 % interval.

    Args:
        frames: frames to recovery, infinite for failures.
        most_frames: length of the curve.

    Returns:
        `(f, 3)` share, lower and upper end; NaN without trials.
    """
    n, rows = len(frames), []
    for limit in range(1, most_frames + 1):
        count = int((frames <= limit).sum())
        rows.append((count / n if n else np.nan, *wilson(count, n)))
    return np.array(rows)


def recovery_row(outcomes: Sequence[Outcome], dt_s: float) -> dict[str, Any]:
    """Summarise events in the columns of data_specs/recovery.toml.

    Args:
        outcomes: one per event.
        dt_s: time between frames, seconds.
    """
    table = np.array(outcomes, float).reshape(-1, len(Outcome._fields))
    frames, metres, wrong, notice, again = table.T
    n, good = len(table), int(np.isfinite(frames).sum())
    noticed = notice[np.isfinite(notice)]
    low, high = wilson(good, n)
    wrong_frames = float(wrong.mean()) if n else np.nan
    return {
        "trials": n,
        "recovered": good / n if n else np.nan,
        "median_frames": quantile(frames, 0.5),
        "p95_frames": quantile(frames, 0.95),
        "median_m": quantile(metres, 0.5),
        "p95_m": quantile(metres, 0.95),
        "wrong_accepted_frames": wrong_frames,
        "wrong_accepted_s": wrong_frames * dt_s,
        "noticed": len(noticed) / n if n else np.nan,
        "median_notice_frames": quantile(noticed, 0.5),
        "median_accepted_again_frames": quantile(again, 0.5),
        "recovered_lo": low,
        "recovered_hi": high,
    }
