"""What is attacked: the verbs, by the door that users take; and everything together."""

import contextlib
import functools
import io
import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from benchmarks.reliability_recordings import recordings, write_kri
from benchmarks.reliability_targets import (
    DATA,
    LISTS,
    VIEWS,
    Target,
    load,
    own_files,
    tables,
    write_data,
)


class RefusedError(Exception):
    """A verb refused with an exit code other than 0."""


def command(words: Iterable[object]) -> None:
    """Run `taojax ...` in this process and hold it to one line.

    Raises:
        RefusedError: exit 2, 3 or 4 with one line.
        AssertionError: anything else but success.
    """
    from taojax.cli import main

    said, told = io.StringIO(), io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(told):
        try:
            code = main([str(word) for word in words])
        except SystemExit as stop:
            code = stop.code
    lines = [line for line in said.getvalue().splitlines() if line.strip()]
    if code == 0:
        return
    own = [at for at, line in enumerate(lines) if line.startswith("taojax: ")]
    if code not in (2, 3, 4) or "Traceback" in said.getvalue() or own != [len(lines) - 1]:
        raise AssertionError(f"exit {code}: " + " | ".join(lines[-6:])[:600])
    raise RefusedError(f"exit {code}")


def _convert(name: str, views: bool, folder: Path, out: Path) -> list[np.ndarray]:
    words: list[object] = ["convert", name, folder / "map", folder / "query", out]
    if name == "folder":
        words = ["convert", name, folder, out]
    words += ["--simulate-descriptors"] if not views else []
    command([*words, "--query-frames", "30", "--map-frames", "40"])
    return load(out, out)


def _inspect(folder: Path, out: Path) -> list[np.ndarray]:
    command(["inspect", folder])
    return []


def _score(folder: Path, out: Path) -> list[np.ndarray]:
    small = ["--association", "rank", "--window", "3", "--branches", "4", "--no-progress"]
    command(["score", folder, "--out", out, *small])
    from taojax.files.records import read_run, signal_names

    run = read_run(out)
    return [run.signals[name] for name in signal_names()]


def _sealed(folder: Path) -> None:
    write_data(folder / "data")
    _score(folder / "data", folder / "run")


def _evaluate(folder: Path, out: Path, *, reseals: bool = False) -> list[np.ndarray]:
    if reseals:
        with contextlib.suppress(Exception):
            reseal(folder / "run")
    command(["evaluate", folder / "run", "--truth", folder / "data/truth", "--out", out])
    return []


def _judged(folder: Path) -> None:
    _sealed(folder)
    command(["evaluate", folder / "run", "--truth", folder / "data/truth"])
    shutil.copytree(folder / "run", folder / "other")


def _closures(folder: Path, out: Path) -> list[np.ndarray]:
    command(["closures", folder / "run", "--out", out])
    return []


def _compare(folder: Path, out: Path) -> list[np.ndarray]:
    command(["compare", folder / "run", folder / "other", "--out", out])
    return []


def _explain(folder: Path, out: Path) -> list[np.ndarray]:
    command(["explain", folder / "run", "--frame", "5", "--no-progress", "--out", out])
    return []


def _rerun(folder: Path, out: Path) -> list[np.ndarray]:
    command(["rerun", folder / "run", "--data", folder / "data", "--no-progress", "--out", out])
    return []


def _swept(folder: Path) -> None:
    write_data(folder)
    (folder / "grid.toml").write_text("[rank]\nlambda_velocity = [0.1, 1]\nwindow = [3]\n")


def _sweep(folder: Path, out: Path) -> list[np.ndarray]:
    grid = ["--grid", folder / "grid.toml", "--branches", "4"]
    command(["sweep", folder, *grid, "--no-judge", "--no-progress", "--out", out])
    with np.load(out / "signals.npz") as sealed:
        return [sealed["tao"]]


def reseal(run: Path) -> None:
    """Make a changed run look sealed, as a forger would."""
    from taojax.files.records import SEALED, digest_file, seal_of

    path = run / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["sha256"] |= {name: digest_file(run / name) for name in SEALED}
    path.write_text(json.dumps(manifest | {"seal": seal_of(manifest)}))


RUN = (
    "run/manifest.json",
    "run/config.toml",
    "run/map_poses.csv",
    "run/retrievals.npz",
    "run/signals.csv",
)
JUDGED = ("run/verdicts.csv", "run/labels.csv")
TRUTH = ("data/truth/query_poses.csv",)


def _verbs() -> list[Target]:
    sets: list[tuple[str, Callable[[Path], None], tuple[str, ...], bool]] = [
        *((t.name.split()[1], t.build, t.files, False) for t in recordings()[:5]),
        ("kri", write_kri, ("query/cam_3/matlab_clahe2/1630106835000000000.png",), False),
        ("folder", write_data, (*DATA, *VIEWS, "truth/query_poses.csv"), True),
    ]
    return [
        *(
            Target(f"convert {n}", b, f, functools.partial(_convert, n, v), 0.25)
            for n, b, f, v in sets
        ),
        Target("inspect", write_data, (*DATA, *VIEWS, "truth/query_poses.csv"), _inspect, 0.25),
        Target(
            "inspect lists", lambda f: write_data(f, lists=True), (*DATA, *LISTS), _inspect, 0.25
        ),
        Target("score", write_data, (*DATA, *VIEWS), _score, 0.05),
        Target("score lists", lambda f: write_data(f, lists=True), (*DATA, *LISTS), _score, 0.05),
        Target("evaluate", _sealed, (*RUN, *TRUTH), _evaluate, 0.05),
        Target(
            "evaluate forged",
            _sealed,
            (*RUN, *TRUTH),
            functools.partial(_evaluate, reseals=True),
            0.05,
        ),
        Target("closures", _judged, (*RUN, "run/odometry.csv", *JUDGED), _closures, 0.1),
        Target("compare", _judged, (*RUN, *JUDGED, "run/audit.json"), _compare, 0.05),
        Target("explain", _judged, (*RUN, "run/odometry.csv", *JUDGED), _explain, 0.05),
        Target("rerun", _sealed, (*RUN, "data/map/poses.csv"), _rerun, 0.05),
        Target("sweep", _swept, (*DATA, *VIEWS, "grid.toml"), _sweep, 0.05),
    ]


def targets() -> list[Target]:
    """Return everything that is attacked."""
    return [*tables(), *own_files(), *recordings(), *_verbs()]
