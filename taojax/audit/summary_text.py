"""What was found: every frame counted, plain sentences, the paper's tables over scenarios."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool
from matplotlib.figure import Figure

from taojax import plots
from taojax.audit import metrics
from taojax.audit.calibration import FALLBACK
from taojax.audit.figures import Picture, csv_text, picture
from taojax.audit.judgement import Evaluation, Judgement
from taojax.audit.opening import TOO_SHORT, UNKNOWN, accepted_row, lines, sentence, summary_lines
from taojax.audit.tables import NAN, Table, as_files, from_rows
from taojax.decisions import plain
from taojax.files.tables import table_text

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
    left = kinds["abstained"]
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
    weights = metrics.block_weights(n, audit.block_frames, audit.n_bootstrap, judgement.config.seed)
    rows = []
    for name, what, among, chosen in _counted(judgement):
        of = test.is_out if among == AMONG["FAR"] else test.is_in
        hit = chosen[test.frame][of].astype(float)
        row: dict[str, Any] = {"rate": name, "counted": what, "among": among}
        row |= {"n": hit.sum(), "n_of": len(hit), "value": hit.mean() if len(hit) else NAN}
        if len(hit):
            drawn = metrics.weighted_mean(hit, weights[:, of])
            row["value_lo"], row["value_hi"] = metrics.interval(drawn)
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
        f"{len(decided) - many('grey')} judged frames {many('accepted_in')} were accepted at "
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
