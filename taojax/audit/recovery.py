"""How a robot that was carried elsewhere comes back: frames and metres to the basin.

Frames count from the first frame after the jump, which is 1. A trial that ends before it has
recovered, at the next jump or at the end of the log, is a failure: it counts as infinite in every
quantile. Sealed signals are held against the truth, event by event.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from taojax.audit.calibration import accepting_level
from taojax.audit.labels import Trials, nearest_map_distance, read_trials, read_truth
from taojax.files.records import Run, read_run

Z_95 = 1.959964
"""Two-sided 95 % point of the normal distribution."""


class Track(NamedTuple):
    """What one method said of every frame, held against the truth."""

    error_m: Float[np.ndarray, " t"]
    """Distance from the pose to the truth, metres; infinite without a pose."""

    signal: Float[np.ndarray, " t"]
    """Larger = more likely off the map; NaN where the method was not run."""

    may_accept: Bool[np.ndarray, " t"]
    """The method itself does not abstain: its status is ok, or it has a pose."""

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


LEAST_FRAMES = 20
"""A jump with fewer frames up to the end of its log is no trial."""

RECORDED = "recorded"
"""In place of a drift level: the recording's own odometry."""


class Part(NamedTuple):
    """One sealed run and its truth, as the command line made them."""

    kind: str
    """trials, offset, stress or recorded."""

    name: str
    run: Path
    truth: Path


class Rules(NamedTuple):
    """What counts as a recovery."""

    basin_m: float
    """A pose within this distance of the truth is right, metres."""

    stay_frames: int
    """So many right frames in a row are a recovery."""

    r_in_m: float
    """For re-entries: in-map means at most this far from a map pose, metres."""


class Judged(NamedTuple):
    """One run held against the truth."""

    name: str
    seal: str
    notes: list[str]
    map_m: Float[np.ndarray, "m 2"]
    place_m: Float[np.ndarray, "t 2"]
    """True positions, or the places whose appearance was seen, metres."""

    pose_m: Float[np.ndarray, "t 2"]
    """Of tao; NaN without one."""

    dt_s: float
    drift: Shaped[np.ndarray, " t"]
    stretch: np.ndarray
    """`(t,)` frames between two jumps; 0 where nothing was spliced."""

    may_fit: Bool[np.ndarray, " t"]
    """Frames that thresholds may be frozen on."""

    log_frames: int
    tracks: Mapping[str, Track]
    events: list[Event]


def _tracks(run: Run, place_m: Float[np.ndarray, "t 2"]) -> dict[str, Track]:
    signals = run.signals
    away = np.hypot(signals["x_m"] - place_m[:, 0], signals["y_m"] - place_m[:, 1])
    is_answered = signals["status"] == "ok"
    found = {"tao": Track(np.where(np.isnan(away), np.inf, away), signals["tao"], is_answered)}
    if run.decisions is not None:
        found |= {name: _verdict_track(run.decisions, name, place_m) for name in ("final", "now")}
    for name, track in (run.tracks or {}).items():
        away = np.hypot(*(track.pose[:, :2].astype(float) - place_m).T)
        error = np.where(track.has_pose, away, np.inf)
        # Tables are plain CSV: a name in them holds no comma.
        found[name.replace(",", "")] = Track(error, track.signal.astype(float), track.has_pose)
    return found


def _verdict_track(
    decisions: Mapping[str, np.ndarray], name: str, place_m: Float[np.ndarray, "t 2"]
) -> Track:
    """Return a verdict as a track: accepted or not, at a level that was frozen elsewhere."""
    end = "" if name == "final" else "_now"
    x, y, verdict = f"x{end}_m", f"y{end}_m", f"verdict{end}"
    away = np.hypot(decisions[x] - place_m[:, 0], decisions[y] - place_m[:, 1])
    has = np.isfinite(away)
    is_accepted = np.asarray(decisions[verdict]) == "accept"
    return Track(np.where(has, away, np.inf), np.where(is_accepted, 0.0, 1.0), has, level=0.5)


