"""Judge a sealed sweep: choose on the calibration half, open the test half for it, draw both."""

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taojax.audit import calibration, labels, metrics, tables
from taojax.audit.figures import Picture, as_files, csv_text, picture
from taojax.audit.labels import read_truth
from taojax.config import Config
from taojax.decisions import plain
from taojax.errors import InputError
from taojax.files.records import INPUTS, digest_file, read_manifest
from taojax.files.specs import column_names, read_npz, write_atomically
from taojax.files.tables import read_table, table_text
from taojax.plots import IN_MAP, MAP_OUT

N_TOP = 10
"""Configurations in the printed table."""


class SealedSweep(NamedTuple):
    """A sealed sweep, verified."""

    grid: tables.Table
    tao: Float[np.ndarray, "c t"]
    map_m: Float[np.ndarray, "m 2"]
    manifest: dict[str, Any]


class SweepJudgement(NamedTuple):
    """What the judge concludes."""

    table: tables.Table
    """Columns of data_specs/sweep.toml."""

    sentences: tuple[str, ...]
    chosen: int | None


def read_sweep(run: Path) -> SealedSweep:
    """Read a sealed sweep, or refuse if a byte has changed since.

    Raises:
        InputError: a sealed file is missing, changed or malformed.
    """
    manifest = read_manifest(run)
    for name, want in manifest["sha256"].items():
        if not name.startswith(INPUTS) and digest_file(run / name) != want:
            raise InputError(f"{run / name}: seal broken, it was changed; sweep again")
    poses = read_table(run / "map_poses.csv", "map_poses")
    grid = read_table(run / "grid.csv", "grid")
    tao = read_npz(run / "signals.npz", "sweep")["tao"].astype(float)
    return SealedSweep(grid, tao, np.stack([poses["x_m"], poses["y_m"]], axis=1), manifest)


def _rates(
    signal: np.ndarray, is_in: np.ndarray, is_out: np.ndarray, threshold: float
) -> tuple[float, float]:
    """Return FAR and FRR at a threshold; NaN where there is no threshold or no such frame."""
    accepted = signal <= threshold
    far = float(accepted[is_out].mean()) if is_out.any() else tables.NAN
    frr = float((~accepted[is_in]).mean()) if is_in.any() else tables.NAN
    return (tables.NAN, tables.NAN) if np.isnan(threshold) else (far, frr)


def calibration_rows(split: labels.CalibrationSplit, sigmas: float) -> list[dict[str, float]]:
    """Measure every configuration on the calibration half, the only half this function is given.

    Args:
        split: signals are named by the number of their configuration.
        sigmas: of the threshold.
    """
    known, rows = split.is_in | split.is_out, []
    has_both = bool(split.is_in.any() and split.is_out.any())
    for name, signal in split.signals.items():
        threshold = calibration.sigma_threshold(split, name, sigmas)
        far, frr = _rates(signal, split.is_in, split.is_out, threshold)
        row = {"threshold": threshold, "far_calibration": far, "frr_calibration": frr}
        if has_both:
            row["auroc_calibration"] = metrics.auroc(signal[known], split.is_out[known])
            row["far_at_95_calibration"] = metrics.far_at_95(signal[known], split.is_out[known])
        rows.append(row)
    return rows


def ranking(rows: list[dict[str, float]]) -> Int[np.ndarray, " c"]:
    """Return configurations best first: calibration AUROC, then FAR@95, then the earlier row."""
    auroc = np.array([row.get("auroc_calibration", tables.NAN) for row in rows])
    far = np.array([row.get("far_at_95_calibration", tables.NAN) for row in rows])
    return np.lexsort((np.arange(len(rows)), far, -auroc))


