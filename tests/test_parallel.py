"""Eight devices, and two processes of two devices each, say what one device says."""

import os
import socket
import subprocess
import sys

import jax
import numpy as np
import on_devices
import pytest
from conftest import ALONE

from taojax.runtime import parallel

PATIENCE_S = 600
"""For a machine that does other things too."""


def run(folder, n_devices, *clusters):
    """Run the jobs in one process for each cluster line, all at once; return their folders."""
    flags = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={n_devices}"}
    children = [
        subprocess.Popen(
            [sys.executable, "-W", "error", on_devices.__file__, folder, *line],
            env=os.environ | ALONE | flags,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for line in clusters
    ]
    try:
        said = [child.communicate(timeout=PATIENCE_S)[0] for child in children]
    finally:
        for child in children:
            child.kill()
    for child, words in zip(children, said, strict=True):
        assert child.returncode == 0, words
    return [folder / str(process) for process in range(len(children))]


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    assert parallel.device_mesh().size == 1
    found = on_devices.found(tmp_path_factory.mktemp("one"))
    return {"found": found, "replayed": on_devices.replayed()}


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    return run(tmp_path_factory.mktemp("eight"), 8, ())


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{listener.getsockname()[1]}"
    return run(tmp_path_factory.mktemp("cluster"), 2, (address, "2", "0"), (address, "2", "1"))


@pytest.mark.parametrize(("where", "counts"), [("eight", [1, 8, 8]), ("cluster", [2, 4, 2])])
def test_more_devices_find_the_same_bits(where, counts, one, request):
    for folder in request.getfixturevalue(where):
        assert np.load(folder / "counts.npy").tolist() == counts
        with np.load(folder / "found.npz") as got:
            assert set(got) == set(one["found"])
            for name, want in one["found"].items():
                # Sums that round depend on how many rows one product has.
                atol = 1e-6 if name == "rounded/similarity" else 0.0
                np.testing.assert_allclose(got[name], want, rtol=0, atol=atol, err_msg=name)


@pytest.mark.parametrize("where", ["eight", "cluster"])
def test_more_devices_replay_the_same_up_to_the_last_bit(where, one, request):
    for folder in request.getfixturevalue(where):
        with np.load(folder / "replayed.npz") as got:
            assert set(got) == set(one["replayed"])
            for name, want in one["replayed"].items():
                # XLA fuses a program for many devices in another way, which moves last bits.
                close = {"rtol": 1e-5, "atol": 1e-5}
                np.testing.assert_allclose(got[name], want, err_msg=name, **close)


def test_ties_and_padding_are_met_by_these_jobs(one):
    similarity, index = one["found"]["prepared/similarity"], one["found"]["prepared/index"]
    is_tie = np.diff(similarity, axis=1) == 0
    assert is_tie.mean() > 0.5
    assert (np.diff(index, axis=1)[is_tie] > 0).all()
    assert (one["found"]["five_places/index"][:, 5:] == -1).all()


def test_placed_and_gathered_is_unchanged(rng):
    tree = {"a": rng.normal(size=(6, 2)).astype(np.float32), "b": np.arange(3)}
    mesh = parallel.device_mesh()
    for where in (parallel.CUT, parallel.WHOLE):
        placed = parallel.place(tree, mesh, where)
        assert isinstance(placed["a"], jax.Array)
        jax.tree.map(np.testing.assert_array_equal, parallel.gather(placed), tree)
