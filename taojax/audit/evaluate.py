"""Judge a sealed run and write what was found into its folder, a table to paste included."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taojax.audit import figures, report, tables
from taojax.audit.graph import in_brief
from taojax.audit.judgement import Evaluation, Judgement, judge
from taojax.audit.labels import Truth, read_truth
from taojax.audit.own_map import in_truth
from taojax.audit.summary_text import MAIN, count_files, find_words, metric_row
from taojax.config import Config
from taojax.decisions import decide, plain
from taojax.files.pose_graph_io import as_verdicts
from taojax.files.records import read_run
from taojax.files.specs import write_atomically
from taojax.files.tables import read_table, table_text
from taojax.risk import to_toml

__all__ = ["Evaluation", "evaluate"]

_COLUMNS = {
    "auroc": "AUROC, all",
    "far_at_95": "FAR at 95 %, all",
    "auroc_test": "AUROC, test",
    "far": "FAR, frozen",
    "frr": "FRR, frozen",
    "delay_frames": "delay [frames]",
}
"""Column of metrics.csv -> its heading; those with an interval print it."""


def _cell(row: Mapping[str, Any], name: str) -> str:
    value, low, high = (row[f"{name}{end}"] for end in ("", "_lo", "_hi"))
    if np.isnan(value):
        return "--"
    if name == "delay_frames":
        return plain(value)
    # Ends that agree are no interval: see words.span.
    return f"{value:.3f} [{low:.3f}, {high:.3f}]" if low < high else f"{value:.3f}"


def _about(judgement: Judgement) -> str:
    row = metric_row(judgement, "fused")
    audit = judgement.config.audit
    return (
        f"In-map within {audit.r_in_m:g} m, map-out beyond {audit.r_out_m:g} m; test split: "
        f"{int(row['n_in_test'])} in-map and {int(row['n_out_test'])} map-out frames; thresholds "
        "frozen on the calibration split; 95 % block-bootstrap intervals; seal "
        f"{str(judgement.manifest['seal'])[:12]}"
    )


def _latex(head: Sequence[str], rows: Sequence[Sequence[str]], about: str, command: str) -> str:
    def line(cells: Sequence[str]) -> str:
        return " & ".join(c.replace("_", r"\_").replace("%", r"\%") for c in cells) + r" \\"

    return "\n".join(
        [
            f"% {about}. Made by: {command}",
            r"% Needs \usepackage{booktabs}.",
            rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
            *(r"\toprule", line(head), r"\midrule", *map(line, rows), r"\bottomrule"),
            r"\end{tabular}",
            "",
        ]
    )


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]], about: str, command: str) -> str:
    rule = ["---", *["---:"] * (len(head) - 1)]
    lines = ["| " + " | ".join(cells) + " |" for cells in (head, rule, *rows)]
    return "\n".join([*lines, "", f"{about}. Made by `{command}`.", ""])


def paste_files(judgement: Judgement, command: str) -> dict[str, str]:
    """Return the main signals as Markdown and LaTeX, and the counts behind the verdicts.

    Args:
        judgement: of the run.
        command: what made it; stands below the table of signals or in a comment.

    Returns:
        Path under the run folder, in `tables/` -> text.
    """
    head = ["signal", *_COLUMNS.values()]
    found = [(name, metric_row(judgement, name)) for name in MAIN]
    rows = [[name, *(_cell(row, column) for column in _COLUMNS)] for name, row in found]
    about = _about(judgement)
    return {
        "tables/main.md": _markdown(head, rows, about, command),
        "tables/main.tex": _latex(head, rows, about, command),
    } | count_files(judgement)


def _command(run: Path, truth: Path, config: Config) -> str:
    audit = config.audit
    return (
        f"taojax evaluate {run} --truth {truth} --r-in {audit.r_in_m:g} --r-out {audit.r_out_m:g}"
    )


def _settings(judgement: Judgement, truth: Truth) -> str:
    """Return what the judge was told, so that a verdict can be repeated."""
    audit = judgement.config.audit
    facts = {
        "schema": 1,
        "run_seal": judgement.manifest["seal"],
        "truth_sha256": truth.sha256,
        "gap_frames": judgement.config.stream.window,
        "seed": judgement.config.seed,
        "audit": {f.name: getattr(audit, f.name) for f in dataclasses.fields(audit)},
        "probability": judgement.detector.note,
        "promise": {
            "now": judgement.calibration.now.promise,
            "final": judgement.calibration.final.promise,
        },
    }
    return json.dumps(facts, indent=2) + "\n"


def _labels(judgement: Judgement) -> tables.Table:
    return {
        "frame": judgement.signals["frame"],
        "label": judgement.label,
        "nearest_m": judgement.nearest_m,
        "split": judgement.splits.name,
    }


def evaluate(run: Path, truth: Path, config: Config, *, out: Path | None = None) -> Evaluation:
    """Judge a sealed run against the truth and write labels, verdicts, tables and report.

    Judging again replaces the judge's files, each at once; the sealed ones are never touched.

    Args:
        run: folder with a sealed run.
        truth: the truth folder of the same recording.
        config: radii, split, thresholds, resamples and seed.
        out: where to write; the run folder if omitted.

    Returns:
        What the command line prints and the summary over scenarios needs.

    Raises:
        InputError: broken seal, unreadable or foreign truth, folder that cannot be written.
    """
    sealed = read_run(run)
    known = read_truth(truth, len(sealed.signals["frame"]))
    moved, nearest = sealed, None
    if "own_gap_m" in sealed.manifest:
        moved, nearest = in_truth(sealed, known, read_table(run / "odometry.csv", "query_odometry"))
    judgement = judge(moved, known, config, nearest)
    decided = judgement.verdicts
    if moved is not sealed:
        # The same verdicts, with answers where the run has put them.
        decided = decide(judgement.calibration, sealed.signals, sealed.delayed)
    numbers = as_verdicts("verdicts.csv", decided, judgement.calibration)
    graph = in_brief(run, sealed, numbers, known, config.audit, config.stream.window)
    pictures = (*([graph.picture] if graph.picture else []), *figures.draw(judgement))
    files: dict[str, str | bytes] = {
        "labels.csv": table_text("labels", _labels(judgement)),
        "verdicts.csv": table_text("verdicts", decided),
        "metrics.csv": table_text("metrics", judgement.metrics),
        "audit.json": _settings(judgement, known),
    }
    files["calibration.toml"] = to_toml(judgement.calibration)
    files |= tables.as_files("verdict_table", judgement.accepted, "verdicts")
    files["tables/risk_coverage.csv"] = table_text("risk_coverage", judgement.risk_coverage)
    for name in ("metrics", "recall", "micro", "errors", "conformal"):
        files |= tables.as_files(name, getattr(judgement, name))
    for drawn in pictures:
        files |= figures.as_files(drawn)
    found = find_words(judgement)
    # What was found first, then what it does to the graph.
    at = 1 if graph.is_lead else len(found)
    said = (graph.sentence,) if graph.sentence else ()
    done = Evaluation(
        run=run,
        judgement=judgement,
        sentences=(*found[:at], *said, *found[at:]),
        command=_command(run, truth, config),
        graph=said if graph.is_lead else (),
        warnings=said if graph.is_alarm else (),
    )
    files |= paste_files(judgement, done.command)
    files["report.html"] = report.run_page(done, pictures)
    folder = out or run
    for name, content in files.items():
        write_atomically(folder / name, content)
    return done
