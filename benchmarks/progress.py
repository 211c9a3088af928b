"""`python -m benchmarks progress`: the paper's Table 3, route progress without poses.

Every set goes the way of any other data folder: written by `taojax.datasets.progress`, scored and
sealed, judged. Nothing on that way knows that all positions lie on one line. Descriptors are real,
odometry is simulated. Two maps each: all anchors, and every second one.

`<data>/kri/map_descriptors.npy` and `query_descriptors.npy`, rows in the order driven, add the
paper's own pair; the map is thinned to its 1,000 frames.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import sets
from benchmarks.entrants import rivals
from taojax.audit import labels, tables
from taojax.audit.judgement import Judgement, judge
from taojax.audit.labels import read_truth
from taojax.config import AuditConfig, Config
from taojax.datasets.progress import (
    ProgressConfig,
    Route,
    route_of_matches,
    route_of_shares,
    write_progress,
)
from taojax.datasets.trajectory import every
from taojax.files.records import read_run
from taojax.files.specs import read_npy, read_npz, write_atomically
from taojax.files.tables import table_text
from taojax.runtime.score import score

R_IN_ROWS, R_OUT_ROWS = 2.0, 10.0
SEEDS = (0, 1, 2, 3, 4)
KRI_ANCHORS = 1000

OTHER_ROW_M = 5.0
"""A second length of a row, on the first seed: nothing may depend on the unit."""

RIVALS = ("topometric", "mht", "seqslam")
"""The systems that were made for routes; all others are in the leaderboard."""

TITLES = {
    "top1": "top-1 score gate",
    "top1_w10": "its mean over 10 frames",
    "topometric": "topometric filter",
    "mht": "multi-hypothesis tracking",
    "seqslam": "SeqSLAM",
    "tao_rank": "TAO as the paper writes it (`tao_rank`)",
    "tao": "**`tao`**",
    "single_view": "calibrated single view",
    "joint_features": "calibrated joint features, as the paper writes them",
    "fused": "**calibrated (`probability_map_out`)**",
}

PAPER = {
    "top1": (0.628, 0.710, 0.801),
    "tao_rank": (0.700, 0.746, 0.828),
    "single_view": (None, 0.517, None),
    "joint_features": (None, 0.653, None),
}
"""Full AUC, held-out AUC and AP of the paper's Table 3; 304 of 1,000 queries map-out."""

BOTH = "map_descriptors", "query_descriptors"

Row = dict[str, Any]


class Recipe(NamedTuple):
    """A set that is loaded when its turn comes."""

    name: str
    folder: str
    make: Callable[[Path], Route]


def _arrays(folder: Path, *names: str) -> tuple[np.ndarray, np.ndarray]:
    mapped, query = (read_npy(folder / f"{name}.npy", "descriptors") for name in names)
    return mapped, query


def _nordland(query: str, folder: Path) -> Route:
    return route_of_shares(*_arrays(folder, "nr", query))


def _brisbane(folder: Path) -> Route:
    matches = read_npz(folder / "truth_matches.npz", "progress")["gt_map_by_query"]
    return route_of_matches(*_arrays(folder, *BOTH), matches.astype(bool))


def _kri(folder: Path) -> Route:
    mapped, query = _arrays(folder, *BOTH)
    return route_of_shares(mapped[every(len(mapped), KRI_ANCHORS)], query)


RECIPES = (
    Recipe("nordland nr-nq", "nordland_netvlad64", partial(_nordland, "nq")),
    Recipe("nordland nr-nq2", "nordland_netvlad64", partial(_nordland, "nq2")),
    Recipe("brisbane", "brisbane_event", _brisbane),
    Recipe("kri", "kri", _kri),
)


def _cut(judgement: Judgement, signals: dict[str, np.ndarray]) -> labels.Splits:
    """Cut signals where the judge cut."""
    share, gap = judgement.config.audit.calibration_share, judgement.config.stream.window
    return labels.split_frames(signals, judgement.label, calibration_share=share, gap_frames=gap)


