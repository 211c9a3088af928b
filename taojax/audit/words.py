"""What was found, in plain sentences."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from taojax.audit.calibration import FALLBACK
from taojax.audit.counts import (
    LEFT_IN,
    LEFT_OUT,
    THRESHOLD_FAR,
    THRESHOLD_FRR,
    VERDICT_FAR,
    VERDICT_FRR,
    rates_of,
)
from taojax.audit.judgement import Evaluation, Judgement
from taojax.audit.opening import TOO_SHORT, UNKNOWN, accepted_row, lines, sentence, summary_lines
from taojax.verdicts import plain

_JOIN_FRAMES = 5  # wrong acceptances this close together are told as one stretch
_MOST_STRETCHES = 3
MAIN = (
    "top1", "top1_w10", "velocity", "tao_rank", "tao", "probability_wrong_now", "probability_wrong",
    "single_view", "joint_features", "fused",
)  # fmt: skip
"""Signals that are told first; the others stand in the files."""

_MOST = 0.5  # beyond this share a rate is called "most"

BLIND = "The calibration split holds no in-map frame, so there is no threshold."
NO_SHIELD = (
    "Here taojax does not protect the map: do not let these closures into a graph. It accepts most "
    "answers given off the map, or more wrong ones than right ones."
)
UNTESTED = (
    "Not tested off the map: the test split holds no map-out frame, so there is no false "
    "acceptance rate. Record a drive that leaves the map in both halves."
)


def metric_row(judgement: Judgement, signal: str) -> dict[str, Any]:
    """Return one row of metrics.csv by the name of its signal."""
    table = judgement.metrics
    at = list(table["signal"]).index(signal)
    return {name: values[at] for name, values in table.items()}


def span(row: Mapping[str, Any], name: str) -> str:
    """Return the interval of a number in words.

    A rate of exactly 0 or 1 is the same in every resample; printing that as an interval of no
    width would promise what the bootstrap cannot know.
    """
    low, high = row[f"{name}_lo"], row[f"{name}_hi"]
    if not np.isfinite(low):
        return "no interval: too few resamples hold both classes"
    if low == high:
        return f"{UNKNOWN}: too few frames differ"
    return f"95 % interval {low:.3f} to {high:.3f}"


def rate(row: Mapping[str, Any], name: str) -> str:
    """Return a number with its interval, as far as both exist."""
    if np.isnan(row[name]):
        return "not defined"
    return f"{row[name]:.3f} ({span(row, name)})"


def _trust(judgement: Judgement) -> list[str]:
    """Say first what a user wants to know; then on what the promise was checked."""
    if not len(judgement.splits.test.frame):
        return [TOO_SHORT]
    row, now = (accepted_row(judgement, name) for name in ("final", "now"))
    said = [sentence(judgement), f"Promised: {row['promise']}."]
    if now["accepted"] or row["accepted"]:
        said.append(
            f"Without waiting, {int(now['accepted'])} test answers are accepted at once, "
            f"{int(now['right'])} of them right."
        )
    return said


def _counts(judgement: Judgement) -> list[str]:
    test, verdict = judgement.splits.test, judgement.verdicts["verdict"]
    n = len(test.frame)
    if n == 0:
        return []
    count = {v: int((verdict[test.frame] == v).sum()) for v in ("accept", "reject", "abstain")}
    off = int((np.asarray(judgement.label)[test.frame] == "map_out").sum())
    return [
        f"Of the {n} test frames ({test.frame[0]} to {test.frame[-1]}), {off} of them off the map, "
        f"taojax accepted {count['accept']}, rejected {count['reject']} and abstained on "
        f"{count['abstain']}."
    ]


def _false_acceptance(judgement: Judgement) -> list[str]:
    if np.isnan(judgement.detector.threshold):
        return [BLIND]
    rates = rates_of(judgement)
    far, left = rates[VERDICT_FAR], rates[LEFT_OUT]
    n, n_out, n_left = (int(x) for x in (far["n"], far["n_of"], left["n"]))
    if not n_out:
        return []
    prevalence = metric_row(judgement, "fused")["prevalence_test"]
    return [
        f"False acceptance rate {rate(far, 'value')}: of {n_out} map-out test frames (prevalence "
        f"{prevalence:.2f}) the verdicts accepted {n}, rejected {n_out - n - n_left} and "
        f"abstained on {n_left}."
    ]


def _false_rejection(judgement: Judgement) -> list[str]:
    row = metric_row(judgement, "fused")
    if np.isnan(judgement.detector.threshold):
        return []
    rates = rates_of(judgement)
    frr, left = rates[VERDICT_FRR], rates[LEFT_IN]
    n, n_in, n_left = (int(x) for x in (frr["n"], frr["n_of"], left["n"]))
    if not n_in:
        said = "The test split holds no in-map frame, so there is no false rejection rate."
        return [said, *_alone(judgement, rates), *_delays(row)]
    said = (
        f"False rejection rate {rate(frr, 'value')}: of {n_in} in-map test frames the verdicts "
        f"rejected {n}, accepted {n_in - n - n_left} and abstained on {n_left}."
    )
    return [said, *_alone(judgement, rates), *_delays(row)]


def _alone(judgement: Judgement, rates: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Say what the probability alone would do; that is what metrics.csv compares signals by."""
    parts = []
    for name, would in ((THRESHOLD_FAR, "accept"), (THRESHOLD_FRR, "reject")):
        row = rates[name]
        if row["n_of"]:
            many = f"{int(row['n'])} of {int(row['n_of'])} {row['among']} test frames"
            parts.append(f"{would} {many} ({name} {row['value']:.3f})")
    if not parts:
        return []
    level = plain(judgement.detector.threshold)
    return [
        f"The probability of being off the map alone, which cannot abstain, would at the threshold "
        f"{level}, frozen on "
        f"the calibration split, {' and '.join(parts)}."
    ]


