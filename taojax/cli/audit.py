"""`taojax audit`: the main job."""

import dataclasses
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from taojax.cli.common import (
    SCENARIOS,
    Common,
    Scenario,
    Scoring,
    config_of,
    draws_bars,
    flag,
    out_of,
    say,
    score_apart,
    told,
)
from taojax.cli.from_images import FOLDER, FromImages, are_asked, make
from taojax.cli.layout import check_drive, check_layout
from taojax.cli.resume import claimed, is_sealed
from taojax.cli.score import decided
from taojax.errors import InputError, UsageError

if TYPE_CHECKING:
    from taojax.config import Config


@dataclasses.dataclass(frozen=True)
class Audit(Common):
    """The main job: score, seal, label, calibrate, measure, report.

    Without DATASET it runs on the built-in simulated KAIST-like world, in its four scenarios; with
    --map-images it begins with two folders of images.

    Example: taojax audit my_data --r-in 5 --r-out 10
    """

    dataset: Annotated[
        Path | None, tyro.conf.Positional, flag("DATASET", "the simulated world")
    ] = None
    """Data folder with truth/, laid out as data_specs/README.md says."""

    scenario: Annotated[Scenario | None, flag("full|default|h3|h4", "all four")] = None
    """Run one scenario of the simulated world alone."""

    simulate_descriptors: bool = False
    """DATASET is a plain folder with poses: simulate what it lacks, as `taojax convert folder`."""

    map: Annotated[Path | None, flag("FOLDER", "DATASET holds it")] = None
    """With --simulate-descriptors: folder of the map drive; DATASET is the query drive alone."""

    self: Annotated[bool, flag("", "False")] = False
    """DATASET is one drive that closes on itself: a frame's map is what lies --gap-m behind it.
    With a map/, the query's drive follows the map's. As `taojax convert self`, then audit."""

    gap_m: Annotated[float | None, flag("M", "50")] = None
    """With --self: way between a frame and the newest one that it may close on, metres."""

    from_images: Annotated[FromImages, tyro.conf.OmitArgPrefixes] = dataclasses.field(
        default_factory=FromImages
    )


def run(args: Audit) -> None:
    """Audit a data folder, two folders of images or the simulated world."""
    _check(args)
    has_images = are_asked(args.from_images)
    is_ready = args.dataset is not None and not args.simulate_descriptors and not args.self
    if args.dataset is not None and is_ready:
        check_layout(args.dataset, has_truth=True)
    if args.dataset is not None and args.self:
        check_drive(args.dataset)
    config = config_of(args)
    out = out_of(args, "audit", config)
    if has_images:
        _audit_images(args, out, config)
        return
    if args.dataset is not None and is_ready:
        _audit_folder(args.dataset, out, config, progress=draws_bars(args.progress))
        return
    with claimed(out, told(args, config)):
        if args.dataset is not None:
            _audit_converted(args, out, config)
        else:
            _audit_world(args.scenario, out, config, progress=draws_bars(args.progress))


def _check(args: Audit) -> None:
    """Refuse flags that contradict each other."""
    truth = args.from_images.truth
    if args.dataset is not None and truth is not None and args.from_images.map_images is None:
        raise UsageError(
            f"--truth goes with --map-images; `taojax convert files {args.dataset} --query-poses"
            f" {truth}` adds it to a data folder"
        )
    if are_asked(args.from_images) and (
        args.dataset is not None or args.scenario or args.simulate_descriptors or args.self
    ):
        raise UsageError(
            "--map-images stands in the place of DATASET, --scenario, --simulate-descriptors and"
            " --self; drop one of them"
        )
    if args.dataset is not None and args.scenario is not None:
        raise UsageError("--scenario names a part of the simulated world; drop it or DATASET")
    if args.simulate_descriptors and args.dataset is None:
        raise UsageError("--simulate-descriptors completes a DATASET; name one")
    if args.map is not None and not args.simulate_descriptors:
        raise UsageError("--map goes with --simulate-descriptors")
    if args.self and (args.dataset is None or args.simulate_descriptors):
        raise UsageError("--self takes one DATASET as it is; name it, drop --simulate-descriptors")
    if args.gap_m is not None and not args.self:
        raise UsageError("--gap-m goes with --self")


def _audit_folder(dataset: Path, out: Path, config: "Config", *, progress: bool) -> None:
    from taojax.files.records import refuse_if_taken

    # The report is written last: a sealed run without one was stopped while it was judged.
    if (out / "report.html").exists() or not is_sealed(out, dataset, config):
        refuse_if_taken(out)
    score_apart([Scoring(dataset, out)], config, progress=progress)
    _judge(dataset, out, config)


