"""Two answers per frame: a stream gives what a log gives, and nothing looks farther than a lag."""

import jax
import numpy as np
import pytest
from conftest import loop, motions

from taojax.config import VerdictConfig
from taojax.datasets.simulate import WorldConfig, make_world
from taojax.decisions import judged
from taojax.risk import shipped
from taojax.runtime import hindsight
from taojax.runtime.maps import map_tables

CONFIG = VerdictConfig(lag=4, window_frames=4)
AT_ONCE = VerdictConfig(lag=0, window_frames=4)
T, M, C = 41, 60, 20
"""Frames (an odd number: the last block is not full), anchors and candidates of every log here."""


@pytest.fixture(scope="module")
def tables():
    return map_tables(loop(M), None)


def log(rng, *, poses=None, strength=0.6):
    """Drive the loop's first part again: odometry, lists and similarities."""
    poses = loop(M)[:T] if poses is None else poses
    places = loop(M)[:, :2]
    away = np.linalg.norm(poses[:, None, :2] - places[None], axis=2)
    likeness = strength * np.exp(-away / 6.0) + 0.25 * rng.random((len(poses), M))
    index = np.argsort(-likeness, axis=1)[:, :C]
    similarity = np.take_along_axis(likeness, index, axis=1).astype(np.float32)
    return motions(poses).astype(np.float32), index.astype(np.int32), similarity


def dense(rng):
    """The same road at a fifth of the way per frame."""
    angle = np.linspace(0.0, 2.0 * np.pi * T / M / 5, T)
    r = 40.0 * (1.0 + 0.2 * np.cos(3 * angle))
    xy = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    ahead = np.gradient(xy, axis=0)
    return log(rng, poses=np.c_[xy, np.arctan2(ahead[:, 1], ahead[:, 0])])


def standing(rng):
    """Half of the frames see one place from one place."""
    return log(rng, poses=loop(M)[np.r_[np.arange(10), np.full(20, 10), np.arange(11, 22)]])


def broken(rng):
    odometry, index, similarity = log(rng)
    odometry[7] = np.nan
    odometry[20, 2] = np.inf
    similarity[11, 0] = np.nan
    index[12:16] = -1
    index[30, 3:] = -1
    index[31, 2] = 10**6
    return odometry, index, similarity


LOGS = {"driving": log, "dense": dense, "standing still": standing, "broken": broken}


def replayed(config, tables, parts):
    return hindsight.replay_both(config, tables, hindsight.clean(tables, *parts))


def streamed(config, tables, parts):
    """Give a follower one frame at a time; return its answers as one log, and its delays."""
    seen, follower = hindsight.clean(tables, *parts), hindsight.Follower(config, tables)
    now, done, delay = [], [], {}
    for t in range(len(seen.odometry)):
        answer = follower.push(jax.tree.map(lambda leaf, t=t: leaf[t], seen))
        finished = follower.finished()
        assert follower.finished() == []
        now.append(answer)
        done += finished
        delay |= {block.first: t - block.first for block in finished}
    done += follower.flush()
    assert follower.flush() == []
    stack = lambda answers: jax.tree.map(lambda *leaves: np.stack(leaves), *answers)
    join = lambda answers: jax.tree.map(lambda *leaves: np.concatenate(leaves), *answers)
    assert [block.first for block in done] == list(
        range(0, len(now), hindsight.block_frames(config))
    )
    assert_same(join([block.now for block in done]), stack(now))
    return hindsight.Both(stack(now), join([block.final for block in done])), delay


def assert_same(a, b, rows=slice(None)):
    for name in ("pose", "map_index", "covariance", "features", "alone"):
        np.testing.assert_array_equal(getattr(a, name)[rows], getattr(b, name)[rows], err_msg=name)


@pytest.mark.parametrize("config", [CONFIG, AT_ONCE], ids=["lag 4", "lag 0"])
@pytest.mark.parametrize("name", LOGS)
def test_a_stream_gives_what_a_log_gives_to_the_last_bit(name, config, tables, rng):
    parts = LOGS[name](rng)
    both, (live, delay) = replayed(config, tables, parts), streamed(config, tables, parts)
    assert both.now.features.shape == both.final.features.shape == (T, len(hindsight.FEATURES))
    assert_same(both.now, live.now)
    assert_same(both.final, live.final)
    longest = {"driving": 1, "dense": hindsight.LONGEST, "standing still": 1, "broken": 2}[name]
    if config.lag == 0:
        assert_same(both.now, both.final)
        assert set(delay.values()) == {0}
    elif name != "standing still":
        assert config.lag <= min(delay.values())
        assert max(delay.values()) <= config.lag * longest
    else:
        # Nothing but standstill follows: it is waited for no longer than the longest lag.
        assert max(delay.values()) <= config.lag * hindsight.LONGEST


