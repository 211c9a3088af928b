"""`python -m benchmarks graph`: what closures do to a pose graph, on recordings and worlds."""

import csv
import io
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.pictures import save
from benchmarks.sets import ALIASES, COMMON
from taojax.audit.evaluate import evaluate
from taojax.audit.graph import ORACLE, TITLES, write_graph
from taojax.config import AuditConfig, Config
from taojax.datasets.edit import scenario
from taojax.datasets.simulate import WorldConfig, make_world, write_world
from taojax.files.records import read_run
from taojax.files.specs import column_names, write_atomically
from taojax.files.tables import read_table
from taojax.graph.optimise import check_extra
from taojax.plots import CYCLE, PALE
from taojax.runtime.score import score

REAL = {
    "mit_corridor": (5.0, 10.0),
    "intel_lab": (1.5, 3.0),
    "tuc_corridor": (2.0, 4.0),
    "tuc_corridor_mapout": (2.0, 4.0),
    "freiburg_campus": (5.0, 10.0),
    "radar_kaist01": (5.0, 10.0),
    "radar_dcc01": (5.0, 10.0),
    "radar_riverside01": (5.0, 10.0),
    "radar_oxford00": (5.0, 10.0),
}
"""Real recordings -> r_in, r_out [m]."""

MARKS = {"ours": "o", "ours_gnc": "D", "pcm_exact": "s", "top1_huber": "X", "top1_gnc": "P"}
"""Methods of the figure, and how each is drawn; the oracle is a line."""

TOLD = ("off_share", "rmse_m", "median_m")
"""Columns that get a table of their own."""

Row = dict[str, Any]


class Recipe(NamedTuple):
    """A data folder that is there or made when its turn comes."""

    name: str
    radii_m: tuple[float, float]
    folder: Callable[[Path], Path]
    """From a scratch folder to the data folder."""


def _world(config: WorldConfig, seed: int, cut: str, scratch: Path) -> Path:
    write_world(scenario(make_world(config, seed), cut), scratch)
    return scratch


def recipes(data: Path, *, quick: bool, only: str = "") -> list[Recipe]:
    """List recordings and worlds; what is absent is said and left out.

    Args:
        data: folder of the real recordings.
        quick: one seed and two levels of aliasing.
        only: part of a name; the others are left out.
    """
    found = []
    for name, radii in REAL.items():
        if only not in name:
            continue
        if not (data / name / "truth").is_dir():
            print(
                f"skipped {name}: not found in {data} (real recordings are not in this repository)"
            )
            continue
        found.append(Recipe(name, radii, lambda _, folder=data / name: folder))
    for cut in ("default", "h3", "h4"):
        for seed in range(1 if quick else 3):
            make = partial(_world, WorldConfig(), seed, cut)
            found.append(Recipe(f"simulated/{cut}/{seed}", (10.0, 10.0), make))
    for alias in ALIASES[:: 3 if quick else 1]:
        config = WorldConfig(alias=alias, common=COMMON)
        make = partial(_world, config, 100, "default")
        found.append(Recipe(f"simulated/alias {alias:g}/100", (10.0, 10.0), make))
    return [recipe for recipe in found if only in recipe.name]


def measure(recipe: Recipe, out: Path) -> list[Row]:
    """Score, judge and optimise one data set; the run stays in `out`.

    Args:
        recipe: what to run.
        out: folder to make.

    Returns:
        The rows of its tables/graph.csv with the name of the set.
    """
    folder, run = recipe.folder(out / "data"), out / "run"
    r_in_m, r_out_m = recipe.radii_m
    config = Config(audit=AuditConfig(r_in_m=r_in_m, r_out_m=r_out_m))
    score(folder, run, config)
    evaluate(run, folder / "truth", config)
    write_graph(
        run, read_run(run), folder / "truth", config.audit, config.stream.window,
        out=run, command=f"taojax graph {run}", say=lambda text: None,
    )  # fmt: skip
    if not (run / "tables/graph.csv").is_file():
        return []
    table = read_table(run / "tables/graph.csv", "graph")
    n = len(table["method"])
    return [{"set": recipe.name} | {k: v[at] for k, v in table.items()} for at in range(n)]


