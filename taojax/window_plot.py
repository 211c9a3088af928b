"""The picture of one frame: its window on the map, and what disagrees."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes

from taojax.plots import CYCLE, IN_MAP, INK, MAP_OUT, PALE

MARGIN = 0.15
"""Room around what is drawn, of its larger side."""

LABELS = ((8, 6), (-8, 6), (8, -13), (-8, -13), (8, 18))
"""Where the label of a branch stands, points: neighbours do not write over each other."""

CANDIDATE, BRANCH = CYCLE[4], CYCLE[2]


class WindowMarks(NamedTuple):
    """What is drawn; frames newest first."""

    map_m: Float[np.ndarray, "m 2"]
    path_m: Float[np.ndarray, "n 2"]
    """Odometry on the cheapest branch."""

    anchor_m: Float[np.ndarray, "n 2"]
    """Map position that each frame is paired with; NaN without one."""

    is_inlier: Bool[np.ndarray, " n"]
    candidate_m: Float[np.ndarray, "c 2"]
    """Of the newest frame, best first."""

    branch: Float[np.ndarray, "k 3"]
    """Poses of the branches told of, cheapest first."""

    branch_cost: Float[np.ndarray, " k"]


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


def draw_window(marks: WindowMarks, *, is_close: bool, ax: Axes) -> Axes:
    """Draw a window on the map.

    Args:
        marks: what to draw.
        is_close: show the window alone; else the whole map with the branches and candidates.
        ax: where to draw.
    """
    agrees, path = marks.is_inlier, marks.path_m
    ax.scatter(*marks.map_m.T, s=4, color="#b8b8b8", linewidths=0, label="map", zorder=1)
    if not is_close:
        ax.scatter(
            *marks.candidate_m.T, s=16, facecolors="none", edgecolors=CANDIDATE, linewidths=0.9,
            marker="s", label=f"candidates of this frame ({len(marks.candidate_m)})", zorder=3,
        )  # fmt: skip
    ax.plot(*path.T, color=INK, linewidth=0.9, zorder=4, label="odometry on the best branch")
    if is_close:
        for at, to, good in zip(path, marks.anchor_m, agrees, strict=True):
            if np.isfinite(to).all():
                colour, style = (IN_MAP, "-") if good else (PALE, ":")
                ax.plot(*np.stack([at, to], axis=1), color=colour, linewidth=0.8, linestyle=style)
    for chosen, colour, marker, size, name in (
        (agrees, IN_MAP, "o", 15, "frames that agree"),
        (~agrees, MAP_OUT, "x", 26, "frames that disagree"),
    ):
        if chosen.any():
            label = f"{name} ({int(chosen.sum())})"
            ax.scatter(*path[chosen].T, s=size, color=colour, marker=marker, linewidths=1.1,
                       label=label, zorder=5)  # fmt: skip
    (left, right), (low, high) = (
        _limits(path, marks.anchor_m)
        if is_close
        else _limits(marks.map_m, path, marks.branch[:, :2])
    )
    for number, (pose, cost) in enumerate(zip(marks.branch, marks.branch_cost, strict=True)):
        if is_close and number:
            break
        label = "robot on each branch, numbered by cost" if number == 0 and not is_close else None
        ax.scatter(*pose[:2], s=34, color=BRANCH, marker="D", edgecolors="white", linewidths=0.6,
                   label=label, zorder=8)  # fmt: skip
        _arrow(ax, pose, 0.07 * (right - left), BRANCH)
        if not is_close:
            right_of, up = LABELS[number % len(LABELS)]
            ax.annotate(
                f"{number + 1}: {cost:.2f}", pose[:2], xytext=(right_of, up), fontsize=8,
                ha="left" if right_of > 0 else "right", textcoords="offset points", color=INK,
                zorder=9,
            )  # fmt: skip
    ax.set(xlabel="x [m]", ylabel="y [m]", xlim=(left, right), ylim=(low, high))
    ax.set_aspect("equal", adjustable="box")
    return ax
