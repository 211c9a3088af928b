"""Which settings a sweep tries: a factorial product per association, read from TOML."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taojax.config import Config, read_toml, replace
from taojax.errors import ConfigError

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
