"""A sweep as a run folder: finished parts are kept, the end is sealed."""

import io
import json
import shutil
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from taojax.config import Config, to_toml
from taojax.errors import InputError
from taojax.records import SCHEMA, digest, read_manifest, refuse_if_taken, seal_of
from taojax.runtime import grid as grids
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.observations import load_observations
from taojax.runtime.score import candidates, facts_of
from taojax.runtime.sweep import at_once, evaluate, plan
from taojax.specs import write_atomically
from taojax.tables import table_text

PARTS = "parts"
"""Folder of finished parts inside an unfinished sweep."""

Stage = Literal["new", "begun", "sealed"]


def stage(out: Path) -> Stage:
    """Say how far a sweep has come.

    Raises:
        InputError: `out` holds something else.
    """
    if (out / "manifest.json").is_file():
        return "sealed"
    if (out / PARTS).is_dir():
        return "begun"
    refuse_if_taken(out)
    return "new"


def check_same(out: Path, config: Config, grid: grids.Grid) -> None:
    """Check that a sealed sweep was made with these settings, so that judging may go on.

    Raises:
        InputError: another grid or configuration, or a broken seal.
    """
    hashes = read_manifest(out)["sha256"]
    now = {"config.toml": to_toml(config), "grid.toml": grids.grid_to_toml(grid)}
    _refuse_others(out, [n for n, text in now.items() if hashes.get(n) != digest(text.encode())])


def _refuse_others(out: Path, differ: Sequence[str]) -> None:
    if differ:
        what = f"holds a sweep with another {' and '.join(differ)}"
        raise InputError(f"{out}: {what}; choose a new --out, or repeat the command that began it")


def begin(out: Path, key: dict[str, str]) -> None:
    """Claim a folder, or check that it was claimed by the same sweep.

    Args:
        out: absent, empty, or a sweep that was interrupted.
        key: name -> hash of everything that the signals depend on.

    Raises:
        InputError: naming what differs.
    """
    path = out / PARTS / "key.json"
    if stage(out) == "begun" and path.is_file():
        found = json.loads(path.read_text(encoding="utf-8"))
        _refuse_others(out, [name for name, value in key.items() if found.get(name) != value])
        return
    write_atomically(path, json.dumps(key, indent=2) + "\n")


def _as_npz(arrays: dict[str, Any]) -> bytes:
    archive = io.BytesIO()
    np.savez(archive, **arrays)
    return archive.getvalue()


def read_parts(out: Path, key: str, tao: np.ndarray) -> set[int]:
    """Fill in the rows that are finished and return their numbers; a part of another key is none.

    Args:
        out: the sweep.
        key: hash of everything that the signals depend on.
        tao: `(c, t)`, filled in place of what is known.
    """
    known: set[int] = set()
    for path in sorted((out / PARTS).glob("*.npz")):
        try:
            with np.load(path, allow_pickle=False) as part:
                if str(part["key"]) == key:
                    tao[part["row"]] = part["tao"]
                    known |= {int(row) for row in part["row"]}
        except (ValueError, OSError, KeyError, IndexError, zipfile.BadZipFile):
            continue  # damaged: it is computed again
    return known


def sweep(
    dataset: Path, out: Path, config: Config, grid: grids.Grid, *, progress: bool = False
) -> dict[str, Any]:
    """Compute the signal of every configuration and seal the result; never looks for truth.

    An interrupted sweep goes on from its finished parts when called again with the same arguments.

    Args:
        dataset: a data folder, laid out as data_specs/README.md says.
        out: run folder to make or to finish.
        config: settings that the grid leaves out.
        grid: what to vary.
        progress: draw a bar on stderr.

    Returns:
        The manifest as sealed.

    Raises:
        InputError: the data do not meet their spec, or `out` holds something else.
    """
    if stage(out) == "sealed":
        raise InputError(f"{out}: already holds a finished sweep; choose a new --out")
    observations = load_observations(dataset)
    rows = grids.expand(grid, config)
    facts = facts_of(
        f"taojax sweep {dataset} --config config.toml --grid grid.toml", dataset, config.seed
    )
    files: dict[str, bytes] = {
        "config.toml": to_toml(config).encode(),
        "grid.toml": grids.grid_to_toml(grid).encode(),
        "grid.csv": table_text("grid", grids.as_table(rows)).encode(),
        "map_poses.csv": table_text("map_poses", observations.map_poses).encode(),
    }
    key = {
        "input data": digest(json.dumps(observations.sha256, sort_keys=True).encode()),
        "grid": digest(files["grid.csv"]),
        "configuration": digest(files["config.toml"]),
        "version of the code": facts["code"],
    }
    begin(out, key)

    index, similarity = candidates(observations)
    poses = observations.map_xyt
    known_views = observations.descriptors and observations.descriptors[0]
    tables = map_tables(poses, config.stream, known_views)
    frames = Frame(*(jnp.asarray(a) for a in (observations.odometry, index, similarity)))
    tao = np.full((len(rows), len(index)), np.nan, np.float32)
    mark = digest(json.dumps(key, sort_keys=True).encode())
    done = read_parts(out, mark, tao)
    bar = tqdm(
        total=len(rows), initial=len(done), unit="configuration", disable=not progress, leave=False
    )
    with bar:
        for signals, units in plan(rows, config, tables, frames):
            left = [unit for unit in units if not done.issuperset(unit.rows)]
            batch = at_once(units[0], jax.default_backend(), len(poses))
            for members, found in evaluate(signals, left, batch=batch):
                tao[list(members)] = found
                part = _as_npz({"row": np.array(members), "tao": found, "key": np.array(mark)})
                write_atomically(out / PARTS / f"{members[0]:06d}.npz", part)
                bar.update(len(members))

    if not np.isfinite(tao).all():
        row = int(np.flatnonzero(~np.isfinite(tao).all(axis=1))[0])
        raise InputError(f"{dataset}: configuration {row} gives signals that are not finite")
    files["signals.npz"] = _as_npz({"tao": tao})
    sealed: dict[str, Any] = {
        "schema": SCHEMA,
        **facts,
        "kind": "sweep",
        "n_configurations": len(rows),
        "notes": list(observations.notes),
        "sha256": observations.sha256 | {name: digest(raw) for name, raw in files.items()},
    }
    sealed["seal"] = seal_of(sealed)
    # The manifest comes last: only with it the folder counts as sealed.
    for name, raw in files.items():
        write_atomically(out / name, raw)
    write_atomically(out / "manifest.json", json.dumps(sealed, indent=2, sort_keys=True) + "\n")
    shutil.rmtree(out / PARTS, ignore_errors=True)
    return sealed
