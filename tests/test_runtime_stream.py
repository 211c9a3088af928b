"""One frame in, one record out: causal, finite, compiled once, the same in every grouping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import loop, motions

from taojax.config import Config, StreamConfig
from taojax.files.records import signal_names
from taojax.runtime import score
from taojax.runtime.frames import STATUSES, Frame
from taojax.runtime.maps import MapTables, map_spacing_m, map_tables
from taojax.runtime.stream import init, replay, step

SMALL = StreamConfig(window=8, branches=6)
RANK = StreamConfig(window=8, branches=6, association="rank")
T, M = 40, 60


def log(rng, n=T, kept=10):
    places, queries = loop(M), loop(n)
    tables = map_tables(places)
    distance = np.linalg.norm(queries[:, None, :2] - places[None, :, :2], axis=-1)
    rows = np.exp(-distance / 10) + rng.normal(0, 0.02, distance.shape)
    index = np.argsort(-rows, axis=1)[:, :kept].astype(np.int32)
    similarity = np.clip(np.take_along_axis(rows, index, 1), -1, 1).astype(np.float32)
    frames = Frame(
        jnp.asarray(motions(queries), jnp.float32), jnp.asarray(index), jnp.asarray(similarity)
    )
    return tables, frames


def at(frames, t):
    return jax.tree.map(lambda leaf: leaf[t], frames)


def test_every_signal_of_the_spec_is_recorded(rng):
    tables, frames = log(rng)
    _, records = replay(SMALL, tables, frames)
    assert set(records.signals) == set(signal_names())


def test_stream_and_batch_give_the_same_records(rng):
    tables, frames = log(rng)
    _, batch = replay(SMALL, tables, frames)
    state, single = init(SMALL, tables), []
    for t in range(T):
        state, record = step(SMALL, tables, state, at(frames, t))
        single.append(record)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *single)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=1e-4), batch, stacked
    )


def test_chunks_give_the_bits_of_one_scan(rng, monkeypatch):
    tables, frames = log(rng)
    frames = jax.tree.map(np.asarray, frames)
    whole = score.replay_log(Config(stream=SMALL), tables, frames)
    monkeypatch.setattr(score, "CHUNK_FRAMES", 16)
    chunks = score.replay_log(Config(stream=SMALL), tables, frames)
    jax.tree.map(np.testing.assert_array_equal, whole, chunks)


def test_step_compiles_once(rng):
    tables, frames = log(rng)
    traces = []

    @jax.jit
    def counted(state, frame):
        traces.append(1)
        return step(SMALL, tables, state, frame)

    state = init(SMALL, tables)
    for t in range(5):
        state, _ = counted(state, at(frames, t))
    assert len(traces) == 1


def test_state_keeps_shapes_and_dtypes(rng):
    tables, frames = log(rng)
    before = init(SMALL, tables)
    after, _ = step(SMALL, tables, before, at(frames, 0))
    shape = lambda tree: jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)
    assert shape(before) == shape(after)


def test_future_frames_cannot_change_the_past(rng):
    tables, full = log(rng)
    tampered = Frame(
        full.odometry.at[25:].set(-9.0), full.index.at[25:].set(3), full.similarity.at[25:].set(0.1)
    )
    _, a = replay(SMALL, tables, full)
    _, b = replay(SMALL, tables, tampered)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[:25], y[:25]), a, b)
    assert not np.array_equal(a.signals["tao"][25:], b.signals["tao"][25:])


def test_the_literal_cost_equals_a_plain_rewrite_over_the_window(rng):
    tables, frames = log(rng)
    _, records = replay(SMALL, tables, frames)
    poses, n = np.zeros((T, 3)), SMALL.window
    for t in range(1, T):
        x, y, a = poses[t - 1]
        dx, dy, da = np.asarray(frames.odometry[t], float)
        poses[t] = [
            x + np.cos(a) * dx - np.sin(a) * dy,
            y + np.sin(a) * dx + np.cos(a) * dy,
            a + da,
        ]
    xy, spacing = np.asarray(tables.places.grid.xy, float), float(tables.spacing_m)
    delta, mask = 3 * spacing, 9 * spacing
    for t in (2, n - 1, T - 1):
        past = np.arange(max(0, t - n + 1), t + 1)
        want = min(
            sum(
                reference.masked_cost(
                    poses[past, :2],
                    xy[np.asarray(frames.index)[past, k]],
                    np.asarray(frames.similarity, float)[past, k],
                    np.ones(len(past), bool),
                    np.full(len(past), 1 / len(past)),
                    lam=1.0,
                    gamma=1.0,
                    tau=0.0,
                    delta=delta,
                    mask=mask,
                )[:3]
            )
            for k in range(SMALL.branches)
        )
        np.testing.assert_allclose(records.signals["tao_rank"][t], want, rtol=1e-3)


def test_the_best_branch_finds_the_robot_on_an_easy_loop(rng):
    tables, frames = log(rng)
    _, records = replay(SMALL, tables, frames)
    error = np.linalg.norm(np.asarray(records.pose)[5:, :2] - loop(T)[5:, :2], axis=1)
    assert np.median(error) < 3 * float(tables.spacing_m)
    assert (np.asarray(records.status)[5:] == STATUSES.index("ok")).mean() > 0.9


def test_the_first_two_frames_are_warming_up_without_a_pose(rng):
    tables, frames = log(rng)
    _, records = replay(SMALL, tables, frames)
    assert [STATUSES[s] for s in records.status[:3]] == ["warming_up", "warming_up", "ok"]
    np.testing.assert_array_equal(records.map_index[:2], [-1, -1])
    assert not records.has_pose[:2].any()


def test_windowed_top1_is_the_mean_of_the_frames_so_far(rng):
    tables, frames = log(rng)
    _, records = replay(SMALL, tables, frames)
    top1 = np.asarray(records.signals["top1"])
    for n in (5, 10, 20):
        want = [top1[max(0, t - n + 1) : t + 1].mean() for t in range(T)]
        np.testing.assert_allclose(records.signals[f"top1_w{n}"], want, rtol=1e-5)


def finite(records):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(records))


def test_frames_without_candidates_are_flagged_and_the_stream_recovers(rng):
    tables, frames = log(rng)
    gone = Frame(frames.odometry, frames.index.at[20].set(-1), frames.similarity)
    _, records = replay(SMALL, tables, gone)
    assert STATUSES[int(records.status[20])] == "no_candidates"
    assert finite(records)
    # Nothing is said of the frame; the next one is where it would have been.
    assert int(records.map_index[20]) == -1
    assert not bool(records.has_pose[20])
    assert np.linalg.norm(records.pose[21, :2] - loop(T)[21, :2]) < 3 * float(tables.spacing_m)
    _, healthy = replay(SMALL, tables, frames)
    after = slice(20 + SMALL.window, None)
    a, b = (r.signals["tao_rank"][after] for r in (records, healthy))
    np.testing.assert_allclose(a, b, rtol=1e-5)


@pytest.mark.parametrize("field", ["odometry", "similarity"])
def test_nan_in_one_frame_hurts_only_the_windows_that_contain_it(field, rng):
    tables, frames = log(rng)
    broken = {name: getattr(frames, name) for name in ("odometry", "index", "similarity")}
    broken[field] = broken[field].at[12].set(jnp.nan)
    _, records = replay(SMALL, tables, Frame(**broken))
    assert finite(records)
    _, healthy = replay(SMALL, tables, frames)
    for name in ("tao_rank_vel", "support", "sue"):
        a, b = np.asarray(records.signals[name]), np.asarray(healthy.signals[name])
        np.testing.assert_array_equal(a[:12], b[:12])
        np.testing.assert_allclose(a[12 + SMALL.window :], b[12 + SMALL.window :], rtol=1e-5)
    # The filter looks three windows back: the frame stands in the path without support.
    tao, unharmed = (np.asarray(r.signals["tao"]) for r in (records, healthy))
    np.testing.assert_array_equal(tao[:12], unharmed[:12])
    np.testing.assert_allclose(tao[-1], unharmed[-1], atol=0.1)


ODD = {
    "standing still": lambda f: Frame(jnp.zeros_like(f.odometry), f.index, f.similarity),
    "one anchor for ever": lambda f: Frame(f.odometry, jnp.full_like(f.index, 7), f.similarity),
    "constant similarity": lambda f: Frame(f.odometry, f.index, jnp.full_like(f.similarity, 0.5)),
    "no candidates at all": lambda f: Frame(f.odometry, jnp.full_like(f.index, -1), f.similarity),
    "rows outside the map": lambda f: Frame(f.odometry, f.index + 1000, f.similarity),
    "jumps of hundreds of metres": lambda f: Frame(
        f.odometry.at[::7, 0].set(900.0), f.index, f.similarity
    ),
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_streams_give_finite_numbers_and_a_status_on_every_frame(kind, rng):
    tables, frames = log(rng)
    _, records = replay(SMALL, tables, ODD[kind](frames))
    assert finite(records)
    assert set(np.asarray(records.status)) <= set(range(len(STATUSES)))


def test_standing_still_is_degenerate(rng):
    tables, frames = log(rng)
    config = StreamConfig(window=8, branches=6, association="rank", lambda_velocity=0.0)
    _, records = replay(config, tables, ODD["standing still"](frames))
    assert {STATUSES[s] for s in np.asarray(records.status)[5:]} == {"degenerate"}


def test_rank_association_makes_tao_the_literal_cost(rng):
    tables, frames = log(rng)
    _, rank = replay(RANK, tables, frames)
    _, joint = replay(SMALL, tables, frames)
    np.testing.assert_array_equal(rank.signals["tao"], rank.signals["tao_rank"])
    np.testing.assert_allclose(
        rank.signals["tao_rank"], joint.signals["tao_rank"], rtol=1e-4, atol=1e-4
    )
    assert not np.allclose(joint.signals["tao"], joint.signals["tao_rank"])


def test_the_filter_follows_a_drive_in_the_opposite_direction(rng):
    tables, frames = log(rng)
    # The same log backwards: the robot meets every place facing the other way.
    turned = loop(T)[::-1] + np.array([0.0, 0.0, np.pi])
    odometry = jnp.asarray(motions(turned), jnp.float32)
    back = Frame(odometry, frames.index[::-1], frames.similarity[::-1])
    _, records = replay(SMALL, tables, back)
    error = np.linalg.norm(np.asarray(records.pose)[8:, :2] - loop(T)[::-1][8:, :2], axis=1)
    assert np.median(error) < 3 * float(tables.spacing_m)


def test_a_frame_whose_candidates_all_miss_does_not_lose_the_place(rng):
    tables, frames = log(rng)
    wrong = (frames.index[20] + M // 2) % M
    _, records = replay(
        SMALL, tables, Frame(frames.odometry, frames.index.at[20].set(wrong), frames.similarity)
    )
    error = np.linalg.norm(np.asarray(records.pose)[20, :2] - loop(T)[20, :2])
    assert error < 3 * float(tables.spacing_m)


def kidnapped(rng):
    """Two drives spliced: odometry says nothing, the places jump across the loop."""
    tables, frames = log(rng, n=60)
    half = np.r_[0:25, 40:60]
    return tables, jax.tree.map(lambda leaf: leaf[half], frames), loop(60)[half]


def test_a_kidnapped_robot_is_found_again_within_a_few_frames(rng):
    tables, frames, truth = kidnapped(rng)
    _, records = replay(StreamConfig(window=8, branches=6), tables, frames)
    error = np.linalg.norm(np.asarray(records.pose)[:, :2] - truth[:, :2], axis=1)
    assert (error[5:25] < 3 * float(tables.spacing_m)).all()
    assert (error[25 + 6 :] < 3 * float(tables.spacing_m)).all()


def test_spacing_ignores_standstill_and_gaps():
    x = np.r_[np.arange(10.0), 9.0, 9.0, 500.0, np.arange(501.0, 505.0)]
    assert map_spacing_m(np.c_[x, 0 * x]) == 1.0
    assert map_spacing_m(np.zeros((5, 2))) == 1.0


def test_a_sweep_over_a_weight_is_one_vmap(rng):
    tables, frames = log(rng)

    def run(weight):
        config = StreamConfig(window=8, branches=6, association="rank", lambda_velocity=weight)
        return replay(config, tables, frames)[1].signals["tao_rank_vel"]

    swept = jax.vmap(run)(jnp.array([0.0, 1.0]))
    np.testing.assert_array_equal(swept[0], np.zeros(T))
    np.testing.assert_allclose(swept[1], run(1.0), rtol=1e-5)


def test_map_tables_are_32_bits_wide():
    tables: MapTables = map_tables(loop(M))
    assert {leaf.dtype.itemsize for leaf in jax.tree.leaves(tables)} == {4}
