"""`python -m benchmarks promise`: is the promise kept on simulated recordings that nobody tuned on?

Each recording is a world of its own: how much of the drive the map covers, how much places alias,
how the odometry drifts, how far apart frames are and how noisy views are is drawn anew. The shipped
numbers and those refined on the recording's first half judge its second half, at every share of
wrong answers that may be asked for. All worlds have one shape, so that nothing compiles twice.
Everything here is simulated; the shipped numbers have seen twenty-three worlds of this simulator,
with other seeds.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from benchmarks.pictures import save
from benchmarks.pool import Recording
from benchmarks.verdict import (
    LEAST_ACCEPTED,
    LEAST_RIGHT,
    MAX_WRONGS,
    answered,
    half_numbers,
    halves,
    write_rows,
)
from taojax.audit.labels import nearest_map_distance
from taojax.config import VerdictConfig
from taojax.datasets.simulate import WorldConfig, make_world
from taojax.plots import CYCLE, PALE, STYLES
from taojax.risk import at_most, probability_wrong, shipped
from taojax.runtime.retrieval import retrieve

N_RECORDINGS, N_QUICK = 1000, 50
FIRST_SEED = 10_000
"""Seeds from here on; nothing else in this project draws worlds from them."""

MAP_FRAMES, QUERY_FRAMES = 400, 480
"""Of every recording."""

RADIUS_M = 10.0
PROMISED = 0.05
"""Share asked for in the panels by what was drawn."""

MAP_STEP_M = 2.7
"""Of the simulated world."""

RATES = 0.5, 1.0, 2.0, 4.0
"""Query frames per map frame."""

DRAWN = {
    "off_share": "share of the test half off the map",
    "alias": "share of appearance in common",
    "drift": "odometry scale error",
    "rate": "query frames per map frame",
    "noise": "noise of the query views",
}
"""What makes one recording another: column -> axis of the figure."""

BINS = 5
"""Parts of each of them in the figure."""

RESAMPLES = 2000
"""Of recordings, for the intervals."""


def knobs(seed: int) -> dict[str, float]:
    """Draw what makes one recording another.

    Args:
        seed: of the recording.

    Returns:
        `mapped` share of the drive, `alias` share of the appearance, `drift` as a share of the
        way, query frames per map frame (`rate`), `noise` of the query views.
    """
    rng = np.random.default_rng([seed, 99])
    return {
        "mapped": float(rng.uniform(0.1, 1.0)),
        "alias": float(rng.uniform(0.05, 0.75)),
        "drift": float(rng.uniform(0.0, 0.06)),
        "rate": float(rng.choice(RATES)),
        "noise": float(rng.uniform(0.3, 1.2)),
    }


def mapped_rows(n: int, kept: int, rng: np.random.Generator) -> np.ndarray:
    """Return which `kept` of `n` map frames stay: one to three stretches in random places."""
    parts = int(rng.integers(1, 4))
    inside = np.diff(np.concatenate([[0], np.sort(rng.choice(kept + 1, parts - 1)), [kept]]))
    outside = np.diff(np.concatenate([[0], np.sort(rng.choice(n - kept + 1, parts)), [n - kept]]))
    is_kept = [np.zeros(outside[0], bool)]
    for there, gone in zip(inside, outside[1:], strict=True):
        is_kept += [np.ones(there, bool), np.zeros(gone, bool)]
    return np.flatnonzero(np.concatenate(is_kept))


def recording(seed: int) -> tuple[Recording, dict[str, float]]:
    """Simulate one recording of `QUERY_FRAMES` over a map of `MAP_FRAMES`."""
    drawn = knobs(seed)
    rng = np.random.default_rng([seed, 98])
    n_map = max(round(MAP_FRAMES / drawn["mapped"]), round(QUERY_FRAMES / drawn["rate"]))
    n_query = round(n_map * drawn["rate"])
    way_m = n_map * MAP_STEP_M
    config = WorldConfig(
        n_map=n_map, n_query=n_query, loop_m=way_m + 100.0, driven_m=way_m,
        route_seed=seed, alias=drawn["alias"], common=min(0.35, 0.95 - drawn["alias"]),
        query_noise=drawn["noise"], odometry_scale=drawn["drift"],
        odometry_yaw_rad_per_m=0.02 * drawn["drift"], offset_cap_m=4.0,
    )  # fmt: skip
    world = make_world(config, seed)
    rows = mapped_rows(n_map, MAP_FRAMES, rng)
    start = int(rng.integers(0, n_query - QUERY_FRAMES + 1))
    part = slice(start, start + QUERY_FRAMES)
    views = world.map_descriptors[rows]
    index, similarity = retrieve(views, world.query_descriptors[part])
    odometry = world.odometry[part, 1:].astype(np.float32)
    odometry[0] = 0.0
    made = Recording(
        f"promise/{seed}", "promise", world.map_poses[rows, 1:], odometry, index, similarity, views,
        world.query_poses[part, 1:3], RADIUS_M, RADIUS_M,
    )  # fmt: skip
    return made, drawn


def rows_of(seed: int, config: VerdictConfig) -> list[dict[str, Any]]:
    """Judge one recording's second half by shipped and refined numbers, at every share asked for.

    Args:
        seed: of the recording.
        config: of the verdicts.

    Returns:
        One row per kind of verdict, numbers and share asked for: what was drawn, and how many of
        the accepted answers are right and wrong.
    """
    made, drawn = recording(seed)
    one, rows = answered(made, config), []
    _, second = halves(one)
    nearest_m = nearest_map_distance(made.truth_m[second], made.map_poses[:, :2])
    drawn["off_share"] = float(np.mean(nearest_m > RADIUS_M))
    for kind in ("final", "now"):
        own, columns = getattr(one.answers, kind), getattr(one, kind)
        for use in ("shipped", "refined"):
            risk = half_numbers(one, kind, use, getattr(shipped(), kind))
            p = probability_wrong(risk, columns)
            for most in MAX_WRONGS:
                accepted = second & (p <= at_most(risk, most).level)
                rows.append({
                    "seed": seed, "verdict": kind, "numbers": use, "max_wrong": most,
                    "wrong": int((accepted & own.is_wrong).sum()),
                    "right": int((accepted & own.is_right).sum()),
                    "right_total": int((second & own.is_right).sum()),
                } | drawn)  # fmt: skip
    return rows


def pooled_share(rows: Sequence[dict[str, Any]]) -> tuple[float, float, float]:
    """Return the wrong share of all accepted answers and its interval over recordings."""
    wrong = np.array([row["wrong"] for row in rows], float)
    total = wrong + np.array([row["right"] for row in rows], float)
    share = float(wrong.sum() / max(total.sum(), 1.0))
    picks = np.random.default_rng(0).integers(0, len(rows), (RESAMPLES, len(rows)))
    shares = wrong[picks].sum(axis=1) / np.maximum(total[picks].sum(axis=1), 1.0)
    low, high = np.quantile(shares, (0.025, 0.975))
    return share, float(low), float(high)


def _chosen(
    rows: Sequence[dict[str, Any]], kind: str, use: str, most: float
) -> list[dict[str, Any]]:
    return [r for r in rows if (r["verdict"], r["numbers"], r["max_wrong"]) == (kind, use, most)]


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Say for every kind of verdict, numbers and share asked for what became of the promise.

    Returns:
        Rows with the wrong share over all accepted answers and its 95 % interval over recordings,
        the mean recall of recordings with ten right answers or more, and the share of recordings
        with `LEAST_ACCEPTED` accepted answers or more that broke the promise.
    """
    found = []
    keys = dict.fromkeys((row["verdict"], row["numbers"], row["max_wrong"]) for row in rows)
    for kind, use, most in keys:
        own = _chosen(rows, kind, use, most)
        share, low, high = pooled_share(own)
        recalls = [r["right"] / r["right_total"] for r in own if r["right_total"] >= LEAST_RIGHT]
        big = [r for r in own if r["right"] + r["wrong"] >= LEAST_ACCEPTED]
        broken = [r["wrong"] > most * (r["right"] + r["wrong"]) for r in big]
        found.append({
            "verdict": kind, "numbers": use, "max_wrong": most, "recordings": len(own),
            "accepted": sum(r["right"] + r["wrong"] for r in own),
            "wrong_share": share, "wrong_lo": low, "wrong_hi": high,
            "recall": float(np.mean(recalls)) if recalls else float("nan"),
            "with_20_accepted": len(big),
            "broke": float(np.mean(broken)) if broken else float("nan"),
        })  # fmt: skip
    return found


