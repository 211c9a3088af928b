"""The picture that a report opens with: the test frames on the map, by final verdict and truth."""

from typing import NamedTuple

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
