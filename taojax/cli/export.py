"""`taojax export`: the step for programs without this package."""

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import tyro

from taojax.cli.common import Common, config_of, flag, out_of, say
from taojax.errors import UsageError


@dataclasses.dataclass(frozen=True)
class Export(Common):
    """The step as StableHLO: runs where jax and numpy are, without this package.

    Without DATASET it is made for the map of the built-in simulated world.

    Example: taojax export my_data --out my_step
    """

    dataset: Annotated[
        Path | None, tyro.conf.Positional, flag("DATASET", "the simulated world, default scenario")
    ] = None
    """Data folder, laid out as data_specs/README.md says; needs no truth."""

    platforms: tuple[Literal["cpu", "cuda"], ...] = ("cpu", "cuda")
    """What to compile for later, one artefact each."""


def run(args: Export) -> None:
    """Export the step."""
    if not args.platforms:
        raise UsageError("--platforms needs at least one of cpu, cuda")
    from taojax.runtime.export import check_exportable, export_step
    from taojax.runtime.score import facts_of

    config = config_of(args)
    out = out_of(args, "export", config)
    check_exportable(out)
    # What repeats this run, seen from its own folder.
    data, platforms = f"{args.dataset} " if args.dataset else "", " ".join(args.platforms)
    command = f"taojax export {data}--config config.toml --platforms {platforms}"
    facts = facts_of(command, args.dataset or Path("simulated world"), config.seed)
    with tempfile.TemporaryDirectory() as scratch:
        dataset = args.dataset or _world(Path(scratch) / "world", config.seed)
        export_step(dataset, out, config, platforms=args.platforms, facts=facts)
    say(f"exported {out}; check it where it will run: python {out}/load_step.py")


def _world(folder: Path, seed: int) -> Path:
    from taojax.datasets.edit import scenario
    from taojax.datasets.simulate import WorldConfig, make_world, write_world

    say("simulating the KAIST-like world")
    write_world(scenario(make_world(WorldConfig(), seed), "default"), folder)
    return folder
