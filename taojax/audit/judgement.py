"""Judge a run in memory: from sealed signals and truth to labels, verdicts and tables."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from taojax.audit import calibration, labels, metrics, risk, tables
from taojax.audit.conformal import Promise
from taojax.audit.labels import Truth
from taojax.config import Config
from taojax.decisions import decide
from taojax.files.records import Run, map_of, signal_names
from taojax.risk import Calibration, Detector, for_run, probability, shipped


class Judgement(NamedTuple):
    """All that the judge concludes of one run."""

    config: Config
    manifest: dict[str, Any]
    signals: dict[str, np.ndarray]
    """Column -> (T,), the sealed table."""

    delayed: dict[str, np.ndarray]
    """The same of the final answers' features."""

    map_m: Float[np.ndarray, "m 2"]
    query_m: Float[np.ndarray, "t 2"]
    """True positions, metres."""

    nearest_m: Float[np.ndarray, " t"]
    """Distance to the nearest map pose, metres."""

    error_m: Float[np.ndarray, " t"]
    """Distance from the final answer to the truth, metres; NaN = no answer."""

    answers: risk.Answers
    """Right or wrong, per frame."""

    label: Shaped[np.ndarray, " t"]
    splits: labels.Splits
    """Of the signals and of the fitted probabilities."""

    outcome: Shaped[np.ndarray, " t"]
    """Key of `plots.OUTCOMES` per frame."""

    recall_curves: dict[float, np.ndarray]
    """Radius [m] -> recall@1..K."""

    decided: Shaped[np.ndarray, " t"] | None
    """What led where at run time, with numbers frozen elsewhere, as `outcome`; None where nobody
    decided."""

    verdicts: tables.Table
    metrics: tables.Table
    recall: tables.Table
    micro: tables.Table
    errors: tables.Table
    conformal: tables.Table
    promise: Promise
    """What the conformal rule promises for tao."""

    detector: Detector
    """The frozen numbers behind the probability of being off the map."""

    logistic: dict[str, Detector]
    """The same of the paper's two logistic models."""

    calibration: Calibration
    """All frozen numbers, those behind the verdicts among them."""

    accepted: tables.Table
    """Right and wrong among the accepted, now and finally; tables/verdicts.csv."""

    risk_coverage: tables.Table

    clock_gap_s: float
    """Largest difference between the time stamps of run and truth."""


def _outcomes(verdict: np.ndarray, label: np.ndarray, own: risk.Own) -> np.ndarray:
    """Say of each frame what the verdict led to."""
    accepted = np.where(own.is_wrong, "accepted_wrong", "accepted_in")
    rejected = np.where(label == "map_out", "rejected_out", "rejected_in")
    rejected = np.where(label == "grey", "grey", rejected)
    outcome = np.where(verdict == "accept", accepted, rejected)
    return np.where(verdict == "abstain", "abstained", outcome)


