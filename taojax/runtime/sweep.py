"""Sweeps: one replay over many settings under `vmap`, and the sealed runs they leave."""

import dataclasses
import io
import itertools
import json
import math
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from tqdm import tqdm

from taojax.config import Config, StreamConfig, VerdictConfig, read_toml, replace, to_toml
from taojax.core.cost import Branch
from taojax.core.se2 import inverse, transform
from taojax.errors import ConfigError, InputError
from taojax.files.records import SCHEMA, digest, read_manifest, refuse_if_taken, seal_of
from taojax.files.specs import write_atomically
from taojax.files.tables import table_text
from taojax.runtime import hindsight
from taojax.runtime.frames import Frame
from taojax.runtime.maps import MapTables, map_tables
from taojax.runtime.observations import load_observations
from taojax.runtime.score import candidates, facts_of
from taojax.runtime.stream import cost_params, rank_costs

RANK = (
    "lambda_velocity", "gamma_similarity", "tau_masks", "delta_spacings", "mask_deltas", "window",
    "branches", "refine",
)  # fmt: skip

JOINT = (
    "evidence", "leave", "come_back", "start_off", "step_gaps", "reach_gaps", "place_gaps",
    "near_gaps", "drift",
)  # fmt: skip

SETTINGS = {"rank": RANK, "joint": JOINT}
"""Association -> the settings that its signal depends on; the others would only repeat rows."""

COLUMNS = tuple(dict.fromkeys(RANK + JOINT))

Grid = Mapping[str, Mapping[str, tuple[float | int | bool, ...]]]
"""Association -> setting -> values; a setting left out keeps the configuration's value."""

Row = dict[str, float | int | str | bool]
"""One configuration: association, its settings, is_default, is_in_grid."""

DEFAULT: Grid = {
    "rank": {
        "lambda_velocity": (0.0, 0.01, 0.1, 1.0),
        "gamma_similarity": (1.0, 10.0, 100.0, 1000.0),
        "delta_spacings": (1.5, 3.0),
        "mask_deltas": (1.0, 3.0),
        "window": (10, 20),
        "branches": (20, 100),
    },
    "joint": {
        "evidence": (2.0, 4.0, 8.0),
        "leave": (0.005, 0.02, 0.08),
        "come_back": (0.03, 0.1),
        "near_gaps": (1.0, 2.0),
    },
}
"""256 rank configurations around the paper's, and 36 of the filter; the defaults are among them."""

MOST = 100_000
"""Configurations of one sweep at most."""


def _value(name: str, value: Any) -> float | int:
    """Return one value of the right type and range.

    Raises:
        ConfigError: it is no number, or the setting may not hold it.
    """
    if name == "refine":
        if not isinstance(value, bool):
            raise ConfigError(f"refine: {value!r} is not allowed; give a list of true and false")
        return value
    is_whole = name in ("window", "branches")
    if isinstance(value, bool) or not isinstance(value, int if is_whole else int | float):
        kind = "whole numbers" if is_whole else "numbers"
        raise ConfigError(f"{name}: {value!r} is not allowed; give a list of {kind}")
    value = value if is_whole else float(value)
    replace(Config(), {name: value})
    return value


def _values(name: str, values: Any) -> tuple[float | int, ...]:
    if not isinstance(values, list | tuple) or not values:
        raise ConfigError(f"{name}: expected a list of values such as [1, 3], got {values!r}")
    return tuple(dict.fromkeys(_value(name, value) for value in values))


def _chosen(tree: Mapping[str, Any], shared: Mapping[str, Any]) -> list[str]:
    """Return which associations a grid is about: as named, else those that know its settings."""
    if "association" in tree:
        named = tree["association"]
        if not isinstance(named, list) or not named or not set(map(str, named)) <= set(SETTINGS):
            raise ConfigError(f'association: expected a list of "rank" and "joint", got {named!r}')
        return list(dict.fromkeys(named))
    return [a for a, known in SETTINGS.items() if a in tree or set(shared) & set(known)]


