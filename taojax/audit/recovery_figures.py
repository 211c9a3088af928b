"""Draw kidnap trials: recovery curves, an example on the map, a stress grid."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from taojax.audit import recovery_plots as plots
from taojax.audit.figures import Picture, csv_text, picture
from taojax.audit.recovery import quantile, recovered_within
from taojax.audit.recovery_data import Judged, Measured, Rules, levels, measure

MOST_FRAMES = 30
"""Length of the recovery curves: the shortest stretch."""

OURS = ("tao", "final", "now", "tao_rank")


def curves(behind: Mapping[tuple[str, str], Measured], *, simulated: str) -> Picture:
    """Draw the share recovered over the frames after the jump, one panel per drift level."""
    drifts = list(dict.fromkeys(drift for _, drift in behind))
    figure = Figure(figsize=(3.6 * len(drifts) + 2.6, 4.0), layout="constrained")
    axes = figure.subplots(1, len(drifts), sharey=True, squeeze=False)[0]
    parts = []
    for ax, level in zip(axes, drifts, strict=True):
        lines = {}
        for (method, drift), found in behind.items():
            if drift == level and found.outcomes:
                frames = np.array([one.frames for one in found.outcomes])
                lines[method] = recovered_within(frames, MOST_FRAMES)
                parts.append((method, drift, len(frames), lines[method]))
        plots.recovery_curves(lines, strong=OURS, ax=ax)
        ax.set_title(f"{level} drift", fontsize=10)
    axes[0].set_ylabel("share of kidnaps recovered")
    lines, names = axes[0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside right center", frameon=False, fontsize=8)
    least = min(n for _, _, n, _ in parts)
    columns = {
        "method": np.concatenate([[m] * MOST_FRAMES for m, *_ in parts]),
        "drift": np.concatenate([[d] * MOST_FRAMES for _, d, *_ in parts]),
        "trials": np.concatenate([[n] * MOST_FRAMES for _, _, n, _ in parts]),
        "frames": np.tile(np.arange(1, MOST_FRAMES + 1), len(parts)),
    }
    table = np.concatenate([curve for *_, curve in parts])
    columns |= {f"recovered{end}": table[:, i] for i, end in enumerate(("", "_lo", "_hi"))}
    caption = (
        f"{simulated} Bands: pointwise 95 % Wilson intervals, for legibility of our two alone; "
        f"those of the rivals, which ran on fewer trials ({least} or more), are in the CSV. A "
        "trial that ends before it recovers stays a failure."
    )
    return picture(figure, "recovery", "Recovery after a kidnap", caption, csv_text(columns))


def example(runs: Sequence[Judged], behind: Mapping, rules: Rules, *, simulated: str) -> Picture:
    """Draw the first counted log of the middle drift level, whatever it shows."""
    drifts = levels(runs)
    level = drifts[len(drifts) // 2]
    run = next(run for run in runs if any(run.drift[e.start] == level for e in run.events))
    first = next(e for e in run.events if run.drift[e.start] == level)
    # Events of one log follow one another without a gap.
    events = [first]
    for event in run.events:
        if event.start == events[-1].end:
            events.append(event)
    low, high = first.start - first.start % run.log_frames, events[-1].end
    track, cut = run.tracks["tao"], slice(low, high)
    right = track.error_m[cut] <= rules.basin_m
    threshold = behind["tao", level].threshold
    accepted = track.may_accept[cut] & (track.signal[cut] <= threshold)
    state = np.where(
        accepted, np.where(right, "accepted_right", "accepted_wrong"),
        np.where(right, "refused_right", "refused_wrong"),
    )  # fmt: skip
    jumps = np.array([event.start - low for event in events])
    figure = Figure(figsize=(7.4, 6.6), layout="constrained")
    plots.kidnap_example(
        run.map_m, run.place_m[cut], run.pose_m[cut], state, jumps, ax=figure.subplots()
    )
    columns = {
        "frame": np.arange(low, high),
        "true_x_m": run.place_m[cut, 0],
        "true_y_m": run.place_m[cut, 1],
        "x_m": run.pose_m[cut, 0],
        "y_m": run.pose_m[cut, 1],
        "error_m": np.where(np.isinf(track.error_m[cut]), np.nan, track.error_m[cut]),
        "state": state,
    }
    caption = (
        f"{simulated} First counted log at {level} drift, {high - low} frames, best poses of tao; "
        f"right means within {rules.basin_m:g} m of the truth. Numbers give the order of the "
        "stretches; a thin line ties a wrong accepted pose to the truth."
    )
    return picture(figure, "example", "One kidnapped log on the map", caption, csv_text(columns))


def stress(runs: Sequence[Judged], rules: Rules) -> Picture:
    """Draw the share recovered over kidnap rate, drift and aliasing, one panel per aliasing."""
    drifts = levels(runs)
    stretches = sorted({int(s) for run in runs for s in np.unique(run.stretch)})
    figure = Figure(figsize=(3.5 * len(runs) + 0.6, 3.3), layout="constrained")
    axes = figure.subplots(1, len(runs), sharey=True, squeeze=False)[0]
    rows: list[tuple] = []
    for ax, run in zip(axes, runs, strict=True):
        share = np.full((len(drifts), len(stretches)), np.nan)
        note = np.full(share.shape, "", dtype=object)
        for at in np.ndindex(*share.shape):
            drift, stretch = drifts[at[0]], stretches[at[1]]
            found = measure([run], "tao", drift, rules, stretch=stretch).outcomes
            frames = np.array([one.frames for one in found])
            median = quantile(frames, 0.5)
            if len(frames):
                share[at] = np.isfinite(frames).mean()
                note[at] = "never" if np.isnan(median) else f"{median:.0f} frames"
            rows.append((run.name, drift, stretch, len(frames), share[at], median))
        labels = tuple(f"every {s}" for s in stretches)
        plots.share_grid(share, note, rows=tuple(drifts), columns=labels, ax=ax)
        ax.set_title(run.name.replace("alias-", "aliasing "), fontsize=10)
        ax.set_xlabel("a kidnap, frames")
    axes[0].set_ylabel("odometry drift")
    names = ("aliasing", "drift", "stretch_frames", "trials", "recovered", "median_frames")
    columns = {
        name: np.array(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)
    }
    least = min(row[3] for row in rows)
    caption = (
        "Simulated. Share of kidnaps that tao recovered from, median frames below it; aliasing is "
        "the share of appearance that a place has in common with its class. At least "
        f"{least} kidnaps a cell. The more often the robot is carried away, the fewer frames it "
        "has to recover before the next time."
    )
    return picture(
        figure, "stress", "Stress: kidnap rate, drift, aliasing", caption, csv_text(columns)
    )