def test_row(test: labels.TestSplit, name: str, threshold: float) -> dict[str, float]:
    """Measure one configuration on the test half."""
    point, known = metrics.operate(test, name, threshold), test.is_in | test.is_out
    row = {} if np.isnan(threshold) else {"far_test": point.far, "frr_test": point.frr}
    if test.is_in.any() and test.is_out.any():
        signal, is_out = test.signals[name][known], test.is_out[known]
        row["auroc_test"] = metrics.auroc(signal, is_out)
        row["far_at_95_test"] = metrics.far_at_95(signal, is_out)
    return row


def describe(table: Mapping[str, np.ndarray], number: int) -> str:
    """Name a configuration by its association and settings."""
    settings = [c for c in column_names("grid") if c not in NO_SETTING]
    said = [f"{c} {table[c][number]:g}" for c in settings if not np.isnan(table[c][number])]
    return f"configuration {number} ({', '.join([str(table['association'][number]), *said])})"


def _default(sealed: SealedSweep, config: Config) -> int:
    """Return the row of the run's own settings, of its own association if that was swept."""
    mine = np.flatnonzero(sealed.grid["is_default"] == 1)
    same = sealed.grid["association"][mine] == config.stream.association
    return int(mine[np.argmax(same)])


def _difference(test: labels.TestSplit, a: int, b: int, config: Config) -> str:
    """Say how far the AUROC of two configurations differ on the same test frames."""
    known, audit = test.is_in | test.is_out, config.audit
    weights = metrics.block_weights(
        len(test.label), audit.block_frames, audit.n_bootstrap, config.seed
    )[:, known]
    drawn = [
        metrics.weighted_separation(test.signals[str(n)][known], test.is_out[known], weights)
        for n in (a, b)
    ]
    low, high = metrics.interval(drawn[0].auroc - drawn[1].auroc)
    if np.isnan(low):
        return "no interval: too few resamples hold both classes"
    shown = "" if low > 0 or high < 0 else ", so no difference is shown"
    return f"95 % interval of the difference {low:+.3f} to {high:+.3f}{shown}"


def _figures_of(row: Mapping[str, float]) -> str:
    names = {"auroc_test": "AUROC", "far_at_95_test": "FAR@95", "far_test": "FAR",
             "frr_test": "FRR"}  # fmt: skip
    return ", ".join(f"{said} {row[key]:.3f}" for key, said in names.items() if key in row)


def judge(
    sealed: SealedSweep, label: np.ndarray, config: Config, *, gap_frames: int
) -> SweepJudgement:
    """Choose on the calibration half and measure the choice on the test half.

    Args:
        sealed: every configuration's signal.
        label: in_map, map_out or grey, per frame.
        config: split, thresholds, resamples and seed.
        gap_frames: longest memory of the sweep.
    """
    signals = {str(n): signal for n, signal in enumerate(sealed.tao)}
    splits = labels.split_frames(
        signals, label, calibration_share=config.audit.calibration_share, gap_frames=gap_frames
    )
    cal, test, n = splits.calibration, splits.test, len(signals)
    rows: list[dict[str, Any]] = calibration_rows(cal, config.audit.sigmas)
    for number, row in enumerate(rows):
        row |= {name: values[number] for name, values in sealed.grid.items()} | {"is_chosen": 0}
    n_in, n_out = int(cal.is_in.sum()), int(cal.is_out.sum())
    counts = f"calibration half (frames 0 to {len(cal.frame) - 1}: {n_in} in-map, {n_out} map-out)"
    if not n_in or not n_out:
        said = f"No configuration is chosen: the {counts} holds one class, and a choice needs both."
        return SweepJudgement(tables.from_rows("sweep", rows), (said,), None)
    order = ranking(rows)
    for place, number in enumerate(order, start=1):
        rows[number]["rank_calibration"] = place
    best, default = int(order[0]), _default(sealed, config)
    rows[best]["is_chosen"] = 1
    # Only from here on the test half is looked at, and for these two configurations alone.
    held = {k: test_row(test, str(k), rows[k]["threshold"]) for k in (best, default)}
    for number, row in held.items():
        rows[number] |= row
    auroc = [row["auroc_calibration"] for row in rows]
    sentences = [
        f"Chosen of {n} on the {counts} alone: {describe(sealed.grid, best)}.",
        f"Calibration AUROC {auroc[best]:.3f}, default {auroc[default]:.3f}, median "
        f"{np.median(auroc):.3f}, worst {min(auroc):.3f}. The best of {n} flatters itself on the "
        "half it was chosen on; only the test half says what it is worth.",
    ]
    if "auroc_test" not in held[best]:
        sentences.append("The test half does not hold both classes: the choice stays untested.")
    elif best == default:
        sentences.append(f"That is the default. Test half: {_figures_of(held[best])}.")
    else:
        sentences.append(
            f"Test half (frames {test.frame[0]} to {test.frame[-1]}), opened after the choice: "
            f"{_figures_of(held[best])}; default, {describe(sealed.grid, default)}: "
            f"{_figures_of(held[default])}; {_difference(test, best, default, config)}."
        )
    sentences.append("No other configuration was measured on the test half.")
    return SweepJudgement(tables.from_rows("sweep", rows), tuple(sentences), best)


