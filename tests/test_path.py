"""How the frames around an answer speak of it, row by row against plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop

from taojax.config import VerdictConfig
from taojax.core.belief import Reading
from taojax.core.path import Window, support
from taojax.runtime import hindsight
from taojax.runtime.maps import map_tables

CONFIG = VerdictConfig(lag=4, window_frames=4)
PLACES = loop(60)
XY = PLACES[:, :2].astype(np.float32)
W, C = 17, 6
NEAR, DRIFT = 2.0, 0.05
"""What an answer is forgiven: gaps, and gaps per gap of way."""


@pytest.fixture(scope="module")
def gap():
    return float(map_tables(PLACES).places.gap_m)


def made(rng, gap):
    """Frames along the map before and after the answer at anchor 20; some lists are wrong."""
    at = 20 + np.arange(W) - W // 2
    pose = PLACES[20] + np.array([0.3, -0.4, 0.08])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    local = (PLACES[at, :2] - pose[:2]) @ np.array([[c, -s], [s, c]])
    local += rng.normal(0, 0.6, local.shape)
    index = (at[:, None] + rng.integers(-2, 9, (W, C))) % 60
    index[3], index[5, 2:], index[6] = -1, -1, (at[6] + 30) % 60
    scaled = np.where(index >= 0, rng.random((W, C)), 0.0)
    way = np.abs(np.arange(W) - W // 2) * 1.3
    weight = rng.random(W) * (np.arange(W) > 0)
    return pose, Window(*(jnp.asarray(a, jnp.float32) for a in (local, way)),
                        jnp.asarray(index, jnp.int32),
                        *(jnp.asarray(a, jnp.float32) for a in (scaled, weight)))  # fmt: skip


def carried(pose, xy):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return xy @ np.array([[c, s], [-s, c]]) + pose[:2]


def plain(pose, window, gap):
    """Return cost, vote, listed, level and sum of weights, written out."""
    xy, way, index, scaled, weight = (np.asarray(leaf, float) for leaf in jax.tree.leaves(window))
    index = index.astype(int)

    def priced(pose):
        relative, price = np.full((W, C), np.inf), np.ones((W, C))
        for i, at in enumerate(carried(pose, xy)):
            for k, anchor in enumerate(index[i]):
                if anchor >= 0:
                    r = np.hypot(*(XY[anchor] - at)) / gap / (NEAR + DRIFT * way[i])
                    bent = r**2 / 2 if r <= 1 else r - 0.5
                    relative[i, k] = r
                    price[i, k] = min(1.0, 0.5 * bent + 0.5 * (1.0 - scaled[i, k]))
        return relative, price

    relative, price = priced(pose)
    best = price.argmin(axis=1)
    own = np.where(relative[np.arange(W), best] <= 1.0, weight, 0.0)
    p = np.r_[xy, np.zeros((1, 2))]
    q = np.r_[XY[index[np.arange(W), best]], pose[None, :2]]
    own = np.r_[own, 1.0]
    pm, qm = (own @ p) / own.sum(), (own @ q) / own.sum()
    h = (own[:, None] * (p - pm)).T @ (q - qm)
    theta = np.arctan2(h[0, 1] - h[1, 0], h[0, 0] + h[1, 1])
    c, s = np.cos(theta), np.sin(theta)
    fitted = np.array([*(qm - np.array([[c, -s], [s, c]]) @ pm), theta])
    relative, price = priced(fitted)
    total = weight.sum()
    return {
        "cost": weight @ price.min(axis=1) / total,
        "vote": weight @ (relative[:, 0] <= 1.0) / total,
        "listed": weight @ (relative <= 1.0).any(axis=1) / total,
        "level": weight @ np.where(index[:, 0] >= 0, scaled[:, 0], 0.0) / total,
        "frames": total,
    }


@pytest.mark.parametrize("seed", range(6))
def test_what_the_frames_around_an_answer_say_equals_numpy(seed, gap):
    pose, window = made(np.random.default_rng(seed), gap)
    got = support(CONFIG, jnp.asarray(XY), jnp.float32(gap), jnp.asarray(pose, jnp.float32), window)
    for name, want in plain(pose, window, gap).items():
        np.testing.assert_allclose(getattr(got, name), want, rtol=2e-4, atol=1e-5, err_msg=name)


def test_way_forgives_and_an_unlisted_frame_costs_one(gap):
    """A frame 2.4 gaps off counts ten gaps of way later, not at once."""
    pose = jnp.asarray(PLACES[20], jnp.float32)
    heading = np.array([np.cos(PLACES[20, 2]), np.sin(PLACES[20, 2])])
    aside = -2.4 * gap * np.array([-heading[1], heading[0]])
    votes, costs = [], []
    for way in (0.0, 10.0):
        local = np.linalg.solve(
            np.stack([heading, [-heading[1], heading[0]]], axis=1), aside
        )  # fmt: skip
        window = Window(
            jnp.asarray(local[None], jnp.float32), jnp.array([way]), jnp.array([[20, -1]]),
            jnp.array([[1.0, 0.0]]), jnp.ones(1),
        )  # fmt: skip
        found = support(CONFIG, jnp.asarray(XY), jnp.float32(gap), pose, window)
        votes.append(float(found.vote))
        costs.append(float(found.cost))
    assert votes == [0.0, 1.0]
    assert costs[1] < costs[0] <= 1.0
    nobody = Window(*(jnp.zeros((1, 2)), jnp.zeros(1), jnp.full((1, 2), -1), jnp.zeros((1, 2)),
                      jnp.ones(1)))  # fmt: skip
    assert support(CONFIG, jnp.asarray(XY), jnp.float32(gap), pose, nobody).cost == 1.0


def test_windows_are_short_usual_and_long_to_the_past_alone(gap):
    """Which frames speak: a quarter lag, a lag to both sides, and three lags back."""
    rng = np.random.default_rng(4)
    places = map_tables(PLACES).places
    pose, window = made(rng, gap)
    paces = np.linspace(-16.0, 16.0, W)  # the lag is 4
    answers = np.c_[carried(pose, np.asarray(window.xy)), np.zeros(W)]
    answers[::3] += 50.0
    reading = Reading(jnp.asarray(pose, jnp.float32), jnp.int32(20), jnp.float32(0.6),
                      jnp.float32(0.1), jnp.float32(0.2), jnp.float32(0.3),
                      jnp.ones(3))  # fmt: skip
    got = dict(zip(hindsight.FEATURES, np.asarray(hindsight._features(
        CONFIG, places, reading, window, jnp.asarray(paces, jnp.float32),
        jnp.asarray(answers, jnp.float32), jnp.float32(0.7),
    )), strict=True))  # fmt: skip
    speaks = {
        "_short": np.abs(paces) <= 1.0,
        "": np.abs(paces) <= 4.0,
        "_long": (np.abs(paces) <= 4.0) | ((paces < 0) & (paces > -12.0)),
    }
    assert [spoken.sum() for spoken in speaks.values()] == [1, 5, 8]
    weights = {end: np.where(on, np.asarray(window.weight), 0.0) for end, on in speaks.items()}
    for end, weight in weights.items():
        part = Window(window.xy, window.way_gaps, window.index, window.scaled,
                      jnp.asarray(weight, jnp.float32))  # fmt: skip
        want = plain(pose, part, gap)
        np.testing.assert_allclose(got[f"cost{end}"], want["cost"], rtol=1e-3, err_msg=end)
        np.testing.assert_allclose(got[f"level{end}"], 1 - want["level"], rtol=1e-3, err_msg=end)
        np.testing.assert_allclose(got[f"vote{end}"], 1 - want["vote"], atol=1e-4, err_msg=end)
    long = weights["_long"]
    agree = long @ (np.arange(W) % 3 != 0) / long.sum()
    np.testing.assert_allclose(got["agree"], 1 - agree, rtol=1e-3)
    np.testing.assert_allclose(got["unseen"], 1 / (1 + weights[""].sum()), rtol=1e-4)
    assert got["own"] == np.float32(0.7)
    for name, p in (("place", 0.4), ("off_map", 0.2), ("elsewhere", 0.1), ("reverse", 0.1)):
        np.testing.assert_allclose(got[name], np.log(p / (1 - p)), rtol=1e-4)
    np.testing.assert_allclose(got["rival"], np.log(0.3), rtol=1e-4)


def test_an_answer_stands_alone_where_neither_its_list_nor_the_end_of_the_lag_names_it(gap):
    rng = np.random.default_rng(5)
    places = map_tables(PLACES).places
    pose, window = made(rng, gap)
    here = W // 2
    reading = Reading(jnp.asarray(pose, jnp.float32), jnp.int32(20), jnp.float32(0.6),
                      jnp.float32(0.1), jnp.float32(0.2), jnp.float32(0.3),
                      jnp.ones(3))  # fmt: skip

    def alone(*, elsewhere, own=hindsight.FARTHEST, there=W):
        """Answers that agree but for some rows, in a log that ends after `there` rows."""
        answers = np.c_[carried(pose, np.asarray(window.xy)), np.zeros(W)]
        answers[list(elsewhere)] += 50.0
        paces = jnp.asarray(np.arange(W) < there, jnp.float32)
        return float(hindsight._alone(
            CONFIG, places, reading, window, paces, jnp.int32(here),
            jnp.asarray(answers, jnp.float32), jnp.float32(own),
        ))  # fmt: skip

    doubt = pytest.approx(0.4)
    ends = range(W - hindsight.END_FRAMES, W)
    assert alone(elsewhere=()) == 0.0
    assert alone(elsewhere=ends) == doubt
    assert alone(elsewhere=ends, own=9.9) == 0.0
    assert alone(elsewhere=list(ends)[:2]) == 0.0
    assert alone(elsewhere=list(ends)[:3]) == doubt
    assert alone(elsewhere=range(ends[0])) == 0.0
    assert alone(elsewhere=(), there=here + 1) == doubt
    assert alone(elsewhere=range(W - 2, W), there=W - 2) == 0.0


@pytest.mark.parametrize("share", [0.11, 0.37, 0.5, 1.0])
def test_windows_reach_as_far_as_so_many_whole_frames_are_driven(share, gap):
    places = map_tables(PLACES).places
    odometry = np.zeros((90, 3), np.float32)
    odometry[:, 0] = share * 0.5 * gap
    far = hindsight.reach(CONFIG, places, odometry)
    driven = np.cumsum(np.full(90, share))
    for t in range(60, 62):
        ahead = next(d for d in range(90 - t) if driven[t + d] - driven[t] >= 4.0 - 1e-3) \
            if driven[-1] - driven[t] >= 4.0 - 1e-3 else 90 - t  # fmt: skip
        assert far.ahead[t] == np.clip(ahead, 4, 20)
        within = sum(driven[t] - driven[j] < 12.0 - 1e-3 for j in range(t + 1))
        assert far.far_back[t] == np.clip(within, 12, 20)
