"""The filter over the map's anchors: what is probable stays one, and both directions agree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taojax.config import VerdictConfig
from taojax.core.belief import (
    Belief,
    carried,
    carried_back,
    combined,
    paced,
    predict,
    read,
    uninformed,
    weigh,
)
from taojax.core.se2 import inverse
from taojax.runtime.maps import map_tables

CONFIG = VerdictConfig(lag=4, window_frames=4)
M, GAP = 48, 2.0
DRIVEN = np.tile(np.float32([GAP, 0.0, 0.0]), (30, 1))


def line(m=M):
    """A straight road, driven eastwards."""
    return np.stack([GAP * np.arange(m), np.zeros(m), np.zeros(m)], axis=1)


@pytest.fixture(scope="module")
def places():
    return map_tables(line(), None).places


def total(belief):
    return float(jnp.sum(belief.mass) + belief.off)


def random_belief(rng, m=M):
    mass, off = rng.random((2, m)).astype(np.float32), np.float32(rng.random())
    scale = mass.sum() + off
    return Belief(jnp.asarray(mass / scale), jnp.asarray(off / scale))


def listed(anchors, strength=1.0):
    """One frame's list: these anchors, the first best."""
    index = np.full(3, -1, np.int32)
    index[: len(anchors)] = anchors
    evidence = np.where(index >= 0, strength * np.array([4.0, 2.0, 1.0]), 0.0)
    return jnp.asarray(index), jnp.asarray(evidence, jnp.float32)


step = jax.jit(predict)


@given(
    motion=st.tuples(*(st.floats(-40, 40),) * 2, st.floats(-4, 4)),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=60, deadline=None)
def test_no_motion_loses_or_makes_probability(motion, seed, places):
    belief = random_belief(np.random.default_rng(seed))
    after = step(CONFIG, places, belief, jnp.asarray(motion, jnp.float32))
    assert total(after) == pytest.approx(1.0, abs=1e-5)
    assert float(jnp.min(after.mass)) >= 0.0
    assert 0.0 <= float(after.off) <= 1.0


@pytest.mark.parametrize("motion", [[1e4, 0, 0], [0, 0, 0], [0, 0, np.pi], [1e-7, 0, 0]])
def test_the_farthest_and_the_least_motions_leave_a_belief(motion, places, rng):
    after = step(CONFIG, places, random_belief(rng), jnp.asarray(motion, jnp.float32))
    assert total(after) == pytest.approx(1.0, abs=1e-5)


def test_whoever_drives_far_beyond_the_map_is_off_it(places):
    at = Belief(jnp.zeros((2, M)).at[0, 20].set(1.0), jnp.zeros(()))
    gone = step(CONFIG, places, at, jnp.array([1e3, 0.0, 0.0]))
    assert float(gone.off) == pytest.approx(1.0, abs=1e-5)
    beside = step(CONFIG, places, at, jnp.array([0.0, 30.0, 0.0]))
    assert float(beside.off) == pytest.approx(1.0, abs=1e-5)


def test_a_step_moves_the_belief_by_a_step_and_leaves_a_little_off_the_map(places):
    at = Belief(jnp.zeros((2, M)).at[0, 20].set(1.0), jnp.zeros(()))
    ahead = step(CONFIG, places, at, jnp.array([3 * GAP, 0.0, 0.0]))
    assert int(jnp.argmax(ahead.mass[0])) == 23
    assert float(ahead.mass[1].sum()) == 0.0
    # `leave` counts per unit of way, and three gaps are more than one unit of an unknown map.
    assert 0.9 * CONFIG.leave < float(ahead.off) < 0.1
    other = Belief(jnp.zeros((2, M)).at[1, 20].set(1.0), jnp.zeros(()))
    back = step(CONFIG, places, other, jnp.array([3 * GAP, 0.0, 0.0]))
    assert int(jnp.argmax(back.mass[1])) == 17


def test_the_inverse_motion_carries_it_back(places):
    at = Belief(jnp.zeros((2, M)).at[0, 20].set(1.0), jnp.zeros(()))
    due, motion = jnp.asarray(True), jnp.array([3 * GAP, 0.0, 0.0])
    back = carried_back(CONFIG, places, carried(CONFIG, places, at, motion, due), motion, due)
    assert int(jnp.argmax(back.mass[0])) == 20
    still = carried(CONFIG, places, at, motion, jnp.asarray(False))
    np.testing.assert_array_equal(still.mass, at.mass)


