"""Draw kidnaps: each function draws on the Axes it is given and returns it, as in taojax.plots."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int, Shaped
from matplotlib.axes import Axes

from taojax.plots import CYCLE, IN_MAP, INK, MAP_OUT, PALE, STYLES, Mark

BELIEFS = {
    "refused_wrong": Mark("wrong pose, not accepted", "#CC79A7", "s", 12),
    "refused_right": Mark("right pose, not accepted", "#56B4E9", "^", 14),
    "accepted_right": Mark("right pose, accepted", IN_MAP, "o", 12),
    "accepted_wrong": Mark("wrong pose, accepted", MAP_OUT, "X", 34),
}
"""What the best pose of a frame was worth -> how it is drawn; the dangerous one last, on top."""


def recovery_curves(
    curves: Mapping[str, Float[np.ndarray, "f 3"]], *, strong: tuple[str, ...], ax: Axes
) -> Axes:
    """Draw the share of trials recovered over the frames after the jump.

    Args:
        curves: method -> (share, lower, upper) after 1, 2, ... frames.
        strong: methods drawn with a thick line and a band for the interval; a dozen bands would
            hide one another.
        ax: where to draw.
    """
    for number, (name, curve) in enumerate(curves.items()):
        frame, is_strong = np.arange(1, len(curve) + 1), name in strong
        colour, style = CYCLE[number % len(CYCLE)], STYLES[(number + number // 7) % len(STYLES)]
        top = 3 if is_strong else 2
        if is_strong:
            low, high = curve[:, 1:].T
            ax.fill_between(frame, low, high, color=colour, alpha=0.2, linewidth=0, zorder=1)
        ax.plot(
            frame, curve[:, 0], color=colour, linestyle=style, label=name, zorder=top,
            linewidth=2.2 if is_strong else 1.1, markersize=3.5, markevery=(number % 4, 4),
            marker="os^"[number // len(CYCLE) - 1] if number >= len(CYCLE) else None,
        )  # fmt: skip
    ax.set(xlabel="frames after the jump", ylim=(-0.02, 1.02))
    ax.set_xlim(1, max((len(curve) for curve in curves.values()), default=2))
    ax.grid(alpha=0.25)
    return ax


def kidnap_example(
    map_m: Float[np.ndarray, "m 2"],
    query_m: Float[np.ndarray, "t 2"],
    pose_m: Float[np.ndarray, "t 2"],
    state: Shaped[np.ndarray, " t"],
    jumps: Int[np.ndarray, " k"],
    *,
    ax: Axes,
) -> Axes:
    """Draw one kidnap log: where the robot was, where it believed to be, where it was carried.

    Args:
        map_m: map positions, metres.
        query_m: true positions, metres.
        pose_m: best poses, metres; NaN without one.
        state: keys of `BELIEFS` per frame.
        jumps: first frames after the jumps.
        ax: where to draw.
    """
    ax.scatter(*map_m.T, s=2, color="#cccccc", linewidths=0, label="map", zorder=1)
    edges = [0, *jumps.tolist(), len(query_m)]
    for number, (a, b) in enumerate(pairwise(edges)):
        label = "true path" if number == 0 else None
        ax.plot(*query_m[a:b].T, color=INK, linewidth=1.0, zorder=2, label=label)
        ax.annotate(
            f"{number + 1}", tuple(query_m[a]), xytext=(7, 7), textcoords="offset points",
            fontsize=9, weight="bold", color=INK, zorder=9,
        )  # fmt: skip
    for number, jump in enumerate(jumps):
        label = "carried to" if number == 0 else None
        ax.annotate(
            "", tuple(query_m[jump]), tuple(query_m[jump - 1]), zorder=3,
            arrowprops={"arrowstyle": "->", "color": PALE, "linestyle": ":"},
        )  # fmt: skip
        ax.plot([], [], color=PALE, linestyle=":", label=label)
    wrong = state == "accepted_wrong"
    for truth, pose in zip(query_m[wrong], pose_m[wrong], strict=True):
        ax.plot(*np.stack([truth, pose], axis=1), color=MAP_OUT, linewidth=0.5, alpha=0.5)
    for order, (name, mark) in enumerate(BELIEFS.items()):
        here = pose_m[state == name]
        if len(here):
            ax.scatter(
                *here.T, s=mark.size, color=mark.colour, marker=mark.marker, linewidths=0.7,
                label=f"{mark.label} ({len(here)})", zorder=4 + order,
            )  # fmt: skip
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set_adjustable("datalim")
    ax.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncol=3)
    return ax


def share_grid(
    share: Float[np.ndarray, "r c"],
    note: Shaped[np.ndarray, "r c"],
    *,
    rows: tuple[str, ...],
    columns: tuple[str, ...],
    ax: Axes,
) -> Axes:
    """Draw shares as a heat map with what they say written in.

    Args:
        share: in [0, 1]; NaN = not measured.
        note: second line of each cell.
        rows: labels from top to bottom.
        columns: labels from left to right.
        ax: where to draw.
    """
    ax.imshow(share, vmin=0.0, vmax=1.0, cmap="cividis", aspect="auto")
    for row, column in np.ndindex(*share.shape):
        value = share[row, column]
        text = "—" if np.isnan(value) else f"{100 * value:.0f} %\n{note[row, column]}"
        colour = "white" if value < 0.6 else INK
        ax.text(column, row, text, ha="center", va="center", fontsize=8, color=colour)
    ax.set_xticks(range(len(columns)), list(columns))
    ax.set_yticks(range(len(rows)), list(rows))
    return ax
