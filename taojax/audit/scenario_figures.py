"""Draw several scenarios beside one another over time."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from taojax import plots
from taojax.audit.figures import Picture, csv_text, picture
from taojax.audit.judgement import Evaluation

COMPARED = ("top1", "tao")
"""The gate of a single view, and ours."""


def traces(scenarios: Mapping[str, Evaluation]) -> Picture:
    """Draw the best similarity and tao over time in every scenario whose map was cut.

    Args:
        scenarios: name -> judged run; at least one.
    """
    n = len(scenarios)
    figure = Figure(figsize=(5.0 * n, 4.4), layout="constrained")
    axes = figure.subplots(len(COMPARED), n, sharex="col", sharey="row", squeeze=False)
    parts: dict[str, list[np.ndarray]] = {"scenario": [], "frame": [], "label": [], "split": []}
    parts |= {name: [] for name in COMPARED}
    for column, (scenario, done) in enumerate(scenarios.items()):
        judgement = done.judgement
        threshold = dict(
            zip(judgement.metrics["signal"], judgement.metrics["threshold"], strict=True)
        )
        start = int((judgement.splits.name != "test").sum())
        for row, name in enumerate(COMPARED):
            values = judgement.signals[name].astype(float)
            plots.signal_trace(
                values, judgement.label == "map_out", name=name if column == 0 else "",
                threshold=float(threshold[name]), test_start=start, ax=axes[row, column],
            )  # fmt: skip
            parts[name].append(values)
        axes[0, column].set_title(scenario, fontsize=10)
        axes[-1, column].set_xlabel("query frame", fontsize=9)
        parts["scenario"].append(np.full(len(judgement.label), scenario))
        parts["frame"].append(judgement.signals["frame"].astype(int))
        parts["label"].append(judgement.label)
        parts["split"].append(judgement.splits.name)
    figure.align_ylabels()
    _share_limits(axes)
    lines, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside upper center", ncol=4, frameon=False, fontsize=8)
    csv = csv_text({key: np.concatenate(values) for key, values in parts.items()})
    caption = (
        "Shaded: frames whose stretch of the map was deleted. Dashed: threshold, frozen on the "
        "calibration split; dotted: start of the test split. Both signals are dimensionless, "
        "larger means more likely off the map."
    )
    return picture(figure, "traces", "Where the map was cut", caption, csv)


def _share_limits(axes: np.ndarray) -> None:
    # Each panel set the limits of its whole row for its own values alone.
    for row in axes:
        values = [line.get_ydata() for ax in row for line in ax.lines[:1]]
        flat = np.concatenate([np.asarray(v, dtype=float) for v in values])
        flat = flat[np.isfinite(flat)]
        if flat.size:
            low, high = np.percentile(flat, (0, 99.5))
            levels = [ax.lines[1].get_ydata()[0] for ax in row if len(ax.lines) > 2]
            high = max([high, *levels])
            pad = 0.06 * (high - low) or 0.5
            row[0].set_ylim(low - pad, high + pad)