def test_an_empty_list_says_nothing(places, rng):
    belief = random_belief(rng)
    after = weigh(belief, *listed([]))
    np.testing.assert_allclose(after.mass, belief.mass, rtol=1e-6)
    np.testing.assert_allclose(after.off, belief.off, rtol=1e-6)


def drive(places, odometry, anchors, config=CONFIG, strength=1.0):
    """Filter a drive; return the readings."""
    belief, pending = uninformed(config, places.grid.xy.shape[0]), jnp.zeros(3)

    @jax.jit
    def one(belief, pending, motion, index, evidence):
        motion, due, pending, weight = paced(config, places, pending, motion)
        belief = weigh(carried(config, places, belief, motion, due), index, weight * evidence)
        return belief, pending, read(config, places, belief, pending)

    said = []
    for motion, seen in zip(odometry, anchors, strict=True):
        belief, pending, reading = one(
            belief, pending, jnp.asarray(motion), *listed(seen, strength)
        )
        said.append(reading)
    return said


def test_a_drive_along_the_map_is_found(places):
    said = drive(places, DRIVEN, [[t + 5, t + 6, 40 - t] for t in range(30)])
    pose = np.stack([reading.pose for reading in said])
    np.testing.assert_allclose(pose[10:, 0], GAP * (np.arange(10, 30) + 5), atol=GAP)
    np.testing.assert_allclose(pose[10:, 1:], 0.0, atol=1e-4)
    assert abs(int(said[-1].map_index) - 34) <= 1
    assert float(said[-1].here) > 0.95
    assert float(said[-1].off) < 0.02
    assert float(said[-1].rival) < 1e-3


def test_the_same_road_driven_the_other_way_is_found_and_the_pose_faces_back(places):
    said = drive(places, DRIVEN, [[40 - t, 41 - t, t + 2] for t in range(30)])
    pose = np.stack([reading.pose for reading in said])
    np.testing.assert_allclose(pose[10:, 0], GAP * (40 - np.arange(10, 30)), atol=GAP)
    np.testing.assert_allclose(np.cos(pose[10:, 2]), -1.0, atol=1e-4)
    assert float(said[-1].here) > 0.95
    assert float(said[-1].turned) < 0.02


def test_anchors_of_both_directions_are_one_road(rng):
    """The second half of the map drove back on the same road: its anchors face the other way."""
    there = line(24)
    back = there[::-1] + [0.5, 0.0, np.pi]
    both = map_tables(np.concatenate([there, back]), None).places
    # Odd frames see the anchors of the way there, even ones those of the way back.
    seen = [[t] if t % 2 else [47 - t] for t in range(2, 20)]
    said = drive(both, DRIVEN[:18], seen)
    pose = np.stack([reading.pose for reading in said])
    np.testing.assert_allclose(pose[8:, 0], GAP * np.arange(10, 20), atol=1.5 * GAP)
    np.testing.assert_allclose(np.cos(pose[8:, 2]), 1.0, atol=1e-3)
    assert float(said[-1].here) > 0.95


def test_without_evidence_nothing_is_certain(places):
    said = drive(places, DRIVEN, [[]] * 30)
    assert float(said[-1].here) < 0.1
    # Where leaving and coming back balance.
    balance = CONFIG.leave / (CONFIG.leave + CONFIG.come_back)
    assert float(said[-1].off) == pytest.approx(balance, abs=0.02)


def test_a_place_travelled_the_other_way_is_told_apart_from_here(places):
    mass = np.zeros((2, M), np.float32)
    mass[0, 10:13] = [0.1, 0.3, 0.1]
    mass[1, 11] = 0.2
    mass[0, 25] = 0.05
    belief = Belief(jnp.asarray(mass), jnp.float32(0.25))
    got = read(CONFIG, places, belief, jnp.zeros(3))
    np.testing.assert_allclose([got.here, got.turned, got.off], [0.5, 0.2, 0.25], atol=1e-6)
    assert got.map_index == 11
    np.testing.assert_allclose(got.rival, 0.05 / 0.5, rtol=1e-5)


def test_covariance_is_that_of_one_place_and_at_least_a_cell(places):
    said = drive(places, DRIVEN, [[t + 5] for t in range(30)])
    x, y, xy = np.asarray(said[-1].covariance)
    assert x >= (0.5 * GAP) ** 2
    assert y == pytest.approx((0.5 * GAP) ** 2)
    assert xy == pytest.approx(0.0, abs=1e-6)
    assert x < (CONFIG.place_gaps * GAP) ** 2


