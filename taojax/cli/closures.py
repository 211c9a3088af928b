"""`taojax closures`: accepted and rejected closures for pose-graph tools."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from taojax.cli.common import flag, say
from taojax.errors import InputError, UsageError

if TYPE_CHECKING:
    from taojax.files.pose_graph_io import Verdicts


@dataclasses.dataclass(frozen=True)
class Closures:
    """Write what was accepted and rejected as g2o, CSV and TUM, for GTSAM, g2o, RTAB-Map and evo.

    Example: taojax closures runs/mine
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = tyro.MISSING
    """Run folder with verdicts: scored or audited."""

    out: Annotated[Path | None, flag("DIR", "RUN")] = None
    """Where to write closures.g2o, closures.csv, rejected.g2o and trajectory.tum."""

    max_wrong: Annotated[float | None, flag("SHARE", "as decided")] = None
    """Share of the accepted closures that may be wrong; decides again by the run's numbers."""

    lag: Annotated[int | None, flag("FRAMES", "the run's")] = None
    """Frames that final verdicts wait for; a run scored with another lag is refused."""


def run(args: Closures) -> None:
    """Write the files."""
    from taojax.files.pose_graph_io import (
        at_share,
        build_graph,
        closure_text,
        g2o_text,
        read_verdicts,
        tum_text,
    )
    from taojax.files.records import read_run
    from taojax.files.specs import write_atomically

    sealed = read_run(args.run)
    verdicts = read_verdicts(args.run, sealed)
    if verdicts is None:
        raise InputError(
            f"{args.run}: nothing is decided here; judge it with `taojax evaluate`, or score with"
            " --calibration"
        )
    if args.max_wrong is not None and not 0.0 < args.max_wrong < 1.0:
        raise UsageError(f"--max-wrong ({args.max_wrong:g}) must be between 0 and 1")
    verdicts = at_share(args.run, sealed, verdicts, args.max_wrong, args.lag)
    graph, folder = build_graph(args.run, sealed, verdicts), args.out or args.run
    trajectory, told = tum_text(graph), _of_the_audit(args.run, verdicts)
    files = {
        "closures.g2o": g2o_text(graph, "accept"),
        "closures.csv": closure_text(graph, sealed, verdicts),
        "rejected.g2o": g2o_text(graph, "reject"),
        "trajectory.tum": trajectory,
    }
    for name, text in files.items():
        write_atomically(folder / name, text)
    n_map, n_query = len(graph.map_pose), len(graph.query_pose)
    n = {verdict: len(graph.rows(verdict)) for verdict in ("accept", "reject", "abstain")}
    n_frames, n_posed = len(graph.verdict), sum(n.values())
    vertices = f"vertices 0 to {n_map - 1} are the map, {n_map} to {n_map + n_query - 1} the query"
    if graph.is_own:
        vertices = f"vertices 0 to {n_query - 1} are the drive's"
    again = "" if args.max_wrong is None else ", decided again,"
    print(f"verdicts of {verdicts.source}{again} on {n_frames} frames; {vertices} frames")
    print(f"closures.g2o    {n['accept']} accepted closures; closures.csv, with time stamps")
    print(f"rejected.g2o    {n['reject']} rejected ones, to look at")
    print(f"left out        {n['abstain']} on which nothing was decided, "
          f"{n_frames - n_posed} without a pose")  # fmt: skip
    print(f"trajectory.tum  {trajectory.count(chr(10))} accepted poses")
    print(
        "covariances     how far the position is spread within its place; an offset between the two"
        " sessions is not in them"
    )
    if told:
        print(told)
    for note in sealed.manifest["notes"]:
        say(f"note: {note}")
    say(f"written to {folder}")


def _of_the_audit(run: Path, verdicts: "Verdicts") -> str | None:
    """Say how far accepted frames could be believed where the run was judged."""
    from taojax.files.tables import read_frames

    if not (run / "labels.csv").is_file():
        return None
    labels = read_frames(run / "labels.csv", "labels", len(verdicts.verdict))
    accepted, where = verdicts.verdict == "accept", "all frames"
    if verdicts.source == "verdicts.csv":
        # Its numbers were fitted on the other half of the same run.
        is_test = labels["split"] == "test"
        where = f"the test half (the other {int((accepted & ~is_test).sum())} are not counted)"
        accepted = accepted & is_test
    n, n_off = int(accepted.sum()), int((accepted & (labels["label"] == "map_out")).sum())
    if 2 * n_off > n:
        what = "; do not use these closures"
    else:
        what = ", where a right pose counts neither way" if n_off else ""
    return (
        f"audit           {n_off} of the {n} accepted of {where} lie off the map{what}; of the"
        " accepted, how many are right: tables/verdicts.csv"
    )
