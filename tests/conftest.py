"""Strict JAX settings for every test, and small data folders to run on."""

import contextlib
import os
import time
import zlib
from pathlib import Path

# Subprocesses and tests share nothing but the CPU: no accelerator, no preallocation.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Workers, commands in fresh interpreters and the next session share what is compiled.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(Path(__file__).parents[1] / ".pytest_cache" / "jax")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
# The oldest JAX alarms at every entry that it reads, though it wrote it itself.
os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

import jax
import numpy as np
import pytest

ALONE = {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
"""For processes that compile side by side, or whose own compiling is what is tried."""

WEEK_S = 7 * 24 * 3600

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def pytest_sessionstart():
    """Forget what was compiled a week ago: most of it is of code that has changed."""
    for entry in Path(os.environ["JAX_COMPILATION_CACHE_DIR"]).glob("*-cache"):
        with contextlib.suppress(FileNotFoundError):
            if time.time() - entry.stat().st_mtime > WEEK_S:
                entry.unlink()


KEPT = []


def _surroundings():
    """Return what an interpreter takes over from the one that starts it."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    streams = [(os.fstat(fd).st_dev, os.fstat(fd).st_ino) for fd in (1, 2)]
    return os.getcwd(), own, streams


@pytest.fixture(scope="module", autouse=True)
def kept_child():
    """Keep one interpreter for the verbs of many tests: most of their time is start and compiling.

    It is what a command that scores many data folders does anyway; after a failure it ends.
    """
    from taojax.cli import child

    run, end, start = child.run, child._end, child.start

    def borrow():
        if KEPT:
            other, surroundings = KEPT.pop()
            if other.process.poll() is None and surroundings == _surroundings():
                return other
            end([other])
        return start()

    def run_and_keep(commands, most=1):
        done, code = [], 1
        child.start, child._end = borrow, done.extend
        try:
            code = run(commands, most)
        finally:
            child.start, child._end = start, end
            if code == 0 and done and not KEPT:
                KEPT.append((done.pop(), _surroundings()))
            end(done)
        return code

    child.run = run_and_keep
    yield
    child.run = run


def pytest_sessionfinish():
    """Let it end."""
    for other, _ in KEPT:
        other.close()
        other.process.wait()
        os.close(other.codes)


@pytest.fixture
def rng(request):
    """A generator seeded by the test's own name: one seed per test, the same every time."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture(scope="session")
def shared():
    """The folder with real recordings beside the checkout; tests that need it skip without it."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("real recordings not found: ../shared/data is absent")
    return folder


def loop(n, radius_m=40.0):
    """Poses once around a wobbly loop, driving counter-clockwise."""
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    r = radius_m * (1.0 + 0.2 * np.cos(3 * angle))
    xy = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    step = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    return np.concatenate([xy, np.arctan2(step[:, 1], step[:, 0])[:, None]], axis=1)


def motions(poses):
    """Body-frame motion between consecutive poses; row 0 is zero."""
    out = np.zeros_like(poses)
    step = np.diff(poses[:, :2], axis=0)
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    out[1:, 0] = c * step[:, 0] + s * step[:, 1]
    out[1:, 1] = -s * step[:, 0] + c * step[:, 1]
    out[1:, 2] = np.angle(np.exp(1j * np.diff(poses[:, 2])))
    return out


def table(path, header, rows):
    """Write a CSV the way a user's script would."""
    path.parent.mkdir(parents=True, exist_ok=True)
    body = "\n".join(",".join(f"{v:.6f}" for v in row) for row in rows)
    path.write_text(f"{header}\n{body}\n")


def write_folder(folder, rng, *, n_map=60, n_query=50, dim=16):
    """Write a small data folder: a loop, driven again with a little noise."""
    places = loop(n_map)
    queries = loop(n_query)
    queries[:, :2] += rng.normal(0, 0.3, (n_query, 2))
    codes = rng.normal(size=(n_map, dim))
    nearest = np.argmin(((queries[:, None, :2] - places[None, :, :2]) ** 2).sum(-1), axis=1)
    seen = codes[nearest] + rng.normal(0, 0.4, (n_query, dim))
    pose = "t_s,x_m,y_m,theta_rad"
    table(folder / "map/poses.csv", pose, np.c_[np.arange(n_map), places])
    table(folder / "truth/query_poses.csv", pose, np.c_[np.arange(n_query), queries])
    odometry = motions(queries)
    odometry[1:] += rng.normal(0, 0.01, (n_query - 1, 3))
    table(
        folder / "query/odometry.csv",
        "t_s,dx_m,dy_m,dtheta_rad",
        np.c_[np.arange(n_query), odometry],
    )
    np.save(folder / "map/descriptors.npy", codes.astype(np.float32))
    np.save(folder / "query/descriptors.npy", seen.astype(np.float32))
    return folder


@pytest.fixture
def data_folder(tmp_path, rng):
    """A small, healthy data folder."""
    return write_folder(tmp_path / "data", rng)
