"""A recording, or a row of trials, scored and sealed."""

import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from tqdm import tqdm

from taojax import __version__
from taojax.config import Config, StreamConfig, replace, to_toml
from taojax.decisions import decide
from taojax.errors import InputError
from taojax.files.records import SealedTrack, code_digest, map_of, refuse_if_taken, write_run
from taojax.files.specs import read_bytes
from taojax.risk import SHIPPED, Calibration, for_run, foreign_map, shipped
from taojax.risk import to_toml as calibration_toml
from taojax.runtime import growing, hindsight
from taojax.runtime.frames import STATUSES, Frame, StreamRecord, check_frame
from taojax.runtime.maps import MapTables, map_tables
from taojax.runtime.observations import Observations, load_observations
from taojax.runtime.parallel import CUT, WHOLE, device_mesh, gather, place
from taojax.runtime.retrieval import N_KEPT, retrieve
from taojax.runtime.rivals import rival_tracks, sealed_track
from taojax.runtime.stream import COMPILING, answered, init, literal, replay

SAME = 1e-4
"""Costs nearer than this, relatively, differ by rounding alone."""


def check_refinement(
    config: Config, refined: StreamRecord, replayed: Callable[[Config], StreamRecord]
) -> str:
    """Say how the refined literal cost stands to the closed form, for the notes of a run.

    Args:
        config: settings of the run, with refinement on.
        refined: its records.
        replayed: replays the same frames with other settings.
    """
    other = replayed(replace(config, {"refine": False}))
    closed = np.asarray(other.signals["tao_rank"], float).ravel()
    change = np.asarray(refined.signals["tao_rank"], float).ravel() - closed
    change = change / np.maximum(np.abs(closed), 1e-6)
    lower, higher = change < -SAME, change > SAME
    words = f"lower in {lower.mean():.0%} of the frames"
    if lower.any():
        words += f" (there by {-np.median(change[lower]):.2%} in the median)"
    words += ", the same in the others"
    if higher.any():
        words += f"; HIGHER in {higher.sum()} (by up to {change.max():.2%}), which is a fault"
    return (
        f"refinement is on: tao_rank is Eq. 1 at its Huber minimum; against the closed form {words}"
    )


CHUNK_TRIALS = 32
"""Trials per call and device; one compilation, and a progress bar that moves."""


def batch_trials() -> int:
    """Return how many trials run side by side on a device, by where jax runs.

    On a CPU one after the other: a step already fills its vector units with branches. Measured on
    two cores: 2.52, 3.12, 2.44 and 2.37 ms a frame with 1, 2, 8 and 32 trials side by side, and
    one alone compiles fastest. An accelerator is empty without many; that number is no
    measurement.
    """
    return 1 if jax.default_backend() == "cpu" else CHUNK_TRIALS


@jax.jit(static_argnames=("batch", "mesh"))
def _replay_each(
    config: StreamConfig, tables: MapTables, frames: Frame, batch: int, mesh: Mesh
) -> StreamRecord:
    def own_trials(config: StreamConfig, tables: MapTables, frames: Frame) -> StreamRecord:
        one = lambda trial: replay(config, tables, trial)[1]
        return jax.lax.map(one, frames, batch_size=None if batch == 1 else batch)

    # Nothing crosses devices, and the check of what varies refuses a scan from a constant start.
    over_devices = jax.shard_map(
        own_trials, mesh=mesh, in_specs=(WHOLE, WHOLE, CUT), out_specs=CUT, check_vma=False
    )
    return over_devices(config, tables, frames)


def in_trials(frames: Frame, trial_frames: int) -> Frame:
    """Cut a log of `B * trial_frames` frames into B trials: leaves get a leading axis."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, trial_frames, *leaf.shape[1:]), frames)


def replay_trials(
    config: Config,
    tables: MapTables,
    frames: Frame,
    *,
    batch: int | None = None,
    mesh: Mesh | None = None,
    progress: bool = False,
) -> StreamRecord:
    """Replay the literal stream over every trial from a fresh start, shared among the devices.

    Args:
        config: settings; only the stream part is used.
        tables: the map, the same for all.
        frames: leaves with two leading axes, trial and time, from `in_trials`.
        batch: trials side by side on a device; `batch_trials()` when omitted.
        mesh: from `device_mesh`, all devices of all processes when omitted.
        progress: draw a bar on stderr.

    Returns:
        One record per frame, trial after trial on one leading axis, as numpy arrays,
        the same in every process.
    """
    mesh = device_mesh() if mesh is None else mesh
    n_trials, n_frames = frames.odometry.shape[:2]
    batch = batch or batch_trials()
    width = min(CHUNK_TRIALS, -(-n_trials // mesh.size)) * mesh.size
    tables = place(tables, mesh, WHOLE)
    parts = []
    with tqdm(total=n_trials * n_frames, unit="frame", disable=not progress, leave=False) as bar:
        for start in range(0, n_trials, width):
            # The last chunk is filled up with its last trial; those records are dropped.
            chosen = np.minimum(np.arange(start, start + width), n_trials - 1)
            n = min(width, n_trials - start)
            chunk = jax.tree.map(lambda leaf, c=chosen: np.asarray(leaf)[c], frames)
            records = _replay_each(literal(config), tables, place(chunk, mesh, CUT), batch, mesh)
            parts.append(jax.tree.map(lambda leaf, m=n: leaf[:m], gather(records)))
            bar.update(n * n_frames)
    together = lambda *leaves: np.concatenate(leaves).reshape(-1, *leaves[0].shape[2:])
    return jax.tree.map(together, *parts)


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
            chunk = jax.tree.map(
                lambda leaf, a=start, b=start + n: jnp.asarray(np.concatenate(
                    [leaf[a:b], np.repeat(leaf[b - 1 : b], CHUNK_FRAMES - (b - a), axis=0)]
                )),
                frames,
            )  # fmt: skip
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


def verdicts(
    config: Config,
    tables: MapTables,
    frames: Frame,
    calibration: Calibration | None = None,
    *,
    progress: bool = False,
) -> dict[str, np.ndarray]:
    """Say of every frame of a log whether its answer may enter the graph, now and finally.

    Args:
        config: settings; the share of wrong answers is `config.audit.max_wrong`.
        tables: the map.
        frames: `(T, ...)` observations.
        calibration: frozen numbers of an audit, from `read_calibration`; the shipped ones when
            omitted.
        progress: draw bars on stderr.

    Returns:
        The columns of data_specs/verdicts.toml, `(T,)` each; the same as `taojax score` seals.

    Raises:
        InputError: arrays of a wrong shape or type, or rows that the map lacks.
    """
    check_frame(frames, axes=1)
    both = hindsight.smooth(config, tables, frames, progress=progress)
    records = answered(config, replay_log(config, tables, frames, progress=progress), both.now)
    table = signal_table(np.arange(float(len(frames.odometry))), records)
    table |= hindsight.now_columns(both.now)
    used = for_run(calibration or shipped(), config.audit.max_wrong, config.verdict.lag)
    return decide(used, table, hindsight.delayed_columns(both.final))


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
        notes.append(
            f"decisions.csv is decided with {SHIPPED}: no frame of this place has set its level"
        )
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
