"""`taojax watch`: JSON lines in, verdicts out."""

import dataclasses
import os
import sys
import time
from pathlib import Path
from typing import Annotated

import tyro

from taojax.verbs.common import flag, say


@dataclasses.dataclass(frozen=True)
class Watch:
    """Judge a live stream: one JSON line per frame on stdin, one verdict line on stdout.

    In: {"t_s": 0.1, "odometry": [dx_m, dy_m, dtheta_rad], "index": [...], "similarity": [...]}.
    A line that is not understood is answered by {"line": n, "error": "..."} and changes nothing.

    Example: taojax watch my_data --calibration runs/mine/calibration.toml
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP_FOLDER")] = (
        tyro.MISSING
    )
    """Data folder, or one with poses.csv and perhaps descriptors.npy of the map."""

    calibration: Annotated[Path | None, flag("FILE.toml", "no verdicts")] = None
    """calibration.toml of an audited run."""

    config: Annotated[Path | None, flag("FILE.toml", "built-in settings")] = None
    """Settings, such as the config.toml of an earlier run."""


def run(args: Watch) -> None:
    """Watch until stdin ends."""
    from taojax import config as settings
    from taojax.detector import foreign_map, from_toml
    from taojax.runtime.watch import Watch as Watcher
    from taojax.runtime.watch import load_map

    config = (settings.from_toml(args.config) if args.config else settings.Config()).stream
    detector = None if args.calibration is None else from_toml(args.calibration)
    loaded = load_map(args.folder, config)
    if detector is not None and (said := foreign_map(detector, loaded.facts)):
        say(f"careful: {said}")
    say("compiling for some 5 to 20 s")
    start = time.perf_counter()
    watcher = Watcher(config, loaded.tables, detector)
    say(f"ready: map of {len(loaded.tables.grid.xy)} places, {loaded.scale}; "
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