def top_table(table: Mapping[str, np.ndarray]) -> tables.Table:
    """Return the rows best on the calibration half, and the default ones."""
    order = np.argsort(table["rank_calibration"], kind="stable")
    kept = [n for n in order if table["rank_calibration"][n] <= N_TOP or table["is_default"][n]]
    return {name: values[kept] for name, values in table.items()}


def terminal_table(top: Mapping[str, np.ndarray], settings: list[str]) -> str:
    """Return the top rows as aligned text.

    Args:
        top: from `top_table`.
        settings: the columns that tell the rows apart.
    """
    shown = ["config", "association", *settings, "auroc_calibration", "auroc_test"]
    cell = lambda v: str(v) if isinstance(v, str) else "" if np.isnan(v) else plain(float(v))
    columns = [[name, *map(cell, top[name])] for name in shown]
    widths = [max(map(len, column)) for column in columns]
    rows = [
        "  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True))
        for row in zip(*columns, strict=True)
    ]
    return "\n".join(rows)


def evaluate_sweep(run: Path, truth: Path, config: Config) -> tuple[str, ...]:
    """Judge a sealed sweep and write sweep.csv, tables and figures into its folder.

    Args:
        run: sealed by `taojax sweep`.
        truth: the truth folder of the same recording.
        config: radii, split, thresholds.

    Returns:
        What the command line prints.

    Raises:
        InputError: broken seal, unreadable or foreign truth, folder that cannot be written.
    """
    sealed = read_sweep(run)
    known = read_truth(truth, sealed.tao.shape[1])
    audit = config.audit
    nearest = labels.nearest_map_distance(known.xy_m, sealed.map_m)
    label = labels.label_frames(nearest, audit.r_in_m, audit.r_out_m)
    # No test signal may remember a calibration frame, whatever the configuration.
    gap = int(np.nanmax([*sealed.grid["window"], config.stream.window]))
    judgement = judge(sealed, label, config, gap_frames=gap)
    files: dict[str, str | bytes] = {}
    lines = [*judgement.sentences, *(f"Note: {note}." for note in sealed.manifest["notes"])]
    if judgement.chosen is not None:
        top = top_table(judgement.table)
        # The printed table is the top; sweep.csv itself holds every row.
        files |= {
            k.replace("/sweep.", "/top."): v for k, v in tables.as_files("sweep", top).items()
        }
        for drawn in draw(judgement.table):
            files |= as_files(drawn)
        every = np.ones(len(sealed.tao), bool)
        lines = [terminal_table(top, varied(judgement.table, every)), *lines]
    files["audit.json"] = json.dumps(
        {"schema": 1, "run_seal": sealed.manifest["seal"], "truth_sha256": known.sha256,
         "gap_frames": gap, "chosen": judgement.chosen, "sentences": judgement.sentences}, indent=2
    ) + "\n"  # fmt: skip
    # Last, for with it the sweep counts as finished.
    files["sweep.csv"] = table_text("sweep", judgement.table)
    for name, content in files.items():
        write_atomically(run / name, content)
    return tuple(lines)


