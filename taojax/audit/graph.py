"""Judge optimised pose graphs: table, sentences, picture and page.

Every method but the oracle is optimised before the truth of the test half is looked at. The
similarity gate is set with the truth of the calibration half alone.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped
from matplotlib.figure import Figure

from taojax import plots
from taojax.audit import figures, labels, tables
from taojax.audit.figures import Picture, csv_text, picture
from taojax.audit.html import Page, grid, render
from taojax.audit.labels import Truth, read_truth
from taojax.audit.own_map import nearest_known
from taojax.config import AuditConfig
from taojax.decisions import plain
from taojax.files.pose_graph_io import Verdicts, compose
from taojax.files.records import Run
from taojax.files.specs import write_atomically
from taojax.graph.answers import Closure, Run2D, Stream, read_answers
from taojax.graph.methods import (
    ALONE,
    Outcome,
    Problem,
    build,
    optimise,
    optimise_all,
    optimise_few,
)
from taojax.graph.optimise import INSTALL, has_extra

__all__ = [
    "Brief",
    "Judged",
    "draw",
    "headline",
    "in_brief",
    "judge_graph",
    "sentences",
    "write_graph",
]

MOST_WRONG = 0.05
"""Share of wrong answers that the similarity gate may let through on the calibration half: the
promise that verdicts make."""

WHOLE = 0.05
"""A graph is whole if at most so much more of the test frames are off than with the oracle."""

ORACLE = "oracle"

RIVAL = "top1_gnc"
"""What the one sentence compares with: the back-end that is told to survive wrong closures."""

LOST = 0.5
"""Where the right closures alone leave more of the test frames off, nothing was held."""

LITTLE = 0.001
"""Shares of frames closer than this are told as equal."""

COLUMNS = 4
"""Panels side by side in the picture."""

TITLES = {
    "top1_huber": "all first candidates, Huber",
    "top1_geman_mcclure": "all first candidates, Geman-McClure",
    "top1_gnc": "all first candidates, GNC",
    "gate_gnc": "similarity gate, GNC",
    "pcm_greedy": "PCM, greedy",
    "pcm_exact": "PCM, exact",
    "ours": "ours, plain",
    "ours_gnc": "ours, GNC",
    "ours_now": "ours now, plain",
    "ours_switch": "ours, probability as switch prior",
    ORACLE: "oracle, plain",
}
"""Method -> how people read it."""


class Judged(NamedTuple):
    """What became of each method's graph."""

    outcomes: tuple[Outcome, ...]
    table: tables.Table
    noise: str
    """What odometry is believed to do, in words."""

    gate: str
    """Where the similarity gate lies, in words; empty where it was not tried."""

    r_out_m: float
    frames: tuple[int, int]
    """First and last test frame."""

    map_m: Float[np.ndarray, "m 2"]
    truth_m: Float[np.ndarray, "n 2"]
    """Of the test frames, metres."""

    paths_m: tuple[Float[np.ndarray, "n 2"], ...]
    """Per method: optimised positions of the test frames."""

    wrong: tuple[Float[np.ndarray, "_ 2 2"], ...]
    """Per method: true and answered position of its wrong closures, metres."""


def gate_level(
    similarity: Float[np.ndarray, " n"], is_wrong: Bool[np.ndarray, " n"], most_wrong: float
) -> float:
    """Return the least similarity at and above which at most a share of the answers is wrong.

    Args:
        similarity: of the first candidates of the calibration half; -inf without one.
        is_wrong: whether each lies too far from the truth.
        most_wrong: the share.

    Returns:
        Infinity where no level does it: the gate lets nothing through.
    """
    order = np.argsort(-similarity, kind="stable")
    order = order[np.isfinite(similarity[order])]
    share = np.cumsum(is_wrong[order]) / np.arange(1, len(order) + 1)
    # Equal similarities pass or fail together.
    is_last = np.diff(similarity[order], append=-np.inf) != 0
    good = np.flatnonzero((share <= most_wrong) & is_last)
    return float(similarity[order[good[-1]]]) if good.size else float("inf")


