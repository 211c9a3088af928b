"""What `taojax explain` prints: one frame in plain words."""

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from taojax.decisions import SILENT, STATUS_MEANS
from taojax.risk import lone_doubt, terms

if TYPE_CHECKING:
    from taojax.files.pose_graph_io import Verdicts
    from taojax.files.records import Run
    from taojax.risk import Risk
    from taojax.runtime.explain import Look

WIDTH = 92
LABEL = 10

N_COSTS = 12
"""Frame costs printed one by one."""

AMBIGUOUS = 0.1
"""Another place whose path costs so little more could as well be the right one."""


def page(look: "Look", run: "Run", verdicts: "Verdicts | None") -> list[str]:
    """Return the lines to print.

    Args:
        look: from `taojax.runtime.explain`.
        run: the sealed run.
        verdicts: what was decided, if anything was.
    """
    parts = [
        ("frame", _frame(look, run)),
        ("verdict", _verdict(look, verdicts)),
        ("now", _now(look, verdicts)),
        ("decided by", _decided(look, run, verdicts)),
        ("promise", "" if verdicts is None else verdicts.calibration.final.promise),
        ("place", _place(look)),
        ("window", _window(look)),
        ("costs", _costs(look)),
        ("rival", _rival(look)),
        ("literal", _literal(look, run)),
        ("list", _list(look, run)),
        ("margin", _margin(look, run, verdicts)),
    ]
    lines = []
    for label, words in parts:
        if words:
            indent = " " * (LABEL + 2)
            lines += textwrap.wrap(
                words, WIDTH, initial_indent=f"{label:<{LABEL}}  ", subsequent_indent=indent
            )
    return lines


def headline(look: "Look", verdicts: "Verdicts | None") -> str:
    """Return one line over the picture."""
    if verdicts is None:
        return f"frame {look.frame}: {look.status}, path cost {look.cost:.3f}"
    said = f"frame {look.frame}: {verdicts.verdict[look.frame]}"
    said += "" if look.status == "ok" else f", {look.status}"
    p, level = verdicts.probability[look.frame], verdicts.calibration.final.level
    said += f", probability of being wrong {p:.3f}"
    return said if np.isnan(level) else f"{said} (accepted up to {level:.3f})"


def _frame(look: "Look", run: "Run") -> str:
    n, t_s = len(run.signals["frame"]), run.signals["t_s"][look.frame]
    difference = abs(look.cost - look.sealed)
    how = "to nine digits" if difference < 1e-9 else f"to {difference:.1g}"
    return (
        f"{look.frame} of 0 to {n - 1} (t = {float(t_s):.13g} s); the seal holds, and the path "
        f"followed again costs what was sealed {how}"
    )


def _verdict(look: "Look", verdicts: "Verdicts | None") -> str:
    means = STATUS_MEANS[look.status]
    why = f"{look.status}: {means}" if means else look.status
    if verdicts is None:
        return f"none: nobody decided in this run; status {why}"
    at = look.frame
    return f"{verdicts.verdict[at]} ({verdicts.source}), {verdicts.reason[at]}; status {why}"


def _now(look: "Look", verdicts: "Verdicts | None") -> str:
    if verdicts is None:
        return ""
    at = look.frame
    apart = np.hypot(*(verdicts.pose[at, :2] - verdicts.pose_now[at, :2]))
    told = f"{verdicts.verdict_now[at]}, {verdicts.reason_now[at]}"
    if np.isnan(apart):
        return told
    return f"{told}; what came after moved the answer by {apart:.1f} m"


MOST_TERMS = 6
"""Features told, the loudest first."""


def _decided(look: "Look", run: "Run", verdicts: "Verdicts | None") -> str:
    if verdicts is None:
        return ""
    risk = verdicts.calibration.final
    found = _terms(risk, look, run)
    told = [
        f"{name} {term:+.2f} (it is {run.delayed[name][look.frame]:.3g})"
        for name, term in list(found.items())[:MOST_TERMS]
    ]
    rest = sum(list(found.values())[MOST_TERMS:])
    said = (
        f"{', '.join(told)}, {len(found) - MOST_TERMS} more {rest:+.2f}: log odds of being wrong "
        f"above the mean of the pooled recordings, which itself has {risk.bias:+.2f}"
    )
    least = lone_doubt(risk, {name: run.delayed[name] for name in risk.reads})[look.frame]
    if least:
        said += f"; it stands alone, so wrong with at least probability {least:.3f}"
    return said


