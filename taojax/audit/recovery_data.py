"""Kidnap runs in memory: sealed signals held against the truth, event by event."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from taojax.audit.calibration import accepting_level
from taojax.audit.recovery import (
    Event,
    Outcome,
    Track,
    jumps_to_events,
    outcome,
    recovery_row,
    reentries,
)
from taojax.audit.truth import Trials, read_trials, read_truth
from taojax.records import Run, read_run

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