BAND = (10.0, 50.0, 90.0)
"""Percentiles over the other settings that a sensitivity curve shows."""

LEAST_SPAN = 0.05
"""AUROC axes and colours span at least this much, so that noise does not look like an effect."""

NO_SETTING = ("config", "association", "is_default", "is_in_grid")
"""Columns of grid.csv that are no numeric setting."""


def heat_map(
    values: Float[np.ndarray, "b a"],
    levels: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]],
    *,
    limits: tuple[float, float],
    ax: Axes,
) -> Axes:
    """Draw a number over two settings, each value written into its cell.

    Args:
        values: row = level of the second setting, column = level of the first.
        levels: values of the first and of the second setting, ascending.
        limits: ends of the colour scale, shared by panels that are compared.
        ax: where to draw.
    """
    low, high = limits
    ax.imshow(values, vmin=low, vmax=high, cmap="cividis", aspect="auto", origin="lower")
    for (row, column), value in np.ndenumerate(values):
        is_dark = value < 0.5 * (low + high)
        ax.text(
            column, row, f"{value:.3f}", ha="center", va="center", fontsize=7,
            color="white" if is_dark else "black",
        )  # fmt: skip
    for axis, at in ((ax.xaxis, levels[0]), (ax.yaxis, levels[1])):
        axis.set_ticks(np.arange(len(at)), [f"{level:g}" for level in at])
    ax.tick_params(labelsize=7)
    return ax


def sensitivity(
    levels: Float[np.ndarray, " a"], summary: Float[np.ndarray, "4 a"], *, name: str, ax: Axes
) -> Axes:
    """Draw how a score depends on one setting while the others vary.

    Args:
        levels: values of the setting, ascending; drawn at equal distances.
        summary: lower end of the band, median, upper end, and best score at each level.
        name: of the setting; becomes the x label.
        ax: where to draw.
    """
    at, (low, middle, high, best) = np.arange(len(levels)), summary
    ax.fill_between(at, low, high, color=IN_MAP, alpha=0.2, linewidth=0, label="10 to 90 %")
    ax.plot(at, middle, color=IN_MAP, marker="o", markersize=4, label="median")
    ax.plot(at, best, color=MAP_OUT, linestyle="--", marker="^", markersize=4, label="best")
    ax.set_xticks(at, [f"{level:g}" for level in levels])
    ax.set(xlabel=name, xlim=(-0.3, len(levels) - 0.7))
    ax.tick_params(labelsize=8)
    ax.grid(alpha=0.25)
    return ax


def _span(low: float, high: float) -> tuple[float, float]:
    """Return limits at least `LEAST_SPAN` apart, within [0, 1]."""
    pad = max(0.0, 0.5 * (LEAST_SPAN - (high - low)))
    high = min(1.0, high + pad)
    return min(low - pad, high - LEAST_SPAN), high


def varied(table: Mapping[str, np.ndarray], mine: Bool[np.ndarray, " c"]) -> list[str]:
    """Return the settings that take more than one value among some rows."""
    names = [c for c in column_names("grid") if c not in NO_SETTING]
    return [c for c in names if len(np.unique(table[c][mine & ~np.isnan(table[c])])) > 1]


def draw(table: Mapping[str, np.ndarray]) -> list[Picture]:
    """Draw sensitivity curves and heat maps of every association, on the calibration half."""
    pictures = []
    for association in ("rank", "joint"):
        mine = (table["association"] == association) & (table["is_in_grid"] == 1)
        if names := varied(table, mine):
            pictures.append(_sensitivity(table, mine, names, association))
        if len(names) > 1:
            pictures.append(_heat_maps(table, mine, names, association))
    return pictures


