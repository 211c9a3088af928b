"""Pictures of the guide (notebooks/README.md): a window on two branches, radii, a frozen level."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from taojax import risk
from taojax.core.procrustes import fit_se2
from taojax.core.se2 import transform
from taojax.files.tables import read_table
from taojax.plots import IN_MAP, INK, MAP_OUT, PALE

SIDES = (("in_map", "truly on the map", IN_MAP), ("map_out", "truly off the map", MAP_OUT))
STEP_M = 5.0
RADII_M = 12.0, 24.0


def _road(n: int) -> np.ndarray:
    """Return points one step apart along a road that runs straight and then turns."""
    heading = np.cumsum(np.where(np.arange(n) < n // 2, 0.0, 0.14))
    return np.cumsum(STEP_M * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)


def _branch(path: np.ndarray, road: np.ndarray, anchors: np.ndarray, title: str, ax: Axes) -> None:
    """Lay the odometry path over the anchors of one hypothesis and draw what is left between."""
    p, q = jnp.asarray(path), jnp.asarray(road[anchors])
    fit = fit_se2(p, q, jnp.ones(len(path)))
    laid = np.asarray(transform(fit.T_map_odom[None], p))
    gap = np.hypot(*(laid - road[anchors]).T)
    ax.plot(*road.T, ".", color=PALE, markersize=5, label="map")
    for a, b in zip(laid, road[anchors], strict=True):
        ax.plot(*np.stack([a, b]).T, color=MAP_OUT, linewidth=1.6)
    ax.plot(*road[anchors].T, "s", color="#E69F00", markersize=6, label="anchors: matches")
    ax.plot(*laid.T, "-o", color=IN_MAP, markersize=4, linewidth=1.2, label="odometry on them")
    ax.set_title(f"{title}: {gap.mean():.1f} m of misfit per frame", fontsize=10)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


def window() -> Figure:
    """Draw one window of odometry on a right and on a wrong hypothesis (made up)."""
    rng, road = np.random.default_rng(2), _road(30)
    right = np.arange(14, 26)
    turned = road[right] - road[right[0]]
    path = turned @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + rng.normal(0, 0.6, turned.shape)
    wrong = np.array([3, 4, 3, 6, 2, 9, 5, 8, 4, 10, 6, 9])
    figure = Figure(figsize=(8.6, 3.6), layout="constrained")
    left, other = figure.subplots(1, 2, sharex=True, sharey=True)
    _branch(path, road, right, "right place", left)
    _branch(path, road, wrong, "wrong place", other)
    lines, names = left.get_legend_handles_labels()
    lines += left.plot([], [], color=MAP_OUT, linewidth=1.6)
    names += ["misfit: the cost"]
    figure.legend(lines, names, loc="outside lower center", ncol=4, frameon=False, fontsize=9)
    return figure


def radii() -> Figure:
    """Draw what in-map, grey and map-out mean about the end of a map (made up)."""
    x = np.arange(0.0, 61.0, STEP_M)
    query = np.stack([np.arange(2.0, 121.0, STEP_M), np.full(24, 4.0)], axis=1)
    nearest = np.hypot(query[:, None, 0] - x[None], query[:, None, 1]).min(axis=1)
    r_in, r_out = RADII_M
    figure = Figure(figsize=(8.6, 3.4), layout="constrained")
    ax = figure.subplots()
    ax.plot(x, np.zeros_like(x), "s", color=PALE, markersize=6, label="map poses")
    for radius, style, name in ((r_in, "-", "r_in"), (r_out, "--", "r_out")):
        ax.add_patch(Circle((x[-1], 0.0), radius, fill=False, linestyle=style, color=INK))
        ax.annotate(
            name, (x[-1], -radius), (0, 5), textcoords="offset points", ha="center", fontsize=9
        )
    kinds = {
        "in-map: should be accepted": (nearest < r_in, "o", IN_MAP),
        "grey: counted, not judged": ((nearest >= r_in) & (nearest <= r_out), "_", "#777777"),
        "map-out: must be rejected": (nearest > r_out, "X", MAP_OUT),
    }
    for label, (chosen, marker, colour) in kinds.items():
        ax.plot(*query[chosen].T, marker, color=colour, markersize=7, label=label)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", ylim=(-29, 29))
    figure.legend(loc="outside lower center", ncol=4, frameon=False, fontsize=9)
    return figure


def level(run: Path) -> Figure:
    """Draw how a level is frozen on one half of a judged run and used on the other."""
    frames, said = (read_table(run / f"{name}.csv", name) for name in ("labels", "verdicts"))
    p = np.clip(said["probability_wrong"].astype(float), 1e-4, 1 - 1e-4)
    odds = np.log(p) - np.log1p(-p)
    frozen = risk.read_calibration(run / "calibration.toml").final.level
    at = np.log(frozen) - np.log1p(-frozen)
    edges = np.linspace(-7.0, 9.5, 34)
    figure = Figure(figsize=(8.6, 3.4), layout="constrained")
    for ax, part, title in zip(
        figure.subplots(1, 2, sharey=True),
        ("calibration", "test"),
        ("calibration half: the level is set here", "test half: the level is only used here"),
        strict=True,
    ):
        for label, name, colour in SIDES:
            chosen = (frames["label"] == label) & (frames["split"] == part)
            style = "stepfilled" if label == "in_map" else "step"
            ax.hist(odds[chosen], edges, histtype=style, color=colour, label=name, linewidth=1.8)
        ax.axvline(
            at, color=INK, linestyle="--", label="frozen: highest level that keeps the promise"
        )
        ax.set_xlabel("log odds that the final answer is wrong")
        ax.set_title(title, fontsize=10)
    first = figure.axes[0]
    first.set(ylabel="frames", ylim=(0, 1.25 * first.get_ylim()[1]))
    for word, side, align in (("accept ", -6, "right"), ("reject", 6, "left")):
        first.annotate(
            word, (at, 0.92), (side, 0), ("data", "axes fraction"), "offset points",
            ha=align, fontsize=9,
        )  # fmt: skip
    lines, names = first.get_legend_handles_labels()
    figure.legend(lines, names, loc="outside lower center", ncol=3, frameon=False, fontsize=9)
    return figure
