"""What the verbs share: flags, where a run goes, and scoring in a fresh process."""

import dataclasses
import hashlib
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import tyro

from taojax.cli import child
from taojax.cli.resume import is_sealed
from taojax.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from taojax.config import Config

Scenario = Literal["full", "default", "h3", "h4"]
SCENARIOS: tuple[Scenario, ...] = ("full", "default", "h3", "h4")


def flag(metavar: str, default: str) -> Any:
    """Return how a flag shows in --help when its default is 'as the config file says'."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


Dataset = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compiling:
    """Flag of the verbs that compile."""

    cache: bool = True
    """Keep what is compiled for the next command, in the user's cache folder."""


@dataclasses.dataclass(frozen=True)
class Common(Compiling):
    """Flags shared by the verbs; each wins over the config file."""

    out: Annotated[Path | None, flag("DIR", "runs/<verb>/<time>-<config hash>")] = None
    """Folder to make."""

    config: Annotated[Path | None, flag("FILE.toml", "built-in settings")] = None
    """Settings, such as the config.toml of an earlier run."""

    r_in: Annotated[float | None, flag("M", "10")] = None
    """In-map radius: truth within it of a map pose, metres."""

    r_out: Annotated[float | None, flag("M", "10, at least r-in")] = None
    """Map-out radius: truth beyond it of every map pose, metres."""

    window: Annotated[int | None, flag("N", "20")] = None
    """Frames in the window of the literal cost."""

    branches: Annotated[int | None, flag("K", "100")] = None
    """Hypotheses of the literal cost per frame."""

    association: Annotated[Literal["rank", "joint"] | None, flag("rank|joint", "joint")] = None
    """What tao and the pose are of: the filter's answer (joint), or the paper's branches (rank)."""

    max_wrong: Annotated[float | None, flag("SHARE", "0.05")] = None
    """Share of the accepted answers that may be wrong."""

    lag: Annotated[int | None, flag("FRAMES", "20")] = None
    """Frames that a final verdict waits for; where frames are dense, what travels as far."""

    seed: Annotated[int | None, flag("INT", "0")] = None
    """Seed of the simulated world and of the bootstrap."""

    progress: bool = True
    """Draw progress bars; never where stderr is a file or a pipe."""


def draws_bars(progress: bool) -> bool:
    """Return whether to draw progress bars: they are asked for, and a person is there to watch."""
    return progress and sys.stderr.isatty()


def say(text: str) -> None:
    """Tell the user something that is not the result."""
    print(text, file=sys.stderr, flush=True)


def check_seed(seed: int | None) -> None:
    """Refuse a seed that no generator takes.

    Raises:
        UsageError: it is negative.
    """
    if seed is not None and seed < 0:
        raise UsageError(f"--seed {seed} must not be negative")


def config_of(args: Common, base: Path | None = None) -> "Config":
    """Return the settings of the config file, of `base` or the defaults, with the flags on top."""
    from taojax import config as settings

    path = args.config or base
    config = settings.from_toml(path) if path else settings.Config()
    names = ("window", "branches", "association", "max_wrong", "lag", "seed")
    flags = {name: getattr(args, name) for name in names}
    flags |= {"r_in_m": args.r_in, "r_out_m": args.r_out}
    if args.r_in is not None and args.r_out is None:
        flags["r_out_m"] = max(args.r_in, config.audit.r_out_m)
    try:
        return settings.replace(config, flags)
    except ConfigError as error:
        raise UsageError(f"flag {error}") from error


def told(args: Common, config: "Config") -> str:
    """Return all that decides what a command makes, to know it again."""
    from taojax.config import to_toml

    return f"{dataclasses.replace(args, out=None, progress=True, cache=True)!r}\n{to_toml(config)}"


def out_of(args: Common, verb: str, config: "Config") -> Path:
    """Return the folder of this run."""
    from taojax.config import to_toml

    if args.out is not None:
        return args.out
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return (
        Path("runs") / verb / f"{stamp}-{hashlib.sha256(to_toml(config).encode()).hexdigest()[:8]}"
    )


class Scoring(NamedTuple):
    """A run that is wanted."""

    dataset: Path
    out: Path
    flags: Sequence[str] = ()


def run_apart(commands: Iterable[Sequence[str]], most: int = 1) -> None:
    """Run verbs in fresh interpreters, so many side by side.

    Raises:
        SystemExit: one failed and has said why.
    """
    code = child.run(commands, most)
    if code < 0:
        say(
            f"taojax: a process of this command was ended by {signal.Signals(-code).name}, perhaps"
            " for want of memory; what is sealed is kept"
        )
    if code:
        raise SystemExit(code if code > 0 else 128 - code)


def score_apart(
    jobs: Iterable[Scoring], config: "Config", *, progress: bool, most: int = 1
) -> None:
    """Score in fresh interpreters: ones in which the judge has never been imported.

    A run that is sealed already, of the same data, settings and code, is kept as it is.

    Args:
        jobs: asked for when the turn of each has come.
        config: settings of all.
        progress: draw bars.
        most: side by side.
    """
    from taojax.config import to_toml

    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "config.toml"
        path.write_text(to_toml(config), encoding="utf-8")
        shared = ["--config", str(path), "--progress" if progress else "--no-progress"]

        def commands() -> Iterator[Sequence[str]]:
            for dataset, out, flags in jobs:
                if is_sealed(out, dataset, config):
                    say(f"{out} is sealed already; going on")
                    continue
                yield ["score", str(dataset), "--out", str(out), *shared, *flags, "--no-advice"]

        run_apart(commands(), most)
