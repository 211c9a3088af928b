"""What a report and the terminal say first: one sentence, one map and three numbers."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from taojax.audit.judgement import Judgement
from taojax.plots import map_limits

KINDS = {
    "abstained": "abstained",
    "rejected": "rejected",
    "aside": "accepted off the map, pose right: counts neither way",
    "right": "accepted, right",
    "wrong": "accepted, wrong",
}
"""Kind of a test frame -> its name in the legend, in the order of drawing: wrong ones on top."""

_WIDE = 1000.0

_MOST_HIGH = 0.75
"""Height of the picture, of its width, at most: a tall map leaves room at its sides."""

_FLAT = 0.4
"""Height of the picture, of its width, below which the numbers stand below it."""

_BAR = 0.2
"""Length of the scale bar, of the width, at most."""


class Entry(NamedTuple):
    """A line of the legend."""

    kind: str
    label: str
    frames: int
    n_right: int
    """Right answers among those that are not accepted."""

    first: int
    """Number of the first of them; -1 = there is none."""


class Drawing(NamedTuple):
    """The picture, ready for the page."""

    svg: str
    """Its shapes and colours are those of the page's style sheet."""

    legend: tuple[Entry, ...]
    before: int
    """Frames before the test half, drawn as a line and not counted."""

    bar_m: float
    """Length of the scale bar, metres."""

    bar_share: float
    """The same, of the width of the picture."""

    is_flat: bool


def kinds_of(judgement: Judgement) -> Shaped[np.ndarray, " t"]:
    """Return the key of `KINDS` of every frame.

    Args:
        judgement: of the run.
    """
    verdict, own = judgement.verdicts["verdict"], judgement.answers.final
    accepted = np.select([own.is_right, own.is_wrong], ["right", "wrong"], "aside")
    left = np.where(verdict == "reject", "rejected", "abstained")
    return np.where(verdict == "accept", accepted, left)


def _legend(judgement: Judgement, kind: np.ndarray, is_test: np.ndarray) -> tuple[Entry, ...]:
    found = []
    for name, label in KINDS.items():
        here = np.flatnonzero(is_test & (kind == name))
        if name == "aside" and not here.size:
            continue
        n_right = int(judgement.answers.final.is_right[here].sum())
        first = int(here[0]) if here.size else -1
        found.append(Entry(name, label, len(here), 0 if name == "right" else n_right, first))
    # The reader looks for what was accepted first.
    return tuple(reversed(found))


def _points(at: Float[np.ndarray, "n 2"]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in at)


def _marks(kind: str, at: Float[np.ndarray, "n 2"]) -> str:
    return f'<polyline class="dots {kind}" points="{_points(at)}"/>' if len(at) else ""


def _ties(truth: Float[np.ndarray, "n 2"], answer: Float[np.ndarray, "n 2"]) -> str:
    """Draw a line from each true to each answered position."""
    if not len(truth):
        return ""
    # Many lines together must not hide what lies below.
    opacity = float(np.clip(40.0 / len(truth), 0.15, 0.8))
    path = "".join(
        f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}"
        for (a, b), (c, d) in zip(truth, answer, strict=True)
    )  # fmt: skip
    return f'<path class="tie" stroke-opacity="{opacity:.2f}" d="{path}"/>'


def _bar(wide_m: float) -> float:
    """Return the longest of 1, 2, 5, 10, ... metres that is no longer than a bar may be."""
    most = _BAR * wide_m
    ten = 10.0 ** np.floor(np.log10(most))
    return float(max(step * ten for step in (1.0, 2.0, 5.0) if step * ten <= most))


def draw_opening(judgement: Judgement) -> Drawing:
    """Draw the test frames at their true positions, y up, equal axes, wrong acceptances on top.

    Args:
        judgement: of the run.
    """
    kind, is_test = kinds_of(judgement), judgement.splits.name == "test"
    answer = np.stack([judgement.verdicts["x_m"], judgement.verdicts["y_m"]], axis=1).astype(float)
    is_wrong: Bool[np.ndarray, " t"] = is_test & (kind == "wrong")
    low, high = map_limits(judgement.map_m, judgement.query_m, answer[is_wrong])
    wide_m, high_m = high - low
    room = max(0.0, high_m / _MOST_HIGH - wide_m)
    left, wide_m = low[0] - 0.5 * room, wide_m + room
    scale = _WIDE / wide_m
    place = lambda xy: np.stack([xy[:, 0] - left, high[1] - xy[:, 1]], axis=1) * scale
    tall = high_m * scale
    legend = _legend(judgement, kind, is_test)
    told = ", ".join(f"{entry.label} {entry.frames}" for entry in legend)
    before = judgement.query_m[~is_test]
    parts = [
        f'<svg viewBox="0 0 {_WIDE:.0f} {tall:.0f}" role="img" '
        f'aria-label="Map and test frames: {told}">',
        f'<polyline class="before" points="{_points(place(before))}"/>' if len(before) else "",
        _marks("map", place(judgement.map_m)),
        *(_marks(name, place(judgement.query_m[is_test & (kind == name)]))
          for name in KINDS if name != "wrong"),
        _ties(place(judgement.query_m[is_wrong]), place(answer[is_wrong])),
        _marks("wrong", place(judgement.query_m[is_wrong])),
        "</svg>",
    ]  # fmt: skip
    bar = _bar(float(wide_m))
    return Drawing(
        "".join(parts), legend, len(before), bar, bar / float(wide_m), tall < _FLAT * _WIDE
    )


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
