"""The trusted past votes on an answer: by hand, and on the ways in which a past can be wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taojax.config import VerdictConfig
from taojax.core import history as past
from taojax.core.se2 import integrate
from taojax.risk import first_look
from taojax.runtime import hindsight

CONFIG = VerdictConfig()
STEP = jnp.array([1.0, 0.0, 0.0])
GAP_M = jnp.asarray(1.0)


def drive(poses, odometry=None, trust=1.0, gap_m=1.0):
    """Ask the past about each pose in turn; straight motion of 1 m a frame when none is given."""
    poses = jnp.asarray(poses, jnp.float32)
    odometry = jnp.broadcast_to(STEP, poses.shape) if odometry is None else jnp.asarray(odometry)
    trust = jnp.broadcast_to(jnp.asarray(trust, jnp.float32), (len(poses),))

    def ask(history, frame):
        return past.contradiction(CONFIG, jnp.asarray(gap_m), history, *frame)

    history, said = jax.lax.scan(ask, past.no_history(), (odometry, poses, trust))
    return history, np.asarray(said)


def line(n, start=0.0, y=0.0, heading=0.0):
    """Poses 1 m apart along x."""
    x = start + np.cos(heading) * np.arange(n)
    return np.stack([x, np.full(n, y), np.full(n, heading)], axis=1)


def by_hand(poses, odometry, trust):
    """Return the same in NumPy, one frame and one witness at a time."""
    odom = np.asarray(integrate(jnp.asarray(odometry)), float)
    held, said, since = [], [], past.HELD_EVERY
    way = np.cumsum(np.hypot(odometry[:, 0], odometry[:, 1]))
    for t, (pose, odo) in enumerate(zip(poses, odom, strict=True)):
        agree = against = 0.0
        for at, weight in held:
            c, s = np.cos(odom[at, 2]), np.sin(odom[at, 2])
            dx, dy = odo[:2] - odom[at, :2]
            forward, left = c * dx + s * dy, c * dy - s * dx
            c, s = np.cos(poses[at][2]), np.sin(poses[at][2])
            x = poses[at][0] + c * forward - s * left
            y = poses[at][1] + s * forward + c * left
            driven = way[t] - way[at]
            vote = weight * np.exp(-driven / 100.0)
            if np.hypot(x - pose[0], y - pose[1]) <= 2 * (2.0 + 0.05 * driven):
                agree += vote
            else:
                against += vote
        said.append(np.log1p(against) - np.log1p(agree))
        since += np.hypot(*odometry[t, :2]) if t else 0.0
        if since >= past.HELD_EVERY:
            held.append((t, trust[t] * (1 + agree) / (1 + agree + against)))
            since = 0.0
    return np.array(said)


def test_the_vote_is_what_is_counted_by_hand(rng):
    n = 80
    odometry = np.c_[rng.uniform(0.0, 1.0, n), rng.normal(0, 0.05, n), rng.normal(0, 0.1, n)]
    odometry[0] = 0.0
    poses = np.asarray(integrate(jnp.asarray(odometry)), float) + rng.normal(0, 0.1, (n, 3))
    poses[30:50, :2] += 25.0
    poses[60] = rng.normal(size=3) * 40
    trust = rng.uniform(size=n)
    got = drive(poses, odometry, trust)[1]
    np.testing.assert_allclose(got, by_hand(poses, odometry, trust), rtol=1e-3, atol=1e-3)


def test_a_drive_that_agrees_with_itself_is_vouched_for_ever_more():
    said = drive(line(50))[1]
    assert said[0] == 0.0
    assert (np.diff(said) < 0).all()
    assert said[-1] < -3.0


@pytest.mark.parametrize("away", [line(40, 300.0, 80.0), line(40, 39.0, 0.0, np.pi)],
                         ids=["elsewhere", "back the way it came"])  # fmt: skip
def test_what_contradicts_the_past_is_doubted_until_it_outlasts_it(away):
    said = drive(np.concatenate([line(40), away]))[1]
    assert said[39] < -2.0
    # Near the turning point a mirrored way is as near as odometry allows.
    assert (said[48:60] > 0.5).all()
    long = drive(np.concatenate([line(40), line(400, 300.0, 80.0)]))[1]
    assert long[-1] < 0.0


def test_a_row_of_contradictions_gains_little_by_its_own_length():
    """Each is held with the weight that the vote leaves it."""
    history, _ = drive(np.concatenate([line(40), line(20, 300.0, 80.0)]))
    trust = np.asarray(history.trust)
    assert (trust[-60:-20] > 0.9).all()
    assert trust[-20:].sum() < 5.0


def test_after_one_false_answer_the_right_ones_are_believed():
    said = drive(np.concatenate([line(30), [[500.0, 0.0, 0.0]], line(10, 31.0)]))[1]
    assert said[30] > 1.0
    assert (said[31:] < -2.0).all()


def test_answers_that_nobody_trusts_have_no_vote():
    said = drive(
        np.concatenate([line(30), line(30, 400.0)]), trust=np.r_[np.zeros(30), np.ones(30)]
    )
    assert said[1][30] == 0.0
    assert said[1][-1] < -2.0


def test_standing_still_is_one_witness():
    n = 200
    odometry = np.tile(np.asarray(STEP), (n, 1))
    odometry[10:190] = 0.0
    poses = np.asarray(integrate(jnp.asarray(odometry)))
    history, _ = drive(poses, odometry)
    assert int((np.asarray(history.trust) > 0).sum()) == 20


def test_the_unit_of_length_is_the_maps_gap(rng):
    poses = np.concatenate([line(30), line(30, 90.0)])
    told = drive(poses)[1]
    larger = drive(poses * [10.0, 10.0, 1.0], np.tile(10.0 * np.asarray(STEP), (60, 1)), gap_m=10.0)
    np.testing.assert_allclose(larger[1], told, atol=1e-4)


def test_only_so_many_are_held_and_every_number_is_finite():
    history, said = drive(line(3 * past.HELD))
    assert history.trust.shape == (past.HELD,)
    assert np.isfinite(said).all()
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(history))


@pytest.mark.parametrize("kind", ["now", "final"])
def test_the_first_look_reads_everything_but_the_past(kind):
    numbers = getattr(first_look(), kind)
    names = tuple(name.removeprefix("now_") for name in numbers.columns)
    assert names == hindsight.FEATURES[:-1]
    assert hindsight.FEATURES[-1] == "contradiction"
    look = hindsight.as_first_look(numbers)
    assert 0.0 < numbers.threshold < 0.5
    trusted = past.first_trust(look, jnp.asarray(numbers.mean - 3 * numbers.scale, jnp.float32))
    doubted = past.first_trust(look, jnp.asarray(numbers.mean + 3 * numbers.scale, jnp.float32))
    assert trusted > 0.9
    assert doubted < 0.1
    # At its threshold an answer counts half.
    even = look.half_trusted
    shift = jnp.log(even / (1.0 - even)) - look.bias
    features = look.mean + look.scale * look.weight * shift / jnp.sum(look.weight**2)
    np.testing.assert_allclose(past.first_trust(look, features), 0.5, atol=1e-3)


def test_a_whole_log_is_asked_as_its_pieces_are(rng):
    n = hindsight.CHUNK + 37
    poses = np.cumsum(rng.normal(0.5, 0.5, (n, 3)), axis=0).astype(np.float32)
    features = rng.normal(size=(n, len(hindsight.FEATURES))).astype(np.float32)
    nothing = np.zeros(n, np.float32)
    answers = hindsight.Answer(
        poses, np.zeros(n, np.int32), np.zeros((n, 3), np.float32), features, nothing
    )
    odometry = rng.normal(0.3, 0.2, (n, 3)).astype(np.float32)
    numbers = first_look().final
    whole = hindsight.recall_log(CONFIG, numbers, 1.5, odometry, answers)
    np.testing.assert_array_equal(whole.features[:, :-1], features[:, :-1])
    first = jax.tree.map(lambda leaf: leaf[:100], answers)
    cut = hindsight.recall_log(CONFIG, numbers, np.full(100, 1.5), odometry[:100], first)
    np.testing.assert_array_equal(cut.features, whole.features[:100])
    assert np.unique(whole.features[:, -1]).size > n // 2
