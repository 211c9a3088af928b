"""`python -m benchmarks speed`: `taojax bench`, and how cost grows with K, N, T and M.

What limits the speed on a CPU (2 cores, XLA of jaxlib 0.10, one run; ratios in the README):

* A single call. XLA keeps books on every buffer of a compiled function in every call, also on
  those inside the little programs of its reductions. Sums as matrix products, minima without
  argmin and moved branches took a quarter off. What remains is Python (60 us), handing memory out
  and back, and threads that wake each other.
* A frame of the literal cost. With the branches in front (`vmap`), sums run over the innermost axis
  and XLA emits scalar loops; with the branches innermost, elementwise kernels take .3 to .7 us
  instead of 2 to 4, and sums by matrix product 1.4: 120 -> 45 us alone, 144 -> 84 us in a replay.
  Several sums that feed one expression are fused into one scalar loop whatever their layout, and
  an optimisation barrier between them is removed before fusion. 300 branches cost 184 us, 1,000
  cost 518; under `vmap` it was 520 for 300.
* The largest kernels of a frame with the filter: spreading the belief over 12 neighbours (48,000
  gathers and 24,000 exponentials, .09 ms) and the look-up behind it (24,000 gathers).

What did not help: one thread instead of two, no asynchronous dispatch, donated state, state packed
into one array, the step inside a loop of one turn, tuned malloc thresholds, wider vectors, fast
mathematics; several frames of a replay under one vmap; a conditional between sums, so that each
keeps its own kernel (120 -> 57 us, and a stall on a GPU); moments stacked into one product (the
copies cost what the sums did); in the filter matrix products instead of sums over 4,000 numbers
(50 us slower).

What did: one array for all signals, coordinates gathered one by one, lists and bytes in the window,
map and settings closed over instead of handed in.
"""

import csv
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from benchmarks.pictures import save
from taojax.baselines.mht import MhtParams, mht
from taojax.cli.bench import simulated_drive
from taojax.config import StreamConfig
from taojax.runtime import bench
from taojax.runtime.bench import Row, best_us
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.stream import init, replay

BASELINE = Path(__file__).parent / "speed_baseline.csv"
TOLERANCE = 0.4
"""Share of a ratio that may be lost: machines differ in more than speed."""

FRAMES = 200
"""Frames of a timed replay."""

Curve = list[tuple[float, float]]


def _frames(drive: bench.Drive, n_frames: int, n_candidates: int) -> Frame:
    """Return frames with as many candidates as wanted; beyond the list they are random."""
    rng = np.random.default_rng(0)
    at = np.arange(n_frames) % len(drive.index)
    index, similarity = drive.index[at], drive.similarity[at]
    lacking = n_candidates - index.shape[1]
    if lacking > 0:
        more = rng.integers(0, len(drive.map_poses), (n_frames, lacking), dtype=np.int32)
        index = np.concatenate([index, more], axis=1)
        low = similarity[:, -1:] * rng.random((n_frames, lacking), dtype=np.float32)
        similarity = np.concatenate([similarity, low], axis=1)
    return Frame(
        *(jnp.asarray(a) for a in (drive.odometry[at], index[:, :n_candidates],
                                   similarity[:, :n_candidates]))
    )  # fmt: skip


def _replayed(drive: bench.Drive, config: StreamConfig, repeats: int) -> float:
    tables = map_tables(drive.map_poses, config, drive.map_descriptors)
    frames = _frames(drive, FRAMES, config.branches)
    return best_us(lambda: replay(config, tables, frames), repeats, FRAMES)


def over_branches(drive: bench.Drive, most: int, repeats: int) -> dict[str, Curve]:
    """Return us per frame over K: rank branches, and the filter beside them."""
    sizes = [k for k in (10, 30, 100, 300, 1000, 3000, 10_000) if k <= most]
    rank = lambda k: StreamConfig(association="rank", branches=k)
    joint = lambda k: StreamConfig(branches=k)
    return {
        "rank over K": [(k, _replayed(drive, rank(k), repeats)) for k in sizes],
        "joint over K": [(k, _replayed(drive, joint(k), repeats)) for k in sizes if k <= 3000],
    }


def over_window(drive: bench.Drive, most: int, repeats: int) -> dict[str, Curve]:
    """Return us per frame over N."""
    sizes = [n for n in (5, 10, 20, 50, 100, 200) if n <= most]
    rank = lambda n: StreamConfig(association="rank", window=n)
    return {"rank over N": [(n, _replayed(drive, rank(n), repeats)) for n in sizes]}


