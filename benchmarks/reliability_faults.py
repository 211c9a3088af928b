"""Killed, full, read-only, taken: what a run folder looks like afterwards."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.reliability_targets import ROOT, write_data
from taojax.errors import InputError
from taojax.records import read_manifest, read_run, write_run
from taojax.specs import column_names, load_spec

SMALL = ("--association", "rank", "--window", "3", "--branches", "4", "--no-progress")
GRID = """
[rank]
lambda_velocity = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
delta_spacings = [2.0, 3.0, 4.0, 5.0, 6.0]
window = [3, 4, 5]
"""
WRITER = """
import sys
from pathlib import Path
from benchmarks.reliability_faults import write_one
print("ready", flush=True)
at = 0
while True:
    write_one(Path(sys.argv[1]) / f"run-{at}")
    at += 1
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
            "kidnap", data, "--out", out, "--trials", 4, "--rival-trials", 0, "--basin", 2,
            "--r-in", 5, *SMALL,
        ],
        _runs,
    ),
)  # fmt: skip


def make_data(folder: Path) -> Path:
    """Write the small data folder that all jobs share."""
    write_data(folder)
    (folder / "grid.toml").write_text(GRID)
    return folder


def _start(words: Sequence[object], **more: object) -> subprocess.Popen[str]:
    # A session of its own: the children of a verb die with it.
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
    child = _start(words, **more)
    said = child.communicate()[1]
    return child.returncode, [line for line in said.splitlines() if line.strip()]


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


def kill_once(job: Job, data: Path, out: Path, after_s: float) -> str:
    """Kill a job after some time, then run the same command again.

    Returns:
        What happened: finished before, whole, half sealed, or not finished again.
    """
    child = _start(job.words(data, out))
    try:
        child.wait(after_s)
    except subprocess.TimeoutExpired:
        os.killpg(child.pid, signal.SIGKILL)
    child.communicate()
    was_done = child.returncode == 0
    if is_half(out, job):
        return "half sealed"
    code, said = finish(job.words(data, out))
    if was_done:
        return "finished before" if code == 3 else "finished twice"
    if code == 3 and "choose a new --out" in said[-1]:
        # A sealed run is kept; what it lacks is made beside it.
        code, said = finish(job.words(data, out.with_name(f"{out.name}-again")))
        return "finished elsewhere" if code == 0 else f"not finished: {said[-1][:200]}"
    return "finished again" if code == 0 else f"not finished: {said[-1][:200]}"


def time_of(job: Job, data: Path, out: Path) -> float:
    """Return how long a job takes undisturbed [s].

    Raises:
        AssertionError: it fails.
    """
    begun = time.monotonic()
    code, said = finish(job.words(data, out))
    assert code == 0, f"{job.name}: exit {code}: {' | '.join(said[-5:])}"
    return time.monotonic() - begun


def kills(n: int, jobs: Sequence[Job] = JOBS, seed: int = 0) -> Counter[str]:
    """Kill jobs n times in all at random moments; return how many came to what."""
    rng, found = np.random.default_rng(seed), Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        data = make_data(place / "data")
        times = [time_of(job, data, place / f"whole-{job.name}") for job in jobs]
        for at in range(n):
            job, whole_s = jobs[at % len(jobs)], times[at % len(jobs)]
            # The imports before the first write are not interesting.
            after_s = float(rng.uniform(0.4, 1.05)) * whole_s
            outcome = kill_once(job, data, place / f"{at}-{job.name}", after_s)
            found[f"{job.name}: {outcome}"] += 1
    return found


def write_one(out: Path) -> None:
    """Seal a run of 200 frames that nobody computed."""
    n = 200
    numbers = {c["name"]: np.linspace(0, 1, n) for c in load_spec("signals")["columns"]}
    whole = {"frame": np.arange(n), "map_index": np.zeros(n), "status": np.full(n, "ok", object)}
    index = np.zeros((n, 100), np.int32)
    write_run(
        out,
        signals=numbers | whole,
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
    # The judge's verb computes in a child of its own, which would outlive the blow.
    sweep = next(job for job in JOBS if job.name == "sweep")
    words = [*sweep.words(data, out), "--no-judge"]
    child = _start(words)
    while child.poll() is None and not parts_of(out):
        time.sleep(0.002)
    os.killpg(child.pid, signal.SIGKILL)
    child.communicate()
    before, again = parts_of(out), _start(words)
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
    both = [_start(words) for _ in range(2)]
    said = [child.communicate()[1] for child in both]
    lines = [text.strip().splitlines()[-1:] for text in said]
    assert all("Traceback" not in text for text in said), lines
    read_run(out)
    return sorted(child.returncode for child in both)


def without_room(data: Path, out: Path, most_bytes: int) -> tuple[int, list[str]]:
    """Score where no file may grow beyond some size."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    return finish(JOBS[0].words(data, out), preexec_fn=limit)
