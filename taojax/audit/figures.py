"""Draw a judgement: each figure as PNG, SVG and the CSV behind it."""

import io
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from taojax import plots
from taojax.audit import calibration
from taojax.audit.judgement import Evaluation, Judgement
from taojax.files.specs import load_spec

TRACED = ("top1", "top1_w10", "velocity", "tao", "probability_wrong")
"""Signals that are drawn."""

_OF_VERDICTS = ("probability_wrong",)
"""Those of them that stand in verdicts.csv."""


OURS = ("probability_wrong", "tao")
"""Those drawn with thicker lines."""

STRICT = ("top1", "velocity", "c_geom", "tao", "a_aniso")
"""Signals drawn under strict labels; h_proxy would lie on c_geom, of which it is a logarithm."""


class Picture(NamedTuple):
    """A figure, saved three ways."""

    name: str
    title: str
    caption: str
    png: bytes
    svg: bytes
    csv: str


def csv_text(columns: Mapping[str, np.ndarray]) -> str:
    """Return columns as CSV, numbers with six significant digits, NaN blank."""
    texts = []
    for values in columns.values():
        if values.dtype.kind in "fc":
            texts.append(["" if np.isnan(v) else f"{v:.6g}" for v in values])
        else:
            texts.append([str(v) for v in values])
    rows = [",".join(columns), *(",".join(row) for row in zip(*texts, strict=True))]
    return "\n".join(rows) + "\n"


def picture(figure: Figure, name: str, title: str, caption: str, csv: str) -> Picture:
    """Save a figure in memory; the same figure gives the same bytes."""
    png, svg = io.BytesIO(), io.BytesIO()
    with rc_context({"svg.hashsalt": "taojax"}):
        figure.savefig(png, format="png", dpi=130, metadata={"Software": None})
        # The layout is found; finding it again for the second file would cost as much again.
        figure.set_layout_engine("none")
        figure.savefig(svg, format="svg", metadata={"Date": None})
    return Picture(name, title, caption, png.getvalue(), svg.getvalue(), csv)


def retrieval(judgement: Judgement) -> Picture:
    """Draw recall over the number of candidates."""
    figure = Figure(figsize=(5.6, 3.6), layout="constrained")
    plots.retrieval_curve(judgement.recall_curves, ax=figure.subplots())
    n = len(next(iter(judgement.recall_curves.values())))
    columns = {"k": np.arange(1, n + 1)}
    columns |= {f"recall_{r:g}m": curve for r, curve in judgement.recall_curves.items()}
    caption = (
        f"Share of all {len(judgement.label)} queries, answerable or not, with a right place "
        "among the K best candidates."
    )
    return picture(figure, "retrieval", "Retrieval", caption, csv_text(columns))


def _traces(judgement: Judgement) -> dict[str, np.ndarray]:
    return {
        name: judgement.verdicts[name] if name in _OF_VERDICTS
        else judgement.signals[name].astype(float)
        for name in TRACED
    }  # fmt: skip


def diagnostics(judgement: Judgement) -> Picture:
    """Draw the main signals over time."""
    traces = _traces(judgement)
    unit = {c["name"]: c.get("unit", "1") for c in load_spec("signals")["columns"]}
    table = judgement.metrics
    threshold = dict(zip(table["signal"], table["threshold"], strict=True))
    threshold["probability_wrong"] = judgement.calibration.final.level
    start = int((judgement.splits.name != "test").sum())
    figure = Figure(figsize=(8.6, 7.2), layout="constrained")
    axes = figure.subplots(len(traces), sharex=True)
    for ax, (name, values) in zip(axes, traces.items(), strict=True):
        suffix = "" if unit.get(name, "1") == "1" else f" [{unit[name]}]"
        plots.signal_trace(
            values, judgement.label == "map_out", name=name + suffix,
            threshold=float(threshold[name]), test_start=start, ax=ax,
        )  # fmt: skip
    axes[-1].set_xlabel("query frame")
    figure.align_ylabels()
    lines: dict[str, Any] = {}
    for ax in axes:  # The first may lack a line, such as a threshold.
        handles, labels = ax.get_legend_handles_labels()
        lines = dict(zip(labels, handles, strict=True)) | lines
    figure.legend(
        lines.values(), lines.keys(), loc="outside upper center", ncol=4, frameon=False, fontsize=8
    )
    columns = {
        "frame": judgement.signals["frame"].astype(int),
        "t_s": judgement.signals["t_s"],
        "label": judgement.label,
        "split": judgement.splits.name,
    }
    caption = (
        "Shaded: truly off the map. Dashed: threshold, frozen on the calibration split. Dotted: "
        "start of the test split. Larger means more likely off the map; the highest half per "
        "cent of values may leave the panel. A signal without a unit is dimensionless; "
        "probability_wrong is that of the final answer, and its line is the level up to which "
        "answers are accepted."
    )
    return picture(figure, "diagnostics", "Signals over time", caption, csv_text(columns | traces))


