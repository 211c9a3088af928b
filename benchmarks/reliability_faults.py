"""Killed, full, read-only, taken: what a run folder looks like afterwards."""

import contextlib
import itertools
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np

from benchmarks.reliability_jobs import JOBS, Job, finish, make_data, start
from benchmarks.reliability_targets import ROOT
from taojax.errors import InputError
from taojax.files.records import read_manifest, read_run, write_run
from taojax.files.specs import column_names, load_spec

WRITER = """
import sys
from pathlib import Path
from benchmarks.reliability_faults import write_one
at = 0
while True:
    write_one(Path(sys.argv[1]) / f"run-{at}")
    if at == 0:
        print("one is sealed", flush=True)
    at += 1
"""


LAST = ("report.html", "sweep.csv")
"""Files that commands write last."""

FINISHED = ("finished again", "was finished")
"""What may come of a killed job once it is repeated."""

TOO_LATE = "done before the blow"

ENDS_S = 10.0
"""A process may outlive the one that started it by so much."""


class Killed(NamedTuple):
    """What came of a job that was killed."""

    outcome: str
    """One of `FINISHED`, `TOO_LATE`; or what must not be: half sealed, failed, not finished, a part
    left, a process left."""

    whole_s: float = 0.0
    """How long the job took undisturbed [s]; 0 = unknown."""


def is_half(out: Path, job: Job) -> bool:
    """Tell whether a folder holds a run that passes for sealed and is not whole."""
    for run in job.sealed(out) if out.is_dir() else []:
        try:
            if read_manifest(run).get("kind") == "sweep":
                continue_from = [run / name for name in read_manifest(run)["sha256"]]
                if not all(p.is_file() for p in continue_from if "inputs" not in p.parts):
                    return True
            else:
                read_run(run)
        except InputError:
            # Refused is fine: nobody takes it for good. A manifest must not exist half, though.
            return True
    return False


def kill_once(job: Job, data: Path, out: Path, after_s: float) -> Killed:
    """Kill a job after some time, and not the processes it started; then run the command again."""
    begun = time.monotonic()
    child = start(job.words(data, out))
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(after_s)
    child.kill()
    try:
        # Whatever the job started holds stderr open as long as it lives.
        said = child.communicate(timeout=ENDS_S)[1]
    except subprocess.TimeoutExpired:
        os.killpg(child.pid, signal.SIGKILL)
        return Killed("a process left")
    if child.returncode != -signal.SIGKILL:
        whole_s = time.monotonic() - begun
        return Killed(f"failed: {said[-200:]}" if child.returncode else TOO_LATE, whole_s)
    return Killed("half sealed") if is_half(out, job) else _again(job, data, out)


def _again(job: Job, data: Path, out: Path) -> Killed:
    """Run a job again after it was killed, and say what came of it."""
    begun = time.monotonic()
    code, said = finish(job.words(data, out))
    is_whole = any((out / name).is_file() for name in LAST)
    if code == 3 and is_whole and "choose a new --out" in said[-1]:
        # The blow fell between the last file and the end of the process.
        return Killed("was finished")
    if code:
        return Killed(f"not finished: {said[-1][:200]}")
    left = [*out.parent.glob(f".{out.name}.*.part"), *out.rglob(".*.part")]
    return Killed("a part left" if left else "finished again", time.monotonic() - begun)