def _sensitivity(
    table: Mapping[str, np.ndarray], mine: np.ndarray, names: list[str], association: str
) -> Picture:
    n_columns = 2 if len(names) == 4 else min(3, len(names))
    n_rows = -(-len(names) // n_columns)
    figure = Figure(figsize=(0.6 + 2.8 * n_columns, 0.7 + 2.3 * n_rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(n_rows, n_columns, sharey=True, squeeze=False)).ravel()
    score, stacked = table["auroc_calibration"], []
    for ax, name in zip(axes, names, strict=False):
        levels = np.unique(table[name][mine])
        groups = [score[mine & (table[name] == level)] for level in levels]
        low, middle, high = np.array([np.percentile(g, BAND) for g in groups]).T
        best = np.array([g.max() for g in groups])
        sensitivity(levels, np.stack([low, middle, high, best]), name=name, ax=ax)
        columns = (levels, low, middle, high, best)
        stacked += [(name, *values) for values in zip(*columns, strict=True)]
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    for ax in axes[::n_columns]:
        ax.set_ylabel("AUROC, calibration half")
    low, high = _span(float(score[mine].min()), float(score[mine].max()))
    axes[0].set_ylim(low - 0.02 * (high - low), high + 0.02 * (high - low))
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside upper center", ncol=3, frameon=False
    )
    heads = ("setting", "value", "p10", "median", "p90", "best")
    csv = csv_text({h: np.array(c) for h, c in zip(heads, zip(*stacked, strict=True), strict=True)})
    caption = f"{int(mine.sum())} {association} configurations; band: 10 to 90 % over the others."
    name = f"sensitivity_{association}"
    return picture(figure, name, f"Sensitivity, {association}", caption, csv)


def _heat_maps(
    table: Mapping[str, np.ndarray], mine: np.ndarray, names: list[str], association: str
) -> Picture:
    score, n = table["auroc_calibration"], len(names)
    cells, stacked = {}, []
    for a, b in itertools.combinations(names, 2):
        x, y = (np.unique(table[c][mine]) for c in (a, b))
        mean = np.array(
            [[score[mine & (table[a] == u) & (table[b] == v)].mean() for u in x] for v in y]
        )
        cells[a, b] = x, y, mean
        stacked += [(a, u, b, v, mean[j, i]) for i, u in enumerate(x) for j, v in enumerate(y)]
    means = np.concatenate([mean.ravel() for *_, mean in cells.values()])
    limits = _span(float(means.min()), float(means.max()))
    figure = Figure(figsize=(1.5 + 2.0 * (n - 1), 1.0 + 1.7 * (n - 1)), layout="constrained")
    axes = figure.subplots(n - 1, n - 1, squeeze=False)
    for (a, b), (x, y, mean) in cells.items():
        column, row = names.index(a), names.index(b) - 1
        ax = heat_map(mean, (x, y), limits=limits, ax=axes[row, column])
        ax.set(xlabel=a if row == n - 2 else "", ylabel=b if column == 0 else "")
    for row, column in itertools.product(range(n - 1), repeat=2):
        axes[row, column].set_visible(column <= row)
    figure.colorbar(
        axes[0, 0].images[0],
        ax=axes,
        location="top",
        shrink=0.6,
        aspect=40,
        label="mean AUROC, calibration half",
    )
    heads = ("setting_x", "x", "setting_y", "y", "mean_auroc_calibration")
    csv = csv_text({h: np.array(c) for h, c in zip(heads, zip(*stacked, strict=True), strict=True)})
    caption = f"Mean over the other settings of {int(mine.sum())} {association} configurations."
    name = f"heat_{association}"
    return picture(figure, name, f"Pairs of settings, {association}", caption, csv)
