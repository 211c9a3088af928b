"""Hostile windows: finite, flagged, as near to a float64 rewrite as stated."""

import numpy as np
import pytest

from benchmarks import reliability_numbers as numbers


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_hostile_windows_agree_with_a_float64_rewrite(dtype):
    found, worst = numbers.windows(500, dtype)
    bad = {name: n for name, n in found.items() if not name.endswith((": ok", ": undecided"))}
    assert bad == {}
    assert worst < 1.0
    undecided = sum(n for name, n in found.items() if name.endswith("undecided"))
    assert undecided < 0.15 * found.total()


def test_the_judge_of_windows_sees_a_wrong_fit(rng):
    batch = numbers.make_windows(rng, 20, np.float64)
    at = next(i for i in range(20) if numbers.KINDS[int(batch.kind[i])] in ("noisy", "rigid"))
    kinds = {numbers.judge(batch, at, 0, changed(batch, at, by), 1e-16).outcome for by in (1, 9)}
    assert kinds == {"wrong fit", "not finite"}


def changed(batch, at, by):
    """Costs of a batch, of which one alignment is turned: a little, or into NaN."""
    shape = (len(batch.kind), numbers.N_BRANCHES)
    T = np.zeros((*shape, 3))
    T[at] = np.nan if by == 9 else 1e6
    zeros = np.zeros(shape)
    costs = {"geom": zeros, "vel": zeros, "sim": zeros}
    flags = {"T_map_odom": T, "is_inlier": None, "is_degenerate": np.zeros(shape, bool)}
    return type("Costs", (), costs | flags)