def kills(
    n: int,
    jobs: Sequence[Job] = JOBS[1:],
    seed: int = 0,
    say: Callable[[str], None] = lambda line: None,
) -> Counter[str]:
    """Kill jobs n times in all at random moments, two at a time; return how many came to what.

    Blows that fell after the end are told too, and do not count among the n.

    Args:
        n: in all.
        jobs: in turn; `score` is left out because `audit` starts one.
        seed: of the moments.
        say: is told of every blow.

    Raises:
        AssertionError: a job fails undisturbed.
    """
    moments = np.random.default_rng(seed).uniform(0.3, 1.0, n)
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        data = make_data(place / "data")

        def undisturbed(job: Job) -> float:
            begun = time.monotonic()
            code, said = finish(job.words(data, place / f"whole-{job.name}"))
            assert code == 0, f"{job.name}: exit {code}: {' | '.join(said[-5:])}"
            return time.monotonic() - begun

        def one(at: int) -> list[str]:
            job, outcomes = jobs[at % len(jobs)], list[str]()
            while not outcomes or outcomes[-1] == TOO_LATE:
                out = place / f"{at}-{job.name}-{len(outcomes)}"
                killed = kill_once(job, data, out, moments[at] * whole_s[job])
                # A machine with other work is not equally fast all the time.
                whole_s[job] = killed.whole_s or whole_s[job]
                outcomes.append(killed.outcome)
            found = [f"{job.name}: {outcome}" for outcome in outcomes]
            say(f"blow {at + 1} of {n}: {', '.join(found)}")
            return found

        # Compiling is not what is tried here; the first runs fill the cache, undisturbed.
        cache = {
            "JAX_COMPILATION_CACHE_DIR": str(place / "cache"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        with mock.patch.dict(os.environ, cache), ThreadPoolExecutor(2) as pool:
            whole_s = dict(zip(jobs, pool.map(undisturbed, jobs), strict=True))
            return Counter(itertools.chain.from_iterable(pool.map(one, range(n))))


def write_one(out: Path) -> None:
    """Seal a run of 200 frames that nobody computed."""
    n = 200
    numbers, later = (
        {c["name"]: np.linspace(0, 1, n) for c in load_spec(name)["columns"]}
        for name in ("signals", "delayed")
    )
    whole = {"frame": np.arange(n), "map_index": np.zeros(n), "status": np.full(n, "ok", object)}
    index = np.zeros((n, 100), np.int32)
    write_run(
        out,
        signals=numbers | whole,
        delayed=later | {"frame": whole["frame"], "map_index": whole["map_index"]},
        map_poses={name: np.linspace(0, 1, n) for name in column_names("map_poses")},
        index=index,
        similarity=index / 2.0,
        config_toml="seed = 0\n",
        manifest={"notes": []},
    )


def kills_while_sealing(n: int, seed: int = 0) -> Counter[str]:
    """Kill a process that does nothing but seal runs; return how many runs were whole or half.

    Other than `kills`, every blow falls between the first and the last byte of some run.
    """
    rng, found = np.random.default_rng(seed), Counter[str]()
    for _ in range(n):
        with tempfile.TemporaryDirectory() as scratch:
            words = [sys.executable, "-c", WRITER, scratch]
            with subprocess.Popen(words, stdout=subprocess.PIPE, cwd=ROOT) as child:
                assert child.stdout is not None
                child.stdout.readline()
                time.sleep(float(rng.uniform(0.0, 0.2)))
                child.kill()
            found["sealing: kills"] += 1
            for run in (path for path in Path(scratch).iterdir() if path.name[0] != "."):
                try:
                    read_run(run)
                    found["sealing: whole runs"] += 1
                except InputError:
                    found["sealing: half sealed"] += 1
            found["sealing: hidden parts left"] += len(list(Path(scratch).glob(".*.part")))
    return found


def resumes(data: Path, out: Path) -> tuple[int, int, int]:
    """Kill a sweep after its first part and run it again.

    Returns:
        Parts at the kill, those that the second run left alone, and its exit code.
    """
    sweep = next(job for job in JOBS if job.name == "sweep")
    # Without the judge: only the parts are looked at.
    words = [*sweep.words(data, out), "--no-judge"]
    child = start(words)
    while child.poll() is None and not parts_of(out):
        time.sleep(0.002)
    child.kill()
    child.communicate()
    before, again = parts_of(out), start(words)
    kept = dict(before)
    while again.poll() is None:
        now = parts_of(out)
        # Gone once it is sealed; touched where a part was computed again.
        kept = {name: at for name, at in kept.items() if now.get(name, at) == at}
        time.sleep(0.002)
    again.communicate()
    return len(before), len(kept), again.returncode


def parts_of(out: Path) -> dict[str, int]:
    """Return the finished parts of a sweep and when each was written [ns]."""
    found = {}
    for path in (out / "parts").glob("*.npz"):
        with contextlib.suppress(FileNotFoundError):
            found[path.name] = path.stat().st_mtime_ns
    return found


def taken_together(data: Path, out: Path) -> list[int]:
    """Start two runs into one folder; return both exit codes, sorted."""
    words = JOBS[0].words(data, out)
    both = [start(words) for _ in range(2)]
    said = [child.communicate()[1] for child in both]
    lines = [text.strip().splitlines()[-1:] for text in said]
    assert all("Traceback" not in text for text in said), lines
    read_run(out)
    return sorted(child.returncode for child in both)


def without_room(job: Job, data: Path, out: Path, most_bytes: int) -> tuple[int, list[str]]:
    """Run a job where no file may grow beyond some size; return exit code and lines on stderr."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    # An entry of the compilation cache that is cut off would alarm all that come after.
    with mock.patch.dict(os.environ, {"JAX_ENABLE_COMPILATION_CACHE": "false"}):
        return finish(job.words(data, out), preexec_fn=limit)
