"""`taojax describe`: a folder of images becomes descriptors."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from taojax.cli.common import draws_bars, flag, say
from taojax.errors import UsageError

if TYPE_CHECKING:
    from taojax.datasets.describe import Described, Network, Preparation


@dataclasses.dataclass(frozen=True, kw_only=True)
class Describing:
    """How images become descriptors."""

    model: Annotated[Path | None, flag("FILE.onnx", "GIST, a classical descriptor")] = None
    """Model with one image input (N, 1 or 3, H, W)."""

    size: Annotated[tuple[int, int] | None, flag("W H", "as the model says")] = None
    """Pixels of the model's input."""

    mean: Annotated[tuple[float, float, float] | None, flag("R G B", "ImageNet's")] = None
    """Subtracted from pixels of 0 to 1."""

    deviation: Annotated[tuple[float, float, float] | None, flag("R G B", "ImageNet's")] = None
    """What they are divided by then."""

    percentiles: tuple[float, float] = (1.0, 99.0)
    """Of each thermal image: what becomes black and white."""

    clahe: float = 2.0
    """Clip limit of the equalisation of thermal images, 0 for none."""

    batch: int = 16
    """Images at a time."""


@dataclasses.dataclass(frozen=True)
class Describe(Describing):
    """Describe the images of a folder, thermal or RGB, by a model of yours or by GIST.

    Example: taojax describe my_images --out map.npy
    """

    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")]
    """Folder of 8- or 16-bit images; one row each, in the order of their names or numbers."""

    out: Annotated[Path, tyro.conf.arg(metavar="FILE.npy")]
    """Rows; how they were made goes to FILE.toml beside."""

    progress: bool = True
    """Draw a progress bar."""


def how_of(flags: Describing) -> "tuple[Preparation, Network | None]":
    """Return how images are prepared and by which model they are described.

    Raises:
        UsageError: flags that contradict each other.
    """
    low, high = flags.percentiles
    if not 0 <= low < high <= 100:
        raise UsageError(f"--percentiles {low:g} {high:g} must rise within 0 to 100")
    if flags.batch < 1:
        raise UsageError(f"--batch {flags.batch} must be at least 1")
    told = {name: getattr(flags, name) for name in ("size", "mean", "deviation")}
    told = {name: value for name, value in told.items() if value is not None}
    if told and flags.model is None:
        raise UsageError(f"--{next(iter(told))} goes with --model")
    from taojax.datasets.describe import Network, Preparation

    network = None if flags.model is None else Network(flags.model, **told)
    return Preparation(low, high, flags.clahe), network


def describe_folder(images: Path, out: Path, flags: Describing, *, progress: bool) -> "Described":
    """Describe the images of a folder as the flags say, with a bar where it is wanted."""
    how, network = how_of(flags)
    from tqdm import tqdm

    from taojax.datasets.describe import describe

    return describe(
        images,
        out,
        how=how,
        network=network,
        batch=flags.batch,
        tell=lambda starts: iter(tqdm(starts, desc="describe", unit="batch", disable=not progress)),
    )


def run(args: Describe) -> None:
    """Describe and say what comes next."""
    made = describe_folder(args.images, args.out, args, progress=draws_bars(args.progress))
    resumed = f", {made.n_resumed:,} of them from an interrupted run" if made.n_resumed else ""
    say(f"{made.n_images:,} images ({made.kind}), in the order of their {made.order}{resumed}")
    say(f"wrote {args.out}: {made.n_images:,} x {made.dimension:,}; how: {args.out.stem}.toml")
