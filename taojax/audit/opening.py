"""What a report and the terminal say first: one sentence and three numbers."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from taojax.audit.judgement import Judgement

UNKNOWN = "interval unknown"
"""Said where every resample gives the same number; the glossary explains it."""

TOO_SHORT = "The recording is too short to hold a test split: nothing is scored out of sample."


class Number(NamedTuple):
    """One of the three numbers."""

    name: str
    text: str
    about: str
    """What it counts, in one line."""

    word: str
    """Its entry in the glossary."""

    is_broken: bool = False
    """Whether it is above what was promised."""


def accepted_row(judgement: Judgement, verdict: str) -> dict[str, Any]:
    """Return one row of tables/verdicts.csv: now or final."""
    table = judgement.accepted
    at = list(table["verdict"]).index(verdict)
    return {name: values[at] for name, values in table.items()}


def percent(share: float) -> str:
    """Return a share in per cent; what is not 0 or 1 is not rounded to it, NaN is a dash."""
    if np.isnan(share):
        return "—"
    if 0.0 < share < 0.001:
        return "< 0.1 %"
    if 0.999 < share < 1.0:
        return "> 99.9 %"
    return f"{100.0 * share:.1f}".removesuffix(".0") + " %"


def _interval(row: Mapping[str, Any], name: str) -> str:
    low, high = row[f"{name}_lo"], row[f"{name}_hi"]
    if not np.isfinite(low) or low == high:
        return UNKNOWN
    return f"95 % interval {percent(low).removesuffix(' %')} to {percent(high)}"


def _promised(judgement: Judgement) -> str:
    """Return what is promised without the share that it promises."""
    row = accepted_row(judgement, "final")
    head = str(row["promise"]).partition(": ")[0]
    return head.removeprefix(f"at most {row['max_wrong']:.0%} of the accepted answers wrong ")


def is_refused(judgement: Judgement) -> bool:
    """Say whether the calibration half supports no promise, so that nothing is accepted."""
    return bool(np.isnan(judgement.calibration.final.level))


def is_broken(row: Mapping[str, Any]) -> bool:
    """Say whether more of the accepted answers are wrong than was promised.

    Args:
        row: of tables/verdicts.csv.
    """
    return bool(row["wrong_share"] > row["max_wrong"])


def sentence(judgement: Judgement) -> str:
    """Say of the accepted how many are right, of the right how many are accepted, what is promised.

    Args:
        judgement: of the run; only its test half is counted.
    """
    frames = len(judgement.splits.test.frame)
    if not frames:
        return TOO_SHORT
    row = accepted_row(judgement, "final")
    n, right, total = (int(row[name]) for name in ("accepted", "right", "right_total"))
    most = percent(float(row["max_wrong"]))
    if n:
        promise = (
            f"at most {most} wrong were promised, {_promised(judgement)}, and "
            f"{percent(float(row['wrong_share']))} are"
            if is_broken(row)
            else f"at most {most} wrong are promised, {_promised(judgement)}"
        )
        return (
            f"{right} of {n} accepted answers are right, and {right} of {total} right answers are "
            f"accepted; {promise}."
        )
    found = f"though {total} answers are right" if total else "and no answer is right"
    why = (
        f"the calibration half supports no promise of at most {most} wrong"
        if is_refused(judgement)
        else "no closure of this recording should enter a graph"
    )
    return f"No closure is accepted on the {frames} test frames, {found}: {why}."


def numbers(judgement: Judgement) -> tuple[Number, Number, Number]:
    """Return the wrong share and the recall of tables/verdicts.csv, and what is promised.

    Args:
        judgement: of the run; only its test half is counted.
    """
    row, frames = accepted_row(judgement, "final"), len(judgement.splits.test.frame)
    n, wrong, right, total = (
        int(row[name]) for name in ("accepted", "wrong", "right", "right_total")
    )
    within = f"{judgement.config.audit.wrong_m:g} m"
    if n:
        one = (
            f"{wrong} of {n} accepted test answers lie more than {within} off, "
            f"{_interval(row, 'wrong')}"
        )
    else:
        one = f"none of {frames} test frames is accepted" if frames else "there is no test half"
    if total:
        two = f"{right} of {total} right test answers, {_interval(row, 'recall')}"
    else:
        two = "no test answer is right" if frames else "there is no test half"
    if is_refused(judgement):
        # What was found and what would help; that nothing is accepted the sentence has said.
        three, said = "nothing", str(row["promise"]).partition(": ")[2]
    else:
        three = f"at most {percent(float(row['max_wrong']))}"
        said = f"of the accepted answers wrong, {_promised(judgement)}"
    share, recall = (percent(float(row[name])) for name in ("wrong_share", "recall"))
    return (
        Number("wrong among the accepted", share, one, "wrong share", is_broken(row)),
        Number("of the right ones accepted", recall, two, "recall"),
        Number("promised", three, said, "accepted"),
    )


def lines(judgement: Judgement) -> tuple[str, ...]:
    """Return the three numbers as the terminal prints them, a line each.

    Args:
        judgement: of the run.
    """
    return tuple(f"{n.name}: {n.text} ({n.about})" for n in numbers(judgement))


def summary_sentence(judgements: Mapping[str, Judgement]) -> str:
    """Say the same over several scenarios, and in which the promise did not hold.

    Args:
        judgements: name of the scenario -> what was concluded of it.
    """
    rows = {name: accepted_row(judged, "final") for name, judged in judgements.items()}
    n, right, total = (
        sum(int(row[name]) for row in rows.values())
        for name in ("accepted", "right", "right_total")
    )
    many = f"{len(rows)} scenario" + ("s" if len(rows) != 1 else "")
    if not n:
        return f"No closure is accepted in {many}, though {total} answers are right."
    most = percent(max(float(row["max_wrong"]) for row in rows.values()))
    broken = [name for name, row in rows.items() if is_broken(row)]
    empty = [name for name, row in rows.items() if not row["accepted"]]
    kept = (
        f"more than the promised {most} are wrong in {', '.join(broken)}"
        if broken
        else f"no scenario has more than the promised {most} wrong ones"
    )
    nothing = f"; nothing is accepted in {', '.join(empty)}" if empty else ""
    return (
        f"Over {many} {right} of {n} accepted answers are right, and {right} of {total} right "
        f"answers are accepted; {kept}{nothing}."
    )


def summary_lines(judgements: Mapping[str, Judgement]) -> tuple[str, ...]:
    """Return what the terminal prints over several scenarios: a sentence, then a line for each.

    Args:
        judgements: name of the scenario -> what was concluded of it.
    """
    told = {
        name: ", ".join(f"{number.name} {number.text}" for number in numbers(judged))
        for name, judged in judgements.items()
    }
    return (summary_sentence(judgements), *(f"{name}: {said}" for name, said in told.items()))
