"""`python -m benchmarks quality`: who tells map-out best, on which data, with losses shown."""

import csv
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.entrants import FITTED, GATES, ORACLES, Entry, Field, compete
from benchmarks.pictures import save
from benchmarks.sets import DataSet, Recipe, recipes
from taojax.audit import calibration, metrics, risk, tables
from taojax.audit.labels import CalibrationSplit
from taojax.config import AuditConfig, Config

NAN = float("nan")
NONE = "n/a"
COLOURS = {"ours": "#1f5fa8", "rival": "#707070", "oracle": "#e08a1e"}
MOST_DOTS = 3
"""Columns of a panel row in the figure."""

Row = dict[str, Any]


class _Judged(NamedTuple):
    """One entrant on one set: its row, and its AUROC on every resample of the test half."""

    row: Row
    drawn: np.ndarray


def _separation(
    signal: np.ndarray, is_out: np.ndarray, weights: np.ndarray, suffix: str
) -> tuple[Row, np.ndarray]:
    """Return AUROC and FAR@95 with intervals, and the AUROC of every resample."""
    if np.isnan(signal).any() or is_out.all() or not is_out.any():
        return {}, np.full(len(weights), NAN)
    drawn = metrics.weighted_separation(signal, is_out, weights)
    row: Row = {}
    points = metrics.auroc(signal, is_out), metrics.far_at_95(signal, is_out)
    for name, point, samples in zip(
        ("auroc", "far_at_95"), points, (drawn.auroc, drawn.far_at_95), strict=True
    ):
        low, high = metrics.interval(samples)
        row |= {f"{name}{suffix}": point}
        row |= {f"{name}{suffix}_lo": low, f"{name}{suffix}_hi": high}
    return row, drawn.auroc


