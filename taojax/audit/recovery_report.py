"""Judge kidnap runs and write tables, figures and one page over all of them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taojax.audit import figures, recovery_figures, tables
from taojax.audit.page import Cell, Grid, Page, grid, render
from taojax.audit.recovery_data import RECORDED, Judged, Part, Rules, load, recovery_rows
from taojax.config import Config, to_toml
from taojax.specs import write_atomically
from taojax.tables import table_text
from taojax.verdicts import plain

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


def _noticed(row: Row) -> str:
    if not row["trials"]:
        return ""
    return (
        f" It refused a frame before accepting a right pose in {100 * row['noticed']:.1f} %, in the"
        f" median at frame {_or_never(row['median_notice_frames'])}, and accepted a right pose"
        f" again at frame {_or_never(row['median_accepted_again_frames'])}."
    )


OURS = ("final", "now", "tao")
"""Methods that sentences tell of: both verdicts, and the paper's signal with joint association."""


def _trial_words(rows: Sequence[Row], simulated: str) -> list[str]:
    said = []
    for row in (row for row in rows if row["method"] in OURS):
        said.append(
            f"{row['method']}, {row['drift']} drift ({simulated}): {_one(row, 'kidnap')}."
            f"{_noticed(row)}"
        )
        others = [r for r in rows if r["drift"] == row["drift"] and r["method"] not in OURS]
        others = [r for r in others if r["trials"]]
        if others and row["method"] == OURS[-1]:
            best = max(
                others, key=lambda r: (r["recovered"], -np.nan_to_num(r["median_frames"], nan=1e9))
            )
            said.append(
                f"{row['drift']} drift, best of {len(others)} others: {_one(best, 'kidnap')}."
            )
    return said


def _offset_words(rows: Sequence[Row]) -> list[str]:
    return [
        f"{row['method']}, {row['drift']} drift (simulated), {row['offset']}: "
        f"{_one(row, 'kidnap')}."
        for row in rows
        if row["method"] in OURS
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
            f" {_or_never(row['median_frames'])} frames",
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
        recovery_figures.curves(behind, simulated=said),
        recovery_figures.example(main, behind, rules, simulated=said),
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
        pictures.append(recovery_figures.stress(stressed, rules))
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