def _errors(stream: Stream, truth: np.ndarray) -> np.ndarray:
    """Return distances from answers to the truth (n,), metres; NaN without an answer."""
    pose = stream.pose[: len(truth)]
    if stream.anchor is not None and stream.motion is not None:
        row = stream.anchor[: len(truth)]
        led = compose(truth[np.maximum(row, 0)], stream.motion[: len(truth)])
        pose = np.where((row >= 0)[:, None], led, np.nan)
    return np.hypot(*(pose[:, :2] - truth[:, :2]).T)


def _answered_m(closure: Closure, truth: np.ndarray) -> np.ndarray:
    """Return where a closure says the robot was: on the map, or from the true place it names."""
    if closure.tie is None:
        return closure.pose[:2]
    return compose(truth[closure.tie.frame], closure.tie.motion)[:2]


def _is_wrong(closure: Closure, truth: np.ndarray, r_out_m: float) -> bool:
    away = _answered_m(closure, truth) - truth[closure.frame, :2]
    return bool(np.hypot(*away) > r_out_m)


def _laid(path: np.ndarray, truth_m: np.ndarray) -> np.ndarray:
    """Lay a trajectory that floats rigidly on the truth: least squared distances, (n, 2).

    Umeyama, Least-squares estimation of transformation parameters, PAMI 1991, without scale.
    """
    a, b = path[:, 0] + 1j * path[:, 1], truth_m[:, 0] + 1j * truth_m[:, 1]
    turn = np.exp(1j * np.angle(np.vdot(a - a.mean(), b - b.mean())))
    laid = turn * (a - a.mean()) + b.mean()
    return np.stack([laid.real, laid.imag], axis=1)


def _row(
    outcome: Outcome,
    path_m: np.ndarray,
    truth: np.ndarray,
    label: np.ndarray,
    r_out_m: float,
) -> dict[str, Any]:
    error = np.hypot(*(path_m - truth[-len(path_m) :, :2]).T)
    is_off, inside = error > r_out_m, label == "in_map"
    wrong = [_is_wrong(closure, truth, r_out_m) for closure in outcome.closures]
    median, p95 = np.percentile(error, (50, 95))
    row = {
        "method": outcome.method, "closures": len(wrong), "rmse_m": np.sqrt(np.mean(error**2)),
        "median_m": median, "p95_m": p95, "off_share": is_off.mean(),
        "seconds": outcome.seconds,
    }  # fmt: skip
    if wrong:
        row["wrong_share"] = np.mean(wrong)
    if inside.any():
        row["off_share_in_map"] = is_off[inside].mean()
    return row


def _split(n: int, audit: AuditConfig, gap_frames: int) -> Shaped[np.ndarray, " t"]:
    """Return calibration, gap or test per frame; labels play no part."""
    nothing = np.full(n, "grey")
    cut = labels.split_frames(
        {}, nothing, calibration_share=audit.calibration_share, gap_frames=gap_frames
    )
    return cut.name


def _gated(run: Run2D, truth: np.ndarray, r_out_m: float) -> tuple[float, str]:
    """Set the gate with the truth of the calibration half alone."""
    error = _errors(run.answers.top1, truth)
    level = gate_level(run.answers.similarity[: len(truth)], ~(error <= r_out_m), MOST_WRONG)
    share = f"at most {100 * MOST_WRONG:g} % of the calibration answers"
    if np.isinf(level):
        return level, f"Similarity gate: shut, for no level keeps {share} from being wrong."
    return level, f"Similarity gate: {plain(level)}, above which {share} are wrong."


def _oracle(problem: Problem, run: Run2D, truth: np.ndarray, r_out_m: float) -> Outcome:
    top1, first = run.answers.top1, problem.first
    right = top1.accepted & (_errors(top1, truth) <= r_out_m)
    right[:first] = False
    return optimise(problem, ORACLE, top1.closures(right), "plain")


