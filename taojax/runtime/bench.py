"""How long everything takes, rivals beside, in one run: only ratios inside one run mean something.

Compilation is measured apart. Single calls wait for their result and are told as quantiles;
whatever works on whole logs as the best of several repeats.
"""

import csv
import gc
import importlib.util
import itertools
import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from taojax.baselines.mht import MhtParams, mht
from taojax.baselines.models import Frames
from taojax.baselines.paper_cost import numpy_cost, svd_cost
from taojax.baselines.topometric import topometric
from taojax.config import StreamConfig, VerdictConfig
from taojax.core.cost import Branch, CostParams, branch_cost
from taojax.errors import GateError, InputError
from taojax.runtime import hindsight
from taojax.runtime.bench_fresh import (
    Row,
    best_us,
    first_steps,
    imports,
    installed,
    peak_mb,
    watched,
)
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.retrieval import normalise, prepare, top_k
from taojax.runtime.stream import init, replay, step

K, N = 100, 20
"""Branches and window of the paper's headline."""

MAP_SHAPE = 2000, 8448
"""Places and width of the descriptors, as a SALAD map has them."""

INPUTS = "odometry", "index", "similarity"
"""Of a frame, as `taojax watch` reads it."""

WINDOW_PARAMS = CostParams(1.0, 1.0, 112.5, 5.0, 15.0)


@dataclass(frozen=True)
class Drive:
    """A recorded drive, whole."""

    map_poses: np.ndarray
    map_descriptors: np.ndarray
    odometry: np.ndarray
    index: np.ndarray
    similarity: np.ndarray
    rows: np.ndarray
    """(T, M) similarity to every map image."""

    def first(self, n_frames: int) -> Frames:
        """Return the first frames as the rivals take them."""
        return Frames(
            self.map_poses,
            self.odometry[:n_frames].astype(float),
            self.rows[:n_frames],
            self.index[:n_frames],
            self.similarity[:n_frames],
        )


def random_windows(rng: np.random.Generator, k: int, n: int) -> tuple[np.ndarray, ...]:
    """Return p, q, similarity and has_anchor of K branches, most of them half right."""
    p = np.cumsum(rng.normal(0, 1.5, (n, 2)), axis=0)
    q = p[None] + rng.normal(0, 2.0, (k, n, 2)) + rng.normal(0, 200.0, (k, 1, 2))
    q[rng.random((k, n)) < 0.5] += rng.normal(0, 100.0, 2)
    return p - p[-1], q, rng.random((k, n)), rng.random((k, n)) < 0.95


def _windows(repeats: int) -> list[Row]:
    """Time the literal cost alone, three ways, on the same random windows."""
    given = random_windows(np.random.default_rng(0), K, N)
    single = tuple(jnp.asarray(a, jnp.float32 if a.dtype == float else bool) for a in given)
    weight, innermost = jnp.full(N, 1.0 / N), [jnp.moveaxis(a, 0, -1) for a in single[1:]]

    @jax.jit
    def closed(p: jax.Array, q: jax.Array, s: jax.Array, has: jax.Array) -> jax.Array:
        branches = Branch(jnp.swapaxes(q, 1, 2), s, has)
        return branch_cost(WINDOW_PARAMS, p, branches, weight).total

    return [
        Row("numpy_rank_us", best_us(lambda: numpy_cost(WINDOW_PARAMS, *given), repeats), "us"),
        Row("svd_rank_us", best_us(lambda: svd_cost(WINDOW_PARAMS, *single), repeats), "us"),
        Row("closed_rank_us", best_us(lambda: closed(single[0], *innermost), repeats), "us"),
    ]


