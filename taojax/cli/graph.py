"""`taojax graph`: what the closures do to a pose graph."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from taojax.cli.common import check_seed, flag, say
from taojax.errors import InputError

if TYPE_CHECKING:
    from taojax.config import AuditConfig


@dataclasses.dataclass(frozen=True)
class Graph:
    """Optimise the query's pose graph with our closures, with rivals' and with an oracle's.

    Needs GTSAM: pip install 'taojax[graph]'. Writes tables/graph.csv, figures/graph.* and
    graph.html.

    Example: taojax graph runs/mine
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = tyro.MISSING
    """Run folder with verdicts: audited, or scored with --calibration."""

    truth: Annotated[Path | None, flag("DIR", "truth/ of the data that the manifest names")] = None
    """Folder that holds query_poses.csv."""

    out: Annotated[Path | None, flag("DIR", "RUN")] = None
    """Where to write."""

    r_in: Annotated[float | None, flag("M", "as evaluated, else 10")] = None
    """In-map radius: truth within it of a map pose, metres."""

    r_out: Annotated[float | None, flag("M", "as evaluated, else 10")] = None
    """An answer or a pose farther than this from the truth is wrong, metres."""

    seed: Annotated[int | None, flag("INT", "none")] = None
    """Changes nothing: no optimiser here draws by chance. Taken as by the other verbs."""

    progress: bool = True
    """Say what is being optimised."""


def run(args: Graph) -> None:
    """Optimise, judge, write, and print what was found."""
    check_seed(args.seed)
    from taojax.graph.optimise import check_extra

    check_extra()
    from taojax.audit.graph import write_graph
    from taojax.config import from_toml
    from taojax.files.records import read_run

    sealed = read_run(args.run)
    facts = evaluated(args.run)
    truth = args.truth or _truth_of(args.run, str(sealed.manifest.get("dataset", "")))
    _refuse_foreign(truth, facts)
    config = from_toml(args.run / "config.toml")
    audit = _audit(config.audit, facts, args)
    window = int(facts.get("gap_frames", config.stream.window))
    out = args.out or args.run
    command = f"taojax graph {args.run} --truth {truth}"
    tell = (lambda name: say(f"optimising {name}")) if args.progress else lambda name: None
    found = write_graph(
        args.run, sealed, truth, audit, window,
        out=out, command=command, say=tell,
    )  # fmt: skip
    print("\n".join(found))
    say(f"written to {out}/graph.html, tables/graph.csv and figures/graph.png")


def evaluated(run: Path) -> dict[str, Any]:
    """Return what the judge of this run was told; empty where there was none."""
    from taojax.files.specs import read_text

    path = run / "audit.json"
    if not path.is_file():
        return {}
    try:
        facts = json.loads(read_text(path))
    except ValueError as error:
        raise InputError(f"{path}: is not JSON; judge the run again") from error
    if not isinstance(facts, dict):
        raise InputError(f"{path}: does not say how the run was judged; judge it again")
    return facts


def _truth_of(run: Path, dataset: str) -> Path:
    """Find the truth beside the data of a run."""
    from taojax.cli.rerun import data_places

    for place in data_places(run, dataset):
        if dataset and (place / "truth/query_poses.csv").is_file():
            return place / "truth"
    raise InputError(f"{run}: its truth is not at {dataset!r} any more; name it with --truth")


def _refuse_foreign(truth: Path, facts: dict[str, Any]) -> None:
    """Refuse a truth other than the one that the verdicts were judged with."""
    from taojax.files.records import digest_file

    path = truth / "query_poses.csv" if truth.is_dir() else truth
    want = facts.get("truth_sha256")
    if want is not None and digest_file(path) != want:
        raise InputError(f"{path}: is not the truth that the run was judged with; name that one")


def _audit(base: "AuditConfig", facts: dict[str, Any], args: Graph) -> "AuditConfig":
    """Return radii and split: as evaluated, with the flags on top."""
    from taojax.config import AuditConfig
    from taojax.errors import ConfigError, UsageError

    known = {field.name: getattr(base, field.name) for field in dataclasses.fields(AuditConfig)}
    told = facts.get("audit", {})
    known |= {
        name: told[name] for name in ("r_in_m", "r_out_m", "calibration_share") if name in told
    }
    if args.r_in is not None:
        known |= {"r_in_m": args.r_in, "r_out_m": max(args.r_in, known["r_out_m"])}
    if args.r_out is not None:
        known["r_out_m"] = args.r_out
    try:
        return AuditConfig(**known)
    except ConfigError as error:
        raise UsageError(f"flag {error}") from error