def parse(tree: Mapping[str, Any]) -> Grid:
    """Check what a grid file holds.

    Args:
        tree: setting -> list of values, for every association that knows the setting; tables
            `rank` and `joint` hold lists for one association alone and win; `association` names
            those to sweep.

    Raises:
        ConfigError: unknown name, wrong type, value out of range, or nothing to vary.
    """
    shared = {k: v for k, v in tree.items() if k not in ("association", *SETTINGS)}
    unknown = sorted(set(shared) - set(COLUMNS))
    if unknown:
        raise ConfigError(f"unknown setting(s) {', '.join(unknown)}; known: {', '.join(COLUMNS)}")
    chosen, grid = _chosen(tree, shared), {}
    if not chosen:
        raise ConfigError("names no setting to vary, such as delta_spacings = [1.5, 3]")
    for name in shared:
        if not any(name in SETTINGS[a] for a in chosen):
            raise ConfigError(f"{name} has no effect on association {' or '.join(chosen)}")
    for association in chosen:
        own, known = tree.get(association, {}), SETTINGS[association]
        if not isinstance(own, Mapping):
            raise ConfigError(f"[{association}]: expected a table of lists, got {own!r}")
        if wrong := sorted(set(own) - set(known)):
            raise ConfigError(f"[{association}] has no setting {', '.join(wrong)}")
        given = {k: v for k, v in shared.items() if k in known} | dict(own)
        grid[association] = {k: _values(k, given[k]) for k in known if k in given}
    if (n := sum(math.prod(map(len, values.values())) for values in grid.values())) > MOST:
        raise ConfigError(f"{n} configurations; at most {MOST} fit one sweep, drop some values")
    return grid


def read_grid(path: Path) -> Grid:
    """Read a grid file.

    Raises:
        ConfigError: unreadable, or not what `parse` allows; one line that names the file.
    """
    tree = read_toml(path)
    try:
        return parse(tree)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def pin(grid: Grid, fixed: Mapping[str, float | int | None], association: str | None) -> Grid:
    """Return a grid in which flags win: a setting named by one keeps this single value.

    Args:
        grid: from `read_grid` or `DEFAULT`.
        fixed: setting -> value; None leaves it alone.
        association: keeps this one alone; None keeps all.

    Raises:
        ConfigError: the grid says nothing of that association.
    """
    kept = {a: dict(v) for a, v in grid.items() if association in (None, a)}
    if not kept:
        raise ConfigError(f"--association {association}: the grid sweeps {', '.join(grid)} only")
    for values in kept.values():
        values |= {k: (v,) for k, v in fixed.items() if v is not None and k in values}
    return kept


def grid_to_toml(grid: Grid) -> str:
    """Return a grid as TOML that `read_grid` reads back unchanged."""
    lines = []
    for association, values in grid.items():
        lines.append(f"[{association}]")
        lines += [f"{name} = {list(v)!r}".lower() for name, v in values.items()]
    return "\n".join(lines) + "\n"


def _product(values: Mapping[str, Sequence[float | int]]) -> Iterator[dict[str, float | int]]:
    for chosen in itertools.product(*values.values()):
        yield dict(zip(values, chosen, strict=True))


def expand(grid: Grid, config: Config) -> list[Row]:
    """Return the configurations in the order of the table.

    Args:
        grid: what to vary.
        config: gives what the grid leaves out, and one more row per association where its own
            settings are not in the product: every sweep is compared with them.
    """
    rows: list[Row] = []
    for association, values in grid.items():
        part = config.stream if association == "rank" else config.verdict
        base = {name: getattr(part, name) for name in SETTINGS[association]}
        tried = [base | changed for changed in _product(values)]
        is_known = base in tried
        for settings in tried if is_known else [*tried, base]:
            is_default = settings == base
            rows.append(
                {"association": association, **settings, "is_default": is_default,
                 "is_in_grid": is_known or not is_default}
            )  # fmt: skip
    return rows


def as_table(rows: Sequence[Row]) -> dict[str, np.ndarray]:
    """Return configurations as the columns of data_specs/grid.toml."""
    return {
        "config": np.arange(len(rows)),
        "association": np.array([row["association"] for row in rows], dtype=object),
        **{name: np.array([row.get(name, np.nan) for row in rows], float) for name in COLUMNS},
        **{k: np.array([row[k] for row in rows], float) for k in ("is_default", "is_in_grid")},
    }


def largest(rows: Sequence[Row], name: str) -> int:
    """Return the largest value of a whole-number setting among the rows that have it."""
    return max(int(row[name]) for row in rows if name in row)


MOST_AT_ONCE = 32
"""Units under one `vmap` at most, where vmap is used at all."""

MEMORY_BYTES = 1 << 30
"""Tables and windows of the units under one `vmap` may take so much."""


class RankLog(eqx.Module):
    """Frames in front of which a whole window of frames that never were is put."""

    p: Float[Array, "t n 2"]
    """Local positions of every frame's window, as a stream would hold them."""

    q: Float[Array, "s k 2"]
    similarity: Float[Array, "s k"]
    has_anchor: Bool[Array, "s k"]