def _stream(drive: Drive, association: str, *, n_calls: int, repeats: int) -> list[Row]:
    """Time single steps, as a robot calls them, and a replay of the same frames."""
    config = StreamConfig(association=association)
    tables = map_tables(drive.map_poses, config, drive.map_descriptors)
    frames = Frame(*(jnp.asarray(a) for a in (drive.odometry, drive.index, drive.similarity)))
    single = [jax.tree.map(lambda leaf, t=t: leaf[t], frames) for t in range(len(drive.index))]
    # One map and one set of settings: closed over, they are not handed in with every frame.
    advance = jax.jit(partial(step, config, tables))
    state = init(config, tables)
    state, _ = jax.block_until_ready(advance(state, single[0]))
    spent = np.empty(n_calls)
    gc.collect()
    gc.disable()
    try:
        for call in range(n_calls):
            began = time.perf_counter()
            state, record = advance(state, single[call % len(single)])
            jax.block_until_ready((state, record))
            spent[call] = time.perf_counter() - began
    finally:
        gc.enable()
    rows = [
        Row(f"step_{association}_p{q}_us", float(np.quantile(spent, q / 100)) * 1e6, "us")
        for q in (50, 95, 99)
    ]
    whole = best_us(lambda: replay(config, tables, frames), repeats, len(single))
    held = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    return [
        *rows,
        Row(f"replay_{association}_us", whole, "us"),
        Row(f"state_{association}_kb", held / 1e3, "kB"),
    ]


def _finals(drive: Drive, repeats: int) -> Row:
    """Time causal and final answers of a whole log; us per frame."""
    tables = map_tables(drive.map_poses, None, drive.map_descriptors)
    seen = hindsight.clean(tables, drive.odometry, drive.index, drive.similarity)
    work = lambda: hindsight.replay_both(VerdictConfig(), tables, seen)
    return Row("final_us", best_us(work, repeats, len(drive.index)), "us")


def _watch(drive: Drive, n_frames: int) -> list[Row]:
    """Time `taojax watch` on the first frames."""
    frames = zip(drive.odometry, drive.index, drive.similarity, strict=True)
    lines = [
        json.dumps({name: leaf.tolist() for name, leaf in zip(INPUTS, frame, strict=True)}).encode()
        for frame in itertools.islice(frames, n_frames)
    ]
    with tempfile.TemporaryDirectory() as folder:
        poses = np.column_stack([np.arange(len(drive.map_poses)), drive.map_poses])
        header = "t_s,x_m,y_m,theta_rad"
        np.savetxt(f"{folder}/poses.csv", poses, "%.9g", ",", header=header, comments="")
        return watched(Path(folder), lines)


def _rivals(drive: Drive, n_frames: int) -> list[Row]:
    """Time systems of their own on the same frames; us per frame."""
    frames, few = drive.first(n_frames), drive.first(min(n_frames, 60))
    unbounded = MhtParams(width=None, n_scan=None)
    return [
        Row("topometric_us", best_us(lambda: topometric(frames), 2, n_frames), "us"),
        Row("mht_bounded_us", best_us(lambda: mht(frames), 1, n_frames), "us"),
        Row("mht_unbounded_us", best_us(lambda: mht(few, unbounded), 1, len(few.index)), "us"),
    ]


def retrieval(n_places: int, width: int, repeats: int) -> list[Row]:
    """Time one query against a resident map, and reading the map's memory once.

    Args:
        n_places: rows of the map.
        width: of a descriptor.
        repeats: the fastest counts.

    Returns:
        `retrieval_us`, `read_us` (every number summed once), `retrieval_of_bandwidth`, and
        `faiss_us` where faiss is installed.
    """
    rng = np.random.default_rng(0)
    descriptors = np.empty((n_places, width), np.float32)
    for start in range(0, n_places, 2000):
        part = descriptors[start : start + 2000]
        rng.standard_normal(out=part, dtype=np.float32)
    query = rng.standard_normal((1, width)).astype(np.float32)
    places, unit = prepare(descriptors), jnp.asarray(normalise(query))
    total = jax.jit(jnp.sum)
    # Whichever reads faster: neither always saturates the memory.
    read = min(
        best_us(lambda: total(places.rows), repeats), best_us(lambda: descriptors.sum(), repeats)
    )
    ours = best_us(lambda: top_k(places, unit, K), repeats)
    rows = [
        Row("retrieval_us", ours, "us"),
        Row("read_us", read, "us"),
        Row("bandwidth_gb_s", descriptors.nbytes / read / 1e3, "GB/s"),
        Row("retrieval_of_bandwidth", read / ours, "x"),
    ]
    if importlib.util.find_spec("faiss"):
        import faiss  # pyright: ignore[reportMissingImports]

        flat = faiss.IndexFlatIP(width)
        flat.add(normalise(descriptors))
        row = normalise(query)
        rows.append(Row("faiss_us", best_us(lambda: flat.search(row, K), repeats), "us"))
    return rows