def test_a_follower_forgets_what_no_window_reaches(tables, rng):
    follower = hindsight.Follower(CONFIG, tables)
    seen = hindsight.clean(tables, *log(rng))
    held = []
    for t in range(3 * T):
        follower.push(jax.tree.map(lambda leaf, t=t: leaf[t % T], seen))
        follower.finished()
        held.append(len(follower._seen))
    most = hindsight.reach_frames(CONFIG) + hindsight.LONGEST * CONFIG.lag + 2
    assert max(held) <= most
    assert held[T] >= held[-1] - 2


@pytest.mark.parametrize("name", ["driving", "dense", "broken"])
def test_an_answer_looks_no_farther_ahead_than_its_lag(name, tables, rng):
    parts, t = LOGS[name](rng), 24
    before, other = replayed(CONFIG, tables, parts), log(np.random.default_rng(1))
    changed = [
        np.concatenate([mine[: t + 1], theirs[1 : T - t]])
        for mine, theirs in zip(parts, other, strict=True)
    ]
    after = replayed(CONFIG, tables, changed)
    assert_same(before.now, after.now, slice(0, t + 1))
    assert not np.array_equal(before.now.features[t + 1 :], after.now.features[t + 1 :])
    far = hindsight.reach(CONFIG, tables.places, hindsight.clean(tables, *parts).odometry)
    n = hindsight.block_frames(CONFIG)
    first = np.arange(T) // n * n
    last = first + far.ahead[first]
    if name == "driving":
        assert (last <= np.arange(T) + CONFIG.lag).all()
    assert (far.ahead <= hindsight.LONGEST * CONFIG.lag).all()
    known = last <= t
    assert known.sum() >= 4
    assert_same(before.final, after.final, known)
    assert not np.array_equal(before.final.features[~known], after.final.features[~known])


def test_the_past_counts_no_more_than_its_windows_reach(tables, rng):
    """What happened long ago reaches a frame through the belief alone, not through a window."""
    parts = log(rng)
    both = replayed(CONFIG, tables, parts)
    level = hindsight.FEATURES.index("level_long")
    parts[2][:3] = 0.0
    again = replayed(CONFIG, tables, parts)
    far = hindsight.LONG_PAST * CONFIG.window_frames + 3
    np.testing.assert_allclose(
        both.now.features[far:, level], again.now.features[far:, level], atol=1e-6
    )
    assert not np.allclose(both.now.features[:far, level], again.now.features[:far, level])


def test_each_trial_starts_anew(tables, rng):
    parts = log(rng)
    seen = hindsight.clean(tables, *parts)
    twice = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf]), seen)
    both = hindsight.replay_each(CONFIG, tables, twice, T)
    alone = hindsight.replay_both(CONFIG, tables, seen)
    for kind in ("now", "final"):
        assert_same(getattr(both, kind), getattr(alone, kind), slice(0, T))
        np.testing.assert_array_equal(
            getattr(both, kind).features[T:], getattr(alone, kind).features
        )


def test_a_drive_on_the_map_is_answered_rightly_now_and_better_later(tables, rng):
    both, truth = replayed(CONFIG, tables, log(rng, strength=0.9)), loop(M)[:T, :2]
    now = np.hypot(*(both.now.pose[:, :2] - truth).T)
    final = np.hypot(*(both.final.pose[:, :2] - truth).T)
    gap = float(tables.places.gap_m)
    assert np.median(final) < gap
    assert (final[:6] < 2 * gap).mean() >= (now[:6] < 2 * gap).mean()
    at = hindsight.FEATURES.index("place")
    assert np.median(both.final.features[:, at]) < np.median(both.now.features[:, at]) < 0


# Odd logs and odd maps.


def assert_finite(both, m):
    for answer in both:
        for leaf in jax.tree.leaves(answer):
            assert np.isfinite(np.asarray(leaf, float)).all()
        assert ((answer.map_index >= 0) & (answer.map_index < m)).all()


