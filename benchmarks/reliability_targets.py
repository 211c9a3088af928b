"""What is attacked: readers of our own files, each with a sound folder to begin from."""

import functools
import importlib
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taojax.files.specs import load_spec

ROOT = Path(__file__).parents[1]
N_MAP, N_QUERY, DIM, K = 40, 36, 8, 5


class Target(NamedTuple):
    """One reader or verb."""

    name: str
    build: Callable[[Path], None]
    """Writes a sound folder."""

    files: tuple[str, ...]
    """Those of it that are attacked."""

    run: Callable[[Path, Path], Iterable[np.ndarray]]
    """Reads the folder, may write the second path; gives arrays that must be finite."""

    share: float = 1.0
    """Of the cases; verbs are slow."""


def from_tests(name: str) -> Any:
    """Return a module of the tests: they write every format."""
    if str(ROOT / "tests") not in sys.path:
        sys.path.insert(0, str(ROOT / "tests"))
    return importlib.import_module(name)


# Tables: a sound row is written from the spec itself.


def _sound_cell(column: dict[str, Any], row: int, n: int) -> str:
    if column.get("type") == "text":
        return column["values"][0] if "values" in column else f"{10**18 + row}.png"
    if column.get("type") == "stamp":
        return str(1_600_000_000_000_000 + row * 100_000)
    low = max(column.get("min", -1.0), -1e9)
    high = min(column.get("max", low + 1e3), low + 1e3)
    if column.get("type") == "int" or column.get("monotonic") or column.get("increasing"):
        return str(int(min(np.ceil(low) + row, high)))
    return f"{low + (high - low) * (row + 1) / (n + 2):.6f}"


def _write_table(spec: str, folder: Path) -> None:
    told, n = load_spec(spec), 8
    names = told.get("layouts", [[c["name"] for c in told["columns"]]])[0]
    columns = {c["name"]: c for c in told["columns"]}
    rows = [[_sound_cell(columns[name], row, n) for name in names] for row in range(n)]
    rows = [names, *rows] if told.get("header", "required") == "required" else rows
    text = "\n".join(told.get("separator", ",").join(row) for row in rows) + "\n"
    (folder / "table.csv").write_text(text, encoding="utf-8")


def _read_table(spec: str, folder: Path, out: Path) -> list[np.ndarray]:
    from taojax.files.tables import read_table

    table = read_table(folder / "table.csv", spec)
    may_blank = {c["name"] for c in load_spec(spec)["columns"] if c.get("blank")}
    return [values for name, values in table.items() if name not in may_blank]


def tables() -> list[Target]:
    folder = ROOT / "data_specs"
    specs = [p.stem for p in sorted(folder.glob("*.toml")) if "columns" in load_spec(p.stem)]
    return [
        Target(
            f"table {spec}",
            functools.partial(_write_table, spec),
            ("table.csv",),
            functools.partial(_read_table, spec),
            0.35,
        )
        for spec in specs
    ]


# Data folders, archives and settings.


def write_data(folder: Path, *, lists: bool = False) -> None:
    """Write a small sound data folder with truth."""
    conftest, rng = from_tests("conftest"), np.random.default_rng(0)
    conftest.write_folder(folder, rng, n_map=N_MAP, n_query=N_QUERY, dim=DIM)
    (folder / "about.toml").write_text('notes = ["simulated"]\n')
    if lists:
        (folder / "map/descriptors.npy").unlink()
        (folder / "query/descriptors.npy").unlink()
        index = np.tile(np.arange(K, dtype=np.int32), (N_QUERY, 1))
        similarity = np.tile(np.linspace(0.9, 0.2, K, dtype=np.float32), (N_QUERY, 1))
        np.savez(folder / "query/retrievals.npz", index=index, similarity=similarity)


DATA = ("map/poses.csv", "query/odometry.csv", "about.toml")
VIEWS = ("map/descriptors.npy", "query/descriptors.npy")
LISTS = ("query/retrievals.npz",)


def load(folder: Path, out: Path) -> list[np.ndarray]:
    from taojax.runtime.observations import load_observations

    found = load_observations(folder)
    held = [found.map_xyt, found.odometry, found.t_s]
    held += [] if found.descriptors is None else [np.asarray(part) for part in found.descriptors]
    return held if found.retrievals is None else [*held, found.retrievals.similarity]


def _settings(folder: Path) -> None:
    from taojax.config import Config, to_toml
    from taojax.risk import shipped
    from taojax.risk import to_toml as calibration_toml

    (folder / "config.toml").write_text(to_toml(Config()))
    (folder / "grid.toml").write_text("lambda_velocity = [0.1, 1]\n[joint]\nevidence = [2]\n")
    (folder / "calibration.toml").write_text(calibration_toml(shipped()))


def _read_settings(folder: Path, out: Path) -> list[np.ndarray]:
    from taojax.config import from_toml
    from taojax.risk import read_calibration
    from taojax.runtime.sweep import expand, read_grid

    config = from_toml(folder / "config.toml")
    rows = expand(read_grid(folder / "grid.toml"), config)
    final = read_calibration(folder / "calibration.toml").final
    numbers = [float(v) for row in rows for v in row.values() if not isinstance(v, str)]
    return [np.array(numbers), final.mean, final.scale, final.weight]


def own_files() -> list[Target]:
    """Return the readers of data folders and settings."""
    settings = ("config.toml", "grid.toml", "calibration.toml")
    with_lists = functools.partial(write_data, lists=True)
    return [
        Target("data folder", write_data, (*DATA, *VIEWS), load, 2.0),
        Target("data folder with lists", with_lists, (*DATA, *LISTS), load, 2.0),
        Target("settings", _settings, settings, _read_settings, 2.0),
    ]
