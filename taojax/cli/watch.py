"""`taojax watch`: JSON lines in, verdicts out."""

import dataclasses
import os
import sys
import time
from pathlib import Path
from typing import Annotated

import tyro

from taojax.cli.common import Compiling, flag, say


@dataclasses.dataclass(frozen=True)
class Watch(Compiling):
    """Judge a live stream: one JSON line per frame on stdin, verdict lines on stdout.

    In: {"t_s": 0.1, "odometry": [dx_m, dy_m, dtheta_rad], "index": [...], "similarity": [...]}.
    Out: a line of kind "now" at once, and one of kind "final" a lag later, ten at a time: match
    them by "frame", never count lines. A final line says when an
    earlier acceptance is withdrawn. A line that is not understood is answered by
    {"line": n, "error": "..."} and changes nothing.

    Example: taojax watch my_data --calibration runs/mine/calibration.toml
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP_FOLDER")] = (
        tyro.MISSING
    )
    """Data folder, or one with poses.csv and perhaps descriptors.npy of the map."""

    calibration: Annotated[Path | None, flag("FILE.toml", "the one that ships")] = None
    """calibration.toml of an audited run."""

    max_wrong: Annotated[float | None, flag("SHARE", "0.05")] = None
    """Share of the accepted answers that may be wrong."""

    lag: Annotated[int | None, flag("FRAMES", "20")] = None
    """Frames that a final verdict waits for; where frames are dense, what travels as far."""

    config: Annotated[Path | None, flag("FILE.toml", "built-in settings")] = None
    """Settings, such as the config.toml of an earlier run."""


def run(args: Watch) -> None:
    """Watch until stdin ends."""
    from taojax import config as settings
    from taojax.errors import ConfigError, UsageError
    from taojax.risk import SHIPPED, foreign_map, read_calibration, shipped
    from taojax.runtime.watch import Watch as Watcher
    from taojax.runtime.watch import load_map

    config = settings.from_toml(args.config) if args.config else settings.Config()
    try:
        config = settings.replace(config, {"max_wrong": args.max_wrong, "lag": args.lag})
    except ConfigError as error:
        raise UsageError(f"flag {error}") from error
    own = None if args.calibration is None else read_calibration(args.calibration)
    loaded = load_map(args.folder, config.stream)
    if said := foreign_map((own or shipped()).fitted_on, loaded.facts):
        say(f"careful: {said}")
    if own is None:
        say(f"note: decided with {SHIPPED}: no frame of this place has set its level")
    say("compiling for some 20 s; where an earlier command has compiled it, less")
    start = time.perf_counter()
    watcher = Watcher(config, loaded.tables, own)
    say(f"ready: map of {len(loaded.tables.places.grid.xy)} places, {loaded.scale}; "
        f"compiled in {time.perf_counter() - start:.1f} s")  # fmt: skip
    try:
        watcher.run(sys.stdin.buffer, _write)
    except BrokenPipeError:
        # Whoever read has left; the interpreter must not try to flush again when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        say(watcher.summary())


def _write(line: str) -> None:
    print(line, flush=True)