def test_without_any_candidate_every_number_is_finite(tables, rng):
    odometry, index, similarity = log(rng)
    both = replayed(CONFIG, tables, (odometry, np.full_like(index, -1), 0 * similarity))
    assert_finite(both, M)
    said = dict(zip(hindsight.FEATURES, both.final.features[T // 2], strict=True))
    assert said["level"] == said["vote"] == said["cost"] == 1.0
    p = judged_final(tables, both)[1]
    assert (p > shipped().final.level).all()


def test_broken_odometry_and_lists_leave_every_number_finite(tables, rng):
    assert_finite(replayed(CONFIG, tables, broken(rng)), M)
    odometry, index, similarity = log(rng)
    nothing = np.full_like(odometry, np.nan), index, np.full_like(similarity, np.inf)
    assert_finite(replayed(CONFIG, tables, nothing), M)


def test_a_map_of_one_place_many_times_over_leaves_every_number_finite(rng):
    odd = map_tables(np.tile([3.0, -2.0, 0.5], (M, 1)), None)
    assert_finite(replayed(CONFIG, odd, log(rng)), M)


# The same world in other coordinates.


def judged_final(tables, both):
    """Return final and causal verdicts by the shipped numbers, and the final probabilities."""
    ok = np.full(len(both.now.map_index), "ok", dtype=object)
    final = judged(shipped().final, hindsight.delayed_columns(both.final), ok)
    now = judged(shipped().now, hindsight.now_columns(both.now), ok)
    return np.stack([final[0], now[0]]), final[2]


class Drive:
    """A small simulated world: map, odometry and lists."""

    def __init__(self):
        knobs = {"n_map": 150, "n_query": 161, "dimension": 64, "loop_m": 300.0, "driven_m": 400.0}
        world = make_world(WorldConfig(**knobs), 3)
        codes = lambda table: table / np.linalg.norm(table, axis=1, keepdims=True)
        likeness = codes(world.query_descriptors) @ codes(world.map_descriptors).T
        # A third of the map was never driven: a stretch of the query is off it.
        self.keep = np.arange(150)[: 2 * 150 // 3]
        self.poses = world.map_poses[self.keep, 1:].astype(float)
        self.descriptors = world.map_descriptors[self.keep]
        self.odometry = world.odometry[:, 1:].astype(np.float32)
        likeness = likeness[:, self.keep]
        self.index = np.argsort(-likeness, axis=1, kind="stable")[:, :C].astype(np.int32)
        self.similarity = np.take_along_axis(likeness, self.index, axis=1).astype(np.float32)

    def answered(self, poses=None, odometry=None, order=None):
        poses, descriptors, index = (
            self.poses if poses is None else poses,
            self.descriptors,
            self.index,
        )
        if order is not None:
            poses, descriptors = poses[order], descriptors[order]
            index = np.argsort(order)[index].astype(np.int32)
        tables = map_tables(poses, None, descriptors)
        odometry = self.odometry if odometry is None else odometry.astype(np.float32)
        both = replayed(CONFIG, tables, (odometry, index, self.similarity))
        return tables, both, *judged_final(tables, both)


@pytest.fixture(scope="module")
def drive():
    return Drive()


@pytest.fixture(scope="module")
def plain(drive):
    return drive.answered()


def turned(drive):
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    poses = drive.poses.copy()
    poses[:, :2] = poses[:, :2] @ np.array([[c, -s], [s, c]]).T + [1234.5, -987.6]
    poses[:, 2] += np.pi / 6
    return {"poses": poses}


def mirrored(drive):
    return {"poses": drive.poses * [1, -1, -1], "odometry": drive.odometry * [1, -1, -1]}


def larger(drive):
    return {"poses": drive.poses * [10, 10, 1], "odometry": drive.odometry * [10, 10, 1]}


def shuffled(drive):
    return {"order": np.random.default_rng(2).permutation(len(drive.poses))}


def unmoved(drive, name, pose):
    """Take poses of a changed world back into the plain one."""
    pose = pose.astype(float)
    if name == "mirrored":
        return pose[:, :2] * [1, -1]
    if name == "larger":
        return pose[:, :2] / 10
    if name == "turned":
        c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
        return (pose[:, :2] - [1234.5, -987.6]) @ np.array([[c, -s], [s, c]])
    return pose[:, :2]


def test_the_small_world_has_verdicts_of_every_kind(plain):
    kinds, counts = np.unique(plain[2], return_counts=True)
    assert set(kinds) == {"accept", "reject", "abstain"}
    assert counts.min() > 5


# Share of changed verdicts, and gaps by which nine final answers in ten move at most. Rows only
# change order and metres only their name; a turned or mirrored map lies otherwise on its grid of
# half a gap, so that other anchors are the nearest ones.
WORLDS = {
    "shuffled": (shuffled, 0.0, 1e-3),
    "larger": (larger, 0.01, 0.05),
    "turned": (turned, 0.03, 1.5),
    "mirrored": (mirrored, 0.03, 1.5),
}


@pytest.mark.parametrize("name", WORLDS)
def test_other_coordinates_change_nearly_nothing(name, drive, plain):
    changed, share, gaps = WORLDS[name]
    tables, both, verdicts, p = drive.answered(**changed(drive))
    before, scale = plain[0].places, 10.0 if name == "larger" else 1.0
    gap = float(before.gap_m)
    assert float(tables.places.gap_m) == pytest.approx(scale * gap, rel=1e-4)
    assert float(tables.places.unit_m) == pytest.approx(scale * float(before.unit_m), rel=1e-3)
    assert (verdicts != plain[2]).mean() <= share
    apart = np.hypot(*(unmoved(drive, name, both.final.pose) - plain[1].final.pose[:, :2]).T) / gap
    assert np.quantile(apart, 0.9) <= gaps
    assert np.median(np.abs(p - plain[3])) <= 0.01
