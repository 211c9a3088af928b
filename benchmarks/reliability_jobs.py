"""The commands that are killed, and how they are started."""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.reliability_targets import write_data

SMALL = ("--association", "rank", "--window", "3", "--branches", "4", "--no-progress")
GRID = """
[rank]
lambda_velocity = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
delta_spacings = [2.0, 3.0, 4.0]
window = [3, 4]
"""


class Job(NamedTuple):
    """A command that makes a folder."""

    name: str
    words: Callable[[Path, Path], Sequence[object]]
    """Data folder, output -> arguments of taojax."""

    sealed: Callable[[Path], list[Path]]
    """Folders below the output that count as sealed runs once they hold a manifest."""


def _runs(out: Path) -> list[Path]:
    return [path.parent for path in out.rglob("manifest.json")]


JOBS = (
    Job("score", lambda data, out: ["score", data, "--out", out, *SMALL], _runs),
    Job("audit", lambda data, out: ["audit", data, "--out", out, *SMALL], _runs),
    Job(
        "sweep",
        lambda data, out: [
            "sweep", data, "--out", out, "--grid", data / "grid.toml", "--no-progress"
        ],
        _runs,
    ),
    Job(
        "kidnap",
        lambda data, out: [
            "kidnap", data, "--out", out, "--trials", 2, "--rival-trials", 0, "--basin", 2,
            "--r-in", 5, *SMALL,
        ],
        # What lies above the runs names them and seals nothing.
        lambda out: [run for run in _runs(out) if run != out],
    ),
)  # fmt: skip


def make_data(folder: Path) -> Path:
    """Write the small data folder that all jobs share."""
    write_data(folder)
    (folder / "grid.toml").write_text(GRID)
    return folder


def start(words: Sequence[object], **more: object) -> subprocess.Popen[str]:
    """Start `taojax WORDS` in a session of its own, its stderr on a pipe."""
    return subprocess.Popen(
        [sys.executable, "-m", "taojax", *map(str, words)],
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env=os.environ | {"JAX_PLATFORMS": "cpu", "MPLBACKEND": "Agg"},
        **more,  # type: ignore[arg-type]
    )


def finish(words: Sequence[object], **more: object) -> tuple[int, list[str]]:
    """Run a command to its end; return exit code and the lines on stderr."""
    child = start(words, **more)
    said = child.communicate()[1]
    return child.returncode, [line for line in said.splitlines() if line.strip()]
