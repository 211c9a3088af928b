"""What each ingredient is worth: one is taken away at a time, everything else stays.

Settings of the filter are changed through the configuration, parts of `tao` are columns of one
replay, and features of the verdict lose their weight in the shipped numbers.
"""

import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.entrants import Field, field_of, stream
from benchmarks.pictures import save
from benchmarks.sets import DataSet, recipes
from taojax.audit import metrics, risk
from taojax.audit.figures import csv_text
from taojax.config import AuditConfig, Config, VerdictConfig
from taojax.files.specs import write_atomically
from taojax.plots import IN_MAP, MAP_OUT, PALE
from taojax.risk import probability_wrong, shipped
from taojax.runtime import hindsight

NAN = float("nan")

DETECTOR, VERDICT = "tao: ", "final verdict: "
"""Beginnings of a variant's name: the off-map signal, and the probability of being wrong."""

WHOLE = {DETECTOR: "all ingredients", VERDICT: "all features"}
"""What the variants of each group are held against."""

PANELS = (
    ("AUROC of tao, all frames", DETECTOR, "auroc"),
    ("FAR at 95 % of tao, all frames", DETECTOR, "far_at_95"),
    ("AUROC of wrong answers, all frames", VERDICT, "auroc"),
)
"""Rows of the figure: title, group of variants, figure of a cell."""

LEAST_SPAN = 0.1
"""An axis spans at least this much, so that noise does not look like an effect."""

EVEN = 0.005
"""A difference below it is drawn as none; no interval is computed here."""

SETTINGS: dict[str, dict[str, Any]] = {
    "all ingredients": {},
    "half the evidence": {"evidence": 2.0},
    "twice the evidence": {"evidence": 8.0},
    "leaves the map four times as often": {"leave": 0.08},
    "comes back a third as often": {"come_back": 0.033},
    "half the tolerance": {"near_gaps": 1.0},
    "twice the tolerance": {"near_gaps": 4.0},
}

COLUMNS = {
    "the literal cost instead": "tao_rank",
    "cost along the path alone": "cost_long",
    "doubt of the place alone": "place",
}
"""Variant -> what stands in for the sum."""

FEATURES = {
    "belief": ("place", "off_map", "elsewhere", "reverse", "rival"),
    "similarity level": ("level_short", "level", "level_long"),
    "cost along the path": ("cost_short", "cost", "cost_long"),
    "vote": ("vote_short", "vote", "vote_long", "listed", "agree"),
    "own candidate": ("own",),
    "contradiction": ("contradiction",),
}
"""Group -> features of the final answer."""


class Cell(NamedTuple):
    """One variant on one set."""

    auroc: float
    far_at_95: float = NAN
    """Of the detector alone."""

    def __str__(self) -> str:
        far = "" if np.isnan(self.far_at_95) else f" / {self.far_at_95:.2f}"
        return f"{self.auroc:.3f}{far}"


Table = Mapping[str, Mapping[str, Cell]]
"""Variant -> set -> cell; every variant knows every set."""


def _cell(signal: np.ndarray, field: Field) -> Cell:
    known = field.label != "grey"
    values, is_out = signal[known], (field.label == "map_out")[known]
    return Cell(metrics.auroc(values, is_out), metrics.far_at_95(values, is_out))


def _wrong_cell(delayed: Mapping[str, np.ndarray], own: risk.Own, without: tuple[str, ...]) -> Cell:
    numbers = shipped().final
    weight = np.where(np.isin(numbers.columns, without), 0.0, numbers.weight)
    p = probability_wrong(numbers._replace(weight=weight), delayed)
    known = own.is_right | own.is_wrong
    return Cell(metrics.auroc(p[known], own.is_wrong[known]))


def _rows(data: DataSet) -> dict[str, Cell]:
    """Return variant -> cell for one set."""
    audit = AuditConfig(r_in_m=data.r_in_m, r_out_m=data.r_out_m)
    field, rows = field_of(data, Config(audit=audit)), {}
    full = stream(data, Config())
    for name, settings in SETTINGS.items():
        run = full if not settings else stream(data, Config(verdict=VerdictConfig(**settings)))
        rows[f"{DETECTOR}{name}"] = _cell(np.asarray(run.records.signals["tao"], float), field)
    now = hindsight.now_columns(full.both.now)
    for name, column in COLUMNS.items():
        values = now.get(f"now_{column}", full.records.signals.get(column))
        rows[f"{DETECTOR}{name}"] = _cell(np.asarray(values, float), field)
    final = full.both.final
    error = np.hypot(*(final.pose[:, :2] - data.truth_m).T)
    own = risk.own_answers(error, field.nearest_m, audit.wrong_m, audit.r_out_m)
    delayed = hindsight.delayed_columns(final)
    rows[f"{VERDICT}all features"] = _wrong_cell(delayed, own, ())
    for name, features in FEATURES.items():
        rows[f"{VERDICT}without {name}"] = _wrong_cell(delayed, own, features)
    return rows


