"""The topometric filter agrees with the original program, and is free of its faults."""

import numpy as np
import pytest
from conftest import loop, motions
from scipy.stats import spearmanr
from test_baselines_rivals import easy, with_lists

from taojax.audit.labels import nearest_map_distance
from taojax.audit.metrics import auroc, far_at_95
from taojax.baselines.topometric import TopometricParams, map_segments, topometric
from taojax.runtime.retrieval import normalise

# In-map and map-out radius [m], AUROC and FAR at 95 % of the original program.
PEERS = {
    "mit_corridor": (5.0, 10.0, 0.658, 0.972),
    "intel_lab": (1.5, 3.0, 0.608, 0.909),
    "tuc_corridor_mapout": (2.0, 4.0, 0.925, 0.266),
}


def read(path):
    return np.loadtxt(path, delimiter=",", skiprows=1)[:, 1:]


def recording(folder):
    """Read a data folder as dense rows."""
    poses = read(folder / "map/poses.csv")
    odometry = read(folder / "query/odometry.csv").astype(np.float32)
    if (folder / "query/retrievals.npz").exists():
        with np.load(folder / "query/retrievals.npz") as lists:
            index, similarity = lists["index"], lists["similarity"]
        rows = np.zeros((len(odometry), len(poses)), np.float32)
        frame, rank = np.nonzero(index >= 0)
        rows[frame, index[frame, rank]] = similarity[frame, rank]
    else:
        codes = [normalise(np.load(folder / part / "descriptors.npy")) for part in ("query", "map")]
        rows = codes[0] @ codes[1].T
    return with_lists(poses, odometry, rows)


@pytest.fixture(scope="module", params=sorted(PEERS))
def peer(request, shared):
    folder = shared.parent / "peers"
    if not folder.is_dir():
        pytest.skip("outputs of the original program not found: ../shared/peers is absent")
    frames = recording(shared / request.param)
    with np.load(folder / f"{request.param}.npz") as stored:
        return request.param, shared, frames, topometric(frames), dict(stored)


def test_off_map_score_ranks_frames_as_the_original_does(peer):
    _, _, _, track, stored = peer
    assert spearmanr(track.signal, stored["off_map_score"]).statistic >= 0.98
    assert np.mean(track.map_index == stored["map_index"]) >= 0.9


def test_off_map_score_is_no_weaker_than_the_original(peer):
    name, shared, frames, track, _ = peer
    r_in, r_out, original_auroc, original_far = PEERS[name]
    truth = read(shared / name / "truth/query_poses.csv")
    nearest = nearest_map_distance(truth[:, :2], frames.map_poses[:, :2])
    is_labelled = (nearest <= r_in) | (nearest > r_out)
    is_labelled[:2] = False
    signal, is_out = track.signal[is_labelled], nearest[is_labelled] > r_out
    assert auroc(signal, is_out) >= original_auroc - 0.005
    assert far_at_95(signal, is_out) <= original_far + 0.02


def test_a_broken_frame_is_forgotten_within_ten_frames():
    healthy, broken = easy(), easy()
    broken.rows[20], broken.odometry[20] = np.nan, np.nan
    a, b = topometric(healthy), topometric(broken)
    np.testing.assert_allclose(a.signal[30:], b.signal[30:], atol=0.02)
    np.testing.assert_array_equal(a.map_index[30:], b.map_index[30:])


def test_standing_still_keeps_the_place():
    frames = easy()
    rows = np.concatenate([frames.rows[:20], np.repeat(frames.rows[20:21], 30, axis=0)])
    odometry = frames.odometry.copy()
    odometry[21:] = 0.0
    track = topometric(with_lists(frames.map_poses, odometry, rows))
    assert (track.map_index[25:] == 20).all()
    assert track.signal[-1] < 0.1


def backwards():
    places = loop(60)
    queries = places[40:10:-1] + np.array([[0.0, 0.0, np.pi]])
    away = np.abs(np.arange(60)[None] - np.arange(40, 10, -1)[:, None])
    rows = 0.3 + 0.3 * np.exp(-(away**2) / 2.0)
    return with_lists(places, motions(queries), rows)


def test_reverse_travel_is_followed_when_asked_for():
    frames = backwards()
    one_way = topometric(frames)
    both = topometric(frames, TopometricParams(both_directions=True))
    np.testing.assert_allclose(both.map_index[10:], np.arange(30, 10, -1), atol=1)
    assert both.signal[10:].mean() < 0.5 * one_way.signal[10:].mean()


def test_map_seams_of_the_heading_do_not_move_the_segments():
    poses = loop(30)
    plain = map_segments(poses, 10, both_directions=True)
    wrapped = poses.copy()
    wrapped[:, 2] = np.angle(np.exp(1j * (poses[:, 2] + 2.0)))
    turned = poses + np.array([[0.0, 0.0, 2.0]])
    np.testing.assert_allclose(
        map_segments(wrapped, 10, both_directions=False).start,
        map_segments(turned, 10, both_directions=False).start,
        atol=1e-9,
    )
    assert plain.start.shape == (3, 2, 11, 30)
    assert not plain.is_there[:, 1:, -1].any()


def test_the_signal_is_a_probability():
    frames = easy()
    track = topometric(frames)
    assert track.signal.min() >= 0.0
    assert track.signal.max() <= 1.0 + 1e-6
