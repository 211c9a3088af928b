"""The main numbers as a small table that a paper or a README can hold."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from taojax.audit.counts import count_files
from taojax.audit.judgement import Judgement
from taojax.audit.words import MAIN, metric_row
from taojax.verdicts import plain

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
