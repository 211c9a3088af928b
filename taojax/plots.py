"""Figures. Each function draws on the Axes it is given and returns it; nothing is shown or saved.

Colours are those of Okabe and Ito, distinct to colour-blind readers; line styles and markers
repeat what they say.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped
from matplotlib.axes import Axes
from matplotlib.transforms import offset_copy

IN_MAP, MAP_OUT, INK, PALE = "#0072B2", "#D55E00", "#222222", "#9a9a9a"

CYCLE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#222222")

STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), "-")

LEAST_SIDE = 0.22
"""The shorter side of a drawn map, of its longer one: a corridor keeps room for its marks."""

MAP_MARGIN = 0.04
"""Room around a map, of its longer side."""

BELOW_MAP_IN = 1.75
"""Room for labels and four rows of legend below a map, inches."""


class Mark(NamedTuple):
    """How one outcome is drawn."""

    label: str
    colour: str
    marker: str
    size: float


OUTCOMES = {
    "abstained": Mark("abstained", "#555555", "|", 26),
    "grey": Mark("grey zone, not judged", "#8f8f8f", "_", 26),
    "rejected_out": Mark("rejected, truly off the map", "#56B4E9", "^", 13),
    "accepted_in": Mark("accepted, right place", IN_MAP, "o", 12),
    "rejected_in": Mark("rejected though in the map", "#CC79A7", "s", 14),
    "accepted_wrong": Mark("accepted, wrong place", MAP_OUT, "X", 30),
}
"""Outcome of a frame -> how it is drawn; the dangerous one last, on top."""


def _legend_above(ax: Axes, *, columns: int) -> None:
    # Inside, some corner always holds a point of some run.
    ax.legend(
        frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=columns,
        columnspacing=1.2, handlelength=2.4,
    )  # fmt: skip


def retrieval_curve(recall: Mapping[float, np.ndarray], *, ax: Axes) -> Axes:
    """Draw recall@K over all queries.

    Args:
        recall: radius [m] -> recall@1..K.
        ax: where to draw.
    """
    for number, (radius, curve) in enumerate(recall.items()):
        k = np.arange(1, len(curve) + 1)
        ax.plot(
            k, curve, color=CYCLE[number], linestyle=STYLES[number], label=f"within {radius:g} m"
        )
    ax.set(xscale="log", xlabel="candidates K", ylabel="recall@K over all queries", ylim=(0, 1.02))
    ax.set_xticks([1, 5, 10, 100], ["1", "5", "10", "100"])
    ax.minorticks_off()
    ax.grid(alpha=0.25)
    _legend_above(ax, columns=len(recall))
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
        ax.axvspan(
            start - 0.5, end - 0.5, color=MAP_OUT, alpha=0.15, linewidth=0,
            label="truly off the map" if start == edges[0] else None,
        )  # fmt: skip
    ax.plot(frame, signal, color=IN_MAP, linewidth=0.8, label="signal")
    if np.isfinite(threshold):
        ax.axhline(threshold, color=INK, linestyle="--", linewidth=0.9, label="frozen threshold")
    ax.axvline(test_start, color=INK, linestyle=":", linewidth=0.9, label="start of the test split")
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


def map_limits(*groups: Float[np.ndarray, "_ 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Return corners around all finite points; neither side is less than a share of the other.

    Args:
        groups: positions to be drawn, metres.

    Returns:
        Lower left and upper right corner, `(2,)` each, metres.
    """
    points = np.concatenate(groups)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.zeros(2), np.ones(2)
    low, high = points.min(axis=0), points.max(axis=0)
    longest = max(float((high - low).max()), 1.0)
    side = np.maximum(high - low, LEAST_SIDE * longest) + 2 * MAP_MARGIN * longest
    return 0.5 * (low + high) - 0.5 * side, 0.5 * (low + high) + 0.5 * side


def map_size(
    *groups: Float[np.ndarray, "_ 2"], wide_in: float = 7.2, most_in: float = 6.2
) -> tuple[float, float]:
    """Return the size of a figure that a map fills, inches.

    Args:
        groups: positions to be drawn, metres.
        wide_in: its width.
        most_in: height of the axes at most; tall maps are narrower.
    """
    low, high = map_limits(*groups)
    across, up = high - low
    inside = min(most_in, (wide_in - 1.0) * float(up / across))
    return wide_in, inside + BELOW_MAP_IN


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
    low, high = map_limits(map_m, query_m, matched_m[wrong])
    ax.set(xlabel="x [m]", ylabel="y [m]", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal", adjustable="box", anchor="N")
    # In points below the axes: a share of their height would write over the label of a flat map.
    below = offset_copy(ax.transAxes, fig=ax.get_figure(root=True), y=-34, units="points")
    ax.legend(
        frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncol=2,
        bbox_transform=below,
    )  # fmt: skip
    return ax


def curves(
    lines: Mapping[str, tuple[np.ndarray, np.ndarray]],
    *,
    x: str,
    y: str,
    ax: Axes,
    strong: tuple[str, ...] = (),
) -> Axes:
    """Draw ROC or precision-recall curves on the unit square.

    Args:
        lines: name -> (x values, y values).
        x: label of the x axis.
        y: label of the y axis.
        ax: where to draw.
        strong: names whose lines are thicker, and unbroken but for the second of them.
    """
    ours = dict(zip(strong, ("-", (0, (4, 1.2))), strict=False))
    for number, (name, (right, up)) in enumerate(lines.items()):
        ax.plot(
            right, up, color=CYCLE[number], linestyle=ours.get(name, STYLES[number % len(STYLES)]),
            label=name, linewidth=2.4 if name in ours else 1.3,
        )  # fmt: skip
    ax.set(xlabel=x, ylabel=y, xlim=(-0.01, 1.01), ylim=(-0.01, 1.01))
    ax.grid(alpha=0.25)
    _legend_above(ax, columns=min(3, len(lines)))
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
    _legend_above(ax, columns=2)
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
    _legend_above(ax, columns=5)
    return ax


def graph_map(
    map_m: Float[np.ndarray, "m 2"],
    truth_m: Float[np.ndarray, "t 2"],
    path_m: Float[np.ndarray, "t 2"],
    wrong: Float[np.ndarray, "w 2 2"],
    *,
    ax: Axes,
) -> Axes:
    """Draw an optimised trajectory on the map, and the wrong closures that pulled at it.

    Args:
        map_m: map positions, metres; map and truth set the limits.
        truth_m: true positions, metres.
        path_m: optimised positions, metres.
        wrong: true and answered position of each wrong closure, metres.
        ax: where to draw.
    """
    ax.scatter(*map_m.T, s=2, color="#c8c8c8", linewidths=0, label="map", zorder=1)
    # Many lines together must not hide what lies below.
    alpha = float(np.clip(40.0 / max(1, len(wrong)), 0.12, 0.6))
    for line in wrong:
        ax.plot(*line.T, color=MAP_OUT, linewidth=0.5, alpha=alpha, zorder=2)
    if len(wrong):
        label = "wrong closure, from the true place to the answer"
        ax.plot([], [], color=MAP_OUT, linewidth=1.0, label=label)
    ax.plot(*truth_m.T, color=INK, linewidth=0.9, linestyle=":", label="truth", zorder=3)
    ax.plot(*path_m.T, color=IN_MAP, linewidth=1.1, label="optimised", zorder=4)
    low, high = map_limits(map_m, truth_m)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal", adjustable="box")
    ax.tick_params(labelsize=6)
    return ax


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