class RankUnit(eqx.Module):
    """One fit, and what is read off it without a second one. Leaves gain an axis under `vmap`."""

    config: StreamConfig
    window: Int[Array, "*u"]
    gamma: Float[Array, "*u g"]
    """Weights of the similarity term; repeated to a common length."""

    branches: Int[Array, "*u g"]


class Unit(NamedTuple):
    """One piece of work: rows of the grid and the arguments that give their signals."""

    rows: tuple[int, ...]
    arguments: RankUnit | VerdictConfig


_C = TypeVar("_C", StreamConfig, VerdictConfig)


def _scalars(config: _C, row: Row, **sizes: Any) -> _C:
    """Return settings whose numbers are arrays, so that one compilation serves every row."""
    free = [f.name for f in dataclasses.fields(config) if not f.metadata.get("static", False)]
    numbers: dict[str, Any] = {
        name: jnp.asarray(row.get(name, getattr(config, name)), jnp.float32) for name in free
    }
    return dataclasses.replace(config, **numbers, **sizes)


def rank_log(tables: MapTables, frames: Frame, window: int, branches: int) -> RankLog:
    """Prepare a recording for rank branches.

    Args:
        tables: the map.
        frames: checked at the door; leaves with a leading time axis.
        window: longest window of the sweep.
        branches: most branches of the sweep.
    """
    room = max(0, branches - frames.index.shape[1])
    index = jnp.pad(frames.index[:, :branches], ((0, 0), (0, room)), constant_values=-1)
    similarity = jnp.pad(frames.similarity[:, :branches], ((0, 0), (0, room)))
    is_there = index >= 0
    anchors = tables.places.grid.xy[index]
    before = ((window - 1, 0), (0, 0))

    def push(p: Array, odometry: Array) -> tuple[Array, Array]:
        moved = transform(inverse(odometry)[None], p)
        p = jnp.concatenate([moved[1:], jnp.zeros((1, 2))])
        return p, p

    return RankLog(
        p=jax.lax.scan(push, jnp.zeros((window, 2)), frames.odometry)[1],
        q=jnp.pad(jnp.where(is_there[..., None], anchors, 0.0), (*before, (0, 0))),
        similarity=jnp.pad(jnp.where(is_there, similarity, 0.0), before),
        has_anchor=jnp.pad(is_there, before),
    )


def rank_signals(tables: MapTables, log: RankLog, unit: RankUnit) -> Float[Array, "g t"]:
    """Return the signal of a stream with rank branches, for every gamma and K of a unit."""
    n, k = log.p.shape[1], log.q.shape[1]
    unweighted = dataclasses.replace(unit.config, gamma_similarity=jnp.ones(()))
    params, age = cost_params(unweighted, tables), jnp.arange(n)[::-1]
    is_branch = jnp.arange(k)[None] < unit.branches[:, None]

    def at(t: Array) -> Float[Array, " g"]:
        seen = (age < unit.window) & (age <= t)
        weight = seen.astype(jnp.float32)
        cut = lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, t, n)
        branches = Branch(cut(log.q), cut(log.similarity), cut(log.has_anchor))
        costs = rank_costs(unit.config, params, log.p[t], branches, weight / jnp.sum(weight))
        total = costs.geom[None] + costs.vel[None] + unit.gamma[:, None] * costs.sim[None]
        return jnp.min(jnp.where(is_branch, total, jnp.inf), axis=1)

    return jax.lax.map(at, jnp.arange(log.p.shape[0])).T


def joint_signals(
    tables: MapTables, seen: hindsight.Seen, config: VerdictConfig
) -> Float[Array, "1 t"]:
    """Return the signal of a filter.

    Args:
        tables: the map.
        seen: from `hindsight.cleaned`.
        config: its settings.
    """

    def advance(state: hindsight.State, frame: hindsight.Seen) -> tuple[hindsight.State, Array]:
        state, answer = hindsight.advance(config, tables, state, frame)
        return state, hindsight.tao(answer.features)

    return jax.lax.scan(advance, hindsight.init(config, tables), seen)[1][None]


