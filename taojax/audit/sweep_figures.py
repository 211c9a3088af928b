"""Draw a judged sweep on the calibration half: sensitivity curves and heat maps."""

import itertools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taojax.audit.figures import Picture, csv_text, picture
from taojax.files.specs import column_names
from taojax.plots import IN_MAP, MAP_OUT

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