def _streamed(config: StreamConfig, drive: bench.Drive, n_frames: int) -> float:
    """Return us per frame of a long stream: one chunk of frames again and again, state kept."""
    tables = map_tables(drive.map_poses, config, drive.map_descriptors)
    chunk = _frames(drive, 1000, config.branches)

    def stream() -> None:
        state = init(config, tables)
        for _ in range(n_frames // 1000):
            state, _ = jax.block_until_ready(replay(config, tables, chunk, state))

    jax.block_until_ready(replay(config, tables, chunk, init(config, tables)))
    began = time.perf_counter()
    stream()
    return (time.perf_counter() - began) / n_frames * 1e6


def over_time(drive: bench.Drive, most: int) -> dict[str, Curve]:
    """Return us per frame over T, and the memory of the process."""
    found: dict[str, Curve] = {}
    for association, limit in (("rank", most), ("joint", most // 10)):
        config = StreamConfig(association=association)
        for length in (t for t in (1000, 10_000, 100_000, 1_000_000) if t <= limit):
            took = _streamed(config, drive, length)
            found.setdefault(f"{association} over T", []).append((length, took))
            found.setdefault(f"{association} memory over T", []).append((length, bench.peak_mb()))
    return found


def over_map(most: int, repeats: int) -> dict[str, Curve]:
    """Return us per query over M, 64 numbers per descriptor."""
    sizes = [m for m in (1000, 10_000, 100_000, 1_000_000) if m <= most]
    return {"retrieval over M": [(m, bench.retrieval(m, 64, repeats)[0].value) for m in sizes]}


def over_tree(drive: bench.Drive, n_frames: int) -> dict[str, Curve]:
    """Return hypotheses per frame of multi-hypothesis tracking; ours stay 2 seeds + 2."""
    frames = drive.first(n_frames)
    forms = {"mht bounded": MhtParams(), "mht unbounded": MhtParams(width=None, n_scan=None)}
    curves: dict[str, Curve] = {
        f"{name} hypotheses over t": [
            (t + 1, float(n)) for t, n in enumerate(mht(frames, params).n_hypotheses)
        ]
        for name, params in forms.items()
    }
    ours = float(StreamConfig().branches)
    curves["tao hypotheses over t"] = [(t + 1, ours) for t in range(n_frames)]
    return curves


def exponent(curve: Curve) -> float:
    """Return the slope of the straight line through a curve on two logarithmic axes."""
    x, y = np.log(np.array(curve)).T
    return float(np.polyfit(x, y, 1)[0])


def draw(curves: dict[str, Curve]) -> Figure:
    """Draw every family of curves in a panel of its own."""
    panels = ("over K", "over N", "over T", "over M", "over t")
    labels = ("branches K", "window N [frames]", "log length T [frames]", "map M [places]", "frame")
    figure = Figure(figsize=(15, 3.2), layout="constrained")
    for ax, panel, label in zip(figure.subplots(1, 5), panels, labels, strict=True):
        for name, curve in curves.items():
            if not name.endswith(panel) or "memory" in name:
                continue
            text = name.removesuffix(panel).strip()
            if panel != "over t":
                text += f", exponent {exponent(curve):.2f}"
            ax.loglog(*np.array(curve).T, marker="o", markersize=3, linewidth=1.2, label=text)
        ax.set(xlabel=label, ylabel="hypotheses" if panel == "over t" else "us per frame")
        ax.grid(visible=True, which="major", linewidth=0.4)
        ax.set_ylim(1.0, 4.0 * ax.get_ylim()[1])
        ax.legend(fontsize=7)
    return figure


def _write(curves: dict[str, Curve], out: Path) -> None:
    with (out / "scaling.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("curve", "x", "value"))
        writer.writerows((name, f"{x:g}", f"{y:.6g}") for name, c in curves.items() for x, y in c)
    save(draw(curves), out / "scaling")


def bless(rows: Sequence[Row]) -> None:
    """Make the ratios of this run the committed baseline."""
    with BASELINE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("name", "value", "unit", "tolerance"))
        writer.writerows((r.name, f"{r.value:.3g}", "x", TOLERANCE) for r in rows if r.unit == "x")


def run(
    out: Path, *, quick: bool, gate: bool, blessed: bool, say: Callable[[str], None] = print
) -> None:
    """Write bench.csv, scaling.csv, scaling.png and scaling.svg.

    Args:
        out: folder to write into.
        quick: shorter curves.
        gate: hold the ratios against the committed baseline.
        blessed: make this run the baseline.
        say: where progress goes.

    Raises:
        GateError: a ratio is worse than the baseline allows.
    """
    out.mkdir(parents=True, exist_ok=True)
    drive = simulated_drive(300)
    rows = bench.measure(drive, quick=quick, say=say)
    repeats = 2
    say("growth with K and N")
    curves = over_branches(drive, 300 if quick else 10_000, repeats)
    curves |= over_window(drive, 50 if quick else 200, repeats)
    say("growth with T, M and of the hypothesis tree")
    curves |= over_time(drive, 100_000 if quick else 1_000_000)
    curves |= over_map(100_000 if quick else 1_000_000, 5)
    curves |= over_tree(drive, 40 if quick else 200)
    for name, curve in curves.items():
        if "hypotheses" not in name:
            slope = exponent(curve) if len(curve) > 1 else float("nan")
            rows.append(Row(f"exponent {name}", slope, "1"))
    bench.write_rows(rows, out / "bench.csv")
    _write(curves, out)
    for row in rows:
        say(f"{row.name:34s} {row.value:12.4g} {row.unit}")
    say(f"wrote {out}/bench.csv, scaling.csv, scaling.png, scaling.svg")
    if blessed:
        bless(rows)
    if gate:
        say("\n".join(bench.check(rows, BASELINE)))
