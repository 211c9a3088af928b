"""The paper's protocol: numbers frozen once serve every scenario, beside each scenario's own.

The paper freezes its threshold at 3 sigma of the residuals of frames 0-499 and uses it in all three
scenarios. A threshold is frozen here on these frames against the map that nothing was deleted from;
a logistic model needs frames off the map as well and is fitted on those of the first scenario.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from taojax.audit import calibration, metrics
from taojax.audit.judgement import Evaluation, Judgement
from taojax.audit.labels import TestSplit
from taojax.audit.summary_text import PAPER_TABLE_2, WHOLE, cut_maps, metric_row
from taojax.audit.tables import FUSED, NAN, PROBABILITIES, Table, from_rows, operating_row
from taojax.risk import Detector, probability

COMPARED = ("top1", "velocity", "tao_rank", "tao", *PROBABILITIES)
"""Rows of a scenario: gates, Eq. 1, ours, and the fitted models."""

PAPER_FAR = {"top1": 3, "tao_rank": 4}
"""Signal -> its FAR in `PAPER_TABLE_2`."""


def model_of(judgement: Judgement, name: str) -> Detector:
    """Return the frozen numbers of one of the fitted probabilities."""
    return judgement.detector if name == FUSED else judgement.logistic[name]


def _once(
    name: str, base: Judgement, fitted: Judgement, test: TestSplit
) -> tuple[TestSplit, float]:
    """Return the test frames with a signal as numbers frozen elsewhere see it, and a threshold."""
    if name not in PROBABILITIES:
        sigmas = base.config.audit.sigmas
        return test, calibration.sigma_threshold(base.splits.calibration, name, sigmas)
    model = model_of(fitted, name)
    seen = dict(test.signals) | {name: probability(model, test.signals)}
    return dataclasses.replace(test, signals=seen), model.threshold


def _auroc(test: TestSplit, name: str) -> float:
    known, values = test.is_in | test.is_out, np.asarray(test.signals[name], float)
    if not test.is_in.any() or not test.is_out.any() or np.isnan(values[known]).any():
        return NAN
    return metrics.auroc(values[known], test.is_out[known])


def frozen_table(scenarios: Mapping[str, Evaluation]) -> Table:
    """Measure every compared signal at its own threshold and at the one that was frozen once.

    Args:
        scenarios: name -> judged run; `full` is the map that was not cut, and stands in for the
            first of the others where it is missing.

    Returns:
        Columns of data_specs/frozen.toml; without rows where there is one scenario, for then both
        are one.
    """
    cut = cut_maps(scenarios)
    if len(scenarios) < 2 or not cut:
        return from_rows("frozen", [])
    first = next(iter(cut))
    whole = WHOLE if WHOLE in scenarios else first
    rows = []
    for scenario, done in cut.items():
        judgement = done.judgement
        test, audit = judgement.splits.test, judgement.config.audit
        weights = metrics.block_weights(
            len(test.frame), audit.block_frames, audit.n_bootstrap, judgement.config.seed
        )
        for name in COMPARED:
            own = metric_row(judgement, name)
            row: dict[str, Any] = {"scenario": scenario, "signal": name}
            row |= {key: own[key] for key in _OWN}
            row["once_on"] = first if name in PROBABILITIES else whole
            seen, threshold = _once(name, scenarios[whole].judgement, cut[first].judgement, test)
            found = operating_row(seen, name, threshold, weights)
            row |= {f"once_{key}": found[key] for key in _ONCE if key in found}
            row["once_auroc_test"] = _auroc(seen, name)
            if name in PAPER_FAR and scenario in PAPER_TABLE_2:
                row["paper_far"] = PAPER_TABLE_2[scenario][PAPER_FAR[name]]
            rows.append(row)
    return from_rows("frozen", rows)


_ONCE = ("threshold", "far", "far_lo", "far_hi", "frr", "frr_lo", "frr_hi")
_OWN = ("auroc_test", *_ONCE)


def frozen_words(table: Table) -> list[str]:
    """Say what freezing once changes for Eq. 1 and for ours; nothing without rows."""
    said = []
    for name, called in (("tao_rank", "Eq. 1 (tao_rank)"), ("tao", "tao")):
        chosen = table["signal"] == name
        if not chosen.any():
            continue
        many = lambda column: ", ".join(f"{x:.3f}" for x in table[column][chosen])  # noqa: B023
        paper = table["paper_far"][chosen]
        beside = "" if np.isnan(paper).all() else f"; the paper {many('paper_far')}"
        said.append(
            f"Of the map-out test frames of {', '.join(table['scenario'][chosen])}, {called} "
            f"accepts {many('once_far')} at one threshold, frozen once on the calibration half of "
            f"{table['once_on'][chosen][0]} as the paper does it, and {many('far')} at thresholds "
            f"of each scenario's own half{beside}."
        )
    return said