def _thresholds(part: CalibrationSplit, name: str, sigmas: float) -> dict[str, float]:
    """Freeze the same two rules for everybody: mean + sigmas, and 95 % of in-map accepted."""
    inside = np.sort(part.signals[name][part.is_in])
    if not inside.size or np.isnan(inside).any():
        return {}
    level = float(inside[-(-19 * len(inside) // 20) - 1])
    return {"": calibration.sigma_threshold(part, name, sigmas), "_95": level}


def _judge(
    data: DataSet, entry: Entry, known: Field, audit: AuditConfig, draws: Sequence[np.ndarray]
) -> _Judged:
    """Measure one entrant: all frames, test half, frozen threshold, place, time."""
    is_known = known.label != "grey"
    splits = known.split({entry.name: entry.signal})
    test = splits.test
    known_test = test.is_in | test.is_out
    row: Row = {"set": data.name, "column": data.column, "data": data.kind}
    row |= {"entrant": entry.name, "kind": entry.kind, "is_fitted": entry.name in FITTED}
    row |= {"n_in": int((known.label == "in_map").sum())}
    row |= {"n_out": int((known.label == "map_out").sum())}
    row |= {"n_in_test": int(test.is_in.sum()), "n_out_test": int(test.is_out.sum())}
    whole, held = draws
    row |= _separation(
        entry.signal[is_known], (known.label == "map_out")[is_known], whole[:, is_known], ""
    )[0]
    part, drawn = _separation(
        test.signals[entry.name][known_test], test.is_out[known_test], held[:, known_test], "_test"
    )
    row |= part
    for rule, threshold in _thresholds(splits.calibration, entry.name, audit.sigmas).items():
        point = tables.operating_row(test, entry.name, threshold, held)
        row |= {f"{name}{rule}": value for name, value in point.items()}
    if entry.place_m is not None:
        gap = np.hypot(*(entry.place_m - data.truth_m).T)[known.label == "in_map"]
        row["located"] = float(np.mean(gap <= 2 * data.r_in_m)) if gap.size else NAN
    # Each is judged on the answer that it gives; signals without one on the frontend's.
    place = entry.place_m
    if place is None:
        top = data.index[:, 0]
        place = np.where(top[:, None] >= 0, data.map_poses[np.maximum(top, 0), :2], np.nan)
    error = np.hypot(*(place - data.truth_m).T)
    own = risk.own_answers(error, known.nearest_m, audit.wrong_m, audit.r_out_m)
    held_out = risk.Own(own.is_right[test.frame], own.is_wrong[test.frame])
    row |= risk.risk_row(test.signals[entry.name], held_out)
    # Of all frames on the map, so that a system which finds fewer places is not favoured.
    findable = float(np.sum(known.nearest_m[test.frame] <= audit.r_out_m))
    for name in ("recall_at_p95", "recall_at_p99"):
        if name in row and findable:
            row[name] *= float(held_out.is_right.sum()) / findable
    row["us_per_frame"] = entry.us_per_frame
    return _Judged(row, drawn)


def leaderboard(
    data: DataSet, config: Config, *, quick: bool = False, names: Collection[str] | None = None
) -> list[Row]:
    """Measure every entrant on one set.

    Args:
        data: the set.
        config: settings; radii are the set's own.
        quick: leave out the slow systems.
        names: only these entrants.

    Returns:
        One row per entrant. `rival` names the rival with the best test-half AUROC, and
        `auroc_minus_rival` the paired difference to it on the same resamples.
    """
    audit = replace(config.audit, r_in_m=data.r_in_m, r_out_m=data.r_out_m)
    config = Config(stream=config.stream, audit=audit, seed=config.seed)
    known, entries = compete(data, config, quick=quick, names=names)
    n_test = len(known.split({}).test.frame)
    draws = [
        metrics.block_weights(n, audit.block_frames, audit.n_bootstrap, config.seed)
        for n in (len(known.label), n_test)
    ]
    judged = [_judge(data, entry, known, audit, draws) for entry in entries]
    rivals = [j for j in judged if j.row["kind"] == "rival" and "auroc_test" in j.row]
    if rivals:
        best = max(rivals, key=lambda j: j.row["auroc_test"])
        for one in judged:
            if "auroc_test" not in one.row:
                continue
            low, high = metrics.interval(one.drawn - best.drawn)
            one.row["rival"] = best.row["entrant"]
            one.row["auroc_minus_rival"] = one.row["auroc_test"] - best.row["auroc_test"]
            one.row.update(auroc_minus_rival_lo=low, auroc_minus_rival_hi=high)
    return [one.row for one in judged]


def _mean(rows: Sequence[Row], column: str, entrant: str, value: str) -> float:
    """Average over the sets of a column; NaN unless the entrant has a value on each."""
    mine = [r for r in rows if r["column"] == column and r["entrant"] == entrant]
    return float(np.mean([r.get(value, NAN) for r in mine])) if mine else NAN


def _number(value: float, places: int = 3) -> str:
    text = f"{value:.{places}f}"
    return NONE if np.isnan(value) else text.removeprefix("0") if places else text


def _pair(rows: Sequence[Row], column: str, entrant: str, values: tuple[str, str]) -> str:
    first, second = (_mean(rows, column, entrant, value) for value in values)
    return NONE if np.isnan(first) else f"{_number(first)} / {_number(second, 2)}"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    every = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in every) + "\n"


def _in_order(rows: Sequence[Row], key: str) -> list[str]:
    return list(dict.fromkeys(str(row[key]) for row in rows))


def _title(name: str, kind: str, *, is_marked: bool) -> str:
    shown = {"ours": f"**{name}**", "oracle": f"*{name}*"}.get(kind, name)
    return shown + (" †" if is_marked and name in FITTED else "")


def _differences(rows: Sequence[Row]) -> str:
    """Return the sets one by one: our two main signals against the best rival of each."""
    ours = [name for name in _in_order(rows, "entrant") if name in ("tao", "verdict, final")]
    lines = []
    for name in _in_order(rows, "set"):
        mine = {r["entrant"]: r for r in rows if r["set"] == name}
        some = next(iter(mine.values()))
        rival = next((str(r["rival"]) for r in mine.values() if "rival" in r), "")
        line = [name, f"{some['n_out']} / {some['n_in']}"]
        line.append(f"{rival} {_number(mine[rival]['auroc_test'])}" if rival else NONE)
        for entrant in ours:
            row = mine[entrant]
            gap = [row.get(f"auroc_minus_rival{end}", NAN) for end in ("", "_lo", "_hi")]
            text = "{:+.3f} [{:+.3f}, {:+.3f}]".format(*gap)
            line.append(NONE if np.isnan(gap[0]) else text + (" loss" if gap[2] < 0 else ""))
        lines.append(line)
    return _table(["set", "map-out / in-map", "best rival, AUROC", *ours], lines)


def to_markdown(rows: Sequence[Row]) -> str:
    """Return the leaderboard as text: test half, all frames, frozen thresholds, differences."""
    columns = _in_order(rows, "column")
    kinds = {str(row["entrant"]): str(row["kind"]) for row in rows}
    parts = ["# Leaderboard: who tells that the map has no answer\n"]
    said = {str(row["column"]): str(row["data"]) for row in rows}
    parts.append("; ".join(f"{name}: {kind}" for name, kind in said.items()) + ".\n")
    parts.append(
        "**Bold**: ours. *Italic*: oracles that know the truth, no competitors. Sets of one column "
        "are averaged. Published defaults for rivals, one set of defaults for us.\n"
    )
    pairs = {
        "Test half: AUROC / FAR@95": ("auroc_test", "far_at_95_test"),
        "Test half: area under the risk-coverage curve of the own answers (small is good) / right "
        "answers of frames on the map that can be accepted while 95 % of the accepted are right": (
            "aurc",
            "recall_at_p95",
        ),
        "All labelled frames: AUROC / FAR@95 († saw the labels of the first half)": (
            "auroc",
            "far_at_95",
        ),
        "Threshold frozen on the first half at mean + 3 sigma of in-map frames, test half: "
        "FAR / FRR": ("far", "frr"),
        "Threshold frozen on the first half where 95 % of in-map frames are accepted, test half: "
        "FAR / FRR": ("far_95", "frr_95"),
    }
    for title, values in pairs.items():
        is_marked = values[0] == "auroc"
        lines = [
            [_title(name, kind, is_marked=is_marked)]
            + [_pair(rows, column, name, values) for column in columns]
            for name, kind in kinds.items()
        ]
        parts.append(f"## {title}\n\n" + _table(["", *columns], lines))
    lines = [
        [_title(name, kind, is_marked=False)]
        + [_number(_mean(rows, column, name, "located"), 2) for column in columns]
        + [_number(float(np.nanmedian(times)), 0) if not np.isnan(times).all() else NONE]
        for name, kind in kinds.items()
        if kind != "oracle" and name not in GATES[1:]
        for times in [np.array([r["us_per_frame"] for r in rows if r["entrant"] == name])]
    ]
    head = ["", *columns, "µs/frame"]
    parts.append("## Located within 2 r_in, in-map frames\n\n" + _table(head, lines))
    parts.append(
        "Gates answer with the frontend's best match, as `top1` does. Times are medians over the "
        "sets, compilation excluded; columns of our stream are computed together.\n"
    )
    parts.append("## Against the best rival of each set, test-half AUROC\n\n" + _differences(rows))
    parts.append(
        "The best rival is chosen per set after the fact, which favours it; the interval is a "
        "paired block bootstrap. `loss`: the whole interval lies below zero.\n\n"
        f"`{ORACLES[0]}` averages the cost at the true places over one window, so it "
        f"still reacts late at seams and can be beaten there. `{ORACLES[1]}` knows the "
        "similarity histograms of both classes and filters them over time.\n"
    )
    return "\n".join(parts)


def draw(rows: Sequence[Row]) -> Figure:
    """Draw test-half AUROC: one panel per column, one line per entrant; bars are intervals."""
    columns, names = _in_order(rows, "column"), _in_order(rows, "entrant")[::-1]
    kinds = {str(row["entrant"]): str(row["kind"]) for row in rows}
    n_down = -(-len(columns) // MOST_DOTS)
    figure = Figure(figsize=(4.2 * MOST_DOTS, 0.6 + n_down * (0.2 * len(names) + 0.9)))
    axes = figure.subplots(n_down, MOST_DOTS, sharex=True, sharey=True, squeeze=False)
    for ax, column in zip(axes.ravel(), columns, strict=False):
        mine = [r for r in rows if r["column"] == column and "auroc_test" in r]
        n_sets = len({r["set"] for r in mine})
        for row in mine:
            height, colour = names.index(str(row["entrant"])), COLOURS[str(row["kind"])]
            if n_sets == 1:
                ends = row["auroc_test_lo"], row["auroc_test_hi"]
                ax.plot(ends, (height, height), color=colour, linewidth=1.2)
            ax.plot(row["auroc_test"], height, "o", color=colour, markersize=4)
        ax.set_title(f"{column} ({mine[0]['data']})" if mine else column, fontsize=8)
        ax.axvline(0.5, color="0.7", linewidth=0.6)
        ax.set_xlim(0.3, 1.01)
        ax.grid(axis="x", linewidth=0.3)
    for ax in axes[:, 0]:
        ax.set_yticks(range(len(names)), names, fontsize=7)
        for label in ax.get_yticklabels():
            label.set_color(COLOURS[kinds[label.get_text()]])
    for ax in axes.ravel()[len(columns) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("AUROC, test half")
    figure.tight_layout()
    return figure


def write(out: Path, rows: Sequence[Row]) -> None:
    """Write leaderboard.csv, .md, .png and .svg."""
    out.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with open(out / "leaderboard.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, restval="", lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: v for k, v in row.items() if v == v})  # without NaN
    (out / "leaderboard.md").write_text(to_markdown(rows), encoding="utf-8")
    save(draw(rows), out / "leaderboard")


def run(out: Path, data: Path, *, quick: bool, only: str = "") -> None:
    """Make the leaderboard.

    Args:
        out: folder to write to.
        data: folder of the real recordings.
        quick: fewer sets and resamples, slow systems left out.
        only: part of a set's name.
    """
    config = Config(audit=AuditConfig(n_bootstrap=100 if quick else 300))
    todo: list[Recipe] = recipes(data, quick=quick, only=only)
    rows: list[Row] = []
    for number, recipe in enumerate(todo, 1):
        rows += leaderboard(recipe.make(), config, quick=quick)
        mine = {r["entrant"]: r for r in rows if r["set"] == recipe.name}
        tao = mine["tao"].get("auroc_test", NAN)
        print(
            f"[{number}/{len(todo)}] {recipe.name}: tao {_number(tao)} test-half AUROC", flush=True
        )
        write(out, rows)
    print(f"wrote {out / 'leaderboard.md'}" if rows else "no data set matches")
