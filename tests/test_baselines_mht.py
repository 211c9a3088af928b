"""The tree of hypotheses: bounded stays bounded, unbounded does not."""

import numpy as np
from test_baselines_rivals import easy, noise

from taojax.baselines.mht import MhtParams, mht


def test_the_bounded_tree_never_exceeds_its_width(rng):
    track = mht(noise(rng), MhtParams(width=20))
    assert (track.n_hypotheses[3:] == 20).all()


def test_the_unbounded_tree_grows_until_memory_ends():
    track = mht(easy(), MhtParams(width=None, n_scan=None, memory=5000))
    count = track.n_hypotheses
    end = int(np.argmax(count == 5000))
    assert end > 2
    assert (np.diff(count[: end + 1]) > 0).all()
    assert count[end - 1] > 2 * count[end - 3]
    assert (count[end:] == 5000).all()


def test_a_leaf_without_candidates_is_dead_reckoned():
    frames = easy()
    for t in range(20, 24):
        frames.index[t], frames.similarity[t] = -1, 0.0
    track = mht(frames)
    gap = track.pose[20:24, :2] - frames.map_poses[20:24, :2]
    assert np.hypot(*gap.T).max() < 3.0
    assert (np.diff(track.signal[19:24]) > 0).all()


def test_a_kidnapped_robot_is_found_again():
    frames = easy()
    for name in ("rows", "index", "similarity"):
        array = getattr(frames, name)
        array[25:] = np.concatenate([array[40:], array[:15]])[: len(array) - 25]
    track = mht(frames)
    np.testing.assert_allclose(track.map_index[30:35], np.arange(45, 50), atol=1)
