"""Every frame counted once, and what each rate counts."""

from typing import Any

import numpy as np
from jaxtyping import Bool

from taojax.audit import bootstrap
from taojax.audit.judgement import Judgement
from taojax.audit.tables import NAN, Table, as_files, from_rows

AMONG = {"FAR": "map-out", "FRR": "in-map"}
"""Rate -> the test frames among which it counts."""

VERDICT_FAR, VERDICT_FRR = "FAR of the verdicts", "FRR of the verdicts"
THRESHOLD_FAR, THRESHOLD_FRR = "FAR at the threshold", "FRR at the threshold"
LEFT_OUT, LEFT_IN = "abstained off the map", "abstained in the map"


def _kinds(judgement: Judgement) -> dict[str, Bool[np.ndarray, " t"]]:
    """Return what can become of a test frame; each is of one kind."""
    verdict = judgement.verdicts["verdict"]
    names = {"accept": "accepted", "reject": "rejected", "abstain": "abstained"}
    return {done: verdict == name for name, done in names.items()}


def counts_table(judgement: Judgement) -> Table:
    """Count every frame of a run once.

    Args:
        judgement: of the run.

    Returns:
        Columns of data_specs/counts.toml.
    """
    label, split = judgement.label, judgement.splits.name
    is_test = split == "test"
    rows = {name: chosen & is_test for name, chosen in _kinds(judgement).items()}
    rows |= {
        "test split": is_test,
        "calibration split": split == "calibration",
        "gap between the splits": split == "gap",
        "all frames": np.full(len(label), True),
    }
    return from_rows(
        "counts",
        [
            {"decided": name, "frames": chosen.sum()}
            | {kind: (chosen & (label == kind)).sum() for kind in ("in_map", "map_out", "grey")}
            for name, chosen in rows.items()
        ],
    )


def _counted(judgement: Judgement) -> list[tuple[str, str, str, Bool[np.ndarray, " t"]]]:
    """Return name, what is counted, among what, and which frames of the run those are."""
    kinds, far, frr = _kinds(judgement), AMONG["FAR"], AMONG["FRR"]
    accepted, rejected = kinds["accepted"], kinds["rejected"]
    left = judgement.verdicts["verdict"] == "abstain"
    is_above = judgement.verdicts["probability_map_out"] > judgement.detector.threshold
    rates = [
        (VERDICT_FAR, "accepted", far, accepted),
        (LEFT_OUT, "abstained", far, left),
        (VERDICT_FRR, "rejected", frr, rejected),
        (LEFT_IN, "abstained", frr, left),
    ]
    if np.isnan(judgement.detector.threshold):
        return rates
    low, high = "probability_map_out at or below the threshold", "probability_map_out above it"
    alone = [(THRESHOLD_FAR, low, far, ~is_above), (THRESHOLD_FRR, high, frr, is_above)]
    return [*rates, *alone]


def rates_table(judgement: Judgement) -> Table:
    """Return what each rate counts, with its interval.

    Args:
        judgement: of the run.

    Returns:
        Columns of data_specs/rates.toml; a rate among no frames is blank.
    """
    test, audit = judgement.splits.test, judgement.config.audit
    n = len(test.frame)
    weights = bootstrap.block_weights(
        n, audit.block_frames, audit.n_bootstrap, judgement.config.seed
    )
    rows = []
    for name, what, among, chosen in _counted(judgement):
        of = test.is_out if among == AMONG["FAR"] else test.is_in
        hit = chosen[test.frame][of].astype(float)
        row: dict[str, Any] = {"rate": name, "counted": what, "among": among}
        row |= {"n": hit.sum(), "n_of": len(hit), "value": hit.mean() if len(hit) else NAN}
        if len(hit):
            drawn = bootstrap.weighted_mean(hit, weights[:, of])
            row["value_lo"], row["value_hi"] = bootstrap.interval(drawn)
        rows.append(row)
    return from_rows("rates", rows)


def rates_of(judgement: Judgement) -> dict[str, dict[str, Any]]:
    """Return the rows of `rates_table` by name.

    Args:
        judgement: of the run.

    Returns:
        Without a frozen threshold the rates at the threshold are missing.
    """
    table = rates_table(judgement)
    rows = zip(*table.values(), strict=True)
    return {str(row[0]): dict(zip(table, row, strict=True)) for row in rows}


def count_files(judgement: Judgement) -> dict[str, str]:
    """Return both tables as CSV, Markdown and LaTeX under `tables/`.

    Args:
        judgement: of the run.
    """
    return as_files("counts", counts_table(judgement)) | as_files("rates", rates_table(judgement))