def rank_units(rows: Sequence[Row], config: StreamConfig) -> list[Unit]:
    """Group the rank rows of a grid by the fit that they share."""
    groups: dict[tuple[Any, ...], list[int]] = {}
    names = ("lambda_velocity", "tau_masks", "delta_spacings", "mask_deltas", "window", "refine")
    for number, row in enumerate(rows):
        if row["association"] == "rank":
            groups.setdefault(tuple(row[name] for name in names), []).append(number)
    width = max(map(len, groups.values()), default=0)
    units = []
    for members in groups.values():
        padded = members + members[-1:] * (width - len(members))
        column = lambda name, of=padded: np.array([rows[number][name] for number in of])
        row = rows[members[0]]
        units.append(
            Unit(
                tuple(members),
                RankUnit(
                    config=_scalars(config, row, refine=bool(row["refine"])),
                    window=jnp.asarray(int(row["window"])),
                    gamma=jnp.asarray(column("gamma_similarity"), jnp.float32),
                    branches=jnp.asarray(column("branches"), jnp.int32),
                ),
            )
        )
    return units


def joint_units(rows: Sequence[Row], config: VerdictConfig) -> list[Unit]:
    """Return one unit per row of a grid that is about the filter."""
    return [
        Unit((number,), _scalars(config, row))
        for number, row in enumerate(rows)
        if row["association"] == "joint"
    ]


def at_once(unit: Unit, backend: str, n_anchors: int) -> int:
    """Return how many units go under one `vmap`; 1 means a loop.

    On a CPU the loop wins: `python -m benchmarks sweep_speed` found vmap to take twice the CPU
    time per unit, for both associations and every batch size. Elsewhere a batch fills the device
    (assumed, not measured), within `MEMORY_BYTES`.
    """
    if backend == "cpu":
        return 1
    n_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(unit.arguments))
    if isinstance(unit.arguments, VerdictConfig):
        n_bytes += 8 * n_anchors
    return max(1, min(MOST_AT_ONCE, MEMORY_BYTES // n_bytes))


def evaluate(
    signals: Callable[[Any], Array], units: Sequence[Unit], *, batch: int
) -> Iterator[tuple[tuple[int, ...], np.ndarray]]:
    """Work through units, one after the other or `batch` at once under `vmap`.

    Args:
        signals: arguments of one unit -> (rows, t).
        units: of one association, of equal shapes.
        batch: from `at_once`.

    Yields:
        Row numbers and their signals `(rows, t)`, as they are finished.
    """
    if batch > 1:
        run = jax.jit(jax.vmap(signals))
        for start in range(0, len(units), batch):
            part = list(units[start : start + batch])
            padded = [*part, *part[-1:] * (batch - len(part))]
            stacked = jax.tree.map(lambda *x: jnp.stack(x), *(u.arguments for u in padded))
            found = np.asarray(run(stacked))
            rows = tuple(row for unit in part for row in unit.rows)
            yield (
                rows,
                np.concatenate([f[: len(u.rows)] for f, u in zip(found, part, strict=False)]),
            )
        return
    run = jax.jit(signals)
    for unit in units:
        yield unit.rows, np.asarray(run(unit.arguments))[: len(unit.rows)]


def plan(
    rows: Sequence[Row], config: Config, tables: MapTables, frames: Frame
) -> list[tuple[Callable[[Any], Array], list[Unit]]]:
    """Return what to compute: per association a function of one unit, and its units."""
    work: list[tuple[Callable[[Any], Array], list[Unit]]] = []
    if ranked := rank_units(rows, config.stream):
        mine = [row for row in rows if row["association"] == "rank"]
        log = rank_log(tables, frames, largest(mine, "window"), largest(mine, "branches"))
        # Refinement is another program: its units stay among themselves.
        for refine in (False, True):
            if alike := [unit for unit in ranked if rows[unit.rows[0]]["refine"] == refine]:
                work.append((partial(rank_signals, tables, log), alike))
    if joint := joint_units(rows, config.verdict):
        seen = hindsight.cleaned(tables, frames.odometry, frames.index, frames.similarity)
        work.append((partial(joint_signals, tables, seen), joint))
    return work


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


def check_same(out: Path, config: Config, grid: Grid) -> None:
    """Check that a sealed sweep was made with these settings, so that judging may go on.

    Raises:
        InputError: another grid or configuration, or a broken seal.
    """
    hashes = read_manifest(out)["sha256"]
    now = {"config.toml": to_toml(config), "grid.toml": grid_to_toml(grid)}
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
    dataset: Path, out: Path, config: Config, grid: Grid, *, progress: bool = False
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
    rows = expand(grid, config)
    facts = facts_of(
        f"taojax sweep {dataset} --config config.toml --grid grid.toml", dataset, config.seed
    )
    files: dict[str, bytes] = {
        "config.toml": to_toml(config).encode(),
        "grid.toml": grid_to_toml(grid).encode(),
        "grid.csv": table_text("grid", as_table(rows)).encode(),
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