def to_markdown(table: Table) -> str:
    """Return the table as text."""
    names = list(next(iter(table.values()), {}))
    lines = ["| variant | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for variant, cells in table.items():
        lines.append(f"| {variant} | " + " | ".join(str(cells[n]) for n in names) + " |")
    return "\n".join(lines) + "\n"


def to_csv(table: Table) -> str:
    """Return one row per variant and set; FAR is blank for the verdict."""
    rows = [(v, name, *cell) for v, cells in table.items() for name, cell in cells.items()]
    columns = zip(("variant", "set", *Cell._fields), zip(*rows, strict=True), strict=True)
    # Names hold commas.
    return csv_text({
        name: np.array([f'"{v}"' for v in values] if isinstance(values[0], str) else values)
        for name, values in columns
    })  # fmt: skip


def _panel(values: Mapping[str, float], whole: str, *, falls: bool, ax: Axes) -> None:
    """Draw one figure of one set: a line at what all ingredients reach, a mark per variant."""
    level = values[whole]
    ax.axvline(level, color=PALE, linewidth=1.0, zorder=1)
    for height, value in enumerate(list(values.values())[::-1]):
        loss = (value - level) * (1 if falls else -1)
        marker, colour = ("X", MAP_OUT) if loss > EVEN else ("o", "#888888")
        marker, colour = ("^", IN_MAP) if loss < -EVEN else (marker, colour)
        ax.plot((level, value), (height, height), color=colour, linewidth=1.0, zorder=2)
        ax.plot(value, height, marker, color=colour, markersize=5.5, zorder=3)
    names = [textwrap.fill(name, 30) for name in values]
    ax.set_yticks(range(len(values)), names[::-1], fontsize=8)
    ax.set_ylim(-0.7, len(values) - 0.3)
    ax.tick_params(axis="x", labelsize=8)
    ax.grid(axis="x", linewidth=0.3)
    low, high = min(values.values()), max(values.values())
    half = max(0.6 * (high - low), LEAST_SPAN / 2)
    ax.set_xlim((low + high) / 2 - half, (low + high) / 2 + half)
    ax.locator_params(axis="x", nbins=5)


def draw(table: Table) -> Figure:
    """Draw what each ingredient is worth: sets across, figures down, variants in each panel."""
    names = list(next(iter(table.values())))
    sizes = [sum(v.startswith(group) for v in table) for _, group, _ in PANELS]
    figure = Figure(
        figsize=(3.0 + 2.2 * len(names), 1.6 + 0.24 * sum(sizes) + 0.5 * len(PANELS)),
        layout="constrained",
    )
    grid = figure.subplots(
        len(PANELS), len(names), sharey="row", squeeze=False, height_ratios=[n + 2 for n in sizes]
    )
    for axes, (title, group, value) in zip(grid, PANELS, strict=True):
        for ax, name in zip(axes, names, strict=True):
            values = {
                variant.removeprefix(group): getattr(cells[name], value)
                for variant, cells in table.items()
                if variant.startswith(group)
            }
            _panel(values, WHOLE[group], falls=value == "far_at_95", ax=ax)
            ax.set_xlabel(title.split(",")[0].split(" of ")[0], fontsize=8)
            if group == PANELS[0][1] and value == PANELS[0][2]:
                ax.set_title(name, fontsize=9)
        axes[0].set_ylabel(title, fontsize=8)
    figure.suptitle(
        "What each ingredient is worth. Line: all of them. With the change: orange cross worse, "
        f"blue triangle better, grey dot within {EVEN:g}.\nOne run each, no intervals. Sets named "
        "simulated/ and range/ are simulated, the others real recordings.",
        fontsize=9,
    )
    return figure


def write(out: Path, table: Table) -> None:
    """Write ablation.md, and ablation.png and .svg with the .csv behind them."""
    write_atomically(out / "ablation.md", to_markdown(table))
    save(draw(table), out / "ablation", to_csv(table))


def run(out: Path, data: Path, *, only: str = "", say: Callable[[str], None] = print) -> None:
    """Write the table and the figure: variants down, data sets across.

    Args:
        out: folder to write into.
        data: folder of the real recordings; absent ones are skipped.
        only: data sets whose name contains this.
        say: where progress goes.
    """
    chosen = [
        recipe
        for recipe in recipes(data, quick=True, only=only)
        if recipe.name in REPRESENTATIVE or only
    ]
    table: dict[str, dict[str, Cell]] = {}
    for number, recipe in enumerate(chosen, start=1):
        for name, cell in _rows(recipe.make()).items():
            table.setdefault(name, {})[recipe.name] = cell
        write(out, table)
        say(f"[{number}/{len(chosen)}] {recipe.name}")
    say(f"wrote {out / 'ablation.md'}, .png, .svg, .csv" if table else "no data set matches")


REPRESENTATIVE = (
    "mit_corridor",
    "intel_lab",
    "tuc_corridor_mapout",
    "simulated/default/0",
    "range/alias 0.7/100",
)
"""Weak and strong descriptors, lists, the paper's world, and one where everything aliases."""
