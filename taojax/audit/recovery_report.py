"""Judge kidnap runs and write tables, figures and one page over all of them."""

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taojax.audit import figures, tables
from taojax.audit.figures import Picture, csv_text, picture
from taojax.audit.html import Cell, Grid, Page, grid, render
from taojax.audit.recovery import (
    RECORDED,
    Judged,
    Measured,
    Part,
    Rules,
    levels,
    load,
    measure,
    quantile,
    recovered_within,
    recovery_rows,
)
from taojax.config import Config, to_toml
from taojax.decisions import plain
from taojax.files.specs import write_atomically
from taojax.files.tables import table_text
from taojax.plots import CYCLE, IN_MAP, INK, MAP_OUT, PALE, STYLES, Mark

BELIEFS = {
    "refused_wrong": Mark("wrong pose, not accepted", "#CC79A7", "s", 12),
    "refused_right": Mark("right pose, not accepted", "#56B4E9", "^", 14),
    "accepted_right": Mark("right pose, accepted", IN_MAP, "o", 12),
    "accepted_wrong": Mark("wrong pose, accepted", MAP_OUT, "X", 34),
}
"""What the best pose of a frame was worth -> how it is drawn; the dangerous one last, on top."""


def recovery_curves(
    curves: Mapping[str, Float[np.ndarray, "f 3"]], *, strong: tuple[str, ...], ax: Axes
) -> Axes:
    """Draw the share of trials recovered over the frames after the jump.

    Args:
        curves: method -> (share, lower, upper) after 1, 2, ... frames.
        strong: methods drawn with a thick line and a band for the interval; a dozen bands would
            hide one another.
        ax: where to draw.
    """
    for number, (name, curve) in enumerate(curves.items()):
        frame, is_strong = np.arange(1, len(curve) + 1), name in strong
        colour, style = CYCLE[number % len(CYCLE)], STYLES[(number + number // 7) % len(STYLES)]
        top = 3 if is_strong else 2
        if is_strong:
            low, high = curve[:, 1:].T
            ax.fill_between(frame, low, high, color=colour, alpha=0.2, linewidth=0, zorder=1)
        ax.plot(
            frame, curve[:, 0], color=colour, linestyle=style, label=name, zorder=top,
            linewidth=2.2 if is_strong else 1.1, markersize=3.5, markevery=(number % 4, 4),
            marker="os^"[number // len(CYCLE) - 1] if number >= len(CYCLE) else None,
        )  # fmt: skip
    ax.set(xlabel="frames after the jump", ylim=(-0.02, 1.02))
    ax.set_xlim(1, max((len(curve) for curve in curves.values()), default=2))
    ax.grid(alpha=0.25)
    return ax


def kidnap_example(
    map_m: Float[np.ndarray, "m 2"],
    query_m: Float[np.ndarray, "t 2"],
    pose_m: Float[np.ndarray, "t 2"],
    state: Shaped[np.ndarray, " t"],
    jumps: Int[np.ndarray, " k"],
    *,
    ax: Axes,
) -> Axes:
    """Draw one kidnap log: where the robot was, where it believed to be, where it was carried.

    Args:
        map_m: map positions, metres.
        query_m: true positions, metres.
        pose_m: best poses, metres; NaN without one.
        state: keys of `BELIEFS` per frame.
        jumps: first frames after the jumps.
        ax: where to draw.
    """
    ax.scatter(*map_m.T, s=2, color="#cccccc", linewidths=0, label="map", zorder=1)
    edges = [0, *jumps.tolist(), len(query_m)]
    for number, (a, b) in enumerate(pairwise(edges)):
        label = "true path" if number == 0 else None
        ax.plot(*query_m[a:b].T, color=INK, linewidth=1.0, zorder=2, label=label)
        ax.annotate(
            f"{number + 1}", tuple(query_m[a]), xytext=(7, 7), textcoords="offset points",
            fontsize=9, weight="bold", color=INK, zorder=9,
        )  # fmt: skip
    for number, jump in enumerate(jumps):
        label = "carried to" if number == 0 else None
        ax.annotate(
            "", tuple(query_m[jump]), tuple(query_m[jump - 1]), zorder=3,
            arrowprops={"arrowstyle": "->", "color": PALE, "linestyle": ":"},
        )  # fmt: skip
        ax.plot([], [], color=PALE, linestyle=":", label=label)
    wrong = state == "accepted_wrong"
    for truth, pose in zip(query_m[wrong], pose_m[wrong], strict=True):
        ax.plot(*np.stack([truth, pose], axis=1), color=MAP_OUT, linewidth=0.5, alpha=0.5)
    for order, (name, mark) in enumerate(BELIEFS.items()):
        here = pose_m[state == name]
        if len(here):
            ax.scatter(
                *here.T, s=mark.size, color=mark.colour, marker=mark.marker, linewidths=0.7,
                label=f"{mark.label} ({len(here)})", zorder=4 + order,
            )  # fmt: skip
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set_adjustable("datalim")
    ax.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncol=3)
    return ax


def share_grid(
    share: Float[np.ndarray, "r c"],
    note: Shaped[np.ndarray, "r c"],
    *,
    rows: tuple[str, ...],
    columns: tuple[str, ...],
    ax: Axes,
) -> Axes:
    """Draw shares as a heat map with what they say written in.

    Args:
        share: in [0, 1]; NaN = not measured.
        note: second line of each cell.
        rows: labels from top to bottom.
        columns: labels from left to right.
        ax: where to draw.
    """
    ax.imshow(share, vmin=0.0, vmax=1.0, cmap="cividis", aspect="auto")
    for row, column in np.ndindex(*share.shape):
        value = share[row, column]
        text = "—" if np.isnan(value) else f"{100 * value:.0f} %\n{note[row, column]}"
        colour = "white" if value < 0.6 else INK
        ax.text(column, row, text, ha="center", va="center", fontsize=8, color=colour)
    ax.set_xticks(range(len(columns)), list(columns))
    ax.set_yticks(range(len(rows)), list(rows))
    return ax


MOST_FRAMES = 30
"""Length of the recovery curves: the shortest stretch."""

STRONG = ("tao", "final", "now", "tao_rank")


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
        recovery_curves(lines, strong=STRONG, ax=ax)
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
    kidnap_example(run.map_m, run.place_m[cut], run.pose_m[cut], state, jumps, ax=figure.subplots())
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
        share_grid(share, note, rows=tuple(drifts), columns=labels, ax=ax)
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


Row = dict[str, Any]

_SHOWN = (
    "method", "drift", "trials", "recovered", "median_frames", "p95_frames", "median_m", "p95_m",
    "wrong_accepted_frames", "noticed", "median_notice_frames", "median_accepted_again_frames",
)  # fmt: skip

_NOTE = (
    "Small print below `recovered` is its 95 % Wilson interval; a dash where failures reach the"
    " quantile."
)


def _or_never(value: float, unit: str = "") -> str:
    return "never" if np.isnan(value) else f"{plain(value)}{unit}"


def _way(frames: float, metres: float) -> str:
    if np.isnan(frames):
        return "never"
    return f"{frames:.0f} frame{'s' if frames > 1 else ''} and {_or_never(metres, ' m')}"


def _one(row: Row, event: str) -> str:
    """Say one row in a sentence."""
    if not row["trials"]:
        return f"no {event}"
    n, good = int(row["trials"]), round(row["recovered"] * row["trials"])
    ends = f"{100 * row['recovered_lo']:.1f} to {100 * row['recovered_hi']:.1f}"
    said = (
        f"{row['method']} came back within the basin in {good} of {n} {event}s"
        f" ({100 * row['recovered']:.1f} %, 95 % interval {ends} %); median"
        f" {_way(row['median_frames'], row['median_m'])}, 95 % quantile"
        f" {_way(row['p95_frames'], row['p95_m'])}"
    )
    if np.isnan(row["wrong_accepted_frames"]):
        return said
    return (
        f"{said}; {plain(row['wrong_accepted_frames'])} wrong accepted frames"
        f" ({plain(row['wrong_accepted_s'])} s) per {event}"
    )


OURS = ("final", "now", "tao")
"""Methods that sentences tell of: both verdicts, and the off-map signal."""


def _each(values: Sequence[str]) -> str:
    """Join what was found at each drift level, in the order of the levels."""
    return " / ".join(values)


def _levels(rows: Sequence[Row]) -> str:
    """Say what one method reached at every drift level, in a sentence without its subject."""
    trials = sorted({int(row["trials"]) for row in rows})
    back = _each([f"{100 * row['recovered']:.1f}" for row in rows])
    frames = _each([_or_never(row["median_frames"]) for row in rows])
    wrong = [row["wrong_accepted_frames"] for row in rows]
    said = (
        f"back within the basin in {back} % of {' or '.join(map(str, trials))} kidnaps, in the"
        f" median at frame {frames}"
    )
    if np.isnan(wrong).any():
        return said
    mean = _each([f"{value:.2f}" for value in wrong])
    again = _each([_or_never(row["median_accepted_again_frames"]) for row in rows])
    return (
        f"{said}; {mean} wrong accepted frames a kidnap; in the median a right pose"
        f" is accepted again at frame {again}"
    )


def _by_method(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    tried = [row for row in rows if row["trials"]]
    return [
        (name, found) for name in OURS if (found := [row for row in tried if row["method"] == name])
    ]


def _trial_words(rows: Sequence[Row], simulated: str) -> list[str]:
    drifts = list(dict.fromkeys(row["drift"] for row in rows if row["trials"]))
    if not drifts:
        return []
    said = [f"Trials with {simulated}; drift {_each(drifts)}."]
    said += [f"{name}: {_levels(found)}." for name, found in _by_method(rows)]
    for drift in drifts:
        others = [
            r for r in rows if r["drift"] == drift and r["method"] not in OURS and r["trials"]
        ]
        if others:
            key = lambda r: (r["recovered"], -np.nan_to_num(r["median_frames"], nan=1e9))
            said.append(
                f"{drift} drift, best of {len(others)} others: "
                f"{_one(max(others, key=key), 'kidnap')}."
            )
    return said


def _offset_words(rows: Sequence[Row]) -> list[str]:
    return [
        f"{name}, {offset} (simulated): {_levels(found)}."
        for offset in dict.fromkeys(row["offset"] for row in rows)
        for name, found in _by_method([row for row in rows if row["offset"] == offset])
        if name in ("final", "now")
    ]


def _reentry_words(rows: Sequence[Row]) -> list[str]:
    said = [
        f"{row['method']}: " + _one(row, "re-entry").replace("re-entrys", "re-entries")
        for row in rows
        if row["method"] in OURS
    ]
    return [f"Coming back to the map by itself (own odometry): {words}." for words in said]


def _grid(name: str, table: tables.Table, title: str, note: str) -> Grid:
    found = grid("recovery", table, title=title, note=note, columns=_SHOWN)
    return found._replace(source=f"{name}.csv")


def _table_files(name: str, table: tables.Table) -> dict[str, str]:
    """Return a recovery table at the top of the run and, as CSV, Markdown and LaTeX, in tables/."""
    files = {f"{name}.csv": table_text("recovery", table)}
    for path, text in tables.as_files("recovery", table).items():
        files[path.replace("/recovery.", f"/{name}.")] = text
    return files


def _cards(rows: Sequence[Row]) -> list[Cell]:
    return [
        Cell(
            f"{100 * row['recovered']:.1f} %",
            f"of {row['trials']} kidnaps recovered at {row['drift']} drift (final), median"
            f" {_way(row['median_frames'], row['median_m'])}",
            "recovery.csv",
        )
        for row in rows
        if row["method"] == OURS[0] and row["trials"]
    ]


def _loaded(parts: Sequence[Part], kind: str, rules: Rules, *, seen: bool = False) -> list[Judged]:
    return [load(part, rules, seen=seen) for part in parts if part.kind == kind]


def write_recovery(
    out: Path,
    parts: Sequence[Part],
    config: Config,
    *,
    basin_m: float,
    offset: str,
    command: str,
) -> tuple[str, ...]:
    """Judge sealed kidnap runs and write what was found on top of their folders.

    Args:
        out: the folder that holds them.
        parts: the runs; at least one of kind `trials`.
        config: window, radii and seed.
        basin_m: a pose within this distance of the truth is right, metres.
        offset: of the main trials: how far the sessions lie apart.
        command: what the user ran.

    Returns:
        What was found, in plain sentences.

    Raises:
        InputError: broken seal, foreign truth, folder that cannot be written.
    """
    rules = Rules(basin_m, config.stream.window // 2, config.audit.r_in_m)
    main = _loaded(parts, "trials", rules)
    simulated = "views and odometry simulated"
    if not any("simulated KAIST" in note for run in main for note in run.notes):
        simulated = "real views, simulated odometry"
    rows, behind = recovery_rows(main, rules, offset)
    words = _trial_words(rows, simulated)
    said = f"{simulated[0].upper()}{simulated[1:]}."
    pictures = [
        curves(behind, simulated=said),
        example(main, behind, rules, simulated=said),
    ]
    table = tables.from_rows("recovery", rows)
    title = f"Back within {basin_m:g} m after a kidnap ({offset})"
    grids, files = [_grid("recovery", table, title, _NOTE)], dict(_table_files("recovery", table))
    runs = list(main)

    if full := _loaded(parts, "offset", rules):
        rows_full = [
            *recovery_rows(full, rules, "full offset against the truth")[0],
            *recovery_rows(_loaded(parts, "offset", rules, seen=True), rules,
                           "full offset against the place seen")[0],
        ]  # fmt: skip
        words += _offset_words(rows_full)
        table = tables.from_rows("recovery", rows_full)
        files |= _table_files("recovery_offset", table)
        found = grid("recovery", table, title="With the full offset between the sessions",
                     note=_NOTE, columns=("method", "offset", *_SHOWN[1:]))  # fmt: skip
        grids.append(found._replace(source="recovery_offset.csv"))
        runs += full
    if recorded := _loaded(parts, RECORDED, rules):
        rows_back, _ = recovery_rows(recorded, rules, "recorded")
        words += _reentry_words(rows_back)
        table = tables.from_rows("recovery", rows_back)
        files |= _table_files("reentry", table)
        note = f"{_NOTE} Thresholds are frozen on the first half; all re-entries are counted."
        grids.append(_grid("reentry", table, "Re-entry: back on the map by itself", note))
        runs += recorded
    if stressed := _loaded(parts, "stress", rules):
        pictures.append(stress(stressed, rules))
        runs += stressed

    notes = list(dict.fromkeys(note for run in runs for note in run.notes))
    seals = {run.name: run.seal for run in runs}
    manifest = {"schema": 1, "command": command, "notes": notes, "basin_m": basin_m, "runs": seals}
    page = Page(
        title="Carried elsewhere: how fast does it find back?",
        subtitle=(
            f"Recovered: the best pose comes within {basin_m:g} m of the truth and stays for"
            f" {rules.stay_frames} frames. Every run was scored and sealed before it was judged."
        ),
        # How each folder was spliced is in its manifest; the page needs to know it once.
        notes=[note for note in notes if not note.startswith("spliced")],
        headline=words,
        cards=_cards(rows),
        grids=grids,
        pictures=pictures,
        facts={f"seal of {name}": seal for name, seal in seals.items()} | {"command": command},
        command=command,
    )
    everything: dict[str, str | bytes] = {
        **files,
        "report.html": render(page),
        "manifest.json": json.dumps(manifest, indent=2) + "\n",
        "config.toml": to_toml(config),
    }
    for drawn in pictures:
        everything |= figures.as_files(drawn)
    for name, content in everything.items():
        write_atomically(out / name, content)
    return tuple(words)