def _audit_images(args: Audit, out: Path, config: "Config") -> None:
    """Describe and convert beside the run, score, and judge where the truth is known."""
    from taojax.datasets.edit import TRUTH
    from taojax.files.records import refuse_if_taken
    from taojax.files.specs import write_atomically

    if not (out / "manifest.json").is_file():
        refuse_if_taken(out)
    drawn = draws_bars(args.progress)
    data, truth_csv = make(args.from_images, out.parent / FOLDER, progress=drawn)
    if (out / "manifest.json").is_file() and not is_sealed(out, data, config):
        raise InputError(f"{out}: holds a run of other images, files or flags; choose a new --out")
    score_apart([Scoring(data, out)], config, progress=drawn)
    if truth_csv is None:
        say(
            "nothing is judged: no --truth; the calibration that ships with taojax decided. The"
            " same command with --truth FILE judges it; with --out, name another one beside this"
        )
        say(decided(out))
        return
    write_atomically(data / TRUTH, truth_csv)
    _judge(data, out, config)


def _convert(args: Audit, data: Path, seed: int) -> None:
    """Make the data folder that is audited in place of DATASET."""
    from taojax.cli import convert
    from taojax.cli.convert_flags import Folder, Self

    assert args.dataset is not None  # noqa: S101 - the caller has asked
    if args.self:
        convert.make_self(Self(folder=args.dataset, out=data, gap_m=args.gap_m, seed=seed))
        return
    convert.make(
        Folder(folder=args.dataset, out=data, map=args.map, simulate_descriptors=True, seed=seed)
    )


def _audit_converted(args: Audit, out: Path, config: "Config") -> None:
    """Make of DATASET what can be audited, in out/data, then audit that."""
    data, scored, progress = out / "data", out / "scored", draws_bars(args.progress)
    if not data.exists():
        _convert(args, data, config.seed)
    if not is_sealed(out, data, config):
        if not is_sealed(scored, data, config):
            shutil.rmtree(scored, ignore_errors=True)
        score_apart([Scoring(data, scored)], config, progress=progress)
        # A run is published into an empty folder alone, and this one holds its data already.
        for path in sorted(scored.iterdir(), key=lambda path: path.name == "manifest.json"):
            path.rename(out / path.name)
        scored.rmdir()
    _judge(data, out, config)


def _judge(dataset: Path, out: Path, config: "Config") -> None:
    from taojax.audit.evaluate import evaluate
    from taojax.audit.summary_text import terminal_words

    say("judging: labels, calibration, intervals from resampled blocks, figures")
    evaluation = evaluate(out, dataset / "truth", config)
    print("\n".join(terminal_words(evaluation)))
    say(f"report: {out}/report.html")
    if "own_gap_m" in evaluation.judgement.manifest:
        say(f"next:   taojax closures {out}; taojax graph {out}")
        return
    # What a user wants to understand first: a wrong closure, a lost one, or any.
    outcome = evaluation.judgement.outcome
    kinds = [outcome == kind for kind in ("accepted_wrong", "rejected_in", "accepted_in")]
    frame = next((kind.nonzero()[0][-1] for kind in kinds if kind.any()), len(outcome) - 1)
    say(f"next:   taojax explain {out} --frame {frame}; taojax closures {out}")


def _audit_world(only: Scenario | None, out: Path, config: "Config", *, progress: bool) -> None:
    from taojax.datasets.edit import scenario
    from taojax.datasets.simulate import WorldConfig, make_world, write_world

    say("simulating the KAIST-like world")
    world = make_world(WorldConfig(), config.seed)
    evaluations = {}
    for name in (only,) if only else SCENARIOS:
        folder = out / "data" / name
        # Half of it may lie there from a command that was stopped.
        shutil.rmtree(folder, ignore_errors=True)
        write_world(scenario(world, name), folder)
        say(f"scoring scenario {name} (simulated)")
        score_apart([Scoring(folder, out / name)], config, progress=progress)
    from taojax.audit.evaluate import evaluate
    from taojax.audit.report import write_summary
    from taojax.audit.summary_text import summary_words

    for name in (only,) if only else SCENARIOS:
        say(f"judging scenario {name} (simulated)")
        evaluations[name] = evaluate(out / name, out / "data" / name / "truth", config)
    command = " ".join(["taojax", *sys.argv[1:]])
    write_summary(out, evaluations, command=command)
    print("\n".join(summary_words(evaluations)))
    say(f"report: {out}/report.html")
