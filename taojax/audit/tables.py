"""The judge's tables as column -> values, in the layout of data_specs/, and as text."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from taojax.audit import calibration, metrics, risk
from taojax.audit.conformal import Promise, conformal_threshold, realised
from taojax.audit.labels import CalibrationSplit, Splits, TestSplit
from taojax.config import AuditConfig
from taojax.decisions import plain
from taojax.files.specs import load_spec
from taojax.files.tables import format_number, table_text
from taojax.risk import Risk

NAN = float("nan")
FUSED = "fused"
PROBABILITIES = (*calibration.LOGISTIC, FUSED)
"""Fitted models of being off the map: rows of metrics.csv that are told of the test half alone."""

RADII_M = (2.5, 5.0, 10.0)
"""The radii of the paper's Table 1."""

_STATISTICS = ("auroc", "aupr_out", "aupr_in", "far_at_95")

Table = dict[str, np.ndarray]


def from_rows(name: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return rows as columns in the order of a spec; what a row leaves out is blank."""
    table = {}
    for column in load_spec(name)["columns"]:
        is_text = column.get("type") == "text"
        values = [row.get(column["name"], "" if is_text else NAN) for row in rows]
        table[column["name"]] = np.array(values, dtype=object if is_text else float)
    return table


def separation_row(
    signal: Float[np.ndarray, " n"],
    is_out: Bool[np.ndarray, " n"],
    weights: Float[np.ndarray, "b n"],
    suffix: str = "",
) -> dict[str, float]:
    """Return AUROC, both AUPR and FAR@95 with their intervals; empty with one class.

    Args:
        signal: of labelled frames.
        is_out: their class.
        weights: bootstrap resamples of the same frames.
        suffix: appended to every name.
    """
    if is_out.all() or not is_out.any():
        return {}
    point = (
        metrics.auroc(signal, is_out),
        *metrics.aupr(signal, is_out),
        metrics.far_at_95(signal, is_out),
    )
    samples = metrics.weighted_separation(signal, is_out, weights)
    row = {}
    for name, value, drawn in zip(_STATISTICS, point, samples, strict=True):
        row[f"{name}{suffix}"] = value
        row[f"{name}{suffix}_lo"], row[f"{name}{suffix}_hi"] = metrics.interval(drawn)
    return row


def _with_interval(name: str, value: float, samples: np.ndarray) -> dict[str, float]:
    low, high = metrics.interval(samples)
    return {name: value, f"{name}_lo": low, f"{name}_hi": high}


def operating_row(
    test: TestSplit, name: str, threshold: float, weights: Float[np.ndarray, "b n"]
) -> dict[str, float]:
    """Return FAR, FRR and the median delay at a frozen threshold, with their intervals.

    Args:
        test: held-out frames.
        name: the signal.
        threshold: frozen; NaN gives an empty row.
        weights: bootstrap resamples of all frames of the split. An exit is drawn as often as
            its first map-out frame.
    """
    if np.isnan(threshold):
        return {}
    point = metrics.operate(test, name, threshold)
    accepted = (test.signals[name] <= threshold).astype(float)
    far = metrics.weighted_mean(accepted[test.is_out], weights[:, test.is_out])
    frr = metrics.weighted_mean(1.0 - accepted[test.is_in], weights[:, test.is_in])
    row = {"threshold": threshold, "n_censored": float(point.is_censored.sum())}
    row |= _with_interval("far", point.far, far) | _with_interval("frr", point.frr, frr)
    if point.delays.size:
        delays, first = point.delays.astype(float), metrics.find_exits(test.label).first
        drawn = metrics.weighted_median(delays, weights[:, first])
        row |= _with_interval("delay_frames", float(np.median(delays)), drawn)
    return row


def probability_row(
    test: TestSplit, name: str, weights: Float[np.ndarray, "b n"]
) -> dict[str, float]:
    """Return ECE and Brier score of a fitted probability, with their intervals."""
    known = test.is_in | test.is_out
    probability, is_out = test.signals[name][known], test.is_out[known]
    if not known.any() or np.isnan(probability).any():
        return {}
    once, drawn = np.ones((1, int(known.sum()))), weights[:, known]
    square = (probability - is_out) ** 2
    point = float(calibration.ece(probability, is_out, once)[0])
    row = _with_interval("ece", point, calibration.ece(probability, is_out, drawn))
    return row | _with_interval("brier", float(square.mean()), metrics.weighted_mean(square, drawn))


def _counts(split: CalibrationSplit | TestSplit, suffix: str) -> dict[str, float]:
    n_in, n_out = float(split.is_in.sum()), float(split.is_out.sum())
    prevalence = n_out / (n_in + n_out) if n_in + n_out else NAN
    return {f"n_in{suffix}": n_in, f"n_out{suffix}": n_out, f"prevalence{suffix}": prevalence}


def metrics_table(
    signals: Mapping[str, np.ndarray],
    label: Shaped[np.ndarray, " t"],
    splits: Splits,
    answers: risk.Answers,
    config: AuditConfig,
    seed: int,
) -> Table:
    """Measure every signal, then the fitted probabilities.

    Args:
        signals: signal -> (t,) over the whole run, in the order of the rows.
        label: per frame.
        splits: of the same signals and of those `PROBABILITIES` that are to be measured.
        answers: right or wrong, of all frames.
        config: thresholds, the share that may be wrong, and resamples.
        seed: of the bootstrap.
    """
    test, n_test = splits.test, len(splits.test.frame)
    whole = metrics.block_weights(len(label), config.block_frames, config.n_bootstrap, seed)
    held = metrics.block_weights(n_test, config.block_frames, config.n_bootstrap, seed)
    known, known_test = label != "grey", test.is_in | test.is_out
    n_in, n_out = float((label == "in_map").sum()), float((label == "map_out").sum())
    prevalence = n_out / (n_in + n_out) if n_in + n_out else NAN
    rows = []
    probabilities = [name for name in PROBABILITIES if name in test.signals]
    for name in (*signals, *probabilities):
        is_probability = name in probabilities
        row: dict[str, Any] = {"signal": name} | _counts(test, "_test")
        row["n_exits"] = float(len(metrics.find_exits(test.label).first))
        if not is_probability:
            row |= {"n_in": n_in, "n_out": n_out, "prevalence": prevalence}
            row |= separation_row(
                np.asarray(signals[name], dtype=float)[known], (label == "map_out")[known],
                whole[:, known],
            )  # fmt: skip
        values = test.signals[name][known_test]
        if not np.isnan(values).any():
            row |= separation_row(
                values, test.is_out[known_test], held[:, known_test], suffix="_test"
            )
        threshold = calibration.sigma_threshold(
            splits.calibration, name, config.sigmas, is_probability=is_probability
        )
        row |= operating_row(test, name, threshold, held)
        own = answers.of(name)
        seen, tested = (own.at(half.frame) for half in (splits.calibration, test))
        row |= risk.risk_row(test.signals[name], tested)
        row |= risk.level_row(
            splits.calibration.signals[name], seen, test.signals[name], tested, config.max_wrong
        )
        rows.append(row | (probability_row(test, name, held) if is_probability else {}))
    return from_rows("metrics", rows)


def promised(split: CalibrationSplit, name: str, config: AuditConfig) -> Promise:
    """Return what the conformal rule promises for one signal at the configured level."""
    return conformal_threshold(
        split,
        name,
        alpha=config.alpha,
        confidence=config.confidence,
        block_frames=config.block_frames,
    )


def conformal_table(names: Sequence[str], splits: Splits, config: AuditConfig) -> Table:
    """Promise a false acceptance rate for every signal, and say what came of it on the test split.

    Args:
        names: signals, the fitted probability not among them.
        splits: calibration frames make the promise, test frames keep it or not.
        config: alpha, confidence and block length.
    """
    rows = []
    for name in names:
        promise = promised(splits.calibration, name, config)
        is_promised = np.isfinite(promise.threshold)
        rows.append(
            {
                "signal": name,
                "alpha": promise.alpha,
                "confidence": promise.confidence,
                "block_frames": config.block_frames,
                "n_blocks": promise.n_blocks,
                "least_alpha": promise.least_alpha,
                "threshold": promise.threshold if is_promised else NAN,
                "far": realised(splits.test, name, promise) if is_promised else NAN,
            }
        )
    return from_rows("conformal", rows)


def verdict_table(
    verdicts: Mapping[str, np.ndarray],
    answers: risk.Answers,
    frames: Int[np.ndarray, " n"],
    risks: Mapping[str, Risk],
    config: AuditConfig,
    seed: int,
) -> Table:
    """Count right and wrong among the accepted test answers, and the accepted among the right.

    Args:
        verdicts: columns of verdicts.csv, all frames.
        answers: right or wrong, of the test frames.
        frames: the test frames.
        risks: verdict -> the numbers it rests on.
        config: block length and resamples.
        seed: of the bootstrap.
    """
    weights = metrics.block_weights(len(frames), config.block_frames, config.n_bootstrap, seed)
    rows = []
    for name, column in (("now", "verdict_now"), ("final", "verdict")):
        own = answers.now if name == "now" else answers.final
        accepted = np.asarray(verdicts[column])[frames] == "accept"
        right, wrong = accepted & own.is_right, accepted & own.is_wrong
        counted, known = right | wrong, own.is_right
        row: dict[str, Any] = {
            "verdict": name, "accepted": counted.sum(), "right": right.sum(), "wrong": wrong.sum(),
            "right_total": known.sum(), "max_wrong": risks[name].max_wrong,
            "promise": risks[name].promise,
        }  # fmt: skip
        for share, of, among in (("wrong", wrong, counted), ("recall", right, known)):
            if among.any():
                drawn = metrics.weighted_mean(of[among].astype(float), weights[:, among])
                value = "wrong_share" if share == "wrong" else "recall"
                row[value] = of[among].mean()
                row[f"{share}_lo"], row[f"{share}_hi"] = metrics.interval(drawn)
        rows.append(row)
    return from_rows("verdict_table", rows)


def risk_coverage_table(
    signals: Mapping[str, np.ndarray], answers: risk.Answers, names: Sequence[str]
) -> Table:
    """Return the risk-coverage curve of every signal over the test answers, in steps of 1 %.

    Args:
        signals: signal -> (n,) of the test frames.
        answers: right or wrong, of the same.
        names: which.
    """
    rows = []
    for name in names:
        coverage, share = risk.risk_coverage(signals[name], answers.of(name))
        rows += [
            {"signal": name, "coverage": c, "wrong_share": w}
            for c, w in zip(coverage, share, strict=True)
        ]
    return from_rows("risk_coverage", rows)


def micro_table(
    signals: Mapping[str, np.ndarray],
    nearest_m: Float[np.ndarray, " t"],
    config: AuditConfig,
    seed: int,
) -> Table:
    """Measure every signal under strict labels at r_in / 2 and r_in, on all frames."""
    weights = metrics.block_weights(len(nearest_m), config.block_frames, config.n_bootstrap, seed)
    rows = []
    for radius in (config.r_in_m / 2, config.r_in_m):
        is_out = nearest_m > radius
        counts = {"radius_m": radius, "n_in": (~is_out).sum(), "n_out": is_out.sum()}
        for name, values in signals.items():
            row: dict[str, Any] = {"signal": name} | counts
            if is_out.any() and not is_out.all():
                values = np.asarray(values, dtype=float)
                drawn = metrics.weighted_separation(values, is_out, weights).auroc
                row |= _with_interval("auroc", metrics.auroc(values, is_out), drawn)
            rows.append(row)
    return from_rows("micro", rows)


def recall_table(curves: Mapping[float, np.ndarray], nearest_m: Float[np.ndarray, " t"]) -> Table:
    """Count answerable queries and recall@1/5/10/100 over all of them.

    Args:
        curves: radius [m] -> recall@1..K.
        nearest_m: distance of each query to the nearest map pose, metres.
    """
    rows = []
    for radius, curve in curves.items():
        row = {"radius_m": radius, "answerable": (nearest_m <= radius).sum(), "n": len(nearest_m)}
        rows.append(row | {f"r_at_{k}": curve[min(k, len(curve)) - 1] for k in (1, 5, 10, 100)})
    return from_rows("recall", rows)


def errors_table(
    error_m: Float[np.ndarray, " t"],
    groups: Mapping[str, Bool[np.ndarray, " t"]],
    within_m: float,
) -> Table:
    """Summarise localisation errors.

    Args:
        error_m: metres; NaN = no pose.
        groups: name -> which frames.
        within_m: an error up to this counts as located.
    """
    rows = []
    for name, chosen in groups.items():
        error = error_m[chosen & np.isfinite(error_m)]
        row: dict[str, Any] = {"frames": name, "n_in": chosen.sum(), "n": len(error)}
        if error.size:
            row["median_m"], row["p95_m"] = np.percentile(error, (50, 95))
            row["share_within"] = np.mean(error <= within_m)
        rows.append(row)
    return from_rows("errors", rows)


def _short(name: str, table: Mapping[str, np.ndarray]) -> tuple[list[str], list[list[str]]]:
    columns = load_spec(name)["columns"]
    texts = []
    for column in columns:
        values, kind = table[column["name"]], column.get("type")
        if kind == "text":
            texts.append([str(v) for v in values])
        elif kind == "int":
            texts.append([format_number(v, column) for v in values])
        else:
            texts.append(["" if np.isnan(v) else plain(v) for v in values])
    return [column["name"] for column in columns], [list(row) for row in zip(*texts, strict=True)]


def to_markdown(name: str, table: Mapping[str, np.ndarray]) -> str:
    """Return a table of a spec as Markdown, four significant digits."""
    head, rows = _short(name, table)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def to_latex(name: str, table: Mapping[str, np.ndarray]) -> str:
    """Return a table of a spec as LaTeX with booktabs rules, four significant digits."""
    head, rows = _short(name, table)
    head, *rows = [[cell.replace("_", r"\_") for cell in line] for line in (head, *rows)]
    body = "\n".join(" & ".join(row) + r" \\" for row in rows)
    return (
        f"\\begin{{tabular}}{{{'l' * len(head)}}}\n\\toprule\n{' & '.join(head)} \\\\\n"
        f"\\midrule\n{body}\n\\bottomrule\n\\end{{tabular}}\n"
    )


def as_files(
    name: str, table: Mapping[str, np.ndarray], called: str | None = None
) -> dict[str, str]:
    """Return a table of a spec as CSV, Markdown and LaTeX under `tables/`, perhaps renamed."""
    called = called or name
    return {
        f"tables/{called}.csv": table_text(name, table),
        f"tables/{called}.md": to_markdown(name, table),
        f"tables/{called}.tex": to_latex(name, table),
    }