def _terms(risk: "Risk", look: "Look", run: "Run") -> dict[str, float]:
    """Return what each feature adds to the log odds of the final answer, the largest first."""
    row = {name: run.delayed[name][look.frame : look.frame + 1] for name in risk.columns}
    found = dict(zip(risk.columns, terms(risk, row)[0].tolist(), strict=True))
    return dict(sorted(found.items(), key=lambda item: -abs(item[1])))


def _pose(pose: np.ndarray) -> str:
    return f"x = {pose[0]:.2f} m, y = {pose[1]:.2f} m, {np.degrees(pose[2]):.0f} degrees"


def _place(look: "Look") -> str:
    if look.map_index < 0:
        return "none: nothing is answered"
    pose = look.hypotheses.pose[0]
    return f"map row {look.map_index}, robot at {_pose(pose)}; its path costs {look.cost:.3f}"


def ranges(numbers: list[int]) -> str:
    """Return sorted whole numbers as short text: `0 to 3, 7`."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in runs)


def _window(look: "Look") -> str:
    w = look.window
    span = f"frames {w.frame[0]} to {w.frame[-1]}"
    against = sorted(int(frame) for frame in w.frame[~w.is_inlier])
    share = float(w.weight[~w.is_inlier].sum())
    if not against:
        return f"{span}; all of these {len(w.frame)} agree"
    return (
        f"{span}; {len(against)} of these {len(w.frame)} disagree{'s' * (len(against) == 1)}, "
        f"with {share:.0%} of the weight: {ranges(against)}"
    )


def _costs(look: "Look") -> str:
    w = look.window
    near = np.argsort(np.abs(w.frame - look.frame), kind="stable")[:N_COSTS]
    costs = " ".join(f"{cost:.2f}" for cost in w.cost[np.sort(near)])
    return (
        f"of the {len(near)} nearest frames on the path, in order: {costs}; a frame without "
        "support costs 1"
    )


def _rival(look: "Look") -> str:
    cost, pose = look.hypotheses
    if len(cost) < 2:
        return "no candidate at another place finds any support"
    told = []
    for number in range(1, len(cost)):
        away = np.hypot(*(pose[number, :2] - pose[0, :2]))
        told.append(f"{number + 1}: cost {cost[number]:.3f}, {away:.0f} m away")
    gap = cost[1:].min() - cost[0]
    judged = "ambiguous" if gap < AMBIGUOUS else "clearly worse"
    if gap < 0:
        judged = "cheaper than the answer"
    return f"{'; '.join(told)}: {judged}"


def _literal(look: "Look", run: "Run") -> str:
    at = lambda name: float(run.signals[name][look.frame])
    return (
        f"the paper's cost, up to this frame, tao_rank {at('tao_rank'):.4g} m^2 = residuals "
        f"{at('tao_rank_geom'):.4g} + velocity {at('tao_rank_vel'):.4g} + similarity "
        f"{at('tao_rank_sim'):.4g}"
    )


def _list(look: "Look", run: "Run") -> str:
    n = len(look.candidate)
    if not n:
        return "no candidates"
    most, entropy = np.log(n), float(run.signals["entropy"][look.frame])
    return (
        f"{n} candidates, best similarity {look.similarity[0]:.3f}, entropy {entropy:.2f} of at "
        f"most {most:.2f} nat; this map tells {look.map_recall:.0%} of its own places apart"
    )


def _margin(look: "Look", run: "Run", verdicts: "Verdicts | None") -> str:
    if verdicts is None:
        return ""
    risk, at = verdicts.calibration.final, look.frame
    if look.status in SILENT:
        return f"to be accepted it lacks an answer of its own: {STATUS_MEANS[look.status]}"
    if np.isnan(risk.level):
        return "no answer of this run is accepted: there is no level"
    excess = sum(_terms(risk, look, run).values()) + risk.bias
    excess -= np.log(risk.level / (1.0 - risk.level))
    if verdicts.verdict[at] == "accept":
        return f"log odds higher by {-excess:.2f} would not have been accepted"
    last = np.flatnonzero(verdicts.verdict[:at] == "accept")
    before = f"the last accepted frame is {last[-1]}" if last.size else "none before it was"
    return f"to be accepted it lacks log odds lower by {excess:.2f}; {before}"