def _delays(row: Mapping[str, Any]) -> list[str]:
    n_exits = int(row["n_exits"])
    if n_exits == 0:
        return ["The test split holds no way out of the map, so there is no detection delay."]
    if row["n_censored"] == n_exits:
        return [f"Exits from the map: {n_exits}; none was noticed."]
    return [
        f"Exits from the map: {n_exits}, of which {int(row['n_censored'])} unnoticed; in the "
        f"median the first rejection comes {row['delay_frames']:g} frames after the first "
        "map-out frame."
    ]


def _separation(judgement: Judgement) -> list[str]:
    tao = metric_row(judgement, "tao")
    n_in, n_out = int(tao["n_in"]), int(tao["n_out"])
    audit = judgement.config.audit
    n_grey = len(judgement.label) - n_in - n_out
    grey = (
        f" {n_grey} grey frames (between {audit.r_in_m:g} and {audit.r_out_m:g} m) are counted "
        "and left out."
        if n_grey
        else ""
    )
    if not n_in or not n_out:
        which = "in-map" if n_in else "map-out"
        return [
            f"All {n_in + n_out} labelled frames are {which}: with one class there is no AUROC, "
            f"AUPR or FAR at 95 %; the recall and error tables stand.{grey}"
        ]
    top1, velocity = metric_row(judgement, "top1"), metric_row(judgement, "velocity")
    return [
        f"Over all {n_in + n_out} labelled frames ({n_in} in-map, {n_out} map-out) the AUROC of "
        f"tao is {rate(tao, 'auroc')}, of the best similarity {rate(top1, 'auroc')}, of the "
        f"velocity gate {rate(velocity, 'auroc')}.{grey}"
    ]


def _failures(judgement: Judgement) -> list[str]:
    """Say where on the map wrong answers were accepted."""
    is_test = judgement.splits.name == "test"
    wrong = np.flatnonzero((judgement.outcome == "accepted_wrong") & is_test)
    if not wrong.size:
        return ["No test frame was accepted at a wrong place."] if is_test.any() else []
    stretches = np.split(wrong, np.flatnonzero(np.diff(wrong) > _JOIN_FRAMES) + 1)
    stretches.sort(key=len, reverse=True)
    n_off = int((judgement.label[wrong] == "map_out").sum())
    told = []
    for frames in stretches[:_MOST_STRETCHES]:
        x, y = np.median(judgement.query_m[frames], axis=0)
        which = f"frames {frames[0]} to {frames[-1]}" if len(frames) > 1 else f"frame {frames[0]}"
        told.append(f"{which} near x = {round(x)} m, y = {round(y)} m")
    more = len(stretches) - len(told)
    tail = (
        f"; and {more} more stretch{'es' if more > 1 else ''} as short or shorter" if more else ""
    )
    return [
        f"{len(wrong)} test {'frames were' if len(wrong) > 1 else 'frame was'} accepted at a wrong "
        f"place, more than {judgement.config.audit.wrong_m:g} m off ({n_off} off the map, "
        f"{len(wrong) - n_off} elsewhere on it): {'; '.join(told)}{tail}."
    ]