def verdict_map(judgement: Judgement) -> Picture:
    """Draw the test frames on the map, coloured by what the verdict led to."""
    test = judgement.splits.name == "test"
    matched = np.stack([judgement.verdicts["x_m"], judgement.verdicts["y_m"]], axis=1)
    wrong = matched[test & (judgement.outcome == "accepted_wrong")]
    size = plots.map_size(judgement.map_m, judgement.query_m[test], wrong)
    figure = Figure(figsize=size, layout="constrained")
    plots.verdict_map(
        judgement.map_m, judgement.query_m[test], matched[test], judgement.outcome[test],
        ax=figure.subplots(),
    )  # fmt: skip
    columns = {
        "frame": judgement.signals["frame"].astype(int),
        "split": judgement.splits.name,
        "true_x_m": judgement.query_m[:, 0],
        "true_y_m": judgement.query_m[:, 1],
        "x_m": matched[:, 0],
        "y_m": matched[:, 1],
        "error_m": judgement.error_m,
        "outcome": judgement.outcome,
    }
    within = 2 * judgement.config.audit.r_in_m
    caption = (
        "Test frames at their true positions. Wrong place: off the map, or more than "
        f"{within:g} m from the truth; a thin line leads to the place that was answered."
    )
    return picture(figure, "map", "Where it was right and wrong", caption, csv_text(columns))


def _labelled(judgement: Judgement) -> tuple[str, dict[str, np.ndarray], np.ndarray]:
    """Return frames with both classes: the test split if it can, else the whole run."""
    test = judgement.splits.test
    known = test.is_in | test.is_out
    if test.is_in.any() and test.is_out.any():
        chosen = {name: np.asarray(test.signals[name], dtype=float)[known] for name in TRACED}
        chosen = {name: v for name, v in chosen.items() if not np.isnan(v).any()}
        return f"test split, n = {int(known.sum())}", chosen, test.is_out[known]
    known = judgement.label != "grey"
    # The probability was fitted on part of the whole run, so it is left out here.
    chosen = {name: judgement.signals[name].astype(float)[known] for name in TRACED[:-1]}
    basis = f"all labelled frames, n = {int(known.sum())}, for the test split holds one class"
    return basis, chosen, (judgement.label == "map_out")[known]


def _stacked(parts: Mapping[str, tuple[np.ndarray, np.ndarray]], x: str, y: str) -> str:
    names = np.concatenate([[name] * len(a) for name, (a, _) in parts.items()])
    right, up = (np.concatenate([part[i] for part in parts.values()]) for i in (0, 1))
    return csv_text({"signal": names, x: right, y: up})


def roc_and_pr(judgement: Judgement) -> tuple[Picture, ...]:
    """Draw ROC and precision-recall curves; none with one class."""
    from sklearn.metrics import precision_recall_curve, roc_curve

    basis, chosen, is_out = _labelled(judgement)
    if is_out.all() or not is_out.any():
        return ()
    roc, pr = {}, {}
    for name, values in chosen.items():
        false_alarm, detected, _ = roc_curve(is_out, values)
        precision, recall, _ = precision_recall_curve(is_out, values)
        roc[name], pr[name] = (false_alarm, detected), (recall, precision)
    pictures = []
    for name, title, lines, x, y in (
        ("roc", "ROC", roc, "in-map frames rejected (FRR)", "map-out frames rejected (1 - FAR)"),
        ("pr", "Precision and recall", pr, "map-out frames rejected (recall)",
         "rejected frames truly map-out (precision)"),
    ):  # fmt: skip
        figure = Figure(figsize=(4.8, 4.7), layout="constrained")
        ax = figure.subplots()
        plots.curves(lines, x=x, y=y, ax=ax, strong=OURS)
        coin = ([0, 1], [0, 1]) if name == "roc" else ([0, 1], [is_out.mean()] * 2)
        ax.plot(*coin, color=plots.PALE, linestyle="--", linewidth=0.8, zorder=1)
        share = f"prevalence of map-out {is_out.mean():.2f}; thin dashes: a coin"
        csv = _stacked(lines, *(("frr", "detected") if name == "roc" else ("recall", "precision")))
        pictures.append(picture(figure, name, title, f"{basis}; {share}.", csv))
    return tuple(pictures)


