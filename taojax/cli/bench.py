"""`taojax bench`: how fast this machine is, rivals beside."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from taojax.cli.common import Compiling, check_seed, flag, say
from taojax.errors import InputError

if TYPE_CHECKING:
    from taojax.runtime.bench import Drive


@dataclasses.dataclass(frozen=True)
class Bench(Compiling):
    """Measure step, replay, retrieval and the rivals in one run; only ratios travel.

    Example: taojax bench --quick --out runs/bench/mine
    """

    out: Annotated[Path | None, flag("DIR", "runs/bench/<time>")] = None
    """Folder to make."""

    quick: bool = False
    """Under a minute: fewer repeats, and no first step in a fresh interpreter."""

    gate: Annotated[Path | None, flag("FILE.csv", "none")] = None
    """Exit with code 5 where a ratio is worse than this baseline allows."""

    seed: int = 0
    """Seed of the simulated drive that is timed."""

    progress: bool = True
    """Say what is being measured."""


def simulated_drive(n_frames: int, seed: int = 0) -> "Drive":
    """Return the first frames of the simulated world, no segment of its map deleted."""
    import numpy as np

    from taojax.datasets.simulate import WorldConfig, make_world
    from taojax.runtime.bench import Drive
    from taojax.runtime.retrieval import dense, retrieve

    world = make_world(WorldConfig(), seed)
    queries = world.query_descriptors[:n_frames]
    index, similarity = retrieve(world.map_descriptors, queries)
    return Drive(
        world.map_poses[:, 1:],
        world.map_descriptors,
        world.odometry[:n_frames, 1:].astype(np.float32),
        index,
        similarity,
        dense(world.map_descriptors, queries),
    )


def run(args: Bench) -> None:
    """Measure, write, and hold against a baseline."""
    check_seed(args.seed)
    from taojax.runtime import bench

    out = args.out or Path("runs") / "bench" / time.strftime("%Y%m%d-%H%M%S")
    if (out / "bench.csv").exists():
        raise InputError(f"{out}: already holds a benchmark; choose a new --out")
    if args.gate is not None and not args.gate.is_file():
        raise InputError(f"{args.gate}: no such file; make one with `python -m benchmarks speed`")
    tell = say if args.progress else lambda text: None
    rows = bench.measure(simulated_drive(300, args.seed), quick=args.quick, say=tell)
    bench.write_rows(rows, out / "bench.csv")
    for row in rows:
        print(f"{row.name:30s} {row.value:12.4g} {row.unit}")
    say(f"table: {out}/bench.csv")
    if args.gate is not None:
        print("\n".join(bench.check(rows, args.gate)))
