"""`python -m benchmarks accelerator`: the same work on a GPU, how fast, and how equal to the CPU.

Where there is no accelerator, the CPU is held against itself: the script runs, its speeds say
nothing.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from taojax.cli.bench import simulated_drive
from taojax.config import Config
from taojax.decisions import decide
from taojax.risk import shipped
from taojax.runtime import bench, hindsight
from taojax.runtime.bench import Drive, Row
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.retrieval import prepare, top_k
from taojax.runtime.score import in_trials, replay_log, replay_trials, signal_table

TOLERANCE = 1e-3
"""A signal may differ by so much of the largest of its kind: float32 sums in another order."""

TRIALS, TRIAL_FRAMES = 1000, 160
"""As many logs, and as long, as the paper's kidnap trials."""

PLACES = 100_000, 8448
"""Of the large map; 3.4 GB."""


class Sizes(NamedTuple):
    """How much is measured."""

    trials: int
    places: tuple[int, int]
    frames: int


FULL, QUICK = Sizes(TRIALS, PLACES, 300), Sizes(4, (2000, 64), 120)


def _frames(drive: Drive, rows: np.ndarray | slice) -> Frame:
    leaves = drive.odometry, drive.index, drive.similarity
    return Frame(*(jnp.asarray(leaf[rows]) for leaf in leaves))


def answers(drive: Drive) -> dict[str, np.ndarray]:
    """Return what the default device says of a drive: lists, signals, answers and verdicts."""
    config = Config()
    tables = map_tables(drive.map_poses, config.stream, drive.map_descriptors)
    records = replay_log(config, tables, _frames(drive, slice(None)))
    seen = hindsight.clean(tables, drive.odometry, drive.index, drive.similarity)
    both = hindsight.replay_both(config.verdict, tables, seen)
    signals = signal_table(np.arange(float(len(drive.odometry))), records)
    signals |= hindsight.now_columns(both.now)
    delayed = hindsight.delayed_columns(both.final)
    decided = decide(shipped(), signals, delayed)
    verdicts = {name: decided[name] == "accept" for name in ("verdict", "verdict_now")}
    places = prepare(drive.map_descriptors)
    lists = [top_k(places, drive.map_descriptors[row : row + 1], 100)[0] for row in range(20)]
    numbers = {**signals, **{f"final_{name}": column for name, column in delayed.items()}}
    found = {k: v for k, v in numbers.items() if np.issubdtype(np.asarray(v).dtype, np.number)}
    return {**found, **verdicts, "retrieved": np.concatenate(lists)}


def unlike(one: np.ndarray, other: np.ndarray) -> float:
    """Return by how much two columns differ: whole numbers by the share that does."""
    one, other = np.asarray(one), np.asarray(other)
    if not np.issubdtype(one.dtype, np.floating):
        return float((one != other).mean())
    known = np.isfinite(one)
    if (known != np.isfinite(other)).any():
        return float("inf")
    largest = max(1e-6, float(np.abs(other[known]).max(initial=0.0)))
    return float(np.abs(one - other)[known].max(initial=0.0) / largest)


def trials(drive: Drive, n: int) -> float:
    """Return the microseconds a frame takes in so many trials side by side."""
    config = Config()
    tables = map_tables(drive.map_poses, config.stream, drive.map_descriptors)
    rows = np.resize(np.arange(len(drive.index)), n * TRIAL_FRAMES)
    log = _frames(drive, rows)
    replay_trials(config, tables, in_trials(log, TRIAL_FRAMES))
    began = time.perf_counter()
    replay_trials(config, tables, in_trials(log, TRIAL_FRAMES))
    return (time.perf_counter() - began) / len(rows) * 1e6


def run(out: Path, *, quick: bool, say: Callable[[str], None] = print) -> None:
    """Write accelerator.csv: times on the default device, and how unlike the CPU's its numbers are.

    Args:
        out: folder to write into.
        quick: a small version.
        say: where progress goes.
    """
    sizes, device = QUICK if quick else FULL, jax.devices()[0]
    drive = simulated_drive(sizes.frames)
    if device.platform == "cpu":
        say("no accelerator: the CPU is held against itself, and its speed says nothing")
    say(f"on {device.device_kind}: bench")
    rows = bench.measure(drive, quick=True, say=say)
    say(f"{sizes.trials} trials, literal")
    rows.append(Row("trials_us", trials(drive, sizes.trials), "us"))
    say(f"retrieval, {sizes.places[0]} x {sizes.places[1]}")
    large = bench.retrieval(*sizes.places, 10)
    rows += [Row(f"large_{row.name}", row.value, row.unit) for row in large]
    say("the same on the CPU")
    ours = answers(drive)
    with jax.default_device(jax.devices("cpu")[0]):
        theirs = answers(drive)
    rows += [Row(f"unlike {name}", unlike(ours[name], theirs[name]), "1") for name in ours]
    bench.write_rows(rows, out / "accelerator.csv")
    apart = [row for row in rows if row.unit == "1" and row.value > TOLERANCE]
    for row in rows:
        if row.unit != "1":
            say(f"{row.name:34s} {row.value:12.4g} {row.unit}")
    say(f"{len(ours) - len(apart)} of {len(ours)} columns equal the CPU's within {TOLERANCE:g}"
        + "".join(f"; {row.name} {row.value:.2g}" for row in apart))  # fmt: skip
    say(f"wrote {out}/accelerator.csv")
