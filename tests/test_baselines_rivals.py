"""Promises that every rival keeps: finite, causal, at home on easy ground, alarmed off the map."""

import numpy as np
import pytest
from conftest import loop, motions

from taojax.baselines.filters import topological, virtual_place
from taojax.baselines.mht import MhtParams, mht
from taojax.baselines.models import Frames, clean
from taojax.baselines.particles import ParticleParams, particles
from taojax.baselines.sequence import seqslam, sue
from taojax.baselines.topometric import TopometricParams, topometric
from taojax.baselines.trajectory_prior import trajectory_prior

N_MAP, N_QUERY, N_CANDIDATES = 60, 50, 12
INJECTING = ParticleParams(n_particles=300, injection=True)

RIVALS = {
    "topometric": topometric,
    "topometric both ways": lambda f: topometric(f, TopometricParams(both_directions=True)),
    "topological": topological,
    "virtual place": virtual_place,
    "particles": lambda f: particles(f, ParticleParams(n_particles=300)),
    "particles injected": lambda f: particles(f, INJECTING),
    "mht": mht,
    "mht unbounded": lambda f: mht(f, MhtParams(width=None, n_scan=None, memory=500)),
    "seqslam": seqslam,
    "sue": sue,
    "trajectory prior": trajectory_prior,
}
LOCALISERS = sorted(set(RIVALS) - {"sue", "trajectory prior"})


@pytest.fixture(params=sorted(RIVALS))
def rival(request):
    return RIVALS[request.param]


def with_lists(map_poses, odometry, rows, k=N_CANDIDATES):
    """Add the candidate lists that belong to dense rows."""
    rows = rows.astype(np.float32)
    k = min(k, rows.shape[1])
    index = np.argsort(-rows, axis=1, kind="stable")[:, :k].astype(np.int32)
    similarity = np.take_along_axis(rows, index, axis=1)
    index = np.where(similarity == 0, -1, index).astype(np.int32)
    return Frames(map_poses, odometry.astype(np.float32), rows, index, similarity)


def easy(n_query=N_QUERY):
    """A loop driven again without noise; places look alike only to their neighbours."""
    places = loop(N_MAP)
    queries = places[:n_query].copy()
    away = np.abs(np.arange(n_query)[:, None] - np.arange(N_MAP)[None])
    away = np.minimum(away, N_MAP - away)
    return with_lists(places, motions(queries), 0.2 + 0.7 * np.exp(-(away**2) / 2.0))


def noise(rng, n_map=N_MAP, n_query=N_QUERY):
    """Similarities and motions that mean nothing."""
    odometry = rng.normal(0, 1, (n_query, 3))
    return with_lists(loop(n_map), odometry, rng.uniform(0, 1, (n_query, n_map)))


def assert_healthy(track, frames):
    n = len(frames.odometry)
    assert track.signal.shape == (n,)
    assert track.map_index.dtype == np.int32
    assert np.isfinite(track.signal).all()
    assert np.isfinite(track.pose).all()
    assert ((track.map_index >= -1) & (track.map_index < len(frames.map_poses))).all()
    assert (track.pose[track.map_index < 0] == 0).all()


def test_random_frames_give_finite_tracks(rival, rng):
    frames = noise(rng)
    assert_healthy(rival(frames), frames)


def test_standing_still_is_survived(rival, rng):
    frames = noise(rng)._replace(odometry=np.zeros((N_QUERY, 3), np.float32))
    assert_healthy(rival(frames), frames)


def test_a_map_that_never_moves_is_survived(rival, rng):
    frames = noise(rng)._replace(map_poses=np.zeros((N_MAP, 3)))
    assert_healthy(rival(frames), frames)


def test_five_nodes_are_enough(rival, rng):
    frames = noise(rng, n_map=5)
    assert_healthy(rival(frames), frames)


def test_a_single_frame_is_enough(rival, rng):
    frames = noise(rng, n_query=1)
    assert_healthy(rival(frames), frames)


def test_no_candidates_at_all_give_no_place(rival):
    frames = easy()
    frames = with_lists(frames.map_poses, frames.odometry, np.zeros_like(frames.rows))
    track = rival(frames)
    assert_healthy(track, frames)
    assert (track.map_index == -1).all()


def test_equal_similarities_are_survived(rival):
    frames = easy()
    frames = with_lists(frames.map_poses, frames.odometry, np.full_like(frames.rows, 0.5))
    assert_healthy(rival(frames), frames)


def test_similarity_above_one_by_rounding_is_survived(rival):
    frames = easy()
    frames = with_lists(frames.map_poses, frames.odometry, frames.rows / 0.9 * 1.0000002)
    assert_healthy(rival(frames), frames)


def test_future_frames_change_nothing_before_them(rival, rng):
    full, cut = easy(), 30
    other = noise(rng)
    tampered = full._replace(
        **{
            name: np.concatenate([getattr(full, name)[:cut], getattr(other, name)[cut:]])
            for name in ("odometry", "rows", "index", "similarity")
        }
    )
    before, after = rival(full), rival(tampered)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a[:cut], b[:cut])
    assert not np.array_equal(before.signal[cut:], after.signal[cut:])


@pytest.mark.parametrize("name", LOCALISERS)
def test_an_easy_loop_is_followed(name):
    frames = easy()
    track = RIVALS[name](frames)
    gap = track.pose[10:, :2] - frames.map_poses[10:N_QUERY, :2]
    step_m = np.median(np.hypot(*np.diff(frames.map_poses[:, :2], axis=0).T))
    assert np.mean(np.hypot(*gap.T) <= 3.0 * step_m) >= 0.9


@pytest.mark.parametrize("name", ["sue", "trajectory prior"])
def test_retrieval_checks_report_the_top_candidate(name):
    frames = easy()
    np.testing.assert_array_equal(RIVALS[name](frames).map_index, frames.index[:, 0])


def test_the_signal_rises_when_nothing_looks_familiar(rival, rng):
    frames, left = easy(), 25
    rows = frames.rows.copy()
    rows[left:] = rng.uniform(0.15, 0.25, rows[left:].shape)
    signal = rival(with_lists(frames.map_poses, frames.odometry, rows)).signal
    assert np.median(signal[left + 10 :]) > np.median(signal[10:left])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_frame_that_is_not_finite_is_forgotten(rival, value):
    frames = easy()
    frames.odometry[20] = value
    frames.rows[20] = value
    frames.similarity[20] = value
    track = rival(frames)
    assert_healthy(track, frames)


def test_cleaning_leaves_healthy_frames_alone(rng):
    frames = noise(rng)
    for a, b in zip(frames, clean(frames), strict=True):
        np.testing.assert_array_equal(a, b)
