"""Refinement against scipy, the closed form and finite differences; hopeless branches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.refinement import scipy_optimum
from taojax.core.cost import Branch, CostParams, branch_cost, cost_terms
from taojax.core.refine import (
    CONVERGED,
    DEGENERATE,
    MAX_STEPS,
    NOT_FINITE,
    STATUSES,
    refine,
)

N = 20
WEIGHT = np.full(N, 1.0 / N)


def params(lam=1.0, gamma=1.0, delta=3.0):
    return CostParams(lam, gamma, 20.0, delta, 3.0 * delta)


def window(rng, share=0.3, noise=0.5):
    """A wandering window somewhere in the map, some of its anchors far off."""
    yaw = np.cumsum(rng.normal(0, 0.3, N))
    p = np.cumsum(rng.uniform(0.5, 3) * np.c_[np.cos(yaw), np.sin(yaw)], axis=0)
    p -= p[-1]
    c, s = np.cos(turn := rng.uniform(-np.pi, np.pi)), np.sin(turn)
    q = p @ np.array([[c, -s], [s, c]]).T + rng.uniform(-100, 100, 2)
    q += rng.normal(0, noise, (N, 2))
    far = rng.random(N) < share
    return p, q + np.where(far[:, None], rng.normal(0, 25, (N, 2)), 0.0)


def from_closed_form(settings, p, branch, weight):
    closed = branch_cost(settings, p, branch, weight)
    return closed, refine(settings, p, branch, weight, closed.T_map_odom)


# `jax.jit`: the weights of Eq. 1 are traced, so that new ones do not compile again.
one = jax.jit(from_closed_form)
many = jax.jit(jax.vmap(from_closed_form, in_axes=(None, None, 0, None)))
windows = jax.jit(jax.vmap(from_closed_form, in_axes=(None, 0, 0, None)))
refined = jax.jit(refine)
value_at = jax.jit(lambda *at: sum(cost_terms(*at)))


def branch_of(q, has=None):
    q = jnp.asarray(q)
    shape = q.shape[:-1]
    has = jnp.ones(shape, bool) if has is None else jnp.asarray(has)
    return Branch(q, jnp.full(shape, 0.8, q.dtype), has)


def solve(p, q, has=None, settings=None, weight=WEIGHT):
    p, weight = jnp.asarray(p), jnp.asarray(weight, dtype=p.dtype)
    return one(settings or params(), p, branch_of(q, has), weight)


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("lam", [0.0, 0.7])
def test_reaches_the_optimum_that_scipy_finds_from_the_same_start(x64, lam, rng):
    p, q = (
        np.array(a)
        for a in zip(*(window(rng, rng.uniform(0, 0.6)) for _ in range(60)), strict=True)
    )
    with jax.enable_x64(x64):
        dtype = jnp.result_type(float)
        closed, got = windows(
            params(lam, 0.0),
            jnp.asarray(p, dtype),
            branch_of(jnp.asarray(q, dtype)),
            jnp.asarray(WEIGHT, dtype),
        )
    starts = np.asarray(closed.T_map_odom, float)
    want = [scipy_optimum(s, a, b, lam, 3.0) for s, a, b in zip(starts, p, q, strict=True)]
    assert np.all(np.asarray(got.cost) <= np.array(want) * (1 + 1e-4) + 1e-6)
    assert np.mean(np.asarray(got.status) == CONVERGED) > 0.98
    assert np.mean(np.asarray(got.cost) < 0.999 * np.asarray(closed.total)) > 0.1


@settings(max_examples=80, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(0, 1),
    st.floats(0, 10),
    st.floats(0.0625, 50),
    st.floats(0, 3),
)
def test_never_above_the_start_whatever_the_window(seed, share, lam, delta, scale):
    p, q = (scale * a for a in window(np.random.default_rng(seed), share))
    closed, got = solve(
        p.astype(np.float32), q.astype(np.float32), settings=params(lam, delta=delta)
    )
    assert np.isfinite(np.r_[got.cost, got.T_map_odom]).all()
    assert float(got.cost) <= float(got.start_cost)
    np.testing.assert_allclose(got.start_cost, closed.total, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("lam", [0.0, 1.0])
def test_from_any_start_the_cost_never_rises(lam, rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    for _ in range(20):
        start = jnp.asarray(rng.normal(0, [50, 50, 2]), jnp.float32)
        got = refined(params(lam), jnp.asarray(p), branch_of(q), jnp.asarray(WEIGHT, "f4"), start)
        assert float(got.cost) <= float(got.start_cost)


@pytest.mark.parametrize("trial", range(4))
@pytest.mark.parametrize("lam", [0.0, 1.0])
def test_equals_the_closed_form_where_all_residuals_are_inside_delta(lam, trial, rng):
    p, q = window(rng, share=0.0)
    with jax.enable_x64(True):
        closed, got = solve(p, q, settings=params(lam, delta=50.0))
        np.testing.assert_allclose(got.cost, closed.total, rtol=1e-12)
        np.testing.assert_allclose(got.T_map_odom, closed.T_map_odom, atol=1e-9)
    assert int(got.status) == CONVERGED
    assert int(got.n_steps) <= 2


def test_cost_terms_add_up_to_the_branch_cost_at_its_own_alignment(rng):
    p, q = window(rng)
    has = rng.random(N) > 0.2
    with jax.enable_x64(True):
        closed = solve(p, q, has)[0]
        weight = jnp.asarray(WEIGHT)
        got = value_at(params(), jnp.asarray(p), branch_of(q, has), weight, closed.T_map_odom)
    np.testing.assert_allclose(got, closed.total, rtol=1e-12)


def test_missing_anchors_and_weightless_frames_are_left_out_of_the_solution(rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    has = np.ones(N, bool)
    has[3:6] = False
    spoilt = q.copy()
    spoilt[3:6] = np.nan
    a, b = solve(p, q, has)[1], solve(p, spoilt, has)[1]
    jax.tree.map(np.testing.assert_array_equal, a, b)
    weight = np.r_[np.zeros(4), np.full(N - 4, 1 / (N - 4))]
    spoilt = q.copy()
    spoilt[:4] += 500.0
    a, b = (solve(p, x, weight=weight)[1] for x in (q, spoilt))
    np.testing.assert_allclose(a.T_map_odom, b.T_map_odom, atol=1e-3)


def test_far_from_the_origin_float32_still_finds_the_optimum(rng):
    p, q = window(rng)
    q = (q + [5e3, -8e3]).astype(np.float32)
    closed, got = solve(p.astype(np.float32), q, settings=params(0.5, 0.0))
    want = scipy_optimum(np.asarray(closed.T_map_odom, float), p, q.astype(float), 0.5, 3.0)
    np.testing.assert_allclose(got.cost, want, rtol=1e-3)


line = np.c_[np.arange(N, dtype=np.float32), np.zeros(N, np.float32)]
still = np.zeros((N, 2), np.float32)
DEGENERATES = {
    "no anchors": (line, line, np.zeros(N, bool), WEIGHT),
    "two anchors": (line, line, np.arange(N) < 2, WEIGHT),
    "one distinct anchor": (line, still + np.array([7.3, -123.4], np.float32), None, WEIGHT),
    "standing still": (still + np.float32(0.3), line, None, WEIGHT),
    "zero weights": (line, line, None, np.zeros(N)),
}


@pytest.mark.parametrize("kind", DEGENERATES)
def test_degenerate_windows_are_flagged_finite_and_keep_their_start(kind):
    p, q, has, weight = DEGENERATES[kind]
    closed, got = solve(p, q, has, params(0.0), weight)
    assert STATUSES[int(got.status)] == "degenerate"
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(got))
    np.testing.assert_array_equal(got.T_map_odom, closed.T_map_odom)
    np.testing.assert_array_equal(got.cost, got.start_cost)


def refined_total(p, q, weight, lam, delta, has):
    branch = Branch(q, jnp.full(len(p), 0.8, q.dtype), has)
    return from_closed_form(params(lam, 1.0, delta), p, branch, weight)[1].cost


gradients = jax.jit(jax.grad(refined_total, argnums=(0, 1, 2, 3, 4)))


@pytest.mark.parametrize("kind", [*DEGENERATES, "perfect fit"])
def test_gradients_are_finite_everywhere(kind):
    p, q, has, weight = DEGENERATES.get(kind, (line, line, None, WEIGHT))
    has = np.ones(N, bool) if has is None else has
    arrays = (jnp.asarray(p), jnp.asarray(q), jnp.asarray(weight, "f4"))
    for gradient in gradients(*arrays, 1.0, 3.0, jnp.asarray(has)):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 3e38])
def test_one_bad_branch_leaves_its_neighbours_untouched_to_the_bit(bad, rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    qs = q[None] + rng.normal(0, 4, (5, N, 2)).astype(np.float32)
    good = many(params(), jnp.asarray(p), branch_of(qs), jnp.asarray(WEIGHT, "f4"))[1]
    broken = qs.copy()
    broken[2, 7] = bad
    got = many(params(), jnp.asarray(p), branch_of(broken), jnp.asarray(WEIGHT, "f4"))[1]
    others = np.array([0, 1, 3, 4])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[others], b[others]), good, got)
    assert int(got.status[2]) == NOT_FINITE
    assert not np.isnan(np.r_[got.cost[2], got.T_map_odom[2]]).any()


def test_steps_are_bounded_in_hopeless_branches(rng):
    p = window(rng)[0].astype(np.float32)
    for _ in range(10):
        qs = rng.uniform(-60, 60, (5, N, 2)).astype(np.float32)
        got = many(params(0.0), jnp.asarray(p), branch_of(qs), jnp.asarray(WEIGHT, "f4"))[1]
        assert int(jnp.max(got.n_steps)) <= MAX_STEPS
        assert np.all(np.asarray(got.status) < DEGENERATE)
        assert np.all(np.asarray(got.cost) <= np.asarray(got.start_cost))


def test_float32_windows_are_solved_where_float64_is_enabled(rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    with jax.enable_x64(True):
        got = solve(p, q)[1]
    assert got.cost.dtype == got.T_map_odom.dtype == np.float32


def test_can_be_exported(rng):
    p, q = (a.astype(np.float32) for a in window(rng))

    def cost(p, q):
        return one(params(), p, branch_of(q), jnp.asarray(WEIGHT, "f4"))[1].cost

    exported = jax.export.export(jax.jit(cost))(p, q)
    np.testing.assert_allclose(exported.call(p, q), cost(p, q), rtol=1e-6)


@jax.jit
def totals(q, lam, gamma, delta, p):
    """Closed-form and refined cost."""
    settings = CostParams(lam, gamma, 20.0, delta, 9.0)
    closed, better = from_closed_form(settings, p, branch_of(q), jnp.asarray(WEIGHT))
    return jnp.stack([closed.total, better.cost])


slopes = jax.jit(jax.jacrev(totals, argnums=(0, 1, 2, 3)))


@pytest.mark.parametrize("trial", range(2))
def test_gradients_in_anchors_lambda_gamma_and_delta_are_exact(trial, rng):
    p, q = window(rng)
    h = 1e-5
    with jax.enable_x64(True):
        point = [jnp.asarray(a) for a in (q, 0.7, 1.3, 2.5)]
        got = slopes(*point, jnp.asarray(p))
        for place, gradient in enumerate(got):
            flat = np.asarray(point[place]).ravel()
            for i in range(0, flat.size, 7):
                ends = []
                for sign in (h, -h):
                    moved = flat.copy()
                    moved[i] += sign
                    there = list(point)
                    there[place] = jnp.asarray(moved.reshape(point[place].shape))
                    ends.append(np.asarray(totals(*there, jnp.asarray(p))))
                want = (ends[0] - ends[1]) / (2 * h)
                exact = np.asarray(gradient).reshape(2, -1)[:, i]
                np.testing.assert_allclose(exact, want, rtol=1e-4, atol=1e-6)
