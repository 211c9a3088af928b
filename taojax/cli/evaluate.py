"""`taojax evaluate`: the judge alone."""

import dataclasses
from pathlib import Path
from shlex import quote
from typing import Annotated

import tyro

from taojax.cli.common import Common, config_of, say
from taojax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Evaluate(Common):
    """Judge a sealed run against the truth: labels, thresholds, metrics, report.

    Example: taojax evaluate runs/mine --truth my_data/truth --r-in 5 --r-out 10
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = tyro.MISSING
    """Run folder made by `taojax score`."""

    truth: Annotated[Path, tyro.conf.arg(metavar="DIR")] = tyro.MISSING
    """Folder that holds query_poses.csv, or the data folder around it."""


def run(args: Evaluate) -> None:
    """Judge a sealed run."""
    from taojax.audit.evaluate import evaluate
    from taojax.audit.summary_text import terminal_words
    from taojax.files.records import read_manifest

    dataset = read_manifest(args.run)["dataset"]
    if args.truth.is_file() and args.truth.suffix != ".csv":
        raise InputError(
            f"{args.truth}: is no query_poses.csv; make one with `taojax convert files"
            f" {quote(str(dataset))} --query-poses {quote(str(args.truth))}`, then give"
            f" --truth {quote(str(Path(dataset) / 'truth'))}"
        )
    config = config_of(args, args.run / "config.toml")
    evaluation = evaluate(args.run, args.truth, config, out=args.out)
    print("\n".join(terminal_words(evaluation)))
    say(f"report: {args.out or args.run}/report.html")
