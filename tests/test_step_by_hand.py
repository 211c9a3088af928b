"""Every signal of a step, row by row, against plain NumPy; weights; one clear error."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_step as by_hand

from taojax.config import StreamConfig, VerdictConfig
from taojax.errors import InputError
from taojax.files.records import signal_names
from taojax.runtime import hindsight
from taojax.runtime.frames import STATUSES, Frame
from taojax.runtime.maps import map_tables
from taojax.runtime.stream import init, replay, step

CONFIG = StreamConfig(
    window=by_hand.N,
    branches=by_hand.K,
    lambda_velocity=by_hand.LAMBDA,
    gamma_similarity=by_hand.GAMMA,
    tau_masks=by_hand.TAU,
    delta_spacings=by_hand.DELTAS,
    mask_deltas=by_hand.MASKS,
    entropy_temperature=by_hand.TEMPERATURE,
    eps=by_hand.EPS,
)
RANK = dataclasses.replace(CONFIG, association="rank")
TABLES = eqx.tree_at(
    lambda t: t.scale, map_tables(by_hand.PLACES), jnp.array([0.1, 0.9], jnp.float32)
)
ROUNDING = {"c_geom": 1e-2, "a_aniso": 1e-2, "h_proxy": 1e-2}


def frames_of(odometry, index, similarity, weight=None):
    return Frame(
        *(None if a is None else jnp.asarray(a) for a in (odometry, index, similarity, weight))
    )


@pytest.fixture(scope="module", params=[1, 2])
def drive(request):
    """Records of both associations, and what NumPy says of the same frames."""
    data = by_hand.made(request.param)
    frames = frames_of(*data)
    got = [jax.tree.map(np.asarray, replay(c, TABLES, frames)[1]) for c in (CONFIG, RANK)]
    return *got, *by_hand.Stream(TABLES, *data).rows(), request.param


def test_no_signal_is_left_out_and_the_drives_are_hard(drive):
    assert any(answer["is_second"] for answer in drive[3])
    assert {*drive[2][0], "tao"} == set(signal_names())


@pytest.mark.parametrize("name", sorted({*signal_names()} - {"tao"}))
def test_a_signal_equals_numpy_in_every_row(name, drive):
    joint, rows = drive[0], drive[2]
    want = np.array([row[name] for row in rows])
    assert np.ptp(want) > 0.01
    rtol = ROUNDING.get(name, 2e-3)
    np.testing.assert_allclose(joint.signals[name], want, rtol=rtol, atol=1e-3)


def test_tao_is_the_literal_cost_or_that_along_the_filters_path_and_the_doubt_of_its_place(drive):
    joint, rank, rows = drive[:3]
    np.testing.assert_allclose(rank.signals["tao"], [r["tao_rank"] for r in rows], rtol=2e-3)
    odometry, index, similarity, _ = by_hand.made(drive[4])
    seen = hindsight.clean(TABLES, odometry, index, similarity)
    said = hindsight.now_columns(hindsight.replay_both(VerdictConfig(), TABLES, seen).now)
    doubt = 1 / (1 + np.exp(-said["now_place"].astype(float)))
    assert np.ptp(doubt) > 0.1
    np.testing.assert_allclose(joint.signals["tao"], said["now_cost_long"] + doubt, atol=1e-4)
    answered = joint.status == STATUSES.index("ok")
    np.testing.assert_array_equal(joint.map_index[answered], said["now_map_index"][answered])
    np.testing.assert_allclose(joint.pose[answered, 0], said["now_x_m"][answered], atol=1e-3)


def test_the_answer_of_the_best_rank_branch_equals_numpy(drive):
    _, rank, _, answers, _ = drive
    for t, answer in enumerate(answers):
        if t >= 2 and answer["index"] >= 0:
            assert rank.map_index[t] == answer["index"]
            np.testing.assert_allclose(rank.pose[t, :2], answer["pose"][:2], atol=0.02)


def literal(weight, seed=1):
    odometry, index, similarity, _ = by_hand.made(seed)
    return replay(RANK, TABLES, frames_of(odometry, index, similarity, weight))[1].signals[
        "tao_rank"
    ]


def test_equal_weights_are_no_weights():
    np.testing.assert_allclose(literal(np.full(by_hand.T, 7.0, "f4")), literal(None), rtol=1e-5)


def test_bad_weights_count_as_none_and_windows_without_any_weigh_all_alike():
    good = np.ones(by_hand.T, "f4")
    bad = good.copy()
    good[[4, 9]], bad[4], bad[9] = 0.0, np.nan, -3.0
    np.testing.assert_array_equal(literal(good), literal(bad))
    np.testing.assert_allclose(literal(0 * good), literal(None), rtol=1e-5)


def test_a_frame_that_weighs_nothing_is_out_of_eq_1():
    odometry, index, similarity, _ = by_hand.made(1)
    weight = np.ones(by_hand.T, "f4")
    weight[20] = 0.0
    spoilt = index.copy()
    spoilt[20] = np.roll(index[20], 3)[::-1]
    a, b = (
        replay(RANK, TABLES, frames_of(odometry, i, similarity, weight))[1].signals["tao_rank"]
        for i in (index, spoilt)
    )
    # Its velocity steps are out as well.
    np.testing.assert_array_equal(a, b)


WRONG = {
    "odometry": (jnp.zeros(4), "frame.odometry: expected floats of shape (3), got float32 (4,)"),
    "index": (
        jnp.zeros(7),
        "frame.index: expected whole numbers of shape (C), got float32 (7,) beside similarity (7,)",
    ),
    "similarity": (jnp.zeros((2, 7)), "frame.similarity: expected floats of shape (C)"),
    "weight": (jnp.ones(3), "frame.weight: expected floats of shape (), got float32 (3,)"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_frame_of_wrong_shape_or_type_raises_one_line(name):
    value, words = WRONG[name]
    good = Frame(jnp.zeros(3), jnp.zeros(7, jnp.int32), jnp.zeros(7), jnp.ones(()))
    bad = eqx.tree_at(lambda f: getattr(f, name), good, value)
    with pytest.raises(InputError) as caught:
        step(RANK, TABLES, init(RANK, TABLES), bad)
    assert str(caught.value).startswith(words)
    assert len(str(caught.value).splitlines()) == 1


def test_a_list_instead_of_an_array_and_a_single_frame_instead_of_a_log_raise_one_line():
    frame = Frame(jnp.zeros(3), jnp.zeros(7, jnp.int32), jnp.zeros(7))
    listed = eqx.tree_at(lambda f: f.odometry, frame, [0.0, 0.0, 0.0])
    with pytest.raises(InputError, match=r"frame\.odometry: expected floats .*, got list"):
        step(RANK, TABLES, init(RANK, TABLES), listed)
    with pytest.raises(InputError, match=r"frame\.odometry: expected floats of shape \(T, 3\)"):
        replay(RANK, TABLES, frame)


@pytest.mark.parametrize("changes", [{"window": 9}, {"branches": 3}, {"association": "joint"}])
def test_a_state_of_other_settings_or_another_map_raises_one_line(changes):
    frame = Frame(jnp.zeros(3), jnp.zeros(7, jnp.int32), jnp.zeros(7))
    other = dataclasses.replace(RANK, **changes)
    with pytest.raises(InputError, match="state: of other settings or another map"):
        step(RANK, TABLES, init(other, TABLES), frame)
    small = map_tables(by_hand.PLACES[:20])
    with pytest.raises(InputError, match="state: of other settings or another map"):
        step(CONFIG, TABLES, init(CONFIG, small), frame)


@pytest.mark.parametrize(
    ("poses", "views", "words"),
    [
        (np.zeros((5, 2)), None, r"poses: expected \(M, 3\) finite numbers, got \(5, 2\)"),
        (np.zeros((0, 3)), None, "poses: expected"),
        (np.full((5, 3), np.nan), None, "finite"),
        (by_hand.PLACES, np.zeros((3, 8)), r"descriptors: expected \(60, D\), got \(3, 8\)"),
    ],
)
def test_a_map_of_wrong_shape_raises_one_line(poses, views, words):
    with pytest.raises(InputError, match=words):
        map_tables(poses, None, views)
