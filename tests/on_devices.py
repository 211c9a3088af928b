"""The same small jobs on whatever devices there are; run as a script, on more than one.

python on_devices.py FOLDER [COORDINATOR N_PROCESSES PROCESS]
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from taojax.config import Config, StreamConfig
from taojax.runtime import retrieval, score
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables

K = 20

LENGTH, N_TRIALS = 8, 11
"""Frames per trial; trials, which divide by no number of devices."""


def exact(rng, n):
    """Descriptors whose cosines are multiples of 1/16: no rounding, and ties everywhere."""
    return rng.choice([-1.0, 1.0], (n, 16)).astype(np.float32)


def found(folder):
    """Retrieve from maps of more and of fewer rows than there are devices."""
    rng = np.random.default_rng(3)
    queries, smooth = exact(rng, 70), rng.normal(size=(70, 24))
    np.save(folder / "map.npy", exact(rng, 203))
    on_disk = np.load(folder / "map.npy", mmap_mode="r")
    places = retrieval.prepare(on_disk)
    lists = {
        "prepared": retrieval.retrieve(places, queries, K),
        "few": retrieval.top_k(places, jnp.asarray(retrieval.normalise(queries[:3])), K),
        "five_places": retrieval.retrieve(exact(rng, 5), queries, K),
        "rounded": retrieval.retrieve(rng.normal(size=(203, 24)), smooth, K),
    }
    usual, retrieval.MAP_BLOCK = retrieval.MAP_BLOCK, 13
    lists["in_blocks"] = retrieval.retrieve(on_disk, queries, K)
    retrieval.MAP_BLOCK = usual
    return {
        f"{name}/{part}": np.asarray(values)
        for name, pair in lists.items()
        for part, values in zip(("index", "similarity"), pair, strict=True)
    }


def replayed():
    """Replay more trials than one call takes."""
    usual, score.CHUNK_TRIALS = score.CHUNK_TRIALS, 1
    config = Config(stream=StreamConfig(window=6, branches=5, association="rank"))
    rng = np.random.default_rng(7)
    n = N_TRIALS * LENGTH
    frames = Frame(
        odometry=jnp.asarray(rng.normal(0.5, 0.3, (n, 3)), jnp.float32),
        index=jnp.asarray(rng.integers(-1, 30, (n, 5)), jnp.int32),
        similarity=jnp.asarray(-np.sort(-rng.random((n, 5)), axis=1), jnp.float32),
    )
    poses = np.c_[np.cumsum(rng.uniform(0.5, 1.5, 30)), np.zeros((30, 2))]
    tables = map_tables(poses, config.stream)
    records = score.replay_trials(config, tables, score.in_trials(frames, LENGTH))
    score.CHUNK_TRIALS = usual
    leaves = jax.tree_util.tree_leaves_with_path(records)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def main(folder, *cluster):
    """Do both jobs and leave the results in the folder, each process its own."""
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    if cluster:
        address, n_processes, process = cluster
        jax.distributed.initialize(address, int(n_processes), int(process))
    own = folder / str(jax.process_index())
    own.mkdir()
    np.savez(own / "found.npz", **found(own))
    np.savez(own / "replayed.npz", **replayed())
    counts = [jax.process_count(), jax.device_count(), jax.local_device_count()]
    np.save(own / "counts.npy", counts)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
