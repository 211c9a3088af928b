"""Timings that need an interpreter of their own, and the rows that timings are written in."""

import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from taojax.files import specs


class Row(NamedTuple):
    """One figure of bench.csv."""

    name: str
    value: float
    unit: str


def best_us(work: Callable[[], object], repeats: int, per: int = 1) -> float:
    """Return the microseconds of the fastest repeat, divided by `per`; the first call is free."""
    jax.block_until_ready(work())
    best = float("inf")
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(work())
        best = min(best, time.perf_counter() - began)
    return best / per * 1e6


def peak_mb() -> float:
    """Return the most memory that this process ever held."""
    # Kilobytes on Linux, bytes on macOS.
    unit = 1.0 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


FIRST_STEP = """
import time, numpy as np, jax, jax.numpy as jnp
from taojax.config import StreamConfig
from taojax.runtime.maps import map_tables
from taojax.runtime.frames import Frame
from taojax.runtime.stream import init, step
a = np.linspace(0, 6, 2000)
config = StreamConfig()
tables = map_tables(np.stack([300 * np.cos(a), 200 * np.sin(a), a], 1), config)
frame = Frame(jnp.zeros(3), jnp.arange(100, dtype=jnp.int32), jnp.zeros(100))
state = jax.block_until_ready(init(config, tables))
began = time.perf_counter()
jax.block_until_ready(step(config, tables, state, frame))
print(time.perf_counter() - began)
"""

IMPORT = """
import time
began = time.perf_counter()
{}
print(time.perf_counter() - began)
"""

N_IMPORTS = 3
"""The fastest counts: the first one also writes bytecode and fills the cache of the disk."""


WATCH_PAUSE_S = 0.02
"""Between two frames: robots look a few times a second, and what is final is found in between."""


def _seconds(code: str, **environment: str) -> float:
    """Return the number that some code prints last in an interpreter of its own."""
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | environment, capture_output=True, check=True
    )
    return float(done.stdout.split()[-1])


def imports() -> list[Row]:
    """Time the import of the package, and of the step with everything behind it."""
    code = {"import_taojax_s": "import taojax", "import_step_s": "from taojax import step"}
    return [
        Row(name, min(_seconds(IMPORT.format(line)) for _ in range(N_IMPORTS)), "s")
        for name, line in code.items()
    ]


def first_steps() -> list[Row]:
    """Time the very first step: nothing cached, then everything cached."""
    with tempfile.TemporaryDirectory() as cache:
        known = {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_ENABLE_COMPILATION_CACHE": "true",
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        return [
            Row(name, _seconds(FIRST_STEP, **known), "s")
            for name in ("first_step_cold_s", "first_step_cached_s")
        ]


def watched(folder: Path, lines: Sequence[bytes]) -> list[Row]:
    """Time `taojax watch` from outside: from a line on its stdin to the answer on its stdout.

    Args:
        folder: with poses.csv of the map.
        lines: one frame each; the first tenth warms up.

    Returns:
        `watch_ready_s`, from the start of the process to its first answer, and quantiles.
    """
    began, spent = time.perf_counter(), []
    command = [sys.executable, "-m", "taojax", "watch", str(folder)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as watch:
        assert watch.stdin is not None  # noqa: S101 - asked for above
        assert watch.stdout is not None  # noqa: S101
        for number, line in enumerate(lines):
            start = time.perf_counter() if number else began
            watch.stdin.write(line + b"\n")
            watch.stdin.flush()
            # Final lines come after the answer; those of the frames before belong to nobody here.
            while f'"kind": "now", "frame": {number},'.encode() not in (
                answer := watch.stdout.readline()
            ):
                if not answer:
                    raise RuntimeError(f"taojax watch {folder} ended at line {number + 1}")
            spent.append(time.perf_counter() - start)
            time.sleep(WATCH_PAUSE_S)
        watch.stdin.close()
        watch.stdout.read()
    warm = np.array(spent[len(spent) // 10 :])
    rows = [Row(f"watch_p{q}_ms", float(np.quantile(warm, q / 100)) * 1e3, "ms") for q in (50, 99)]
    return [Row("watch_ready_s", spent[0], "s"), *rows]


def _bytes_below(folder: Path) -> int:
    files = (path for path in folder.rglob("*") if "__pycache__" not in path.parts)
    return sum(path.stat().st_size for path in files if path.is_file())


def _bytes_of(name: str) -> int:
    """Return the size of an installed distribution; 0 for one this machine does without."""
    try:
        files = metadata.files(name) or ()
    except metadata.PackageNotFoundError:
        return 0
    paths = {Path(str(file.locate())).resolve() for file in files if file.suffix != ".pyc"}
    return sum(path.stat().st_size for path in paths if path.is_file())


def needed() -> set[str]:
    """Return the names of all distributions that the package needs, without its extras."""
    found, left = set[str](), ["taojax"]
    while left:
        name = left.pop()
        try:
            lines = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        names = {re.split(r"[^\w.-]", line)[0] for line in lines if "extra" not in line}
        names = {re.sub(r"[-_.]+", "-", name).lower() for name in names}
        left += names - found
        found |= names
    return found


def installed() -> list[Row]:
    """Measure the room that the package takes, alone and with all it needs."""
    package = Path(specs.__file__).parents[1]
    own = _bytes_below(package)
    if not (package / "data_specs").is_dir():
        # A source checkout has them beside the package, a wheel inside.
        own += _bytes_below(package.parent / "data_specs")
    others = sum(_bytes_of(name) for name in needed())
    return [
        Row("installed_mb", own / 1e6, "MB"),
        Row("installed_with_dependencies_mb", (own + others) / 1e6, "MB"),
    ]
