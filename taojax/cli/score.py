"""`taojax score`: the robot side alone."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from taojax.cli.common import Common, Dataset, config_of, draws_bars, flag, out_of, say
from taojax.cli.layout import check_layout
from taojax.errors import UsageError


@dataclasses.dataclass(frozen=True)
class Score(Common):
    """Run time only: score a data folder and seal signals.csv. Needs no truth.

    Example: taojax score my_data --out runs/mine
    """

    dataset: Dataset = tyro.MISSING
    """Data folder, laid out as data_specs/README.md says."""

    calibration: Annotated[Path | None, flag("FILE.toml", "the one that ships")] = None
    """calibration.toml of an audited run, whose frozen numbers decide (decisions.csv)."""

    rivals: bool = False
    """Also run the rank association and every rival: adds tracks.npz. Slow."""

    rival_logs: Annotated[int | None, flag("N", "all")] = None
    """Of a folder of trials, run the rivals on the first so many alone."""

    advice: bool = True
    """Say what can be done with the run."""


def run(args: Score) -> None:
    """Score a data folder and seal the result."""
    from taojax.risk import read_calibration
    from taojax.runtime.score import score

    check_layout(args.dataset, has_truth=False)
    config = config_of(args)
    out = out_of(args, "score", config)
    rival_logs = args.rival_logs
    if rival_logs is not None and (rival_logs < 0 or not args.rivals):
        raise UsageError("--rival-logs counts from 0 and goes with --rivals")
    if args.rivals and rival_logs is None:
        rival_logs = sys.maxsize
    calibration = None if args.calibration is None else read_calibration(args.calibration)
    manifest = score(
        args.dataset,
        out,
        config,
        calibration=calibration,
        rival_logs=rival_logs,
        progress=draws_bars(args.progress),
    )
    for note in manifest["notes"]:
        say(f"note: {note}")
    say(f"sealed {out}/signals.csv (seal {manifest['seal'][:12]})")
    if args.advice:
        say(decided(out))


def decided(out: Path) -> str:
    """Say what was decided, what is promised and what can be done with it."""
    from taojax.files.tables import read_table
    from taojax.risk import read_calibration

    promise = read_calibration(out / "detector.toml").final.promise
    verdict = read_table(out / "decisions.csv", "verdicts")["verdict"]
    n = {name: int((verdict == name).sum()) for name in ("accept", "reject", "abstain")}
    return (
        f"decided {n['accept']} accepted, {n['reject']} rejected, {n['abstain']} left open"
        f" (decisions.csv)\npromised: {promise}\nnext:   taojax closures {out}"
    )
