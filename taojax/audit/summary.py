"""Several scenarios side by side, in the layout of the paper."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from taojax import plots
from taojax.audit.figures import Picture, csv_text, picture
from taojax.audit.judgement import Evaluation
from taojax.audit.tables import Table, from_rows
from taojax.audit.words import metric_row
from taojax.tables import table_text

WHOLE = "full"
"""The scenario whose map was not cut; it carries Table 1 and the micro-scale audit."""

PAPER_TABLE_1 = {
    2.5: (221, 1000, 0.009, 0.101, 0.169, 0.212),
    5.0: (474, 1000, 0.055, 0.311, 0.407, 0.465),
    10.0: (1000, 1000, 0.706, 0.946, 0.980, 0.999),
}
"""Radius [m] -> answerable queries, queries, R@1, R@5, R@10, R@100."""

PAPER_TABLE_2 = {
    "default": (246, 0.937, 0.930, 0.583, 0.259),
    "h3": (253, 0.977, 0.976, 0.238, 0.049),
    "h4": (271, 0.946, 0.983, 0.326, 0.119),
}
"""Scenario -> map-out frames, top-1 AUC, TAO AUC, top-1 FPR, TAO FPR."""

_PAPER_COLUMNS = (
    "paper_map_out_frames", "paper_top1_auroc", "paper_tao_auroc",
    "paper_top1_far", "paper_tao_far",
)  # fmt: skip
_COMPARED = ("top1", "velocity", "tao_rank", "tao")


def cut_maps(scenarios: Mapping[str, Evaluation]) -> dict[str, Evaluation]:
    """Return the scenarios in which a part of the map was deleted."""
    return {name: done for name, done in scenarios.items() if name != WHOLE}


def mapout_table(scenarios: Mapping[str, Evaluation]) -> Table:
    """Put our figures beside those of the paper's Table 2."""
    rows = []
    for name, done in cut_maps(scenarios).items():
        row = {
            "scenario": name,
            "frames": len(done.judgement.label),
            "map_out_frames": (done.judgement.label == "map_out").sum(),
        }
        for signal in _COMPARED:
            measured = metric_row(done.judgement, signal)
            row |= {f"{signal}_{key}": measured[key] for key in ("auroc", "far")}
        row["fused_far"] = metric_row(done.judgement, "fused")["far"]
        if name in PAPER_TABLE_2:
            row |= dict(zip(_PAPER_COLUMNS, PAPER_TABLE_2[name], strict=True))
        rows.append(row)
    return from_rows("mapout", rows)


def paper_recall_table() -> Table:
    """Return the paper's Table 1 in the layout of ours."""
    names = ("answerable", "n", "r_at_1", "r_at_5", "r_at_10", "r_at_100")
    rows = [
        {"radius_m": radius} | dict(zip(names, values, strict=True))
        for radius, values in PAPER_TABLE_1.items()
    ]
    return from_rows("recall", rows)


def joined_metrics(scenarios: Mapping[str, Evaluation]) -> str:
    """Return the metrics of all scenarios as one CSV with a leading column `scenario`."""
    lines: list[str] = []
    for name, done in scenarios.items():
        head, *rows = table_text("metrics", done.judgement.metrics).splitlines()
        lines += [] if lines else [f"scenario,{head}"]
        lines += [f"{name},{row}" for row in rows]
    return "\n".join(lines) + "\n"


def compare(scenarios: Mapping[str, Evaluation]) -> Picture:
    """Draw AUROC and FAR of the gates per scenario, the paper's figures beside ours."""
    cut = cut_maps(scenarios)
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    columns = {"scenario": np.array([name for name in cut for _ in _COMPARED])}
    columns["signal"] = np.array(list(_COMPARED) * len(cut))
    for ax, key, label, at in zip(
        figure.subplots(1, 2), ("auroc", "far"), ("AUROC, all labelled frames", "FAR, test split"),
        ((1, 2), (3, 4)), strict=True,
    ):  # fmt: skip
        groups = {}
        for signal in _COMPARED:
            rows = [metric_row(done.judgement, signal) for done in cut.values()]
            names = (key, f"{key}_lo", f"{key}_hi")
            groups[signal] = np.array([[row[n] for n in names] for row in rows], dtype=float)
        paper = np.array([PAPER_TABLE_2.get(name, (np.nan,) * 5) for name in cut], dtype=float)
        reference = {"top1": paper[:, at[0]], "tao_rank": paper[:, at[1]]}
        plots.scenario_dots(groups, tuple(cut), reference=reference, label=label, ax=ax)
        if (legend := ax.get_legend()) is not None:
            legend.remove()
        stacked = np.stack([groups[signal] for signal in _COMPARED], axis=1).reshape(-1, 3)
        columns |= {f"{key}{end}": stacked[:, i] for i, end in enumerate(("", "_lo", "_hi"))}
    lines = figure.axes[0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside upper center", ncol=5, frameon=False, fontsize=8)
    caption = (
        "Bars: 95 % block-bootstrap intervals. Hollow diamonds: the paper's figures for the best "
        "similarity and for TAO, on its own recording. FAR: each signal at its own frozen "
        "threshold, without abstaining."
    )
    return picture(figure, "mapout", "Map-out scenarios", caption, csv_text(columns))


def maps(scenarios: Mapping[str, Evaluation]) -> Picture:
    """Draw the verdict map of every scenario."""
    n = len(scenarios)
    across = min(n, 2)
    drawn = [part for done in scenarios.values()
             for part in (done.judgement.map_m, done.judgement.query_m)]  # fmt: skip
    wide, high = plots.map_size(*drawn, wide_in=5.4, most_in=4.8)
    figure = Figure(figsize=(wide * across, high * (-(-n // across))), layout="constrained")
    axes = figure.subplots(-(-n // across), across, squeeze=False).ravel()
    heads = ("scenario", "frame", "true_x_m", "true_y_m", "x_m", "y_m", "outcome")
    parts: dict[str, list[np.ndarray]] = {head: [] for head in heads}
    for ax, (name, done) in zip(axes, scenarios.items(), strict=False):
        judgement = done.judgement
        test = judgement.splits.test.frame
        columns = ("x_m", "y_m")
        matched = np.stack([judgement.verdicts[c][test] for c in columns], axis=1).astype(float)
        plots.verdict_map(
            judgement.map_m, judgement.query_m[test], matched, judgement.outcome[test], ax=ax
        )
        ax.set_title(name, fontsize=10)
        behind = (
            np.full(len(test), name), test, *judgement.query_m[test].T, *matched.T,
            judgement.outcome[test],
        )  # fmt: skip
        for head, values in zip(heads, behind, strict=True):
            parts[head].append(values)
    for ax in axes[n:]:
        ax.set_axis_off()
    csv = csv_text({key: np.concatenate(values) for key, values in parts.items()})
    caption = "Test frames of every scenario at their true positions, by what the verdict led to."
    return picture(figure, "maps", "Where it was right and wrong", caption, csv)
