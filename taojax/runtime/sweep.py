"""Many configurations of one recording: the same frames, one compilation, a bounded memory.

What the settings share is prepared once. Rank branches do not depend on the past, so a frame's
windows are slices of one log, a shorter window or fewer branches are masks, and the weight of the
similarity term and the number of branches need no second fit: a *unit* of work is one fit with all
its values of those two. A unit of the filter is one configuration, a scan over time.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from taojax.config import Config, StreamConfig, VerdictConfig
from taojax.core.cost import Branch
from taojax.core.se2 import inverse, transform
from taojax.runtime import hindsight
from taojax.runtime.frames import Frame
from taojax.runtime.grid import Row, largest
from taojax.runtime.maps import MapTables
from taojax.runtime.stream import cost_params, rank_costs

MOST_AT_ONCE = 32
"""Units under one `vmap` at most, where vmap is used at all."""

MEMORY_BYTES = 1 << 30
"""Tables and rings of the units under one `vmap` may take so much."""


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
