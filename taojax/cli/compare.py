"""`taojax compare`: judged runs of one recording, and which differences are beyond chance."""

import dataclasses
import hashlib
import sys
import time
from pathlib import Path
from typing import Annotated

import tyro

from taojax.cli.common import check_seed, flag, say
from taojax.errors import UsageError


@dataclasses.dataclass(frozen=True)
class Compare:
    """Compare judged runs of one recording with the first: paired intervals, table and figure.

    Example: taojax compare runs/mine runs/other --out runs/compared
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN RUN...")] = (
        tyro.MISSING
    )
    """Two or more judged run folders, made by `taojax audit` or by `score` and `evaluate`."""

    out: Annotated[Path | None, flag("DIR", "runs/compare/<time>-<hash of the seals>")] = None
    """Folder to make."""

    seed: Annotated[int | None, flag("INT", "the first run's")] = None
    """Seed of the bootstrap."""


def run(args: Compare) -> None:
    """Compare runs, print what is beyond chance, write table and figure."""
    if len(args.runs) < 2:
        raise UsageError("compare needs at least two runs")
    check_seed(args.seed)
    from taojax.audit.compare import compare, sentences, write
    from taojax.files.records import refuse_if_taken

    if args.out is not None:
        refuse_if_taken(args.out)
    found = compare(args.runs, args.seed)
    out = args.out
    if out is None:
        seals = "".join(run.manifest["seal"] for run in found.runs)
        short = hashlib.sha256(seals.encode()).hexdigest()[:8]
        out = Path("runs") / "compare" / f"{time.strftime('%Y%m%d-%H%M%S')}-{short}"
    write(found, out, " ".join(["taojax", *sys.argv[1:]]))
    print("\n".join(sentences(found)))
    say(f"table: {out}/tables/compare.md, figure: {out}/figures/compare.png")