def test_quarter_steps_give_nearly_the_same_belief(places):
    """Motions are gathered: a transition over a quarter of a cell would only blur."""
    whole = drive(places, DRIVEN, [[t + 5, t + 6] for t in range(30)])
    # The evidence of a frame counts by its way, so four quarters say what one whole frame says.
    near = np.floor(4.75 + np.arange(120) / 4).astype(int)
    fine = drive(places, np.repeat(DRIVEN / 4, 4, axis=0), [[at, at + 1] for at in near])[3::4]
    for a, b in zip(whole[5:], fine[5:], strict=True):
        # Between two transitions the lists pull ahead by less than the gap that is still pending.
        np.testing.assert_allclose(a.pose, b.pose, atol=GAP)
        assert float(a.off) == pytest.approx(float(b.off), abs=0.02)
        assert float(a.here) == pytest.approx(float(b.here), abs=0.05)


def test_a_frame_where_the_robot_stands_still_counts_nothing(places):
    still = np.zeros((5, 3), np.float32)
    seen = [[t + 5] for t in range(20)]
    moved = drive(places, DRIVEN[:20], seen)
    stood = drive(places, np.concatenate([DRIVEN[:20], still]), seen + [[40]] * 5)
    np.testing.assert_array_equal(moved[-1].pose, stood[-1].pose)
    assert float(moved[-1].here) == float(stood[-1].here)


# The same transition and a textbook forward-backward, written densely in plain NumPy.


def flat(belief):
    return np.r_[np.asarray(belief.mass, float).ravel(), float(belief.off)]


def dense(config, places, motion):
    """Return the transition (2m + 1, 2m + 1), row = after, before it is brought to sum one.

    What an anchor receives stands in its row; what no anchor receives is off the map.
    """
    grid, gap = places.grid, float(places.gap_m)
    xy, facing = np.asarray(grid.xy, float), np.asarray(grid.facing, float)
    m, driven = len(xy), np.hypot(motion[0], motion[1])
    units = min(1.0, driven / float(places.unit_m))
    on, off = (1 - config.leave) ** units, (1 - config.come_back) ** units
    variance = (0.5 * gap) ** 2 + (0.15 * driven) ** 2
    near, away = np.asarray(grid.neighbour), np.asarray(grid.neighbour_m2, float)
    spread = np.zeros((m, m))
    for anchor in range(m):
        weight = np.exp(-0.5 * away[:, anchor] / variance)
        spread[anchor, near[:, anchor]] = weight / weight.sum()
    out = np.zeros((2 * m + 1, 2 * m + 1))
    c, s = np.cos(-motion[2]), np.sin(-motion[2])
    for anchor in range(m):
        face = np.array([[c, -s], [s, c]]) @ facing[anchor]
        step_xy = np.array([[face[0], -face[1]], [face[1], face[0]]]) @ motion[:2]
        for direction, sign in ((0, -1.0), (1, 1.0)):
            at = xy[anchor] + sign * step_xy
            source = int(np.argmin(((xy - at) ** 2).sum(axis=1)))
            if ((xy[source] - at) ** 2).sum() >= (config.reach_gaps * gap) ** 2:
                continue
            same = direction if facing[source] @ face >= 0 else 1 - direction
            row = direction * m + anchor
            out[row, same * m : same * m + m] = on * spread[source]
    out[:-1, -1] = (1 - off) / (2 * m)
    out[-1] = 1.0 - out[:-1].sum(axis=0)
    return out


def ring(m=14):
    """A closed road, on which no anchor is the last one."""
    angle = 2 * np.pi * np.arange(m) / m
    radius = 0.5 * GAP / np.sin(np.pi / m)
    xy = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([xy, angle[:, None] + np.pi / 2 + np.pi / m], axis=1)


def along(poses, n):
    """Return the motion from one anchor of the ring to the n-th after it."""
    c, s = np.cos(poses[0, 2]), np.sin(poses[0, 2])
    dx, dy = poses[n, :2] - poses[0, :2]
    return np.array([c * dx + s * dy, c * dy - s * dx, 2 * np.pi * n / len(poses)])


