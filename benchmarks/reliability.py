"""`python -m benchmarks reliability`: bad input, hostile numbers, faults and long streams, counted.

What is quick of it runs in the tests (test_fuzz, test_numbers, test_faults, test_long_stream).
"""

import csv
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taojax.errors import UsageError

SECTIONS = ("fuzz", "numbers", "faults", "stream")


class Row(NamedTuple):
    """One line of the table."""

    what: str
    cases: int
    outcomes: str
    seconds: float
    is_good: bool


def _words(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {n:,}" for name, n in sorted(counts.items()))


def _fuzz(quick: bool) -> Iterator[Row]:
    from benchmarks.reliability_fuzz import GOOD, attack_all

    begun = time.monotonic()
    cases = attack_all(500 if quick else 20_000, say=print)
    spent = time.monotonic() - begun
    for case in cases:
        if case.outcome not in GOOD:
            print(f"{case.target}, case {case.number}: {case.outcome}: {case.note}")
    for name in dict.fromkeys(case.target for case in cases):
        own = Counter(case.outcome for case in cases if case.target == name)
        yield Row(f"fuzz: {name}", own.total(), _words(own), np.nan, set(own) <= set(GOOD))
    every = Counter(case.outcome for case in cases)
    yield Row("fuzz: all", every.total(), _words(every), spent, set(every) <= set(GOOD))


def _numbers(quick: bool) -> Iterator[Row]:
    from benchmarks.reliability_numbers import windows

    for dtype in (np.float32, np.float64):
        begun = time.monotonic()
        found, worst = windows(500 if quick else 50_000, dtype)
        outcomes = Counter[str]()
        for name, n in found.items():
            outcomes[name.partition(": ")[2]] += n
        said = f"{_words(outcomes)}; worst {worst:.2f} of the tolerance"
        is_good = set(outcomes) <= {"ok", "undecided"}
        spent = time.monotonic() - begun
        yield Row(f"windows, {dtype.__name__}", outcomes.total(), said, spent, is_good)


def _faults(quick: bool) -> Iterator[Row]:
    from benchmarks import reliability_faults as faults

    begun = time.monotonic()
    found = faults.kills_while_sealing(5 if quick else 200)
    spent, n = time.monotonic() - begun, found.pop("sealing: kills")
    yield Row("kill -9 while sealing", n, _words(found), spent, "sealing: half sealed" not in found)
    begun = time.monotonic()
    found = faults.kills(2 if quick else 200, say=print)
    bad = [name for name in found if not name.endswith((*faults.FINISHED, faults.TOO_LATE))]
    late = sum(n for name, n in found.items() if name.endswith(faults.TOO_LATE))
    spent = time.monotonic() - begun
    yield Row("kill -9 of verbs", found.total() - late, _words(found), spent, not bad)
    with tempfile.TemporaryDirectory() as scratch:
        data = faults.make_data(Path(scratch) / "data")
        begun = time.monotonic()
        n, kept, code = faults.resumes(data, Path(scratch) / "sweep")
        said = f"{kept} of {n} finished parts kept, exit {code}"
        yield Row("sweep goes on", 1, said, time.monotonic() - begun, kept == n > 0 and code == 0)
        begun = time.monotonic()
        codes = faults.taken_together(data, Path(scratch) / "both")
        said = f"exits {codes[0]} and {codes[1]}"
        yield Row("two with one --out", 1, said, time.monotonic() - begun, codes == [0, 3])
        for job in faults.JOBS:
            begun = time.monotonic()
            code, lines = faults.without_room(job, data, Path(scratch) / f"full-{job.name}", 2000)
            is_good = code == 3 and "cannot be written" in lines[-1]
            spent = time.monotonic() - begun
            yield Row(f"no room: {job.name}", 1, f"exit {code}: {lines[-1]}", spent, is_good)


def _stream(quick: bool) -> Iterator[Row]:
    from benchmarks import reliability_stream as stream

    for association, n in (("rank", 1_000_000), ("joint", 1_000_000)):
        gone = stream.drive(association, 10_000 if quick else n)
        far = max(gap for name, gap in gone.differs.items() if name not in stream.REMEMBERS)
        memory = max(gone.differs[name] for name in stream.REMEMBERS)
        said = (
            f"{gone.grown_mib:.1f} MiB grown, {gone.n_compiled} compiled again, {gone.n_bad} not"
            f" finite, against a fresh start {far:g} (window) and {memory:g} (memory)"
        )
        is_good = gone.grown_mib < 64 and far == 0.0 and gone.n_compiled == gone.n_bad == 0
        yield Row(f"stream, {association}", gone.n_frames, said, gone.seconds, is_good)
        begun, kinds = time.monotonic(), stream.KINDS
        differ = {kind: stream.count_differing(association, kind) for kind in kinds}
        said = "numbers that differ from an empty frame: " + _words(differ)
        spent = time.monotonic() - begun
        yield Row(f"broken frame, {association}", len(kinds), said, spent, not any(differ.values()))
    begun = time.monotonic()
    published, ours = stream.poisoned(False), stream.poisoned(True)
    said = f"frames lost: {published} as published, {ours} behind our door"
    yield Row("topometric, one NaN of 100", 2, said, time.monotonic() - begun, ours == 0)


RUN: dict[str, Callable[[bool], Iterator[Row]]] = {
    "fuzz": _fuzz,
    "numbers": _numbers,
    "faults": _faults,
    "stream": _stream,
}


def sections(only: str) -> Sequence[str]:
    """Return the sections asked for.

    Args:
        only: names between commas; blank = all.

    Raises:
        UsageError: another name.
    """
    chosen = [name.strip() for name in only.split(",")] if only else SECTIONS
    if unknown := [name for name in chosen if name not in SECTIONS]:
        raise UsageError(f"--only {only}: no section {unknown[0]!r}; give {', '.join(SECTIONS)}")
    return chosen


def run(out: Path, *, quick: bool, only: str) -> int:
    """Run the sections asked for, print one table and write reliability.csv.

    Args:
        out: folder to make.
        quick: hundreds of cases instead of tens of thousands.
        only: names of sections, between commas; blank = all.

    Returns:
        Rows that are not as they must be.

    Raises:
        UsageError: `only` names no section.
    """
    chosen = sections(only)
    rows = [row for name in chosen for row in RUN[name](quick)]
    width = max(len(row.what) for row in rows)
    for row in rows:
        mark = " " if row.is_good else "!"
        seconds = "" if np.isnan(row.seconds) else f"{row.seconds:.0f} s"
        print(f"{mark} {row.what:{width}} {row.cases:>9,} {seconds:>7}  {row.outcomes}")
    out.mkdir(parents=True, exist_ok=True)
    with (out / "reliability.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows(rows)
    return sum(not row.is_good for row in rows)
