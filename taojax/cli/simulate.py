"""`taojax simulate`: the simulated world as a data folder."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from taojax.cli.common import Scenario, check_seed, say


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


def run(args: Simulate) -> None:
    """Write the world."""
    check_seed(args.seed)
    from taojax.datasets.edit import scenario
    from taojax.datasets.simulate import WorldConfig, make_world, write_world

    write_world(scenario(make_world(WorldConfig(), args.seed), args.scenario), args.folder)
    say(f"simulated world (scenario {args.scenario}, seed {args.seed}) in {args.folder}")
