"""Long drives: constant memory, one program, counters that stop, and nothing left of the past."""

import pytest

from benchmarks import reliability_stream as stream


@pytest.mark.parametrize("association", stream.CONFIGS)
def test_a_long_stream_equals_a_fresh_start_on_its_last_frames(association, monkeypatch):
    n = {"rank": 4000, "joint": 1000}[association]
    monkeypatch.setattr(stream, "CHUNK", n // 10)
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
