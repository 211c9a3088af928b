"""`taojax kidnap`: carried elsewhere without odometry noticing."""

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import tyro

from taojax.cli.common import (
    Common,
    Scoring,
    config_of,
    draws_bars,
    flag,
    out_of,
    say,
    score_apart,
    told,
)
from taojax.cli.resume import claimed
from taojax.errors import InputError, UsageError

if TYPE_CHECKING:
    from taojax.audit.recovery import Part
    from taojax.config import Config
    from taojax.datasets.kidnap import Plan, Source

CAP_M = 4.0
"""Offset between the sessions of the main trials, at most: the full one would leave a perfect
alignment about 1 m inside the basin."""

FULL_SHARE = 4
"""Trials at full offset are a quarter of the main ones."""

WORKERS = 2
"""Runs that are scored at the same time, each in a process of its own."""

STRESS_ALIAS = (0.05, 0.45, 0.7)
"""Share of appearance that a place has in common with its class."""

STRESS_STRETCHES = ((20, 30), (30, 50), (70, 90))
"""Frames between two kidnaps, shortest and longest."""

STRESS_TRIALS = 24
"""Counted kidnaps per cell of the stress grid."""


@dataclasses.dataclass(frozen=True)
class Kidnap(Common):
    """Kidnapped-robot trials: frames and metres until the best pose is right again.

    Without DATASET they are spliced from the built-in simulated worlds. Views of a DATASET stay
    real and its odometry is simulated; how it finds back to its map by itself is told beside it.

    Example: taojax kidnap my_data --r-in 5 --trials 200
    """

    dataset: Annotated[
        Path | None, tyro.conf.Positional, flag("DATASET", "the simulated worlds")
    ] = None
    """Data folder with truth/, laid out as data_specs/README.md says."""

    trials: int = 1000
    """Kidnaps counted per drift level, at least."""

    rival_trials: int = 40
    """Of these, so many per level are given to the slow rivals too; 0 leaves them out."""

    basin: float = 10.0
    """A pose within so many metres of the truth is right."""

    worlds: int = 4
    """Simulated worlds that share the trials."""

    stress: bool = True
    """Also draw the grid of kidnap rate, drift and aliasing (simulated worlds only)."""


class _Job(NamedTuple):
    """One folder to be scored, sealed and judged."""

    kind: str
    name: str
    data: Path
    rival_logs: int


def run(args: Kidnap) -> None:
    """Splice kidnap logs, score them apart and judge how the robot comes back."""
    if args.trials < 1 or args.rival_trials < 0 or args.worlds < 1 or not args.basin > 0:
        raise UsageError("--trials and --worlds count from 1, --rival-trials from 0, --basin > 0")
    config = config_of(args)
    out = out_of(args, "kidnap", config)
    with claimed(out, told(args, config)):
        _carry(args, config, out)


def _carry(args: Kidnap, config: "Config", out: Path) -> None:
    """Fill a folder with logs, their sealed runs and what the judge makes of them."""
    jobs = _simulated(args, config, out) if args.dataset is None else _recorded(args, config, out)
    parts = _score_all(jobs, out, config, progress=draws_bars(args.progress))
    from taojax.audit.recovery_report import write_recovery

    say("judging")
    offset = f"offset at most {CAP_M:g} m" if args.dataset is None else "recorded"
    command = " ".join(["taojax", *sys.argv[1:]])
    words = write_recovery(out, parts, config, basin_m=args.basin, offset=offset, command=command)
    print("\n".join(words))
    say(f"report: {out}/report.html")


def _splice(
    source: "Source", plans: "Sequence[Plan]", seed: int, folder: Path, rival_trials: int
) -> int:
    """Write the logs of some plans; return how many first logs hold the rivals' trials."""
    from taojax.datasets.kidnap import LEVELS, make_logs, write_logs

    logs = [
        log for at, plan in enumerate(plans) for log in make_logs(source, plan, seed + 1000 * at)
    ]
    write_logs(source, logs, folder)
    n_logs = n_counted = 0
    while n_logs < len(logs) and n_counted < rival_trials:
        n_counted += logs[n_logs].n_counted
        n_logs += len(LEVELS)
    return n_logs


def _simulated(args: Kidnap, config: "Config", out: Path) -> list[_Job]:
    """Make the folders of the simulated worlds."""
    from taojax.datasets.kidnap import Plan, world_source
    from taojax.datasets.simulate import WorldConfig

    r_in, seeds = config.audit.r_in_m, range(config.seed, config.seed + args.worlds)
    jobs = []
    say(f"simulating {args.worlds} KAIST-like world(s) and carrying the robot around in them")
    for kind, knobs, n in (
        ("trials", WorldConfig(offset_cap_m=CAP_M), args.trials),
        ("offset", WorldConfig(), -(-args.trials // FULL_SHARE)),
    ):
        share = -(-n // args.worlds)
        for seed in seeds:
            name = f"{kind}-{seed}"
            source = world_source(knobs, seed)
            rivals = -(-args.rival_trials // args.worlds) if kind == "trials" else 0
            data = out / "data" / name
            n_logs = _splice(source, [Plan(share, r_in_m=r_in)], seed, data, rivals)
            jobs.append(_Job(kind, name, data, n_logs))
    for alias in STRESS_ALIAS if args.stress else ():
        name, data = f"alias-{alias:g}", out / "data" / f"alias-{alias:g}"
        world = WorldConfig(offset_cap_m=CAP_M, alias=alias, common=0.2)
        plans = [Plan(STRESS_TRIALS, stretch, r_in) for stretch in STRESS_STRETCHES]
        _splice(world_source(world, config.seed), plans, config.seed, data, 0)
        jobs.append(_Job("stress", name, data, 0))
    return jobs


def _recorded(args: Kidnap, config: "Config", out: Path) -> list[_Job]:
    """Make the folders of a recording."""
    from taojax.datasets.kidnap import Plan, far_m, folder_source

    dataset = args.dataset or Path()
    if not dataset.is_dir():
        raise InputError(f"{dataset}: no such data folder; see data_specs/README.md for the layout")
    source = folder_source(dataset)
    if far_m(source) < 2.0 * args.basin:
        raise InputError(
            f"{dataset}: a map of this size carries the robot only {far_m(source):.1f} m away, and"
            f" the basin is {args.basin:g} m; give a smaller --basin"
        )
    jobs = []
    for half in range(WORKERS):
        name = f"trials-{half}"
        plan = Plan(-(-args.trials // WORKERS), r_in_m=config.audit.r_in_m)
        seed, rivals = 2 * config.seed + half, -(-args.rival_trials // WORKERS)
        data = out / "data" / name
        jobs.append(_Job("trials", name, data, _splice(source, [plan], seed, data, rivals)))
    jobs.append(_Job("recorded", "recorded", dataset, 1 if args.rival_trials else 0))
    return jobs


def _score_all(
    jobs: Sequence[_Job], out: Path, config: "Config", *, progress: bool
) -> "list[Part]":
    """Score every folder, two at a time, each in a fresh interpreter."""

    def wanted() -> Iterator[Scoring]:
        for job in jobs:
            say(f"scoring {job.name}" + (" (with rivals)" if job.rival_logs else ""))
            flags = ["--rivals", "--rival-logs", str(job.rival_logs)]
            yield Scoring(job.data, out / job.name, [] if job.kind == "stress" else flags)

    score_apart(wanted(), config, progress=progress, most=WORKERS)
    from taojax.audit.recovery import Part

    return [Part(job.kind, job.name, out / job.name, job.data / "truth") for job in jobs]