def strict(judgement: Judgement) -> tuple[Picture, ...]:
    """Draw ROC curves under the strict labels of the micro-scale audit; none with one class."""
    from sklearn.metrics import roc_curve

    table = judgement.micro
    radii = [r for r in np.unique(table["radius_m"])
             if (judgement.nearest_m <= r).any() and (judgement.nearest_m > r).any()]  # fmt: skip
    if not radii:
        return ()
    figure = Figure(figsize=(4.6 * len(radii), 4.9), layout="constrained")
    parts = []
    for ax, radius in zip(figure.subplots(1, len(radii), squeeze=False)[0], radii, strict=True):
        is_out, lines = judgement.nearest_m > radius, {}
        for name in STRICT:
            false_alarm, detected, _ = roc_curve(is_out, judgement.signals[name].astype(float))
            at = (table["radius_m"] == radius) & (table["signal"] == name)
            lines[f"{name} ({float(table['auroc'][at][0]):.3f})"] = (false_alarm, detected)
            parts.append((radius, name, false_alarm, detected))
        ours = tuple(label for label in lines if label.startswith("tao "))
        x, y = f"frames within {radius:g} m rejected", f"frames beyond {radius:g} m rejected"
        plots.curves(lines, x=x, y=y, ax=ax, strong=ours)
        ax.plot([0, 1], [0, 1], color=plots.PALE, linestyle="--", linewidth=0.8, zorder=1)
    columns = {
        "radius_m": np.concatenate([np.full(len(a), radius) for radius, _, a, _ in parts]),
        "signal": np.concatenate([[name] * len(a) for _, name, a, _ in parts]),
        "rejected_within": np.concatenate([a for *_, a, _ in parts]),
        "rejected_beyond": np.concatenate([b for *_, b in parts]),
    }
    caption = (
        f"All {len(judgement.label)} frames, without a grey zone: a frame is in the map only "
        "strictly within the radius. In brackets the AUROC; dashed: a coin."
    )
    title = "Micro-scale audit: strict labels"
    return (picture(figure, "micro", title, caption, csv_text(columns)),)


def reliability(judgement: Judgement) -> tuple[Picture, ...]:
    """Draw promised against realised probability on the test split, if there is one."""
    test = judgement.splits.test
    known = test.is_in | test.is_out
    probability = test.signals["fused"][known]
    if not known.any() or np.isnan(probability).any():
        return ()
    bins = calibration.reliability(probability, test.is_out[known])
    figure = Figure(figsize=(4.8, 4.8), layout="constrained")
    plots.reliability_diagram(
        bins.promised, bins.realised, bins.n_frames, ax=figure.subplots()
    )  # fmt: skip
    csv = csv_text({"promised": bins.promised, "realised": bins.realised, "n": bins.n_frames})
    caption = f"Test split, n = {int(known.sum())}. {judgement.detector.note}"
    return (picture(figure, "reliability", "Reliability of the probability", caption, csv),)


def draw(judgement: Judgement) -> tuple[Picture, ...]:
    """Draw every figure of one run."""
    return (
        verdict_map(judgement),
        diagnostics(judgement),
        *roc_and_pr(judgement),
        *reliability(judgement),
        retrieval(judgement),
        *strict(judgement),
    )


def as_files(drawn: Picture) -> dict[str, str | bytes]:
    """Return a figure as PNG, SVG and CSV under `figures/`."""
    stem = f"figures/{drawn.name}"
    return {f"{stem}.png": drawn.png, f"{stem}.svg": drawn.svg, f"{stem}.csv": drawn.csv}


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
