"""`taojax view`: a run in the viewer of Rerun."""

import dataclasses
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import tyro

from taojax.cli.common import flag, say
from taojax.errors import InputError, UsageError

if TYPE_CHECKING:
    from taojax.files.records import Run
    from taojax.view import Judged


@dataclasses.dataclass(frozen=True)
class View:
    """Write map, answers, candidates, verdicts and their probabilities for the viewer of Rerun.

    Needs its SDK: pip install 'taojax[view]'. Truth and labels are shown only where the run was
    judged. Then: rerun RUN/view.rrd

    Example: taojax view runs/mine
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = tyro.MISSING
    """Run folder with verdicts: scored or audited."""

    out: Annotated[Path | None, flag("FILE.rrd", "RUN/view.rrd")] = None
    """Recording to write."""


def run(args: View) -> None:
    """Write the recording and say what is in it."""
    out = args.out or args.run / "view.rrd"
    if out.suffix.lower() != ".rrd":
        raise UsageError(f"--out {out} is no .rrd; name one")
    from taojax.view import check_extra, write_view

    check_extra()
    from taojax.files.pose_graph_io import build_graph, read_verdicts
    from taojax.files.records import read_run

    sealed = read_run(args.run)
    verdicts = read_verdicts(args.run, sealed)
    if verdicts is None:
        raise InputError(f"{args.run}: nothing is decided here; score the data again")
    judged = _judged(args.run, sealed)
    graph = build_graph(args.run, sealed, verdicts)
    write_view(out, sealed, verdicts, graph, judged)
    n = {name: int((verdicts.verdict == name).sum()) for name in ("accept", "reject", "abstain")}
    print(
        f"{len(verdicts.verdict)} frames on {len(graph.map_pose)} map poses, verdicts of"
        f" {verdicts.source}: {n['accept']} accepted, {n['reject']} rejected,"
        f" {n['abstain']} left open; {_told(judged)}"
    )
    say(f"written to {out}; next: rerun {quote(str(out))}")


def _judged(run: Path, sealed: "Run") -> "Judged | None":
    """Return labels and, where they are at hand and are those of the judge, true positions."""
    if not (run / "labels.csv").is_file():
        return None
    from taojax.audit.labels import read_truth
    from taojax.cli.graph import evaluated
    from taojax.cli.rerun import data_places
    from taojax.files.pose_graph_io import refuse_foreign
    from taojax.files.tables import read_frames
    from taojax.view import Judged

    refuse_foreign(run, sealed)
    n = len(sealed.signals["frame"])
    label = read_frames(run / "labels.csv", "labels", n)["label"]
    # The truth of a drive that is its own map lies in a frame of its own.
    if "own_gap_m" in sealed.manifest:
        return Judged(label, None)
    for place in data_places(run, str(sealed.manifest.get("dataset", ""))):
        path = place / "truth/query_poses.csv"
        if path.is_file():
            truth = read_truth(path, n)
            if truth.sha256 == evaluated(run).get("truth_sha256"):
                return Judged(label, truth.xy_m)
    return Judged(label, None)


def _told(judged: "Judged | None") -> str:
    if judged is None:
        return "not judged: no truth in it"
    return "truth: labels alone" if judged.xy_m is None else "truth: labels and true positions"
