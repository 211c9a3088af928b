"""Trials side by side equal trials one by one, and what rivals say is sealed like the rest."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import write_folder

from taojax.cli import main
from taojax.config import Config, StreamConfig, replace
from taojax.errors import InputError
from taojax.files import records
from taojax.runtime import rivals
from taojax.runtime.frames import Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.score import in_trials, replay_log, replay_trials, score

SMALL = Config(stream=StreamConfig(window=6, branches=5))
RANK = replace(SMALL, {"association": "rank"})
"""Compiles in a fraction of the time; what is tested does not depend on it."""

LENGTH = 10


@pytest.fixture(scope="module")
def trials():
    rng = np.random.default_rng(7)
    poses = np.c_[np.cumsum(rng.uniform(0.5, 1.5, 30)), np.zeros((30, 2))]
    frames = Frame(
        odometry=jnp.asarray(rng.normal(0.5, 0.3, (5 * LENGTH, 3)), jnp.float32),
        index=jnp.asarray(rng.integers(-1, 30, (5 * LENGTH, 5)), jnp.int32),
        similarity=-jnp.sort(-jnp.asarray(rng.random((5 * LENGTH, 5)), jnp.float32), axis=1),
    )
    return map_tables(poses, SMALL.stream), frames


@pytest.mark.parametrize("batch", [1, 2, None])
def test_trials_equal_separate_replays(batch, trials):
    tables, frames = trials
    config = SMALL
    together = replay_trials(config, tables, in_trials(frames, LENGTH), batch=batch)
    assert together.pose.shape == (5 * LENGTH, 3)
    for number in range(5):
        cut = slice(number * LENGTH, (number + 1) * LENGTH)
        alone = replay_log(config, tables, jax.tree.map(lambda leaf, c=cut: leaf[c], frames))
        part = jax.tree.map(lambda leaf, c=cut: leaf[c], together)
        np.testing.assert_array_equal(part.status, alone.status)
        np.testing.assert_array_equal(part.has_pose, alone.has_pose)
        np.testing.assert_allclose(part.pose, alone.pose, rtol=1e-4, atol=1e-4)
        for name, values in alone.signals.items():
            close = {"rtol": 1e-3, "atol": 1e-3}
            np.testing.assert_allclose(part.signals[name], values, err_msg=name, **close)


def test_more_trials_than_one_chunk(trials, monkeypatch):
    tables, frames = trials
    cut = in_trials(frames, LENGTH)
    whole = replay_trials(RANK, tables, cut)
    monkeypatch.setattr("taojax.runtime.score.CHUNK_TRIALS", 2)
    chunked = replay_trials(RANK, tables, cut)
    np.testing.assert_array_equal(whole.status, chunked.status)
    np.testing.assert_allclose(whole.pose, chunked.pose, atol=1e-5)


def test_a_folder_of_trials_starts_afresh_every_time(rng, tmp_path):
    folder = write_folder(tmp_path / "data", rng)
    (folder / "about.toml").write_text("trial_frames = 25\n")
    score(folder, tmp_path / "run", RANK)
    signals = records.read_run(tmp_path / "run").signals
    assert signals["frame"].tolist() == list(range(50))
    warm = signals["status"] == "warming_up"
    assert np.flatnonzero(warm).tolist() == [0, 1, 25, 26]


@pytest.fixture
def two_rivals(monkeypatch):
    few = {name: rivals.SYSTEMS[name] for name in ("mht", "seqslam")}
    monkeypatch.setattr("taojax.runtime.rivals.SYSTEMS", few)


def test_rivals_are_sealed_and_read_back(rng, tmp_path, two_rivals):
    folder = write_folder(tmp_path / "data", rng)
    (folder / "about.toml").write_text("trial_frames = 25\n")
    manifest = score(folder, tmp_path / "run", RANK, rival_logs=1)
    run = records.read_run(tmp_path / "run")
    assert manifest["tracks"] == ["tao_rank", "mht", "seqslam"]
    assert run.tracks is not None
    assert list(run.tracks) == manifest["tracks"]
    rank = run.tracks["tao_rank"]
    np.testing.assert_allclose(rank.signal, run.signals["tao_rank"], rtol=1e-4, atol=1e-5)
    for name in ("mht", "seqslam"):
        track = run.tracks[name]
        assert np.isfinite(track.signal[:25]).all()
        assert np.isnan(track.signal[25:]).all()
        assert not track.has_pose[25:].any()
        assert track.pose.shape == (50, 3)
    assert np.isfinite(rank.signal).all()


def test_rivals_leave_our_own_bytes_alone(rng, tmp_path, two_rivals):
    folder = write_folder(tmp_path / "data", rng)
    score(folder, tmp_path / "a", RANK)
    score(folder, tmp_path / "b", RANK, rival_logs=1)
    for name in records.SEALED:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert records.read_run(tmp_path / "a").tracks is None


def test_rivals_of_a_list_folder(rng, tmp_path, two_rivals):
    folder = write_folder(tmp_path / "data", rng)
    index = rng.integers(0, 60, (50, 7)).astype(np.int32)
    similarity = -np.sort(-rng.random((50, 7)).astype(np.float32), axis=1)
    np.savez(folder / "query/retrievals.npz", index=index, similarity=similarity)
    score(folder, tmp_path / "run", RANK, rival_logs=1)
    tracks = records.read_run(tmp_path / "run").tracks
    assert tracks is not None
    assert np.isfinite(tracks["seqslam"].signal).all()


def test_a_flipped_byte_in_the_tracks_breaks_the_seal(rng, tmp_path, two_rivals):
    folder = write_folder(tmp_path / "data", rng)
    score(folder, tmp_path / "run", RANK, rival_logs=0)
    path = tmp_path / "run" / "tracks.npz"
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)
    with pytest.raises(InputError, match=r"tracks\.npz: seal broken"):
        records.read_run(tmp_path / "run")


def test_the_names_of_the_tracks_are_under_the_seal(rng, tmp_path, two_rivals):
    folder = write_folder(tmp_path / "data", rng)
    score(folder, tmp_path / "run", RANK, rival_logs=1)
    path = tmp_path / "run" / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["tracks"] = manifest["tracks"][::-1]
    path.write_text(json.dumps(manifest))
    with pytest.raises(InputError, match="manifest was edited"):
        records.read_run(tmp_path / "run")


def test_rival_logs_need_rivals(data_folder, tmp_path, capsys):
    words = ["score", str(data_folder), "--out", str(tmp_path / "run"), "--rival-logs", "1"]
    assert main(words) == 2
    assert "--rivals" in capsys.readouterr().err