def judge_graph(
    run: Run2D,
    truth: Float[np.ndarray, "t _"],
    audit: AuditConfig,
    gap_frames: int,
    say: Callable[[str], None] | None = lambda text: None,
) -> Judged | None:
    """Optimise the graph of the test half in every way, then hold the results against the truth.

    Args:
        run: from `read_answers`.
        truth: true positions of all frames, metres; and headings [rad], which one drive that
            closes on itself needs.
        audit: radii and split.
        gap_frames: between calibration and test half; also the window.
        say: told what is being optimised; None optimises only what the one sentence needs.

    Returns:
        None where the recording is too short to hold a test half.
    """
    split = _split(len(truth), audit, gap_frames)
    if not (split == "test").any():
        return None
    end, first = int((split == "calibration").sum()), int(np.argmax(split == "test"))
    problem = build(run, calibration_end=end, first=first, window=gap_frames)
    if say is None:
        said, found = "", optimise_few(problem)
    else:
        gate, said = _gated(run, truth[:end], audit.r_out_m)
        found = optimise_all(problem, gate, say)
    # From here on the truth of the test half is known.
    found.append(_oracle(problem, run, truth, audit.r_out_m))
    truth_m = truth[:, :2]
    paths = [o.solution.pose[:, :2] for o in found]
    if run.is_own:
        # Nothing says where the drive lies but itself.
        paths = [_laid(path, truth_m)[first:] for path in paths]
        nearest = nearest_known(truth_m, run.odometry, run.own_gap_m)[first:]
        map_m = truth_m
    else:
        map_m = run.map_pose[:, :2]
        nearest = labels.nearest_map_distance(truth_m[first:], map_m)
    label = labels.label_frames(nearest, audit.r_in_m, audit.r_out_m)
    rows = [
        _row(outcome, path, truth, label, audit.r_out_m)
        for outcome, path in zip(found, paths, strict=True)
    ]
    wrong = tuple(
        np.array([
            (truth_m[c.frame], _answered_m(c, truth))
            for c in outcome.closures
            if _is_wrong(c, truth, audit.r_out_m)
        ]).reshape(-1, 2, 2)
        for outcome in found
    )  # fmt: skip
    return Judged(
        outcomes=tuple(found),
        table=tables.from_rows("graph", rows),
        noise=problem.chain.noise.said(run.spacing_m),
        gate=said,
        r_out_m=audit.r_out_m,
        frames=(first, len(truth_m) - 1),
        map_m=map_m,
        truth_m=truth_m[first:],
        paths_m=tuple(paths),
        wrong=wrong,
    )


def _of(judged: Judged, method: str) -> dict[str, Any]:
    at = list(judged.table["method"]).index(method)
    return {name: values[at] for name, values in judged.table.items()}


def _measured(row: dict[str, Any]) -> str:
    return f"{plain(row['median_m'])} m median, {100 * row['off_share']:.1f} % of the frames off"


def _fate(row: dict[str, Any], best: dict[str, Any]) -> str:
    """Say what became of a graph, measured by what the right closures alone make of it.

    Returns:
        whole; kept, as far as the right ones keep it; lost, as it is with them; broken; or drifts,
        where too few closures hold it but none of them is wrong.
    """
    if row["off_share"] <= WHOLE:
        return "whole"
    if row["off_share"] > best["off_share"] + WHOLE:
        return "broken" if row["wrong_share"] > 0 else "drifts"
    return "kept" if best["off_share"] <= LOST else "lost"


def is_whole(judged: Judged) -> bool:
    """Return whether our closures break nothing that the right ones alone would hold."""
    return _fate(_of(judged, "ours"), _of(judged, ORACLE)) not in ("broken", "drifts")


