"""`taojax sweep`: many configurations at once, chosen on the calibration half."""

import dataclasses
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from taojax.cli.common import Common, config_of, draws_bars, flag, out_of, run_apart, say
from taojax.errors import InputError

if TYPE_CHECKING:
    from taojax.config import Config
    from taojax.runtime.sweep import Grid


@dataclasses.dataclass(frozen=True)
class Sweep(Common):
    """Ablation: try many settings on one recording, choose on its calibration half, test once.

    Without DATASET it runs on the built-in simulated world. Interrupted, the same command with the
    same --out goes on where it stopped. A flag such as --window keeps that setting at one value.

    Example: taojax sweep my_data --grid grid.toml --out runs/mine
    """

    dataset: Annotated[
        Path | None, tyro.conf.Positional, flag("DATASET", "the simulated world, default scenario")
    ] = None
    """Data folder with truth/, laid out as data_specs/README.md says."""

    grid: Annotated[Path | None, flag("FILE.toml", "256 rank and 36 joint configurations")] = None
    """Values per setting, such as lambda_velocity = [0, 0.1, 1]; the sweep is their product."""

    judge: bool = True
    """Judge the sealed sweep; without it no truth is needed."""


def run(args: Sweep) -> None:
    """Sweep a data folder or the simulated world."""
    from taojax.runtime import sweep as grids
    from taojax.runtime.sweep import check_same, stage

    config = config_of(args)
    grid = grids.DEFAULT if args.grid is None else grids.read_grid(args.grid)
    grid = grids.pin(grid, {"window": args.window, "branches": args.branches}, args.association)
    out = out_of(args, "sweep", config)
    is_sealed = stage(out) == "sealed"
    if is_sealed and ((out / "sweep.csv").is_file() or not args.judge):
        raise InputError(f"{out}: already holds a finished sweep; choose a new --out")
    if is_sealed:
        check_same(out, config, grid)
    dataset = args.dataset or _world(out, config.seed)
    truth = dataset / "truth" / "query_poses.csv"
    if args.judge and dataset.is_dir() and not truth.is_file():
        raise InputError(f"{truth}: no such file; add it, or add --no-judge")
    try:
        if not args.judge:
            _compute(dataset, out, config, grid, progress=draws_bars(args.progress))
            return
        if not is_sealed:
            _compute_apart(dataset, out, config, grid, progress=draws_bars(args.progress))
    except KeyboardInterrupt:
        say(f"taojax: interrupted; run the same command again to continue, with --out {out}")
        raise SystemExit(130) from None
    from taojax.audit.sweep import evaluate_sweep

    print("\n".join(evaluate_sweep(out, dataset / "truth", config)))
    say(f"table: {out}/sweep.csv")


def _world(out: Path, seed: int) -> Path:
    """Write the simulated world into the sweep's folder, once."""
    from taojax.datasets.edit import scenario
    from taojax.datasets.simulate import WorldConfig, make_world, write_world
    from taojax.runtime.sweep import PARTS

    folder = out / "data" / "default"
    if not (folder / "about.toml").is_file():  # written last
        say("simulating the KAIST-like world")
        (out / PARTS).mkdir(parents=True, exist_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
        write_world(scenario(make_world(WorldConfig(), seed), "default"), folder)
    return folder


def _compute(dataset: Path, out: Path, config: "Config", grid: "Grid", *, progress: bool) -> None:
    from taojax.runtime.sweep import sweep

    manifest = sweep(dataset, out, config, grid, progress=progress)
    n, seal = manifest["n_configurations"], manifest["seal"][:12]
    say(f"sealed {n} configurations in {out}/signals.npz (seal {seal})")


def _compute_apart(
    dataset: Path, out: Path, config: "Config", grid: "Grid", *, progress: bool
) -> None:
    """Compute in a fresh interpreter: one in which the judge has never been imported."""
    from taojax.config import to_toml
    from taojax.runtime.sweep import grid_to_toml as grid_toml

    with tempfile.TemporaryDirectory() as scratch:
        settings, values = Path(scratch) / "config.toml", Path(scratch) / "grid.toml"
        settings.write_text(to_toml(config), encoding="utf-8")
        values.write_text(grid_toml(grid), encoding="utf-8")
        words = ["sweep", str(dataset), "--out", str(out), "--config", str(settings)]
        words += ["--grid", str(values), "--no-judge"]
        words += ["--progress" if progress else "--no-progress"]
        run_apart([words])