def _ratios(rows: Sequence[Row]) -> list[Row]:
    """Return what counts, larger = better."""
    at = {row.name: row.value for row in rows}
    pairs = {
        "numpy_over_replay_rank": ("numpy_rank_us", "replay_rank_us"),
        "numpy_over_step_rank": ("numpy_rank_us", "step_rank_p50_us"),
        "numpy_over_step_joint": ("numpy_rank_us", "step_joint_p50_us"),
        "topometric_over_replay_joint": ("topometric_us", "replay_joint_us"),
        "topometric_over_final": ("topometric_us", "final_us"),
        "mht_over_replay_joint": ("mht_bounded_us", "replay_joint_us"),
    }
    return [Row(name, at[over] / at[under], "x") for name, (over, under) in pairs.items()]


def measure(drive: Drive, *, quick: bool, say: Callable[[str], None]) -> list[Row]:
    """Measure everything once.

    Args:
        drive: the same frames for everybody.
        quick: fewer repeats, and no fresh interpreters.
        say: where progress goes.

    Returns:
        The rows of bench.csv.
    """
    say(f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    n_calls, repeats = (300, 3) if quick else (2000, 7)
    rows = _windows(10 * repeats)
    for association in ("rank", "joint"):
        say(f"step and replay, {association}")
        rows += _stream(drive, association, n_calls=n_calls, repeats=repeats)
    rows.append(_finals(drive, repeats))
    say("rivals")
    rows += _rivals(drive, 60 if quick else 300)
    say(f"retrieval, {MAP_SHAPE[0]} x {MAP_SHAPE[1]}")
    rows += retrieval(*MAP_SHAPE, 3 * repeats)
    rows += _ratios(rows)
    if not quick:
        say("imports and first step in a fresh interpreter")
        rows += [*imports(), *first_steps()]
        say("watch, through its pipe")
        rows += _watch(drive, 300)
    return [*rows, *installed(), Row("peak_memory_mb", peak_mb(), "MB")]


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write bench.csv: name,value,unit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows((row.name, f"{row.value:.6g}", row.unit) for row in rows)


def check(rows: Sequence[Row], baseline: Path) -> list[str]:
    """Hold the ratios of a run against a baseline.

    Args:
        rows: from `measure`.
        baseline: CSV with name,value,unit,tolerance; larger is better, tolerance is the share
            that may be lost.

    Returns:
        One line per row of the baseline.

    Raises:
        InputError: the baseline cannot be read.
        GateError: a ratio is worse than the baseline allows.
    """
    at = {row.name: row.value for row in rows}
    lines, bad = [], []
    try:
        with baseline.open(encoding="utf-8", newline="") as file:
            known = [
                (row["name"], float(row["value"]) * (1.0 - float(row["tolerance"])))
                for row in csv.DictReader(file)
            ]
    except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{baseline}: no baseline ({error}); it needs the columns name,value,unit,tolerance"
        ) from error
    for name, least in known:
        now = at.get(name, float("nan"))
        lines.append(f"{name} {now:.3g}, at least {least:.3g}")
        if not now >= least:
            bad.append(lines[-1])
    if bad:
        raise GateError("slower than the baseline allows: " + "; ".join(bad))
    return lines
