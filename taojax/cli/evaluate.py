"""`taojax evaluate`: the judge alone."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from taojax.cli.common import Common, config_of, say


@dataclasses.dataclass(frozen=True)
class Evaluate(Common):
    """Judge a sealed run against the truth: labels, thresholds, metrics, report.

    Example: taojax evaluate runs/mine --truth my_data/truth --r-in 5 --r-out 10
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = tyro.MISSING
    """Run folder made by `taojax score`."""

    truth: Annotated[Path, tyro.conf.arg(metavar="DIR")] = tyro.MISSING
    """Folder that holds query_poses.csv."""


def run(args: Evaluate) -> None:
    """Judge a sealed run."""
    from taojax.audit.evaluate import evaluate
    from taojax.audit.summary_text import terminal_words
    from taojax.files.records import read_manifest

    read_manifest(args.run)
    config = config_of(args, args.run / "config.toml")
    evaluation = evaluate(args.run, args.truth, config, out=args.out)
    print("\n".join(terminal_words(evaluation)))
    say(f"report: {args.out or args.run}/report.html")
