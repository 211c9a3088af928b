"""`python -m benchmarks sweep_speed`: a loop against vmap, and how long a whole sweep takes.

On a CPU the loop wins. CPU milliseconds per unit of work on 2 cores (1,000 frames, K = 100; wall
times are as long or longer, the machine was shared): rank 244 in a loop, 560 under vmap over 4
units, 585 over 16; joint 326 in a loop, 736 and 666 under vmap. One unit of rank work is one fit
with all its values of gamma and K, so that the 256 default configurations are 32 units: 13 s of
CPU, 18 s of wall at load 5. A grid of 256 in which no two share a fit takes 64 to 80 s of CPU (60
to 94 s of wall at load 3, 147 s at load 9); the 36 joint configurations 18 s of CPU. XLA runs one
program at a time on this backend, so that two threads buy nothing. No accelerator was at hand.
"""

import csv
import os
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from taojax.config import Config, VerdictConfig
from taojax.datasets.edit import scenario
from taojax.datasets.simulate import WorldConfig, make_world
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.retrieval import retrieve
from taojax.runtime.sweep import DEFAULT, Grid, Row, at_once, evaluate, expand, plan

BATCHES = (1, 4, 16)
"""Units under one vmap; 1 is the loop."""

SEPARATE: Grid = {
    "rank": {
        "lambda_velocity": (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0),
        "delta_spacings": (1.5, 2.0, 3.0, 4.0),
        "mask_deltas": (1.0, 2.0, 3.0, 4.0),
        "window": (10, 20),
    }
}
"""256 configurations of which no two share a fit: the most expensive grid of that size."""


class Recording:
    """The simulated default scenario, 1,000 frames, 100 candidates."""

    def __init__(self) -> None:
        world = scenario(make_world(WorldConfig(), 0), "default")
        index, similarity = retrieve(world.map_descriptors, world.query_descriptors)
        self.poses = world.map_poses[:, 1:]
        self.tables = map_tables(self.poses, None, world.map_descriptors)
        odometry = world.odometry[:, 1:].astype(np.float32)
        self.frames = Frame(*(jnp.asarray(a) for a in (odometry, index, similarity)))

    def work(self, rows: list[Row]) -> list:
        return plan(rows, Config(), self.tables, self.frames)


def compare(recording: Recording, say: Callable[[str], None]) -> list[dict[str, object]]:
    """Time the same units in a loop and under vmap, compilation apart."""
    found = []
    for signals, units in recording.work(expand(DEFAULT, Config())):
        name = "joint" if isinstance(units[0].arguments, VerdictConfig) else "rank"
        for batch in BATCHES:
            part = units[: max(batch, 4)]
            run = jax.jit(jax.vmap(signals) if batch > 1 else signals)
            stack = lambda some: jax.tree.map(lambda *x: jnp.stack(x), *(u.arguments for u in some))
            pieces = [stack(part[i : i + batch]) for i in range(0, len(part), batch)]
            pieces = pieces if batch > 1 else [unit.arguments for unit in part]
            began = time.perf_counter()
            jax.block_until_ready(run(pieces[0]))
            first = time.perf_counter() - began
            began, cpu = time.perf_counter(), time.process_time()
            for piece in pieces:
                jax.block_until_ready(run(piece))
            wall, cpu = time.perf_counter() - began, time.process_time() - cpu
            n = len(part)
            row = {"association": name, "batch": batch, "first_call_s": round(first, 2),
                   "ms_per_unit": round(wall / n * 1e3, 1),
                   "cpu_ms": round(cpu / n * 1e3, 1)}  # fmt: skip
            found.append(row)
            say("  ".join(f"{k} {v}" for k, v in row.items()))
    return found


def whole(recording: Recording, name: str, grid: Grid, say: Callable[[str], None]) -> None:
    """Time a sweep from a bare recording to the last signal, compilation included."""
    rows, backend = expand(grid, Config()), jax.default_backend()
    began, cpu, done = time.perf_counter(), time.process_time(), 0
    for signals, units in recording.work(rows):
        for members, _ in evaluate(
            signals, units, batch=at_once(units[0], backend, len(recording.poses))
        ):
            done += len(members)
    took, cpu = time.perf_counter() - began, time.process_time() - cpu
    frames = len(recording.frames.index)
    say(f"{name}: {done} configurations x {frames} frames in {took:.1f} s, {cpu:.1f} s of CPU")


def run(out: Path, *, say: Callable[[str], None] = print) -> None:
    """Write sweep_speed.csv: milliseconds per unit of work and batch size."""
    out.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0]
    say(f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores, load {load:.1f} before")
    recording = Recording()
    whole(recording, "256 rank configurations of the default grid", {"rank": DEFAULT["rank"]}, say)
    whole(recording, "256 rank configurations that share no fit", SEPARATE, say)
    whole(
        recording, "36 joint configurations of the default grid", {"joint": DEFAULT["joint"]}, say
    )
    rows = compare(recording, say)
    with (out / "sweep_speed.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    say(f"wrote {out / 'sweep_speed.csv'}; load {os.getloadavg()[0]:.1f} after")
