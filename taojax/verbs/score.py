"""`taojax score`: the robot side alone."""

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from taojax.errors import UsageError
from taojax.verbs.common import Common, Dataset, config_of, flag, out_of, say
from taojax.verbs.layout import check_layout


@dataclasses.dataclass(frozen=True)
class Score(Common):
    """Run time only: score a data folder and seal signals.csv. Needs no truth.

    Example: taojax score my_data --out runs/mine
    """

    dataset: Dataset = tyro.MISSING
    """Data folder, laid out as data_specs/README.md says."""

    calibration: Annotated[Path | None, flag("FILE.toml", "no verdicts at run time")] = None
    """calibration.toml of an audited run: adds decisions.csv, verdicts at frozen numbers."""

    rivals: bool = False
    """Also run the rank association and every rival: adds tracks.npz. Slow."""

    rival_logs: Annotated[int | None, flag("N", "all")] = None
    """Of a folder of trials, run the rivals on the first so many alone."""

    advice: bool = True
    """Say what can be done with the run."""


def run(args: Score) -> None:
    """Score a data folder and seal the result."""
    from taojax.detector import from_toml
    from taojax.runtime.score import score

    check_layout(args.dataset, has_truth=False)
    config = config_of(args)
    out = out_of(args, "score", config)
    rival_logs = args.rival_logs
    if rival_logs is not None and (rival_logs < 0 or not args.rivals):
        raise UsageError("--rival-logs counts from 0 and goes with --rivals")
    if args.rivals and rival_logs is None:
        rival_logs = sys.maxsize
    detector = None if args.calibration is None else from_toml(args.calibration)
    manifest = score(
        args.dataset,
        out,
        config,
        detector=detector,
        rival_logs=rival_logs,
        progress=args.progress,
    )
    for note in manifest["notes"]:
        say(f"note: {note}")
    say(f"sealed {out}/signals.csv (seal {manifest['seal'][:12]})")
    if args.advice:
        say(_next(out, manifest))


def _next(out: Path, manifest: Mapping[str, Any]) -> str:
    """Say what was decided and what can be done with it."""
    if "decisions.csv" not in manifest["sha256"]:
        return (
            "next:   no verdicts yet; add --calibration FILE of an audited run, or judge with"
            f" taojax evaluate {out} --truth DIR"
        )
    from taojax.tables import read_table

    verdict = read_table(out / "decisions.csv", "decisions")["verdict"]
    n = {name: int((verdict == name).sum()) for name in ("accept", "reject", "abstain")}
    return (
        f"decided {n['accept']} accepted, {n['reject']} rejected, {n['abstain']} left open"
        f" (decisions.csv)\nnext:   taojax closures {out}"
    )
