"""The command line of the benchmarks; imports happen inside the verbs, so that help is fast."""

import argparse
import importlib
import sys
import time
from pathlib import Path

from taojax.errors import GateError, MissingExtraError, TaojaxError, UsageError

DATA = Path(__file__).parents[2] / "shared" / "data"
"""Where real recordings lie when `--data` does not say: beside the checkout."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    quality = verbs.add_parser("quality", help="leaderboard of map-out detection, losses included")
    quality.add_argument("--quick", action="store_true", help="fewer seeds, slow systems left out")
    quality.add_argument("--out", type=Path, help="folder to make (default runs/quality/TIME)")
    quality.add_argument("--data", type=Path, default=DATA, help="folder of the real recordings")
    quality.add_argument("--only", default="", help="only data sets whose name contains this")
    verdict = verbs.add_parser("verdict", help="verdicts on recordings left out; makes the default")
    verdict.add_argument("--out", type=Path, help="folder to make (default runs/verdict/TIME)")
    verdict.add_argument("--data", type=Path, default=DATA, help="folder of the real recordings")
    verdict.add_argument("--only", default="", help="only recordings whose name contains this")
    verdict.add_argument("--write", action="store_true", help="replace the default calibration")
    promise = verbs.add_parser("promise", help="is the promise kept on 1,000 simulated recordings")
    promise.add_argument("--quick", action="store_true", help="fifty recordings")
    promise.add_argument("--out", type=Path, help="folder to make (default runs/promise/TIME)")
    ablation = verbs.add_parser("ablation", help="what each ingredient is worth")
    ablation.add_argument("--out", type=Path, help="folder to make (default runs/ablation/TIME)")
    ablation.add_argument("--data", type=Path, default=DATA, help="folder of the real recordings")
    ablation.add_argument("--only", default="", help="only data sets whose name contains this")
    progress = verbs.add_parser("progress", help="the paper's Table 3: no poses")
    progress.add_argument("--out", type=Path, help="folder to make (default runs/progress/TIME)")
    progress.add_argument("--data", type=Path, default=DATA, help="folder of the real recordings")
    gallery = verbs.add_parser("gallery", help="the README's sheet of figures")
    gallery.add_argument("--out", type=Path, help="folder to make (default runs/gallery/TIME)")
    graph = verbs.add_parser("graph", help="what closures do to a pose graph; needs gtsam")
    graph.add_argument("--quick", action="store_true", help="fewer worlds")
    graph.add_argument("--out", type=Path, help="folder to make (default runs/graph/TIME)")
    graph.add_argument("--data", type=Path, default=DATA, help="folder of the real recordings")
    graph.add_argument("--only", default="", help="only data sets whose name contains this")
    notebooks = verbs.add_parser("notebooks", help="executes the notebooks, keeps their figures")
    notebooks.add_argument("--only", default="", help="only notebooks whose name contains this")
    refinement = verbs.add_parser("refinement", help="what the true Huber minimum buys and costs")
    refinement.add_argument("--quick", action="store_true", help="500 windows instead of 10,000")
    refinement.add_argument(
        "--out", type=Path, help="folder to make (default runs/refinement/TIME)"
    )
    refinement.add_argument("--data", type=Path, default=DATA, help="folder of the real recordings")
    sweeps = verbs.add_parser("sweep_speed", help="a loop against vmap over configurations")
    sweeps.add_argument("--out", type=Path, help="folder to make (default runs/sweep_speed/TIME)")
    speed = verbs.add_parser("speed", help="step, replay, retrieval, rivals, and how they grow")
    speed.add_argument("--quick", action="store_true", help="shorter curves, fewer repeats")
    speed.add_argument("--out", type=Path, help="folder to make (default runs/speed/TIME)")
    speed.add_argument("--gate", action="store_true", help="fail where a ratio got worse")
    speed.add_argument("--bless", action="store_true", help="make this run the baseline")
    gpu = verbs.add_parser("accelerator", help="speed on a GPU, and how equal to the CPU")
    gpu.add_argument("--quick", action="store_true", help="a small version")
    gpu.add_argument("--out", type=Path, help="folder to make (default runs/accelerator/TIME)")
    reliability = verbs.add_parser("reliability", help="bad input, numbers, faults, long streams")
    reliability.add_argument("--quick", action="store_true", help="hundreds of cases")
    reliability.add_argument("--only", default="", help="of fuzz,numbers,faults,stream")
    reliability.add_argument(
        "--out", type=Path, help="folder to make (default runs/reliability/TIME)"
    )
    return parser


def _graph(out: Path, args: argparse.Namespace) -> int:
    from benchmarks import graph

    try:
        graph.run(out, args.data, quick=args.quick, only=args.only)
    except TaojaxError as error:
        print(error, file=sys.stderr)
        return 4 if isinstance(error, MissingExtraError) else 3
    return 0


def _reliability(out: Path, args: argparse.Namespace) -> int:
    from benchmarks import reliability

    try:
        return 1 if reliability.run(out, quick=args.quick, only=args.only) else 0
    except UsageError as error:
        print(error, file=sys.stderr)
        return 2


def main(arguments: list[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    args = _parser().parse_args(arguments)
    if args.verb == "notebooks":
        from benchmarks import notebooks

        notebooks.run(args.only)
        return 0
    out = args.out or Path("runs") / args.verb / time.strftime("%Y%m%d-%H%M%S")
    if out.exists() and any(out.iterdir()):
        print(f"{out} is not empty: choose another --out", file=sys.stderr)
        return 3
    # Flags that a benchmark takes beside its folder, by their names.
    flags = {
        "ablation": ("data", "only"),
        "accelerator": ("quick",),
        "gallery": (),
        "progress": ("data",),
        "promise": ("quick",),
        "quality": ("data", "quick", "only"),
        "refinement": ("data", "quick"),
        "sweep_speed": (),
        "verdict": ("data", "only", "write"),
    }
    if args.verb in flags:
        module = importlib.import_module(f"benchmarks.{args.verb}")
        module.run(out, **{name: getattr(args, name) for name in flags[args.verb]})
    elif args.verb == "speed":
        from benchmarks import speed

        try:
            speed.run(out, quick=args.quick, gate=args.gate, blessed=args.bless)
        except TaojaxError as error:
            print(error, file=sys.stderr)
            return 5 if isinstance(error, GateError) else 3
    else:
        return {"reliability": _reliability, "graph": _graph}[args.verb](out, args)
    return 0


if __name__ == "__main__":
    sys.exit(main())
