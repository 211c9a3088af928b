"""A whole data set through the stream into one sealed table, with progress."""

import platform
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from taojax import __version__
from taojax.config import Config, to_toml
from taojax.detector import foreign_map
from taojax.errors import InputError
from taojax.records import SealedTrack, code_digest, map_of, refuse_if_taken, write_run
from taojax.risk import SHIPPED, Calibration, for_run, shipped
from taojax.risk import to_toml as calibration_toml
from taojax.runtime import growing, hindsight
from taojax.runtime.frames import STATUSES, Frame, StreamRecord
from taojax.runtime.maps import MapTables, map_tables
from taojax.runtime.observations import Observations, load_observations
from taojax.runtime.refined import check_refinement
from taojax.runtime.retrieval import N_KEPT, retrieve
from taojax.runtime.rivals import rival_tracks, sealed_track
from taojax.runtime.stream import COMPILING, answered, init, literal, replay
from taojax.runtime.trials import in_trials, replay_trials
from taojax.specs import read_bytes
from taojax.verdicts import decide

CHUNK_FRAMES = 256
"""Frames per scan; one compilation, and a progress bar that moves."""


def candidates(observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Return the `(T, 100)` map rows and similarities of every query, best first."""
    if observations.descriptors is not None:
        return retrieve(*observations.descriptors)
    if observations.retrievals is None:
        raise InputError("neither descriptors nor retrieval lists; see data_specs/README.md")
    index, similarity = observations.retrievals.index, observations.retrievals.similarity
    room = max(0, N_KEPT - index.shape[1])
    index = np.pad(index[:, :N_KEPT], ((0, 0), (0, room)), constant_values=-1)
    similarity = np.pad(similarity[:, :N_KEPT], ((0, 0), (0, room)))
    return index, similarity


def replay_log(
    config: Config, tables: MapTables, frames: Frame, *, progress: bool = False
) -> StreamRecord:
    """Replay the literal stream over a whole log in chunks of one fixed shape.

    Args:
        config: settings; only the stream part is used.
        tables: the map.
        frames: numpy or JAX leaves with a leading time axis.
        progress: draw a bar on stderr.

    Returns:
        One record per frame, as numpy arrays.
    """
    n_frames = len(frames.odometry)
    frames = jax.tree.map(np.asarray, frames)
    settings = literal(config)
    state, parts = init(settings, tables), []
    with tqdm(
        total=n_frames, unit="frame", disable=not progress, leave=False, desc=COMPILING
    ) as bar:
        for start in range(0, n_frames, CHUNK_FRAMES):
            n = min(CHUNK_FRAMES, n_frames - start)
            # The last chunk is padded with frames that never were; their records are dropped.
            width = min(CHUNK_FRAMES, max(n, n_frames))
            chunk = jax.tree.map(
                lambda leaf, a=start, b=start + n, w=width: jnp.asarray(
                    np.concatenate([leaf[a:b], np.repeat(leaf[b - 1 : b], w - (b - a), axis=0)])
                ),
                frames,
            )
            state, records = replay(settings, tables, chunk, state)
            parts.append(jax.tree.map(lambda leaf, m=n: np.asarray(leaf)[:m], records))
            bar.set_description_str("scoring", refresh=False)
            bar.update(n)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def signal_table(t_s: np.ndarray, records: StreamRecord) -> dict[str, np.ndarray]:
    """Return the columns of signals.csv."""
    pose = np.where(records.has_pose[:, None], records.pose.astype(float), np.nan)
    return {
        "frame": np.arange(len(t_s)),
        "t_s": t_s,
        "status": np.array(STATUSES, dtype=object)[records.status],
        "map_index": np.asarray(records.map_index),
        "x_m": pose[:, 0],
        "y_m": pose[:, 1],
        "theta_rad": pose[:, 2],
        **{name: np.asarray(values) for name, values in records.signals.items()},
    }


def facts_of(command: str, dataset: Path, seed: int) -> dict[str, Any]:
    """Return what the manifest says of this machine and code."""
    names = ("jax", "jaxlib", "equinox", "optimistix", "numpy")
    return {
        "command": command,
        "dataset": str(dataset),
        "seed": seed,
        "versions": {
            "python": platform.python_version(),
            "taojax": __version__,
            **{name: metadata.version(name) for name in names},
        },
        "code": code_digest(),
        "device": jax.devices()[0].device_kind,
    }


def map_facts(tables: MapTables) -> dict[str, Any]:
    """Return what the manifest says of the map, so that its tables need no descriptors again."""
    return {
        "map_spacing_m": float(tables.spacing_m),
        "map_scale": [float(end) for end in tables.scale],
        "map_recall": float(tables.recall),
        "map_gap_m": float(tables.places.gap_m),
        "evidence_unit_m": float(tables.places.unit_m),
    }


def score(
    dataset: Path,
    out: Path,
    config: Config,
    *,
    calibration: Calibration | None = None,
    rival_logs: int | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Score a data folder and seal the result; needs no truth and never looks for it.

    A folder of trials (`trial_frames` in about.toml) is replayed trial by trial, each from a fresh
    start.

    Args:
        dataset: a data folder, laid out as data_specs/README.md says.
        out: run folder to make; must be absent or empty.
        config: settings.
        calibration: frozen numbers of an earlier audit; the shipped ones when omitted.
        rival_logs: also seal the literal track and, on so many first trials (a folder without
            trials is one), every rival; adds tracks.npz. None = neither.
        progress: draw a bar on stderr.

    Returns:
        The manifest as sealed.

    Raises:
        InputError: the data do not meet their spec, or `out` is taken.
    """
    refuse_if_taken(out)
    observations = load_observations(dataset, may_be_own=True)
    if observations.own_gap_m is not None:
        if rival_logs is not None:
            raise InputError(f"{dataset}: is its own map, on which no rival runs; drop --rivals")
        return _score_own(dataset, out, config, observations, calibration, progress=progress)
    index, similarity = candidates(observations)
    known = observations.descriptors and observations.descriptors[0]
    tables = map_tables(observations.map_xyt, config.stream, known)
    frames = Frame(*(jnp.asarray(a) for a in (observations.odometry, index, similarity)))
    n = observations.trial_frames

    def replayed(config: Config) -> StreamRecord:
        if n is None:
            return replay_log(config, tables, frames, progress=progress)
        return replay_trials(config, tables, in_trials(frames, n), progress=progress)

    records = replayed(config)
    track = sealed_track(records, "tao_rank")
    seen = hindsight.clean(tables, np.asarray(observations.odometry), index, similarity)
    both = hindsight.replay_each(config.verdict, tables, seen, n, progress=progress)
    tracks = None
    if rival_logs is not None:
        said = rival_tracks(observations, frames, most_logs=rival_logs, progress=progress)
        tracks = {"tao_rank": track, **said}
    notes = [check_refinement(config, records, replayed)] if config.stream.refine else []
    records = answered(config, records, both.now)
    table = signal_table(observations.t_s, records) | hindsight.now_columns(both.now)
    delayed = hindsight.delayed_columns(both.final)
    said = _Said(table, delayed, index, similarity, tables, notes, tracks)
    return _sealed(dataset, out, config, observations, calibration, said)


def _score_own(
    dataset: Path,
    out: Path,
    config: Config,
    observations: Observations,
    calibration: Calibration | None,
    *,
    progress: bool,
) -> dict[str, Any]:
    """Score a drive that is its own map."""
    cut = growing.blocks(observations.odometry, float(observations.own_gap_m or 0.0))
    lists = growing.candidates(observations, cut, progress=progress)
    grown = growing.replay_growing(config, observations, cut, lists, progress=progress)
    table = signal_table(observations.t_s, grown.record) | grown.now
    note = (
        f"one drive that closes on itself: a frame knows what lies {observations.own_gap_m:g} m of"
        f" way or more behind it, in blocks of {growing.BLOCK} frames; places lie where the drive's"
        " own odometry has put them"
    )
    said = _Said(table, grown.delayed, *lists, grown.tables, [note], None)
    return _sealed(dataset, out, config, observations, calibration, said)


@dataclass(frozen=True)
class _Said:
    """What a run says, to be sealed."""

    signals: dict[str, np.ndarray]
    delayed: dict[str, np.ndarray]
    index: np.ndarray
    similarity: np.ndarray
    tables: MapTables
    notes: list[str]
    tracks: dict[str, SealedTrack] | None


def _sealed(
    dataset: Path,
    out: Path,
    config: Config,
    observations: Observations,
    calibration: Calibration | None,
    said: _Said,
) -> dict[str, Any]:
    """Decide and seal; return the manifest."""
    table, delayed = said.signals, said.delayed
    # What repeats this run, seen from its own folder; the words typed may name files long gone.
    command = f"taojax score {dataset} --config config.toml"
    notes = [*observations.notes, *said.notes]
    known_map = {**map_facts(said.tables), "sha256": observations.sha256}
    used = for_run(calibration or shipped(), config.audit.max_wrong, config.verdict.lag)
    if foreign := foreign_map(used.fitted_on, map_of(known_map)):
        notes.append(foreign)
    if used.fitted_on is None:
        notes.append(f"decided with {SHIPPED}: no frame of this place has set its level")
    return write_run(
        out,
        signals=table,
        delayed=delayed,
        odometry=read_bytes(dataset / "query/odometry.csv"),
        decisions=decide(used, table, delayed),
        calibration_toml=calibration_toml(used),
        tracks=said.tracks,
        map_poses=observations.map_poses,
        index=said.index,
        similarity=said.similarity,
        config_toml=to_toml(config),
        manifest={
            **facts_of(command, dataset, config.seed),
            "notes": notes,
            **known_map,
            "trial_frames": observations.trial_frames,
            **({} if observations.own_gap_m is None else {"own_gap_m": observations.own_gap_m}),
        },
    )