def _errors(judgement: Judgement) -> list[str]:
    table = judgement.errors
    n = int(table["n"][0])
    if n == 0:
        return []
    within = judgement.config.audit.wrong_m
    return [
        f"Where {n} in-map test frames were accepted, the pose is off by "
        f"{table['median_m'][0]:.2f} m in the median and {table['p95_m'][0]:.2f} m at the 95th "
        f"percentile; {100 * table['share_within'][0]:.1f} % lie within {within:g} m."
    ]


def _clock(judgement: Judgement) -> list[str]:
    if judgement.clock_gap_s <= 1e-3:
        return []
    return [
        f"The time stamps of truth and run differ by up to {judgement.clock_gap_s:g}; rows were "
        "paired in order."
    ]


def _is_mostly_wrong(outcome: np.ndarray) -> bool:
    return int(np.sum(outcome == "accepted_wrong")) > int(np.sum(outcome == "accepted_in"))


def _use(judgement: Judgement) -> list[str]:
    """Say first what forbids to trust the rest."""
    if np.isnan(judgement.detector.threshold) or not len(judgement.splits.test.frame):
        return []
    far, said = rates_of(judgement)[VERDICT_FAR], []
    is_open = far["n_of"] > 0 and far["value"] > _MOST
    if is_open or _is_mostly_wrong(judgement.outcome[judgement.splits.test.frame]):
        said.append(NO_SHIELD)
    if not far["n_of"]:
        said.append(UNTESTED)
    if judgement.detector.note.startswith(FALLBACK):
        said.append(judgement.detector.note)
    return said


def _decided(judgement: Judgement) -> list[str]:
    """Judge what was decided at run time: its numbers are frozen, so every frame is a test."""
    decided = judgement.decided
    if decided is None:
        return []
    many = lambda *kinds: int(np.isin(decided, kinds).sum())
    is_out, is_in = judgement.label == "map_out", judgement.label == "in_map"
    accepted = np.isin(decided, ("accepted_in", "accepted_wrong"))
    rejected = np.isin(decided, ("rejected_in", "rejected_out"))
    return [
        f"Decided at run time, with numbers frozen before (decisions.csv): of all "
        f"{len(decided) - many('grey')} labelled frames {many('accepted_in')} were accepted at "
        f"the right place and {many('accepted_wrong')} at a wrong place; "
        f"{int((accepted & is_out).sum())} of {int(is_out.sum())} map-out frames were accepted, "
        f"{int((rejected & is_in).sum())} of {int(is_in.sum())} in-map frames rejected, "
        f"{many('abstained')} left open. All that follows is judged anew, calibrated "
        "on the first half of this run (verdicts.csv)."
    ]


_PARTS = (
    _trust, _decided, _use, _counts, _false_acceptance, _failures, _false_rejection, _errors,
    _separation,
)  # fmt: skip


def warnings(judgement: Judgement) -> tuple[str, ...]:
    """Return those of the sentences that should alarm the reader."""
    found = {TOO_SHORT, BLIND, *_use(judgement), *_clock(judgement)}
    if _is_mostly_wrong(judgement.outcome[judgement.splits.test.frame]):
        found.add(sentence(judgement))
    return tuple(said for said in find_words(judgement) if said in found)


def alarms(done: Evaluation) -> tuple[str, ...]:
    """Return all that should alarm the reader of a run, the graph's part among it.

    Args:
        done: the judged run.
    """
    return (*warnings(done.judgement), *done.warnings)


def all_alarms(scenarios: Mapping[str, Evaluation]) -> tuple[str, ...]:
    """Return the same of several scenarios, each with its name.

    Args:
        scenarios: name -> judged run.
    """
    return tuple(f"{name}: {said}" for name, done in scenarios.items() for said in alarms(done))


def terminal_words(done: Evaluation) -> tuple[str, ...]:
    """Return what the terminal says of a judged run: three lines, then what should alarm.

    Args:
        done: the judged run.
    """
    return (*lines(done.judgement), *(f"warning: {said}" for said in alarms(done)))


def summary_words(scenarios: Mapping[str, Evaluation]) -> tuple[str, ...]:
    """Return what the terminal says of several scenarios: a sentence, a line each, alarms.

    Args:
        scenarios: name -> judged run.
    """
    judged = {name: done.judgement for name, done in scenarios.items()}
    return (*summary_lines(judged), *(f"warning: {said}" for said in all_alarms(scenarios)))


def find_words(judgement: Judgement) -> tuple[str, ...]:
    """Return what was found, most important first; it begins with the report's first sentence."""
    found = [said for part in _PARTS for said in part(judgement)]
    note = [] if judgement.detector.note in found else [judgement.detector.note]
    promised = f"Conformal threshold of tao: {judgement.promise.sentence}"
    return (*found, *note, promised, *_clock(judgement))