def headline(judged: Judged) -> str:
    """Return the one sentence: our closures, all first candidates, and the right ones alone."""
    ours, every, best = (_of(judged, name) for name in ("ours", RIVAL, ORACLE))
    if not ours["closures"]:
        note = next(o.note for o in judged.outcomes if o.method == "ours")
        start = f"The graph is odometry alone ({note.removeprefix(ALONE)})"
    else:
        start = {
            "whole": "With these closures the graph stays whole",
            "kept": "With these closures the graph stays as whole as the right ones alone keep it",
            "lost": "These closures do not hold the graph, nor do the right ones alone",
            "broken": "With these closures the graph breaks",
            "drifts": "None of these closures is wrong, but where none holds the graph it drifts",
        }[_fate(ours, best)]
    fate = {
        "whole": "stays whole", "kept": "is kept too", "lost": "does not hold", "broken": "breaks",
        "drifts": "drifts",
    }  # fmt: skip
    rival = fate[_fate(every, best)]
    gap = ours["off_share"] - every["off_share"]
    is_behind = gap > LITTLE or (abs(gap) <= LITTLE and ours["median_m"] > every["median_m"])
    right = (
        f"with the right ones alone: {_measured(best)}"
        if best["closures"]
        else "none of the first candidates is right"
    )
    return (
        f"{start}: {_measured(ours)}; with all first candidates and GNC it {rival}: "
        f"{_measured(every)}{', which is better here' if is_behind else ''}; {right}. Off means "
        f"more than {judged.r_out_m:g} m, on the test frames {judged.frames[0]} to "
        f"{judged.frames[1]}."
    )


def sentences(judged: Judged) -> tuple[str, ...]:
    """Return what was found, most important first."""
    notes = [f"{TITLES[o.method]}: {o.note}." for o in judged.outcomes if o.note]
    gate = [judged.gate] if judged.gate else []
    return (headline(judged), judged.noise, *gate, *dict.fromkeys(notes))