def draw(rows: Sequence[dict[str, Any]]) -> Figure:
    """Draw the realised wrong share against the promised one, and at 5 % by what was drawn."""
    figure = Figure(figsize=(11, 6.4), layout="constrained")
    axes, said = figure.subplots(2, 3).ravel(), summary(rows)
    kinds = [(kind, use) for kind in ("final", "now") for use in ("shipped", "refined")]
    for number, (kind, use) in enumerate(kinds):
        style = {"color": CYCLE[number], "linestyle": STYLES[number], "marker": "o", "ms": 4}
        table = [row for row in said if (row["verdict"], row["numbers"]) == (kind, use)]
        at = np.array([row["max_wrong"] for row in table])
        share = np.array([row["wrong_share"] for row in table])
        spread = np.abs(np.array([[r["wrong_lo"], r["wrong_hi"]] for r in table]).T - share)
        axes[0].errorbar(at, share, spread, label=f"{kind}, {use}", capsize=2, **style)
    axes[0].plot([0, max(MAX_WRONGS)], [0, max(MAX_WRONGS)], color=PALE, lw=1)
    axes[0].set(xlabel="promised at most (--max-wrong)", ylabel="wrong among the accepted",
                title="all recordings")  # fmt: skip
    axes[0].legend(frameon=False, fontsize=8)
    for ax, (name, label) in zip(axes[1:], DRAWN.items(), strict=True):
        ax.axhline(PROMISED, color=PALE, lw=1)
        for number, (kind, use) in enumerate(kinds):
            own = _chosen(rows, kind, use, PROMISED)
            value = np.array([row[name] for row in own])
            edges = np.unique(np.quantile(value, np.linspace(0, 1, BINS + 1)))
            part = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
            bins = [[r for r, b in zip(own, part, strict=True) if b == k]
                    for k in range(len(edges) - 1)]  # fmt: skip
            x = [float(np.mean([r[name] for r in inside])) for inside in bins if inside]
            y = [pooled_share(inside)[0] for inside in bins if inside]
            ax.plot(x, y, color=CYCLE[number], linestyle=STYLES[number], marker="o", ms=4)
        ax.set(xlabel=label, ylabel="wrong among the accepted", title=f"promised {PROMISED:.0%}")
    for ax in axes:
        ax.grid(alpha=0.25)
        ax.set_ylim(bottom=0)
    return figure


def run(out: Path, *, quick: bool) -> None:
    """Simulate, judge, write both tables and the figure.

    Args:
        out: folder to make.
        quick: fifty recordings.
    """
    n, config = N_QUICK if quick else N_RECORDINGS, VerdictConfig()
    seeds = tqdm(range(FIRST_SEED, FIRST_SEED + n), unit="recording")
    rows = [row for seed in seeds for row in rows_of(seed, config)]
    out.mkdir(parents=True, exist_ok=True)
    write_rows(out / "recordings.csv", rows)
    table = summary(rows)
    write_rows(out / "promise.csv", table)
    save(draw(rows), out / "promise")
    for row in table:
        print(
            f"{row['verdict']}, {row['numbers']}, promised {row['max_wrong']:.0%}: "
            f"{row['wrong_share']:.3f} ({row['wrong_lo']:.3f} to {row['wrong_hi']:.3f}) of "
            f"{row['accepted']} accepted wrong, recall {row['recall']:.2f}, broken on "
            f"{row['broke']:.3f} of {row['with_20_accepted']} recordings"
        )