@pytest.mark.parametrize("motion", [[2.6, 0.2, 0.05], [-1.0, 3.0, 2.5], [0.0, 0.0, 0.4]])
def test_a_transition_is_that_of_plain_loops(motion, rng):
    for poses in (ring(), line(14)):
        places = map_tables(poses, None).places
        belief = random_belief(rng, 14)
        units = min(1.0, np.hypot(*motion[:2]) / float(places.unit_m))
        off = float(belief.off) * (1.0 - CONFIG.come_back) ** units
        want = dense(CONFIG, places, np.array(motion)) @ flat(belief)
        # Beyond the end of a road two anchors come from one: more arrives than there was.
        want[-1] = max(want[-1], off)
        got = flat(step(CONFIG, places, belief, jnp.asarray(motion, jnp.float32)))
        np.testing.assert_allclose(got, want / want.sum(), atol=1e-5)


def test_forward_and_backward_are_those_of_a_dense_hidden_markov_model(rng):
    poses, m, n = ring(), 14, 9
    places = map_tables(poses, None).places
    motions = [along(poses, rng.integers(1, 4)) for _ in range(n)]
    lists = [listed([t, (3 * t) % m], strength=0.7) for t in range(n)]
    due = jnp.asarray(True)
    evidence = []
    for index, log in lists:
        one = np.ones(m)
        kept = np.asarray(index) >= 0
        one[np.asarray(index)[kept]] = np.exp(np.asarray(log, float)[kept])
        evidence.append(np.r_[one, one, 1.0])

    prior = uninformed(CONFIG, m)
    belief, alpha, ours, forward = prior, flat(prior), [], []
    steps = [dense(CONFIG, places, motion) for motion in motions]
    for motion, matrix, seen, e in zip(motions, steps, lists, evidence, strict=True):
        alpha = (matrix @ alpha) * e
        alpha /= alpha.sum()
        forward.append(alpha)
        belief = carried(CONFIG, places, belief, jnp.asarray(motion, jnp.float32), due)
        belief = weigh(belief, *seen)
        ours.append(belief)
        np.testing.assert_allclose(flat(belief), alpha, atol=1e-5)

    # Backwards the filter starts from its prior and runs over reversed motions; `combined` takes
    # out the prior that both halves hold. The textbook's messages are columns of the transition.
    behind, theirs, beta, apart = prior, flat(prior), np.ones(2 * m + 1), []
    for t in range(n - 1, -1, -1):
        got = flat(combined(CONFIG, ours[t], behind))
        want = forward[t] * theirs / flat(prior)
        np.testing.assert_allclose(got, want / want.sum(), atol=2e-5)
        textbook = forward[t] * beta / (forward[t] @ beta)
        apart.append(0.5 * np.abs(got - textbook).sum())
        assert np.argmax(got) == np.argmax(textbook)
        motion = jnp.asarray(motions[t], jnp.float32)
        behind = carried_back(CONFIG, places, weigh(behind, *lists[t]), motion, due)
        theirs = dense(CONFIG, places, np.asarray(inverse(motion))) @ (evidence[t] * theirs)
        theirs /= theirs.sum()
        beta = steps[t].T @ (evidence[t] * beta)
        beta /= beta.sum()
    assert max(apart) < 0.02


def test_hindsight_decides_between_two_places_that_look_the_same(places):
    """What is seen later tells of a frame whose own list knows two places."""
    n, due, motion = 12, jnp.asarray(True), jnp.asarray(DRIVEN[0])
    here, there = np.arange(n) + 2, np.arange(n) + 26
    log = np.stack([np.where(np.arange(n) < 8, 3.1, 0.0), np.full(n, 3.0)], axis=1)
    lists = [
        (jnp.asarray([here[t], there[t]], jnp.int32), jnp.asarray(log[t], jnp.float32))
        for t in range(n)
    ]
    move = jax.jit(lambda belief, motion: carried(CONFIG, places, belief, motion, due))
    forward, behind = uninformed(CONFIG, M), uninformed(CONFIG, M)
    for seen in lists[:6]:
        forward = weigh(move(forward, motion), *seen)
    for seen in lists[:5:-1]:
        behind = move(weigh(behind, *seen), inverse(motion))
    now = read(CONFIG, places, forward, jnp.zeros(3))
    final = read(CONFIG, places, combined(CONFIG, forward, behind), jnp.zeros(3))
    assert abs(int(now.map_index) - 7) <= 1
    assert float(now.rival) > 0.3
    assert abs(int(final.map_index) - 31) <= 1
    assert float(final.here) > 0.95
