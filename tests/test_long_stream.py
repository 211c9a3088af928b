"""Long drives and broken frames: constant memory, one program, and nothing left of the past."""

import pytest

from benchmarks import reliability_stream as stream


@pytest.mark.parametrize("association", stream.CONFIGS)
def test_a_long_stream_equals_a_fresh_start_on_its_last_frames(association, monkeypatch):
    n = {"rank": 4000, "joint": 1000}[association]
    # As long as the logs below, so that one compilation serves both.
    monkeypatch.setattr(stream, "CHUNK", 100)
    gone = stream.drive(association, n, single_steps=50)
    assert gone.n_frames == n + 50
    assert (gone.n_bad, gone.n_compiled) == (0, 0)
    assert gone.n_seen == 20
    # One lap is 60 frames: the state holds no more than the window, whatever was driven.
    assert gone.p_m < 100.0
    assert gone.grown_mib < 64.0
    windowed = {n: gap for n, gap in gone.differs.items() if n not in stream.REMEMBERS}
    assert set(windowed.values()) == {0.0}
    assert max(gone.differs.values()) < 1e-3


@pytest.mark.parametrize("association", stream.CONFIGS)
@pytest.mark.parametrize("kind", stream.KINDS)
def test_a_broken_frame_leaves_the_bits_of_an_empty_one(association, kind):
    assert stream.count_differing(association, kind) == 0


def test_the_topometric_filter_as_published_never_recovers_from_one_nan():
    assert stream.poisoned(is_cleaned=False, at=30, n=100) == 70
    assert stream.poisoned(is_cleaned=True, at=30, n=100) == 0
