"""Figures. Each function draws on the Axes it is given and returns it; nothing is shown or saved.

Colours are those of Okabe and Ito, distinct to colour-blind readers; line styles and markers
repeat what they say.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from matplotlib.axes import Axes

IN_MAP, MAP_OUT, INK, PALE = "#0072B2", "#D55E00", "#222222", "#9a9a9a"
CYCLE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#222222")
STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), "-")


class Mark(NamedTuple):
    """How one outcome is drawn."""

    label: str
    colour: str
    marker: str
    size: float


OUTCOMES = {
    "abstained": Mark("abstained", PALE, "|", 22),
    "grey": Mark("grey zone, not judged", "#c9c9c9", "_", 22),
    "rejected_out": Mark("rejected, truly off the map", "#56B4E9", "^", 13),
    "accepted_in": Mark("accepted, right place", IN_MAP, "o", 12),
    "rejected_in": Mark("rejected though in the map", "#CC79A7", "s", 14),
    "accepted_wrong": Mark("accepted, wrong place", MAP_OUT, "X", 30),
}
"""Outcome of a frame -> how it is drawn; the dangerous one last, on top."""

BELIEFS = {
    "refused_wrong": Mark("wrong pose, not accepted", "#CC79A7", "s", 12),
    "refused_right": Mark("right pose, not accepted", "#56B4E9", "^", 14),
    "accepted_right": Mark("right pose, accepted", IN_MAP, "o", 12),
    "accepted_wrong": Mark("wrong pose, accepted", MAP_OUT, "X", 34),
}
"""What the best pose of a frame was worth -> how it is drawn; the dangerous one last, on top."""


def retrieval_curve(recall: Mapping[float, np.ndarray], *, ax: Axes) -> Axes:
    """Draw recall@K over all queries.

    Args:
        recall: radius [m] -> recall@1..K.
        ax: where to draw.
    """
    for number, (radius, curve) in enumerate(recall.items()):
        k = np.arange(1, len(curve) + 1)
        ax.plot(k, curve, color=CYCLE[number], linestyle=STYLES[number], label=f"{radius:g} m")
    ax.set(xscale="log", xlabel="candidates K", ylabel="recall@K over all queries", ylim=(0, 1.02))
    ax.set_xticks([1, 5, 10, 100], ["1", "5", "10", "100"])
    ax.minorticks_off()
    ax.grid(alpha=0.25)
    ax.legend(title="right within", frameon=False, loc="lower right")
    return ax


def signal_trace(
    signal: Float[np.ndarray, " t"],
    is_out: Bool[np.ndarray, " t"],
    *,
    name: str,
    threshold: float,
    test_start: int,
    ax: Axes,
) -> Axes:
    """Draw one signal over the frames, shading those that truly lie off the map.

    Args:
        signal: larger = more likely off the map; NaN leaves a gap.
        is_out: which frames are map-out.
        name: with the unit; becomes the y label.
        threshold: frozen on the calibration split; NaN draws none.
        test_start: first frame of the test split.
        ax: where to draw.
    """
    frame = np.arange(len(signal))
    edges = np.flatnonzero(np.diff(np.r_[0, is_out.astype(int), 0]))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        ax.axvspan(start - 0.5, end - 0.5, color=MAP_OUT, alpha=0.15, linewidth=0)
    ax.plot(frame, signal, color=IN_MAP, linewidth=0.8)
    if np.isfinite(threshold):
        ax.axhline(threshold, color=INK, linestyle="--", linewidth=0.9)
    ax.axvline(test_start, color=INK, linestyle=":", linewidth=0.9)
    finite = signal[np.isfinite(signal)]
    if finite.size:
        # One wild frame must not flatten the rest; what is cut off still leaves at the top edge.
        low, high = np.percentile(finite, (0, 99.5))
        high = max(high, threshold) if np.isfinite(threshold) else high
        pad = 0.06 * (high - low) or 0.5
        ax.set_ylim(low - pad, high + pad)
    ax.set_xlim(0, max(1, len(signal) - 1))
    ax.set_ylabel(name, fontsize=8)
    ax.tick_params(labelsize=8)
    return ax


def verdict_map(
    map_m: Float[np.ndarray, "m 2"],
    query_m: Float[np.ndarray, "t 2"],
    matched_m: Float[np.ndarray, "t 2"],
    outcome: Shaped[np.ndarray, " t"],
    *,
    ax: Axes,
) -> Axes:
    """Draw where answers were accepted, rejected and wrongly accepted.

    Args:
        map_m: map positions, metres.
        query_m: true positions, metres.
        matched_m: answered positions, metres; a line ties each wrong one to the truth.
        outcome: keys of `OUTCOMES`.
        ax: where to draw.
    """
    ax.scatter(*map_m.T, s=3, color="#b8b8b8", linewidths=0, label="map", zorder=1)
    wrong = outcome == "accepted_wrong"
    # Many lines together must not hide what lies below.
    alpha = float(np.clip(40.0 / max(1, wrong.sum()), 0.1, 0.5))
    for truth, answer in zip(query_m[wrong], matched_m[wrong], strict=True):
        ax.plot(*np.stack([truth, answer], axis=1), color=MAP_OUT, linewidth=0.5, alpha=alpha)
    for order, (name, mark) in enumerate(OUTCOMES.items()):
        here = query_m[outcome == name]
        if len(here):
            ax.scatter(
                *here.T, s=mark.size, color=mark.colour, marker=mark.marker, linewidths=0.7,
                label=f"{mark.label} ({len(here)})", zorder=3 + order,
            )  # fmt: skip
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set_adjustable("datalim")
    ax.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncol=2)
    return ax


def curves(lines: Mapping[str, tuple[np.ndarray, np.ndarray]], *, x: str, y: str, ax: Axes) -> Axes:
    """Draw ROC or precision-recall curves on the unit square.

    Args:
        lines: name -> (x values, y values).
        x: label of the x axis.
        y: label of the y axis.
        ax: where to draw.
    """
    for number, (name, (right, up)) in enumerate(lines.items()):
        ax.plot(right, up, color=CYCLE[number], linestyle=STYLES[number], linewidth=1.3, label=name)
    ax.set(xlabel=x, ylabel=y, xlim=(-0.01, 1.01), ylim=(-0.01, 1.01))
    ax.grid(alpha=0.25)
    ax.legend(frameon=False, fontsize=8, loc="lower right")
    return ax


def reliability_diagram(
    promised: Float[np.ndarray, " b"],
    realised: Float[np.ndarray, " b"],
    count: np.ndarray,
    *,
    ax: Axes,
) -> Axes:
    """Draw the realised share of map-out frames over the promised probability.

    Args:
        promised: mean probability per bin.
        realised: share of map-out frames per bin.
        count: `(b,)` frames per bin; written beside each point when they differ.
        ax: where to draw.
    """
    ax.plot([0, 1], [0, 1], color=PALE, linestyle="--", label="perfectly calibrated")
    size = str(count.min()) if count.min() == count.max() else f"{count.min()} to {count.max()}"
    label = f"{len(count)} bins of {size} frames"
    ax.plot(promised, realised, color=IN_MAP, marker="o", markersize=5, label=label)
    ax.set(
        xlabel="promised probability of being map-out", ylabel="realised share of map-out frames",
        xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), aspect="equal",
    )  # fmt: skip
    ax.grid(alpha=0.25)
    ax.legend(frameon=False, fontsize=8, loc="upper left")
    return ax


def scenario_dots(
    groups: Mapping[str, Float[np.ndarray, "s 3"]],
    scenarios: tuple[str, ...],
    *,
    reference: Mapping[str, Float[np.ndarray, " s"]],
    label: str,
    ax: Axes,
) -> Axes:
    """Draw one number per scenario and signal with its interval.

    Args:
        groups: signal -> (value, low, high) per scenario; NaN = not measured.
        scenarios: names on the x axis.
        reference: signal -> published value per scenario, drawn as a hollow diamond.
        label: of the y axis.
        ax: where to draw.
    """
    at = np.arange(len(scenarios))
    for number, (name, table) in enumerate(groups.items()):
        x = at + 0.16 * (number - (len(groups) - 1) / 2)
        value, low, high = table.T
        ax.vlines(x, low, high, color=CYCLE[number], linewidth=1.5)
        ax.scatter(x, value, color=CYCLE[number], marker="osD^v"[number % 5], s=28, label=name)
        if name in reference:
            ax.scatter(
                x, reference[name], facecolors="none", edgecolors=INK, marker="D", s=42,
                label="paper" if name == next(iter(reference)) else None,
            )  # fmt: skip
    ax.set_xticks(at, list(scenarios))
    ax.set(ylabel=label, xlabel="scenario", xlim=(-0.6, len(scenarios) - 0.4), ylim=(-0.02, 1.02))
    ax.grid(alpha=0.25, axis="y")
    # Above the panel: inside, some corner always holds a point.
    ax.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=4)
    return ax


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
