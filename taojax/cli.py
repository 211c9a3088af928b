"""Command line. Each command imports its own room only when it is called.

The flags are plain dataclasses: `--help` answers without importing jax.
"""

import dataclasses
import hashlib
import os
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from taojax.errors import ConfigError, InputError, MissingExtraError, TaojaxError, UsageError

if TYPE_CHECKING:
    from taojax.config import Config

Scenario = Literal["full", "default", "h3", "h4"]
SCENARIOS: tuple[Scenario, ...] = ("full", "default", "h3", "h4")
ABOUT = "Am I lost, or just somewhere new, and may this loop closure enter my graph?"
EXIT_CODES = {UsageError: 2, InputError: 3, ConfigError: 3, MissingExtraError: 4}


def _flag(metavar: str, default: str) -> Any:
    """Return how a flag shows in --help when its default is 'as the config file says'."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


Dataset = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]


@dataclasses.dataclass(frozen=True)
class Common:
    """Flags shared by the verbs; each wins over the config file."""

    out: Annotated[Path | None, _flag("DIR", "runs/<verb>/<time>-<config hash>")] = None
    """Folder to make."""

    config: Annotated[Path | None, _flag("FILE.toml", "built-in settings")] = None
    """Settings, such as the config.toml of an earlier run."""

    r_in: Annotated[float | None, _flag("M", "10")] = None
    """In-map radius: truth within it of a map pose, metres."""

    r_out: Annotated[float | None, _flag("M", "10, at least r-in")] = None
    """Map-out radius: truth beyond it of every map pose, metres."""

    window: Annotated[int | None, _flag("N", "20")] = None
    """Frames remembered."""

    branches: Annotated[int | None, _flag("K", "100")] = None
    """Hypotheses per frame."""

    association: Annotated[Literal["rank", "joint"] | None, _flag("rank|joint", "rank")] = None
    """What a branch is."""

    seed: Annotated[int | None, _flag("INT", "0")] = None
    """Seed of the simulated world and of the bootstrap."""

    progress: bool = True
    """Draw progress bars."""


@dataclasses.dataclass(frozen=True)
class Audit(Common):
    """The main job: score, seal, label, calibrate, measure, report.

    Without DATASET it runs on the built-in simulated KAIST-like world, in its four scenarios.

    Example: taojax audit my_data --r-in 5 --r-out 10
    """

    dataset: Annotated[
        Path | None, tyro.conf.Positional, _flag("DATASET", "the simulated world")
    ] = None
    """Data folder with truth/, laid out as data_specs/README.md says."""

    scenario: Annotated[Scenario | None, _flag("full|default|h3|h4", "all four")] = None
    """Run one scenario of the simulated world alone."""


@dataclasses.dataclass(frozen=True)
class Score(Common):
    """Run time only: score a data folder and seal signals.csv. Needs no truth.

    Example: taojax score my_data --out runs/mine
    """

    dataset: Dataset = tyro.MISSING
    """Data folder, laid out as data_specs/README.md says."""

    calibration: Annotated[Path | None, _flag("FILE.toml", "no verdicts at run time")] = None
    """calibration.toml of an audited run: adds decisions.csv, verdicts at frozen numbers."""


@dataclasses.dataclass(frozen=True)
class Evaluate(Common):
    """Judge a sealed run against the truth: labels, thresholds, metrics, report.

    Example: taojax evaluate runs/mine --truth my_data/truth --r-in 5 --r-out 10
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = tyro.MISSING
    """Run folder made by `taojax score`."""

    truth: Annotated[Path, tyro.conf.arg(metavar="DIR")] = tyro.MISSING
    """Folder that holds query_poses.csv."""


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Write the simulated KAIST-like world as a data folder.

    Example: taojax simulate my_world --scenario h3 --seed 1
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Data folder to make."""

    scenario: Scenario = "default"
    """Which map segments are deleted; full deletes none."""

    seed: int = 0
    """Another seed is another day on the same route."""


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _config(args: Common, base: Path | None = None) -> "Config":
    """Return the settings of the config file, of `base` or the defaults, with the flags on top."""
    from taojax import config as settings

    path = args.config or base
    config = settings.from_toml(path) if path else settings.Config()
    names = ("window", "branches", "association", "seed")
    flags = {name: getattr(args, name) for name in names}
    flags |= {"r_in_m": args.r_in, "r_out_m": args.r_out}
    if args.r_in is not None and args.r_out is None:
        flags["r_out_m"] = max(args.r_in, config.audit.r_out_m)
    try:
        return settings.replace(config, flags)
    except ConfigError as error:
        raise UsageError(f"flag {error}") from error


def _out(args: Common, verb: str, config: "Config") -> Path:
    from taojax.config import to_toml

    if args.out is not None:
        return args.out
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return (
        Path("runs") / verb / f"{stamp}-{hashlib.sha256(to_toml(config).encode()).hexdigest()[:8]}"
    )


def _score_apart(dataset: Path, out: Path, config: "Config", *, progress: bool) -> None:
    """Score in a fresh interpreter: one in which the judge has never been imported."""
    from taojax.config import to_toml

    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "config.toml"
        path.write_text(to_toml(config), encoding="utf-8")
        flag = "--progress" if progress else "--no-progress"
        words = ["score", str(dataset), "--out", str(out), "--config", str(path), flag]
        done = subprocess.run([sys.executable, "-m", "taojax", *words], check=False)
    if done.returncode:
        raise SystemExit(done.returncode)


def _score(args: Score) -> None:
    from taojax.detector import from_toml
    from taojax.runtime.score import score

    config = _config(args)
    out = _out(args, "score", config)
    detector = None if args.calibration is None else from_toml(args.calibration)
    manifest = score(args.dataset, out, config, detector=detector, progress=args.progress)
    _say(f"sealed {out}/signals.csv (seal {manifest['seal'][:12]})")


def _evaluate(args: Evaluate) -> None:
    from taojax.audit.evaluate import evaluate
    from taojax.records import read_manifest

    read_manifest(args.run)
    config = _config(args, args.run / "config.toml")
    evaluation = evaluate(args.run, args.truth, config, out=args.out)
    print("\n".join(evaluation.sentences))
    _say(f"report: {args.out or args.run}/report.html")


def _audit(args: Audit) -> None:
    if args.dataset is not None and args.scenario is not None:
        raise UsageError("--scenario names a part of the simulated world; drop it or DATASET")
    config = _config(args)
    out = _out(args, "audit", config)
    if args.dataset is not None:
        _audit_folder(args.dataset, out, config, progress=args.progress)
    else:
        _audit_world(args.scenario, out, config, progress=args.progress)


def _audit_folder(dataset: Path, out: Path, config: "Config", *, progress: bool) -> None:
    from taojax.records import refuse_if_taken

    refuse_if_taken(out)
    truth = dataset / "truth" / "query_poses.csv"
    if dataset.is_dir() and not truth.is_file():
        raise InputError(f"{truth}: no such file; add it, or run `taojax score` without truth")
    _score_apart(dataset, out, config, progress=progress)
    from taojax.audit.evaluate import evaluate

    evaluation = evaluate(out, dataset / "truth", config)
    print("\n".join(evaluation.sentences))
    _say(f"report: {out}/report.html")


def _audit_world(only: Scenario | None, out: Path, config: "Config", *, progress: bool) -> None:
    from taojax.datasets.edit import scenario
    from taojax.datasets.simulate import WorldConfig, make_world
    from taojax.datasets.world import write_world
    from taojax.records import refuse_if_taken

    refuse_if_taken(out)
    _say("simulating the KAIST-like world")
    world = make_world(WorldConfig(), config.seed)
    evaluations = {}
    for name in (only,) if only else SCENARIOS:
        folder = out / "data" / name
        write_world(scenario(world, name), folder)
        _say(f"scoring scenario {name} (simulated)")
        _score_apart(folder, out / name, config, progress=progress)
    from taojax.audit.evaluate import evaluate
    from taojax.audit.report import write_summary

    for name in (only,) if only else SCENARIOS:
        _say(f"judging scenario {name} (simulated)")
        evaluations[name] = evaluate(out / name, out / "data" / name / "truth", config)
    command = " ".join(["taojax", *sys.argv[1:]])
    print("\n".join(write_summary(out, evaluations, command=command)))
    _say(f"report: {out}/report.html")


def _simulate(args: Simulate) -> None:
    from taojax.datasets.edit import scenario
    from taojax.datasets.simulate import WorldConfig, make_world
    from taojax.datasets.world import write_world

    write_world(scenario(make_world(WorldConfig(), args.seed), args.scenario), args.folder)
    _say(f"simulated world (scenario {args.scenario}, seed {args.seed}) in {args.folder}")


RUN = {Audit: _audit, Score: _score, Evaluate: _evaluate, Simulate: _simulate}


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 ok, 1 internal error, 2 usage, 3 bad input, 4 missing extra, 130 interrupted.
    """
    verbs = Audit | Score | Evaluate | Simulate
    args = tyro.cli(verbs, prog="taojax", args=argv, description=ABOUT)
    # Matplotlib's cache and XLA's notices are not the user's business.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    try:
        RUN[type(args)](args)
    except TaojaxError as error:
        _say(f"taojax: {error}")
        return next(code for kind, code in EXIT_CODES.items() if isinstance(error, kind))
    except KeyboardInterrupt:
        _say("taojax: interrupted; what is sealed is kept")
        return 130
    except Exception:
        traceback.print_exc()
        _say("taojax: internal error; please report it with the lines above")
        return 1
    return 0
