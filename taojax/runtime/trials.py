"""Many short logs at once, over every device: each trial is replayed from a fresh start."""

import jax
import numpy as np
from jax.sharding import Mesh
from tqdm import tqdm

from taojax.config import Config, StreamConfig
from taojax.runtime.frames import Frame, StreamRecord
from taojax.runtime.maps import MapTables
from taojax.runtime.parallel import CUT, WHOLE, device_mesh, gather, place
from taojax.runtime.stream import literal, replay

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
