"""What all measurements share: a row of the table, a clock, the memory."""

import resource
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import jax


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