def measure(route: Route, settings: ProgressConfig, seed: int, config: Config) -> list[Row]:
    """Write, score and judge one route as `taojax audit` would.

    Args:
        route: two drives.
        settings: unit, thinning and noise.
        seed: of the simulated odometry.
        config: of scoring and judging; the radii, in rows, are multiplied with the unit.

    Returns:
        Rows of data_specs/progress.toml without `set`, one per method.
    """
    radii = R_IN_ROWS * settings.row_m, R_OUT_ROWS * settings.row_m
    config = replace(config, audit=replace(config.audit, r_in_m=radii[0], r_out_m=radii[1]))
    with tempfile.TemporaryDirectory() as scratch:
        data, run = Path(scratch) / "data", Path(scratch) / "run"
        write_progress(data, route, settings, seed=seed)
        score(data, run, config)
        truth = read_truth(data / "truth", len(route.query_rows))
        judgement = judge(read_run(run), truth, config)
        said = rivals(sets.real(data, radii), lambda name: name in RIVALS)
    # The judge's own table, and one for what it does not know: rivals.
    others = {entry.name: entry.signal for entry in said}
    splits = _cut(judgement, others)
    beside = tables.metrics_table(
        others, judgement.label, splits, judgement.answers, config.audit, config.seed
    )
    rows = {}
    for table in (judgement.metrics, beside):
        for at, signal in enumerate(table["signal"]):
            row = {column: values[at] for column, values in table.items()}
            rows[signal] = row
    n_anchors = settings.n_anchors or len(route.map_rows)
    own = {"n_anchors": n_anchors, "row_m": settings.row_m, "seed": seed}
    return [rows[method] | own | {"method": method} for method in TITLES]


def _cell(values: Sequence[float]) -> str:
    """Return the mean over the seeds, and the range where they differ."""
    if np.isnan(values).any():
        return ""
    mean, low, high = (f"{f(values):.3f}".removeprefix("0") for f in (np.mean, np.min, np.max))
    return mean if low == high else f"{mean} ({low} to {high})"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


COLUMNS = {
    "full AUC": "auroc",
    "held-out AUC": "auroc_test",
    "AP": "aupr_out",
    "held-out AP": "aupr_out_test",
    "AP, in-map positive": "aupr_in",
    "FAR": "far",
    "FRR": "frr",
}


def _section(rows: Sequence[Row], name: str, n_anchors: int) -> str:
    """Return the table of one set and map."""
    mine = [r for r in rows if (r["set"], r["n_anchors"], r["row_m"]) == (name, n_anchors, 1.0)]
    lines = []
    for method, title in TITLES.items():
        own = [row for row in mine if row["method"] == method]
        lines.append([title, *(_cell([r[c] for r in own]) for c in COLUMNS.values())])
    known = next(row for row in mine if row["method"] == "top1")
    counts = (
        f"{known['n_out']:.0f} map-out and {known['n_in']:.0f} in-map queries, held out "
        f"{known['n_out_test']:.0f} and {known['n_in_test']:.0f}"
    )
    return f"## {name}, {n_anchors} anchors\n\n{counts}.\n\n" + _table(["", *COLUMNS], lines)


def _unit(rows: Sequence[Row]) -> str:
    """Say how far our figures depend on the length of a row."""
    gaps = [
        abs(row[figure] - other[figure])
        for row in rows
        for other in rows
        if row["row_m"] == 1.0 and other["row_m"] == OTHER_ROW_M
        if all(row[k] == other[k] for k in ("set", "n_anchors", "seed", "method"))
        if row["method"] not in RIVALS
        for figure in ("auroc", "auroc_test", "far")
    ]
    return (
        f"With {OTHER_ROW_M:g} m instead of 1 per row (first seed, all anchors, radii along) no "
        f"AUROC and no FAR of ours changes by more than {max(1e-4, np.nanmax(gaps)):.4f}.\n"
    )


