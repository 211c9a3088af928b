"""Hostile files for every reader and verb; each case ends well or with one line."""

import contextlib
import math
import multiprocessing
import os
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.reliability_arrays import changed
from benchmarks.reliability_mutate import replace_file, restore
from benchmarks.reliability_targets import Target
from benchmarks.reliability_verbs import RefusedError, targets
from taojax.errors import TaojaxError

CASE_S = 60.0
"""A case that takes longer hangs."""

MEMORY_BYTES = 8 << 30
"""Address space of the process under attack."""

GOOD = ("ok", "refused")


class Case(NamedTuple):
    """How one attack ended."""

    target: str
    number: int
    outcome: str
    """ok, refused, error, not finite, two lines, canary, stray file, hang or crash."""

    note: str


def plan(n_cases: int, chosen: Sequence[Target]) -> list[tuple[str, int]]:
    """Share cases among the targets: (target, number of the case)."""
    total = sum(target.share for target in chosen)
    counts = [math.ceil(n_cases * target.share / total) for target in chosen]
    return [(t.name, at) for t, n in zip(chosen, counts, strict=True) for at in range(n)]


def _attack(target: Target, number: int, place: Path) -> Iterator[Path]:
    """Change files of a sound folder; put them back afterwards."""
    rng = np.random.default_rng([zlib.crc32(target.name.encode()), number])
    n_files = 1 if rng.random() < 0.8 else min(2, len(target.files))
    chosen = [target.files[int(at)] for at in rng.permutation(len(target.files))[:n_files]]
    sound = {name: (place / "sound" / name).read_bytes() for name in chosen}
    if target.name == "evaluate forged":
        sound |= {"run/manifest.json": (place / "sound/run/manifest.json").read_bytes()}
    try:
        for name in chosen:
            path = place / "sound" / name
            if rng.random() < 0.04:
                replace_file(path, rng, place / "secret")
            else:
                path.write_bytes(changed(path, sound[name], rng, place / "canary"))
        yield place / "sound"
    finally:
        for name, raw in sound.items():
            restore(place / "sound" / name, raw)


def _names(place: Path) -> set[str]:
    """Return every path below a place but those of the output."""
    found = set()
    for folder, folders, files in os.walk(place):
        if Path(folder) == place:
            folders[:] = [name for name in folders if name != "out"]
        found |= {os.path.join(folder, name) for name in (*folders, *files)}
    return found


def _outcome(target: Target, folder: Path, place: Path) -> tuple[str, str]:
    try:
        arrays = [np.asarray(array) for array in target.run(folder, place / "out")]
    except RefusedError as error:
        return "refused", str(error)
    except TaojaxError as error:
        return "two lines" if "\n" in str(error) else "refused", repr(str(error))[:300]
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)
        own = next((f for f in reversed(where) if "taojax/" in f.filename), where[-1])
        note = f"{type(error).__name__}: {error} [{Path(own.filename).name}:{own.lineno}]"
        return "error", note[:700]
    numbers = [array for array in arrays if array.dtype.kind == "f"]
    is_good = all(np.isfinite(array).all() for array in numbers)
    return ("ok", "") if is_good else ("not finite", "")


def run_case(target: Target, number: int, place: Path) -> Case:
    """Attack once, in this process.

    Args:
        target: whom.
        number: seeds the attack.
        place: scratch folder with `sound/` built by the target and a file `secret`.
    """
    before = _names(place)
    with contextlib.contextmanager(_attack)(target, number, place) as folder:
        outcome, note = _outcome(target, folder, place)
    strayed = sorted(_names(place) - before)
    if (place / "canary").exists():
        outcome, note = "canary", ""
    elif strayed:
        outcome, note = "stray file", strayed[0]
    for path in (*(Path(name) for name in strayed), place / "out"):
        shutil.rmtree(path, ignore_errors=True)
        path.unlink(missing_ok=True) if not path.is_dir() else None
    return Case(target.name, number, outcome, note)


def prepare(target: Target, place: Path) -> None:
    """Build the sound folder of a target and check that it is sound.

    Raises:
        AssertionError: it is refused.
    """
    shutil.rmtree(place, ignore_errors=True)
    (place / "sound").mkdir(parents=True)
    (place / "cwd").mkdir()
    (place / "secret").write_text("t_s,x_m,y_m,theta_rad\n")
    target.build(place / "sound")
    got = _outcome(target, place / "sound", place)
    assert got[0] == "ok", f"{target.name}: {got}"
    shutil.rmtree(place / "out", ignore_errors=True)


def _serve(work: Connection) -> None:
    """Attack as told, one case after the other; the parent watches the clock."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # HDF5 tells stderr about every fault
    warnings.simplefilter("error")  # a warning is a second line
    known = {target.name: target for target in targets()}
    with tempfile.TemporaryDirectory() as scratch:
        place, ready = Path(scratch) / "place", ""
        while True:
            name, number = work.recv()
            if name != ready:
                os.chdir(scratch)
                try:
                    prepare(known[name], place)
                except Exception as error:
                    work.send(repr(error)[:600])
                    continue
                os.chdir(place / "cwd")
                ready = name
                work.send("")
            work.send(run_case(known[name], number, place))


class _Victim:
    """A process under attack, replaced when it dies."""

    def __init__(self) -> None:
        self.name = ""
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(other,), daemon=True)
        self.process.start()
        other.close()
        self.name = ""

    def stop(self) -> None:
        self.process.kill()
        self.process.join()

    def attack(self, name: str, number: int) -> Case:
        try:
            self.pipe.send((name, number))
            if name != self.name:
                if not self.pipe.poll(10 * CASE_S):
                    raise AssertionError(f"{name}: cannot be prepared")
                if problem := self.pipe.recv():
                    raise AssertionError(f"{name}: cannot be prepared: {problem}")
                self.name = name
            if self.pipe.poll(CASE_S):
                return self.pipe.recv()
            case = Case(name, number, "hang", f"longer than {CASE_S:g} s")
        except (EOFError, ConnectionError):
            self.process.join()
            case = Case(name, number, "crash", f"exit {self.process.exitcode}")
        self.stop()
        self._start()
        return case


def attack_all(
    n_cases: int, only: str = "", say: Callable[[str], None] = lambda text: None
) -> list[Case]:
    """Attack every target in a process of its own.

    Args:
        n_cases: in all.
        only: targets whose name contains this.
        say: hears of every target that is done.
    """
    chosen = [target for target in targets() if only in target.name]
    victim, cases, begun = _Victim(), [], time.monotonic()
    try:
        work = plan(n_cases, chosen)
        for at, (name, number) in enumerate(work):
            cases.append(victim.attack(name, number))
            if at + 1 == len(work) or work[at + 1][0] != name:
                own = Counter(case.outcome for case in cases if case.target == name)
                spent = time.monotonic() - begun
                say(
                    f"{name}: "
                    + ", ".join(f"{k} {n}" for k, n in own.items())
                    + f" ({spent:.0f} s)"
                )
    finally:
        victim.stop()
    return cases