def _events(trials: Trials) -> list[Event]:
    """Return the counted kidnaps: of test logs, not too near to the end."""
    log_end = (trials.log + 1) * trials.log_frames
    events = jumps_to_events(trials.start, trials.step_m, log_end, LEAST_FRAMES)
    return [e for e in events if trials.split[e.start // trials.log_frames] == "test"]


def load(part: Part, rules: Rules, *, seen: bool = False) -> Judged:
    """Verify a run and hold it against its truth.

    Args:
        part: where it lies.
        rules: radii and frames.
        seen: hold the poses against the places whose appearance was seen, not against the truth.

    Raises:
        InputError: broken seal, or a truth that is malformed or of another recording.
    """
    run = read_run(part.run)
    n = len(run.signals["frame"])
    path = part.truth / "seen_poses.csv" if seen else part.truth
    truth = read_truth(path, n)
    map_m = np.stack([run.map_poses["x_m"], run.map_poses["y_m"]], axis=1)
    if part.kind == "recorded":
        drift, stretch = np.full(n, RECORDED, dtype=object), np.zeros(n, int)
        events, length = reentries(truth.xy_m, map_m, rules.r_in_m, rules.stay_frames), n
        may_fit = np.full(n, True)
        for event in events:
            may_fit[event.start : event.end] = False
    else:
        trials = read_trials(part.truth, n)
        length = trials.log_frames
        drift, stretch = (np.repeat(a, length) for a in (trials.drift, trials.stretch_frames))
        may_fit = np.repeat(trials.split == "calibration", length)
        events = _events(trials)
    notes = run.manifest.get("notes", [])
    return Judged(
        name=part.name,
        seal=str(run.manifest["seal"]),
        notes=[str(note) for note in ([notes] if isinstance(notes, str) else notes)],
        map_m=map_m,
        place_m=truth.xy_m,
        pose_m=np.stack([run.signals["x_m"], run.signals["y_m"]], axis=1).astype(float),
        dt_s=float(np.median(np.diff(truth.t_s[:length]))),
        drift=drift,
        stretch=stretch,
        may_fit=may_fit,
        log_frames=length,
        tracks=_tracks(run, truth.xy_m),
        events=events,
    )


class Measured(NamedTuple):
    """One method at one drift level."""

    threshold: float
    outcomes: list[Outcome]


def measure(
    runs: Sequence[Judged], method: str, drift: str, rules: Rules, *, stretch: int | None = None
) -> Measured:
    """Freeze a method's threshold on calibration frames and measure its events.

    Args:
        runs: judged; they are taken together.
        method: key of `tracks`; a run without it is left out, and so are logs it was not run on.
        drift: level.
        rules: radii and frames.
        stretch: only logs of this stretch length.
    """
    runs = [run for run in runs if method in run.tracks]
    fitted = []
    for run in runs:
        track = run.tracks[method]
        chosen = run.may_fit & (run.drift == drift) & (track.error_m <= rules.basin_m)
        fitted.append(track.signal[chosen & np.isfinite(track.signal)])
    own = [run.tracks[method].level for run in runs]
    threshold = (
        own[0]
        if own and own[0] is not None
        else accepting_level(np.concatenate([np.zeros(0), *fitted]))
    )
    outcomes = [
        outcome(
            run.tracks[method], run.place_m, event, threshold,
            basin_m=rules.basin_m, stay_frames=rules.stay_frames,
        )
        for run in runs
        for event in run.events
        if run.drift[event.start] == drift
        and (stretch is None or run.stretch[event.start] == stretch)
        and np.isfinite(run.tracks[method].signal[event.start])
    ]  # fmt: skip
    return Measured(threshold, outcomes)


def methods(runs: Iterable[Judged]) -> list[str]:
    """Return every method of some runs, ours first."""
    return list(dict.fromkeys(name for run in runs for name in run.tracks))


def levels(runs: Iterable[Judged]) -> list[str]:
    """Return every drift level of some runs, in order."""
    return list(dict.fromkeys(level for run in runs for level in dict.fromkeys(run.drift)))


def recovery_rows(
    runs: Sequence[Judged], rules: Rules, offset: str
) -> tuple[list[dict[str, Any]], dict[tuple[str, str], Measured]]:
    """Measure every method at every level.

    Args:
        runs: judged; they are taken together.
        rules: radii and frames.
        offset: what the poses were held against.

    Returns:
        Rows of data_specs/recovery.toml, and what is behind them by (method, drift).
    """
    rows, behind = [], {}
    for method in methods(runs):
        for drift in levels(runs):
            found = measure(runs, method, drift, rules)
            if not found.outcomes and method != "tao":
                continue
            behind[method, drift] = found
            row = recovery_row(found.outcomes, runs[0].dt_s)
            rows.append(
                {"method": method, "drift": drift, **row, "threshold": found.threshold,
                 "offset": offset}
            )  # fmt: skip
    return rows, behind