def _by_set(rows: Sequence[Row], column: str) -> dict[str, dict[str, float]]:
    out: dict[str, dict[str, float]] = {}
    for row in rows:
        out.setdefault(row["set"], {})[row["method"]] = row[column]
    return out


def to_markdown(rows: Sequence[Row]) -> str:
    """Return a table per column of `TOLD`: sets down, methods across."""
    parts = []
    for column in TOLD:
        digits = 3 if column.endswith("share") else 1
        lines = [f"**{column}**", "", "| set | " + " | ".join(TITLES.values()) + " |"]
        lines.append("|---" * (len(TITLES) + 1) + "|")
        for name, cells in _by_set(rows, column).items():
            told = [f"{cells[m]:.{digits}f}" if m in cells else "" for m in TITLES]
            lines.append(f"| {name} | " + " | ".join(told) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def to_csv(rows: Sequence[Row]) -> str:
    """Return one row per set and method."""
    held = io.StringIO()
    writer = csv.writer(held, lineterminator="\n")
    columns = ("set", *column_names("graph"))
    writer.writerow(columns)
    for row in rows:
        cells = (row[c] for c in columns)
        writer.writerow(
            ("" if np.isnan(v) else f"{v:.6g}") if isinstance(v, float) else v for v in cells
        )
    return held.getvalue()


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the share of the test frames that are off, one line of marks per set."""
    found = _by_set(rows, "off_share")
    figure = Figure(figsize=(7.6, 1.6 + 0.32 * len(found)), layout="constrained")
    ax = figure.subplots()
    for height, cells in enumerate(reversed(found.values())):
        ax.plot([cells[ORACLE]] * 2, [height - 0.32, height + 0.32], color=PALE, linewidth=3,
                label="oracle" if height == 0 else None)  # fmt: skip
        for number, (method, marker) in enumerate(MARKS.items()):
            label = TITLES[method] if height == 0 else None
            # Side by side, for equal shares would hide one another.
            at = height + 0.13 * (len(MARKS) // 2 - number)
            ax.plot(cells[method], at, marker, color=CYCLE[number], markersize=5, label=label)
    ax.set_yticks(range(len(found)), list(found)[::-1], fontsize=8)
    ax.set(xlim=(-0.02, 1.02), ylim=(-0.7, len(found) - 0.3))
    ax.set_xlabel("share of the test frames farther than r_out from the truth, after optimising")
    ax.grid(axis="x", linewidth=0.3)
    figure.legend(loc="outside upper center", ncol=3, frameon=False, fontsize=8)
    return figure


def write(out: Path, rows: Sequence[Row]) -> None:
    """Write graph.md, and graph.png and .svg with the .csv behind them."""
    write_atomically(out / "graph.md", to_markdown(rows))
    save(draw(rows), out / "graph", to_csv(rows))


def run(
    out: Path, data: Path, *, quick: bool, only: str = "", say: Callable[[str], None] = print
) -> None:
    """Run every set and write what was found after each.

    Args:
        out: folder to write into; runs stay in runs/.
        data: folder of the real recordings.
        quick: fewer worlds.
        only: data sets whose name contains this.
        say: where progress goes.
    """
    check_extra()
    chosen, rows = recipes(data, quick=quick, only=only), []
    for number, recipe in enumerate(chosen, start=1):
        rows += measure(recipe, out / "runs" / recipe.name.replace("/", "_").replace(" ", "_"))
        if rows:
            write(out, rows)
        say(f"[{number}/{len(chosen)}] {recipe.name}")
    say(f"wrote {out / 'graph.md'}, .png, .svg, .csv" if rows else "no data set matches")
