"""What `taojax explain` prints: one frame in plain words."""

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from taojax.risk import terms
from taojax.verdicts import SILENT, STATUS_MEANS

if TYPE_CHECKING:
    from taojax.closures import Verdicts
    from taojax.records import Run
    from taojax.risk import Risk
    from taojax.runtime.explain import Look

WIDTH = 92
LABEL = 10

N_COSTS = 12
"""Frame costs printed one by one, newest first."""


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
        ("tao", _tao(look)),
        ("place", _place(look)),
        ("branch", _branch(look)),
        ("window", _window(look)),
        ("costs", _costs(look)),
        ("support", _support(look)),
        ("rival", _rival(look)),
        ("list", _list(look)),
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
    said = f"frame {look.frame}: {look.status}, tao {look.signals['tao']:.3f}"
    if verdicts is None:
        return said
    said = f"frame {look.frame}: {verdicts.verdict[look.frame]}"
    said += "" if look.status == "ok" else f", {look.status}"
    p, level = verdicts.probability[look.frame], verdicts.calibration.final.level
    said += f", probability of being wrong {p:.3f}"
    return said if np.isnan(level) else f"{said} (accepted up to {level:.3f})"


def _frame(look: "Look", run: "Run") -> str:
    n, t_s = len(run.signals["frame"]), run.signals["t_s"][look.frame]
    difference = abs(look.signals["tao"] - look.sealed["tao"])
    how = "bit for bit" if difference == 0 else f"to {difference:.1g}"
    return (
        f"{look.frame} of 0 to {n - 1} (t = {float(t_s):.10g} s); the seal holds, and the replay "
        f"gives the sealed tao {how}"
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
    return (
        f"{', '.join(told)}, {len(found) - MOST_TERMS} more {rest:+.2f}: log odds of being wrong "
        f"above the mean of the pooled recordings, which itself has {risk.bias:+.2f}"
    )


def _terms(risk: "Risk", look: "Look", run: "Run") -> dict[str, float]:
    """Return what each feature adds to the log odds of the final answer, the largest first."""
    row = {name: run.delayed[name][look.frame : look.frame + 1] for name in risk.columns}
    found = dict(zip(risk.columns, terms(risk, row)[0].tolist(), strict=True))
    return dict(sorted(found.items(), key=lambda item: -abs(item[1])))


def _tao(look: "Look") -> str:
    s = look.signals
    if look.unit == "m^2":
        return (
            f"{s['tao']:.4g} m^2 (rank association) = residuals {s['tao_geom']:.4g} + velocity "
            f"{s['tao_vel']:.4g} + similarity {s['tao_sim']:.4g}"
        )
    missing = max(0.0, s["tao_window"] - s["tao_geom"] - s["tao_sim"])
    return (
        f"{s['tao']:.3f} = alignment {s['tao_align']:.3f} + recursive filter "
        f"{s['tao'] - s['tao_align']:.3f} (it doubts its place with {s['recursive']:.3f}); over "
        f"the whole window {s['tao_window']:.3f} = residuals {s['tao_geom']:.3f} + similarity "
        f"{s['tao_sim']:.3f} + frames without support and turn {missing:.3f}"
    )


def _pose(pose: np.ndarray) -> str:
    return f"x = {pose[0]:.2f} m, y = {pose[1]:.2f} m, {np.degrees(pose[2]):.0f} degrees"


def _place(look: "Look") -> str:
    if look.map_index < 0:
        return "none: no pose is reported"
    gap = np.hypot(*(look.pose[:2] - look.branches.pose[0, :2]))
    return f"map row {look.map_index}, robot at {_pose(look.pose)}; {gap:.1f} m from branch 1, " + (
        "because a jump was noticed" if look.status == "lost" else "known from newer frames"
    )


def _branch(look: "Look") -> str:
    b = look.branches
    if not len(b.cost):
        return "none: no hypothesis at all"
    told = [f"1: cost {b.cost[0]:.3g}, started from {b.source[0]}, at {_pose(b.pose[0])}"]
    for number in range(1, len(b.cost)):
        away = np.hypot(*(b.pose[number, :2] - b.pose[0, :2]))
        told.append(f"{number + 1}: cost {b.cost[number]:.3g}, {away:.0f} m away")
    return "; ".join(told)


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
    against = sorted(int(frame) for frame in w.frame[~w.is_inlier])
    share = float(w.weight[~w.is_inlier].sum())
    if not against:
        return f"all of its {len(w.frame)} frames agree with branch 1"
    return (
        f"{len(against)} of its {len(w.frame)} frames disagree{'s' * (len(against) == 1)} with "
        f"branch 1, with {share:.0%} of the weight: {ranges(against)}"
    )


def _costs(look: "Look") -> str:
    costs = " ".join(f"{cost:.2f}" for cost in look.window.cost[:N_COSTS])
    unit = "" if look.unit == "1" else f" {look.unit}"
    tail = ", at most that" if look.unit == "1" else ""
    return (
        f"of the newest frames on branch 1, newest first: {costs}{unit}; a frame without support "
        f"costs {look.no_support:.3g}{unit}{tail}"
    )


def _support(look: "Look") -> str:
    stale = int(look.signals["stale"])
    if stale == 0:
        return "this frame itself supports the reported place"
    if stale >= len(look.window.frame):
        return "no frame of the window supports the reported place"
    last = f"frame {look.frame - stale}, {stale} before, is the last that does"
    return f"this frame does not support the reported place; {last}"


def _rival(look: "Look") -> str:
    s = look.signals
    if look.unit == "m^2":
        b = look.branches
        if len(b.cost) < 2:
            return "no branch lies at another place"
        more = b.cost[1] - b.cost[0]
        return f"the cheapest branch elsewhere costs {b.cost[1]:.4g} m^2, {more:.4g} more"
    if s["tao_rival"] >= look.no_support:
        return "no place elsewhere is supported at all"
    return (
        f"the cheapest place elsewhere costs {s['tao_rival']:.3f}, "
        f"{s['tao_rival'] - s['tao_window']:.3f} more than branch 1: "
        + ("ambiguous" if s["tao_rival"] - s["tao_window"] < 0.1 else "clearly worse")
    )


def _list(look: "Look") -> str:
    n = len(look.candidate)
    if not n:
        return "no candidates"
    most = np.log(n)
    return (
        f"{n} candidates, best similarity {look.similarity[0]:.3f}, entropy "
        f"{look.signals['entropy']:.2f} of at most {most:.2f} nat; this map tells "
        f"{look.map_recall:.0%} of its own places apart"
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