def draw(judged: Judged, name: str = "graph") -> Picture:
    """Draw the trajectory of every method on the map.

    Args:
        judged: what became of each.
        name: of the picture's files.
    """
    n = len(judged.outcomes)
    across = min(n, COLUMNS)
    n_rows = -(-n // across)
    wide, high = plots.map_size(judged.map_m, judged.truth_m, wide_in=3.4, most_in=3.0)
    size = (wide * across, (high - plots.BELOW_MAP_IN + 0.55) * n_rows + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(n_rows, across, squeeze=False).ravel()
    columns = {
        "frame": np.arange(judged.frames[0], judged.frames[1] + 1),
        "true_x_m": judged.truth_m[:, 0],
        "true_y_m": judged.truth_m[:, 1],
    }
    lines: dict[str, Any] = {}
    for ax, outcome, path, wrong in zip(
        axes, judged.outcomes, judged.paths_m, judged.wrong, strict=False
    ):
        plots.graph_map(judged.map_m, judged.truth_m, path, wrong, ax=ax)
        row = _of(judged, outcome.method)
        said = f"{plain(row['median_m'])} m median, {len(wrong)} of {row['closures']:.0f} wrong"
        ax.set_title(f"{TITLES[outcome.method]}\n{said}", fontsize=8)
        handles, names = ax.get_legend_handles_labels()
        lines |= dict(zip(names, handles, strict=True))
        columns[f"{outcome.method}_x_m"], columns[f"{outcome.method}_y_m"] = path.T
    for ax in axes[n:]:
        ax.set_axis_off()
    figure.supxlabel("x [m]", fontsize=8)
    figure.supylabel("y [m]", fontsize=8)
    figure.legend(
        lines.values(), lines.keys(), loc="outside upper center", ncol=4, frameon=False, fontsize=8
    )
    caption = (
        f"Test frames {judged.frames[0]} to {judged.frames[1]}, optimised with each method's "
        "closures. A wrong closure pulls the trajectory from where the robot was to where the "
        "answer lies. Trajectories may leave the frame."
    )
    return picture(figure, name, "What the closures do to the graph", caption, csv_text(columns))


def _truth(known: Truth) -> np.ndarray:
    return np.column_stack([known.xy_m, known.theta_rad])


class Brief(NamedTuple):
    """What the report of a run says of the graph."""

    sentence: str
    """Empty where there is no graph to speak of."""

    picture: Picture | None = None
    is_lead: bool = False
    """Whether it was measured, and is told right after the first sentence."""

    is_alarm: bool = False


LACKS = (
    f"What these closures do to a pose graph is not said here: it needs GTSAM ({INSTALL}, then "
    "judge again or run `taojax graph`)."
)
"""Said where the extra is missing."""


def in_brief(
    folder: Path,
    sealed: Run,
    verdicts: Verdicts,
    known: Truth,
    audit: AuditConfig,
    gap_frames: int,
) -> Brief:
    """Optimise the graph of a run with three methods alone, and say what became of it.

    Args:
        folder: the run.
        sealed: read from it by `records.read_run`.
        verdicts: what was decided.
        known: the truth of the same recording.
        audit: radii and split.
        gap_frames: between calibration and test half.

    Returns:
        One sentence and the picture; how to get them without the extra; nothing where the run
        holds no odometry or no test half.
    """
    if "odometry.csv" not in sealed.manifest["sha256"] or "map_spacing_m" not in sealed.manifest:
        return Brief("")
    if not has_extra():
        return Brief(LACKS)
    run = read_answers(folder, sealed, verdicts)
    judged = judge_graph(run, _truth(known), audit, gap_frames, None)
    if judged is None:
        return Brief("")
    return Brief(headline(judged), draw(judged, "graph_brief"), True, not is_whole(judged))


def _page(judged: Judged, drawn: Picture, facts: dict[str, str], command: str) -> str:
    found = sentences(judged)
    note = "Plain least squares, robust kernels and consistency on the same odometry chain."
    return render(
        Page(
            title="What the closures do to the graph",
            subtitle=f"Pose graph of the test frames {judged.frames[0]} to {judged.frames[1]}.",
            notes=[],
            headline=found[1:],
            lead=found[:1],
            grids=[grid("graph", judged.table, title="Back-ends and closures", note=note)],
            pictures=[drawn],
            facts=facts,
            command=command,
        )
    )


def write_graph(  # noqa: PLR0913 - a run, its truth, how it is judged, where it is written
    folder: Path,
    sealed: Run,
    truth: Path,
    audit: AuditConfig,
    gap_frames: int,
    *,
    out: Path,
    command: str,
    say: Callable[[str], None],
) -> tuple[str, ...]:
    """Optimise the graph of a run in every way, judge it, and write what was found.

    Args:
        folder: the run.
        sealed: read from it by `records.read_run`.
        truth: the truth folder of the same recording.
        audit: radii and split.
        gap_frames: between calibration and test half.
        out: folder to write tables/graph.*, figures/graph.* and graph.html into.
        command: how to repeat it.
        say: told what is being optimised.

    Returns:
        What was found, in plain sentences; one that says so where there is no test half.

    Raises:
        InputError: nothing is decided, the truth is foreign, or `out` cannot be written.
    """
    run = read_answers(folder, sealed)
    known = read_truth(truth, len(run.odometry))
    judged = judge_graph(run, _truth(known), audit, gap_frames, say)
    if judged is None:
        return ("The recording is too short to hold a test half: there is no graph to judge.",)
    drawn = draw(judged)
    facts = {"seal of the run": str(sealed.manifest["seal"]), "truth": known.sha256}
    files: dict[str, str | bytes] = {
        **tables.as_files("graph", judged.table),
        **figures.as_files(drawn),
        "graph.html": _page(judged, drawn, facts, command),
    }
    for name, content in files.items():
        write_atomically(out / name, content)
    return sentences(judged)
