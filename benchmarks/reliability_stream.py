"""Long drives and broken frames: constant memory, one compilation, nothing that lingers."""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.reliability_targets import from_tests
from taojax.config import StreamConfig
from taojax.runtime.frames import Frame, StreamRecord
from taojax.runtime.maps import MapTables, map_tables
from taojax.runtime.stream import StreamState, init, replay, step

CHUNK = 1000
REMEMBERS = ("tao",)
"""Signals of the filter, whose memory has no end; the others see the window alone."""

CONFIGS = {
    "rank": StreamConfig(window=8, branches=6, association="rank"),
    "joint": StreamConfig(window=8, branches=6),
}


class Drive(NamedTuple):
    """How a long stream went."""

    n_frames: int
    seconds: float
    grown_mib: float
    """Resident memory at the end over that after the first tenth."""

    n_compiled: int
    """Programs compiled after the first chunk."""

    n_bad: int
    """Records with a number that is not finite."""

    n_seen: int
    p_m: float
    """Largest local coordinate that the state holds at the end [m]."""

    differs: dict[str, float]
    """Signal -> difference at the end from a fresh start on the same last frames."""


def recording(n: int, seed: int = 0) -> tuple[MapTables, Frame]:
    """Return a loop of a map and n frames driven round and round in it, 60 frames a lap."""
    conftest, rng, n_map = from_tests("conftest"), np.random.default_rng(seed), 60
    places, lap = conftest.loop(n_map), conftest.loop(60)
    gap = np.linalg.norm(lap[:, None, :2] - places[None, :, :2], axis=-1)
    poses = lap[np.arange(n + 1) % 60]
    # The motion over the seam of a lap too, which the first frame of a log lacks.
    odometry = conftest.motions(poses)[1:] + rng.normal(0, 0.005, (n, 3))
    rows = np.exp(-gap / 10)[(np.arange(n) + 1) % 60] + rng.normal(0, 0.02, (n, n_map))
    index = np.argsort(-rows, axis=1)[:, :10].astype(np.int32)
    similarity = np.clip(np.take_along_axis(rows, index, 1), -1, 1).astype(np.float32)
    return map_tables(places), Frame(
        *(jnp.asarray(a) for a in (odometry.astype(np.float32), index, similarity))
    )


def resident_mib() -> float:
    """Return the resident memory of this process."""
    with open("/proc/self/statm", encoding="ascii") as stat:
        return int(stat.read().split()[1]) * 4096 / 2**20


def drive(association: str, n_frames: int, *, single_steps: int = 2000) -> Drive:
    """Drive n frames in chunks, then some by single steps, and compare with a fresh start.

    Args:
        association: rank or joint.
        n_frames: by `replay`, in chunks of one size.
        single_steps: more of them by `step`.
    """
    config, n_chunks = CONFIGS[association], max(10, n_frames // CHUNK)
    tables, frames = recording(CHUNK)
    state, warm_mib, n_bad, before = init(config, tables), 0.0, 0, 0
    step(config, tables, state, _at(frames, 0))
    begun = time.perf_counter()
    for chunk in range(n_chunks):
        state, records = replay(config, tables, frames, state)
        n_bad += _bad(records)
        if chunk == 0:
            before = _programs()
        if chunk == n_chunks // 10:
            warm_mib = resident_mib()
    for at in range(single_steps):
        state, record = step(config, tables, state, _at(frames, at % CHUNK))
        n_bad += _bad(record)
    n_compiled, grown = _programs() - before, resident_mib() - warm_mib
    total = n_chunks * CHUNK + single_steps
    return Drive(
        n_frames=total,
        seconds=time.perf_counter() - begun,
        grown_mib=grown,
        n_compiled=n_compiled,
        n_bad=n_bad,
        n_seen=int(state.n_seen),
        p_m=float(jnp.abs(state.p).max()),
        differs=_against_fresh(config, tables, frames, state),
    )


def _against_fresh(
    config: StreamConfig, tables: MapTables, frames: Frame, state: StreamState
) -> dict[str, float]:
    """Go on from an old state and from a fresh start on the last frames alone."""
    _, long = replay(config, tables, frames, state)
    # Both by the same program: a chunk is longer than any window.
    _, fresh = replay(config, tables, frames, init(config, tables))
    names = long.signals.names
    return {n: abs(float(long.signals[n][-1]) - float(fresh.signals[n][-1])) for n in names}


def _at(frames: Frame, t: int) -> Frame:
    return jax.tree.map(lambda leaf: leaf[t], frames)


def _bad(records: StreamRecord) -> int:
    return sum(int((~jnp.isfinite(leaf)).sum()) for leaf in jax.tree.leaves(records))


def _programs() -> int:
    """Return how many programs `step` and `replay` have compiled so far."""
    programs: Any = (step, replay)
    return sum(program._cache_size() for program in programs)


# Broken frames.


def broken(frames: Frame, at: int, kind: str) -> tuple[Frame, Frame]:
    """Return a log with one frame broken, and the same log with an empty frame there."""
    empty = Frame(frames.odometry, frames.index.at[at].set(-1), frames.similarity)
    still = Frame(frames.odometry.at[at].set(0.0), empty.index, empty.similarity)
    nan = {
        "odometry NaN": Frame(frames.odometry.at[at, 1].set(jnp.nan), *_lists(frames)),
        "odometry infinite": Frame(frames.odometry.at[at].set(jnp.inf), *_lists(frames)),
        "similarity NaN": Frame(
            frames.odometry, frames.index, frames.similarity.at[at].set(jnp.nan)
        ),
        "rows outside the map": Frame(
            frames.odometry, frames.index.at[at].set(2**31 - 1), frames.similarity
        ),
    }
    return nan[kind], still if kind.startswith("odometry") else empty


def _lists(frames: Frame) -> tuple[jax.Array, jax.Array]:
    return frames.index, frames.similarity


KINDS = ("odometry NaN", "odometry infinite", "similarity NaN", "rows outside the map")


def count_differing(association: str, kind: str, at: int = 30, n: int = 100) -> int:
    """Return how many numbers of records and state differ between a broken and an empty frame."""
    config = CONFIGS[association]
    tables, frames = recording(n)
    ends = [replay(config, tables, log, init(config, tables)) for log in broken(frames, at, kind)]
    same = jax.tree.map(lambda a, b: int((a != b).sum()), *ends)
    return sum(jax.tree.leaves(same))


def poisoned(is_cleaned: bool, at: int = 30, n: int = 100) -> int:
    """Return how many frames the topometric filter has no number for, after one NaN.

    Args:
        is_cleaned: as our rivals are given their frames; published, the filter cleans nothing.
        at: the broken frame.
        n: frames.
    """
    from taojax.baselines import topometric
    from taojax.baselines.models import Frames
    from taojax.runtime.rivals import dense_lists

    _, frames = recording(n)
    index, similarity = (np.asarray(a) for a in _lists(frames))
    rows = dense_lists(index, similarity, 60)
    rows[at] = np.nan
    places = np.asarray(from_tests("conftest").loop(60))
    log = Frames(places, np.asarray(frames.odometry, float), rows, index, similarity)
    own = topometric.clean
    try:
        topometric.clean = own if is_cleaned else lambda frames: frames
        with np.errstate(invalid="ignore"):
            signal = topometric.topometric(log).signal
    finally:
        topometric.clean = own
    return int((~np.isfinite(signal)).sum())