def to_markdown(rows: Sequence[Row]) -> str:
    """Return the tables as text, the paper's beside."""
    seeds = sorted({int(row["seed"]) for row in rows if row["row_m"] == 1.0})
    parts = [
        "# Route progress without poses (the paper's Table 3)\n",
        "Real descriptors, **simulated odometry** (scale bias 5 %, 10 % per step; seeds "
        f"{', '.join(map(str, seeds))}). Mean over the seeds, range in brackets where they "
        f"differ. In-map within {R_IN_ROWS:g} rows of an anchor, map-out beyond {R_OUT_ROWS:g}. "
        "Two stretches of the route are deleted from the map, one in each half of the queries. "
        "AP: map-out is the positive class. FAR and FRR: held-out half, at mean + 3 standard "
        "deviations of in-map calibration values; probabilities at the level that accepts 95 % "
        "of them. Calibrated models are fitted on the calibration half and measured on the "
        "other.\n",
        _unit(rows),
    ]
    for name in dict.fromkeys(row["set"] for row in rows):
        own = [row for row in rows if row["set"] == name]
        for n_anchors in dict.fromkeys(row["n_anchors"] for row in own):
            parts.append(_section(rows, name, n_anchors))
    parts.append(_paper())
    return "\n".join(parts)


def _paper() -> str:
    """Return the paper's own figures, which are of other data."""
    lines = [
        [TITLES[method].replace("*", ""), *("" if v is None else f"{v:.3f}"[1:] for v in values)]
        for method, values in PAPER.items()
    ]
    return (
        "## For comparison: the paper on IRSLAM-KRI, other data (thermal, day to night)\n\n"
        "304 of 1,000 queries map-out; no FAR is given. At that share and those AUC the AP of "
        "map-out over all queries cannot exceed .725 and .780, so theirs is of another class or "
        "split.\n\n" + _table(["", "full AUC", "held-out AUC", "AP"], lines)
    )


def write(out: Path, rows: Sequence[Row]) -> None:
    """Write progress.csv and progress.md."""
    text = table_text("progress", tables.from_rows("progress", rows))
    write_atomically(out / "progress.csv", text)
    write_atomically(out / "progress.md", to_markdown(rows))


def run(
    out: Path,
    data: Path,
    *,
    seeds: Sequence[int] = SEEDS,
    config: Config | None = None,
    say: Callable[[str], None] = print,
) -> None:
    """Measure every set that is there.

    Args:
        out: folder to write to.
        data: folder of the real recordings.
        seeds: of the simulated odometry; the first is also run at another length of a row.
        config: of scoring and judging; defaults when omitted.
        say: where progress and skipped sets go.
    """
    config = Config(audit=AuditConfig(n_bootstrap=100)) if config is None else config
    rows: list[Row] = []
    for recipe in RECIPES:
        if not (data / recipe.folder).is_dir():
            what = f"skipped {recipe.name}: no {recipe.folder} in {data}"
            say(f"{what} (real recordings are not in this repository)")
            continue
        route = recipe.make(data / recipe.folder)
        n_map = len(route.map_rows)
        todo = [(n, 1.0, seed) for n in (n_map, n_map // 2) for seed in seeds]
        todo.append((n_map, OTHER_ROW_M, seeds[0]))
        for n_anchors, row_m, seed in todo:
            settings = ProgressConfig(row_m=row_m, n_anchors=n_anchors)
            found = measure(route, settings, seed, config)
            rows += [{"set": recipe.name} | row for row in found]
        tao = next(row for row in rows if row["set"] == recipe.name and row["method"] == "tao")
        say(f"{recipe.name}: tao {tao['auroc_test']:.3f} held-out AUROC, seed {seeds[0]}")
        write(out, rows)
    say(f"wrote {out / 'progress.md'}" if rows else "no data set found")