def judge(
    run: Run, truth: Truth, config: Config, nearest_m: Float[np.ndarray, " t"] | None = None
) -> Judgement:
    """Judge a sealed run.

    Args:
        run: verified by `records.read_run`.
        truth: of the same recording.
        config: radii, split, thresholds and resamples; the window sets the gap.
        nearest_m: distance of each frame to the nearest map pose that it may know, metres; to the
            nearest of all when omitted.

    Returns:
        Labels, verdicts and tables.
    """
    audit = config.audit
    map_m = np.stack([run.map_poses["x_m"], run.map_poses["y_m"]], axis=1)
    nearest = labels.nearest_map_distance(truth.xy_m, map_m) if nearest_m is None else nearest_m
    label = labels.label_frames(nearest, audit.r_in_m, audit.r_out_m)
    signals = {name: run.signals[name] for name in signal_names()}

    error, error_now = (
        np.hypot(table[x] - truth.xy_m[:, 0], table[y] - truth.xy_m[:, 1])
        for table, x, y in ((run.delayed, "x_m", "y_m"), (run.signals, "now_x_m", "now_y_m"))
    )
    answers = risk.Answers(*(
        risk.own_answers(own, nearest, audit.wrong_m, audit.r_out_m) for own in (error_now, error)
    ))  # fmt: skip
    share, gap = audit.calibration_share, config.stream.window
    # One splitter makes both halves, of the features of the answers as of the signals.
    base = for_run(shipped(), audit.max_wrong, config.verdict.lag)
    features = {name: run.signals[name] for name in base.now.columns}
    features |= {name: run.delayed[name] for name in base.final.reads + base.map_out.columns}
    first = labels.split_frames(
        signals | features, label, calibration_share=share, gap_frames=gap
    ).calibration
    half = answers.at(first.frame)
    refined = [
        risk.refine(pooled, first, own, audit.max_wrong)
        for pooled, own in ((base.now, half.now), (base.final, half.final))
    ]
    model = calibration.fit(first, base.map_out)
    logistic = {
        name: calibration.fit_plain(first, columns)
        for name, columns in calibration.LOGISTIC.items()
    }
    numbers = Calibration(refined[0], refined[1], model, map_of(run.manifest))
    verdicts = decide(numbers, run.signals, run.delayed)
    # Cut again with the probabilities beside the signals: only the splitter makes the two tables.
    measured = signals | {name: verdicts[name] for name in (risk.NOW, risk.FINAL)}
    with_fused = measured | {name: probability(plain, signals) for name, plain in logistic.items()}
    with_fused[tables.FUSED] = verdicts["probability_map_out"]
    splits = labels.split_frames(
        with_fused | features, label, calibration_share=share, gap_frames=gap
    )
    tested, both = answers.at(splits.test.frame), {"now": refined[0], "final": refined[1]}

    inside, test = label == "in_map", splits.name == "test"
    accepted = verdicts["verdict"] == "accept"
    groups = {
        "test accepted": inside & test & accepted,
        "test all": inside & test,
        "all accepted": inside & accepted,
        "all": inside,
    }
    curves = {r: metrics.recall_curve(run.index, truth.xy_m, map_m, r) for r in tables.RADII_M}
    return Judgement(
        config=config,
        manifest=run.manifest,
        signals=run.signals,
        delayed={name: run.delayed[name] for name in base.final.reads},
        map_m=map_m,
        query_m=truth.xy_m,
        nearest_m=nearest,
        error_m=error,
        label=label,
        splits=splits,
        outcome=_outcomes(verdicts["verdict"], label, answers.final),
        answers=answers,
        decided=None
        if run.decisions is None
        else _outcomes(run.decisions["verdict"], label, answers.final),
        recall_curves=curves,
        verdicts=verdicts,
        metrics=tables.metrics_table(measured, label, splits, answers, audit, config.seed),
        calibration=numbers,
        accepted=tables.verdict_table(
            verdicts, tested, splits.test.frame, both, audit, config.seed
        ),
        risk_coverage=tables.risk_coverage_table(splits.test.signals, tested, tuple(with_fused)),
        recall=tables.recall_table(curves, nearest),
        micro=tables.micro_table(signals, nearest, audit, config.seed),
        conformal=tables.conformal_table(tuple(signals), splits, audit),
        promise=tables.promised(splits.calibration, "tao", audit),
        errors=tables.errors_table(error, groups, audit.wrong_m),
        detector=model,
        logistic=logistic,
        clock_gap_s=float(np.max(np.abs(truth.t_s - run.signals["t_s"]))),
    )


class Evaluation(NamedTuple):
    """A judged run: what the command line prints, and what the summary over scenarios needs."""

    run: Path
    judgement: Judgement
    sentences: tuple[str, ...]
    """What was found, most important first."""

    command: str
    """How to repeat the judging."""

    graph: tuple[str, ...] = ()
    """What the closures do to the graph, where that was measured; some of `sentences`."""

    warnings: tuple[str, ...] = ()
    """Those of them that should alarm."""
