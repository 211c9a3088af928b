"""The picture of one answer: its path on the map, and what disagrees."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes

from taojax.plots import CYCLE, IN_MAP, INK, MAP_OUT, PALE

MARGIN = 0.15
"""Room around what is drawn, of its larger side."""

ARROW = 0.07
"""Length of an arrow, of the side of its panel."""

AXES_POINTS = 340.0
"""Side of a panel, points; labels are placed before anything is laid out."""

LETTER, LINE = 5.2, 10.0
"""Width of a letter and height of a line of a label, points."""

REACH = (13.0, 20.0, 30.0, 42.0, 56.0)
"""How far from its place the middle of a label may stand, points."""

CANDIDATE, BRANCH = CYCLE[4], CYCLE[2]


class WindowMarks(NamedTuple):
    """What is drawn; frames in order."""

    map_m: Float[np.ndarray, "m 2"]
    path_m: Float[np.ndarray, "n 2"]
    """Odometry, carried by the answer."""

    anchor_m: Float[np.ndarray, "n 2"]
    """Map position that each frame is paired with; NaN without one."""

    is_inlier: Bool[np.ndarray, " n"]
    candidate_m: Float[np.ndarray, "c 2"]
    """Of the newest frame, best first."""

    place: Float[np.ndarray, "k 3"]
    """The answer and other places."""

    place_cost: Float[np.ndarray, " k"]


def _arrow(ax: Axes, pose: np.ndarray, length_m: float, colour: str) -> None:
    ax.annotate(
        "", xy=(pose[0] + length_m * np.cos(pose[2]), pose[1] + length_m * np.sin(pose[2])),
        xytext=(pose[0], pose[1]), zorder=7,
        arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1.4, "shrinkA": 0},
    )  # fmt: skip


def _limits(*groups: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return square limits around everything that is finite."""
    points = np.concatenate(groups)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    half = (0.5 + MARGIN) * max(float((high - low).max()), 1.0)
    x, y = (float(v) for v in 0.5 * (low + high))
    return (x - half, x + half), (y - half, y + half)


def _hits(box: np.ndarray, points: Float[np.ndarray, "p 2"]) -> int:
    """Count the points inside a box of (left, low, right, high)."""
    return int(np.sum(np.all((points > box[:2]) & (points < box[2:]), axis=1)))


def place_labels(
    at: Float[np.ndarray, "k 2"], texts: Sequence[str], busy: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, "k 2"]:
    """Find a middle for each label that hides neither another label nor what is drawn.

    Args:
        at: what is labelled, points.
        texts: one line each.
        busy: where something is drawn, points.

    Returns:
        Offsets from `at`, points; the nearest of the best.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False) + 0.4
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ways = np.concatenate([reach * ring for reach in REACH])
    boxes: list[np.ndarray] = []
    found = np.zeros((len(texts), 2))
    for number, (spot, text) in enumerate(zip(at, texts, strict=True)):
        half = 0.5 * np.array([LETTER * len(text) + 4.0, LINE + 2.0])
        costs = []
        for way in ways:
            box = np.concatenate([spot + way - half, spot + way + half])
            shared = [np.minimum(box[2:], o[2:]) - np.maximum(box[:2], o[:2]) for o in boxes]
            overlap = sum(float(np.prod(np.maximum(side, 0.0))) for side in shared)
            off = np.sum(np.maximum(-box[:2], 0.0) + np.maximum(box[2:] - AXES_POINTS, 0.0))
            costs.append(overlap + 6.0 * _hits(box, busy) + 20.0 * float(off) + np.hypot(*way) / 4)
        found[number] = ways[int(np.argmin(costs))]
        middle = spot + found[number]
        boxes.append(np.concatenate([middle - half, middle + half]))
    return found


def _label_places(marks: WindowMarks, corner: np.ndarray, side_m: float, ax: Axes) -> None:
    """Number the places and write their costs."""
    points = lambda xy: (xy - corner) * AXES_POINTS / side_m
    pose, cost = marks.place, marks.place_cost
    ahead = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1)
    steps = ARROW * side_m * np.linspace(0.0, 1.1, 7)
    arrows = (pose[:, None, :2] + steps[None, :, None] * ahead[:, None]).reshape(-1, 2)
    drawn = (marks.map_m, marks.candidate_m, marks.path_m, arrows, arrows, pose[:, :2])
    busy = points(np.concatenate([part for part in drawn if len(part)]))
    texts = [f"{number}: {value:.2f}" for number, value in enumerate(cost, start=1)]
    offsets = place_labels(points(pose[:, :2]), texts, busy)
    for spot, text, offset in zip(pose[:, :2], texts, offsets, strict=True):
        ax.annotate(
            text, spot, xytext=offset, textcoords="offset points", fontsize=8, color=INK,
            ha="center", va="center", zorder=9,
            arrowprops={"arrowstyle": "-", "color": PALE, "linewidth": 0.6, "shrinkA": 0,
                        "shrinkB": 4},
        )  # fmt: skip


def draw_window(marks: WindowMarks, *, is_close: bool, ax: Axes) -> Axes:
    """Draw a window on the map.

    Args:
        marks: what to draw.
        is_close: show the window alone; else the whole map with the places and candidates.
        ax: where to draw.
    """
    agrees, path = marks.is_inlier, marks.path_m
    ax.scatter(*marks.map_m.T, s=4, color="#b8b8b8", linewidths=0, label="map", zorder=1)
    if not is_close:
        ax.scatter(
            *marks.candidate_m.T, s=16, facecolors="none", edgecolors=CANDIDATE, linewidths=0.9,
            marker="s", label=f"candidates of this frame ({len(marks.candidate_m)})", zorder=3,
        )  # fmt: skip
    ax.plot(*path.T, color=INK, linewidth=0.9, zorder=4, label="odometry, carried by the answer")
    if is_close:
        label = "from a frame to the map pose it is paired with"
        for at, to, good in zip(path, marks.anchor_m, agrees, strict=True):
            if np.isfinite(to).all():
                colour, style = (IN_MAP, "-") if good else (PALE, ":")
                ends = np.stack([at, to], axis=1)
                ax.plot(*ends, color=colour, linewidth=0.8, linestyle=style, label=label)
                label = None
    for chosen, colour, marker, size, name in (
        (agrees, IN_MAP, "o", 15, "frames that agree"),
        (~agrees, MAP_OUT, "x", 26, "frames that disagree"),
    ):
        if chosen.any():
            label = f"{name} ({int(chosen.sum())})"
            ax.scatter(*path[chosen].T, s=size, color=colour, marker=marker, linewidths=1.1,
                       label=label, zorder=5)  # fmt: skip
    (left, right), (low, high) = (
        _limits(path, marks.anchor_m[agrees])
        if is_close
        else _limits(marks.map_m, path, marks.place[:, :2])
    )
    for number, pose in enumerate(marks.place):
        if is_close and number:
            break
        label = (
            "the answer (1) and other places, with costs" if number == 0 and not is_close else None
        )
        ax.scatter(*pose[:2], s=34, color=BRANCH, marker="D", edgecolors="white", linewidths=0.6,
                   label=label, zorder=8)  # fmt: skip
        _arrow(ax, pose, ARROW * (right - left), BRANCH)
    if not is_close:
        _label_places(marks, np.array([left, low]), right - left, ax)
    ax.set(xlabel="x [m]", ylabel="y [m]", xlim=(left, right), ylim=(low, high))
    ax.set_aspect("equal", adjustable="box")
    return ax
