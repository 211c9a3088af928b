"""The closed form against SVD, scipy and a plain re-write; laws; degenerate windows."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from taojax.core import cost as cost_module
from taojax.core import procrustes
from taojax.core.cost import Branch, CostParams, branch_cost, huber
from taojax.core.procrustes import VectorPairs, diagnose, fit_se2
from taojax.core.se2 import compose, transform

N = 12
one = eqx.filter_jit(branch_cost)
many = eqx.filter_jit(jax.vmap(branch_cost, in_axes=(None, None, 0, None)))
fit = jax.jit(fit_se2)


def params(lam=1.0, gamma=1.0, tau=1.0, delta=3.0, mask=9.0):
    return CostParams(lam, gamma, tau, delta, mask)


def window(rng, n=N, noise=0.5):
    p = np.cumsum(rng.normal(1.0, 0.7, (n, 2)), axis=0)
    p -= p[-1]
    angle, shift = rng.uniform(-3, 3), rng.uniform(-50, 50, 2)
    c, s = np.cos(angle), np.sin(angle)
    q = p @ np.array([[c, -s], [s, c]]).T + shift + rng.normal(0, noise, (n, 2))
    return p, q


def cost(p, q, s=None, has=None, weight=None, settings=None):
    n = len(p)
    s = np.full(n, 0.8) if s is None else s
    has = np.ones(n, bool) if has is None else has
    weight = np.full(n, 1.0 / n) if weight is None else weight
    branch = Branch(jnp.asarray(q), jnp.asarray(np.asarray(s, q.dtype)), jnp.asarray(has))
    return one(
        settings or params(), jnp.asarray(p), branch, jnp.asarray(np.asarray(weight, q.dtype))
    )


KINDS = {
    "random": lambda rng: window(rng),
    "collinear": lambda rng: (np.c_[np.arange(N) - N + 1.0, np.zeros(N)], window(rng)[1]),
    "repeated": lambda rng: tuple(np.repeat(a[::3], 3, axis=0) for a in window(rng)),
    "nearly straight": lambda rng: (
        np.c_[np.arange(N) - N + 1.0, 1e-5 * rng.normal(size=N)],
        np.c_[np.arange(N) * 1.0, 1e-5 * rng.normal(size=N)],
    ),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lam", [0.0, 1.0, 30.0])
def test_closed_form_equals_the_svd_route(kind, lam, rng):
    p, q = KINDS[kind](rng)
    w = rng.uniform(0.1, 1.0, N)
    w /= w.sum()
    steps = (np.diff(x, axis=0, prepend=x[:1]) for x in (p, q))
    with jax.enable_x64(True):
        share = jnp.full(N, 2 * lam / (N - 1)).at[0].set(0.0)
        more = VectorPairs(*map(jnp.asarray, steps), share)
        got = fit(jnp.asarray(p), jnp.asarray(q), jnp.asarray(w), more)
    assert not bool(got.is_degenerate)
    np.testing.assert_allclose(got.T_map_odom, reference.fit(p, q, w, lam), atol=1e-8)


@pytest.mark.parametrize("trial", range(5))
def test_scipy_finds_no_lower_quadratic_cost(trial, rng):
    p, q = window(rng, noise=3.0)
    w = np.full(N, 1.0 / N)
    with jax.enable_x64(True):
        got = np.asarray(cost(p, q, settings=params(delta=1e6, mask=1e7)).T_map_odom)
    best = min(
        (
            scipy.optimize.minimize(
                reference.quadratic, [*q.mean(0), a], (p, q, w, 1.0), "BFGS", tol=1e-12
            )
            for a in np.linspace(-3, 3, 7)
        ),
        key=lambda result: result.fun,
    )
    ours = reference.quadratic(got, p, q, w, 1.0)
    assert ours <= best.fun * (1 + 1e-9)
    np.testing.assert_allclose(ours, best.fun, rtol=1e-9)


@pytest.mark.parametrize("trial", range(8))
def test_masked_cost_equals_a_plain_rewrite(trial, rng):
    p, q = window(rng, n=20)
    q[rng.integers(0, 20, 5)] += rng.normal(0, 40, (5, 2))
    has, s = rng.random(20) > 0.15, rng.uniform(0, 1, 20)
    w = np.full(20, 1 / 20)
    want = reference.masked_cost(p, q, s, has, w, lam=0.7, gamma=2.0, tau=5.0, delta=3.0, mask=9.0)
    with jax.enable_x64(True):
        got = cost(p, q, s, has, w, params(lam=0.7, gamma=2.0, tau=5.0))
    np.testing.assert_allclose([got.geom, got.vel, got.sim], want[:3], rtol=1e-9)
    np.testing.assert_allclose(got.T_map_odom, want[3], atol=1e-8)


def test_float32_is_close_to_float64_on_windows_far_from_the_origin(rng):
    p, q = window(rng)
    q += [5e4, -8e4]
    a = cost(p.astype(np.float32), q.astype(np.float32))
    with jax.enable_x64(True):
        b = cost(p, q.astype(np.float32).astype(np.float64))
    np.testing.assert_allclose(a.total, b.total, rtol=0.02)


def test_moving_the_map_moves_the_alignment_and_keeps_the_cost(rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    move = jnp.array([7.0, -3.0, 1.1])
    moved = transform(jnp.broadcast_to(move, (N, 3)), jnp.asarray(q))
    a, b = cost(p, q), cost(p, np.asarray(moved))
    np.testing.assert_allclose(a.total, b.total, rtol=1e-3)
    np.testing.assert_allclose(compose(move, a.T_map_odom), b.T_map_odom, atol=2e-3)


def test_moving_the_odometry_frame_keeps_the_cost(rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    move = jnp.array([5.0, 2.0, -2.0])
    moved = np.asarray(transform(jnp.broadcast_to(move, (N, 3)), jnp.asarray(p)))
    a, b = cost(p, q), cost(moved, q)
    np.testing.assert_allclose(a.total, b.total, rtol=1e-3)
    np.testing.assert_allclose(compose(b.T_map_odom, move), a.T_map_odom, atol=2e-3)


def test_permuting_branches_permutes_outputs(rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    qs = jnp.asarray(q[None] + rng.normal(0, 2, (6, N, 2)).astype(np.float32))
    order = jnp.asarray(rng.permutation(6))
    branches = Branch(qs, jnp.full((6, N), 0.5), jnp.ones((6, N), bool))
    weight = jnp.full(N, 1.0 / N)
    a = many(params(), jnp.asarray(p), branches, weight)
    shuffled = jax.tree.map(lambda leaf: leaf[order], branches)
    b = many(params(), jnp.asarray(p), shuffled, weight)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[order], y), a, b)


def test_weightless_frames_change_nothing(rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    junk = rng.normal(0, 100, (4, 2)).astype(np.float32)
    w = np.r_[np.zeros(4), np.full(N, 1 / N)]
    a, b = cost(p, q), cost(np.r_[junk, p], np.r_[junk[::-1], q], weight=w)
    np.testing.assert_allclose([a.geom, a.vel, a.sim], [b.geom, b.vel, b.sim], rtol=1e-5)


def test_a_missing_anchor_costs_tau_plus_gamma_of_its_weight(rng):
    p, _ = window(rng)
    p = p.astype(np.float32)
    has = np.ones(N, bool)
    has[3] = False
    got = cost(p, p + np.float32(5.0), np.ones(N), has, settings=params(tau=4.0, gamma=3.0))
    np.testing.assert_allclose(got.total, (4.0 + 3.0) / N, atol=1e-5)


def test_losing_an_anchor_beyond_the_mask_never_makes_a_branch_cheaper(rng):
    p, q = (a.astype(np.float32) for a in window(rng, noise=0.01))
    q[2] += 500.0
    delta, mask = 3.0, 9.0
    settings = params(lam=0.0, tau=delta * (mask - delta / 2), delta=delta, mask=mask)
    has = np.ones(N, bool)
    has[2] = False
    without = cost(p, q, has=has, settings=settings)
    q[2] -= 500.0
    assert float(without.total) > float(cost(p, q, settings=settings).total)


@settings(max_examples=60, deadline=None)
@given(st.floats(0, 1000, width=32, allow_subnormal=False), st.floats(0.125, 50, width=32))
def test_huber_is_quadratic_inside_and_linear_outside(r, delta):
    want = r**2 / 2 if r <= delta else delta * (r - delta / 2)
    got = huber(jnp.float32(r) ** 2, jnp.float32(delta))
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-30)


def test_singular_values_equal_numpy(rng):
    p, q = window(rng)
    w = np.full(N, 1.0 / N)
    with jax.enable_x64(True):
        got = diagnose(jnp.asarray(p), jnp.asarray(q), jnp.asarray(w))
    want = np.linalg.svd(reference.covariance(p, q, w)[0], compute_uv=False)
    np.testing.assert_allclose([got.s1, got.s2], want, rtol=1e-9)
    np.testing.assert_allclose(got.c_geom, want.prod(), rtol=1e-9)
    np.testing.assert_allclose(got.a_aniso, want[0] / want[1], rtol=1e-9)


def test_straight_windows_keep_their_small_singular_value_in_float32(rng):
    x = np.arange(20.0) * 5
    p = np.c_[x, 1e-3 * rng.normal(size=20)]
    q = np.c_[x, 1e-3 * rng.normal(size=20)]
    w = np.full(20, 0.05)
    got = diagnose(*(jnp.asarray(a, jnp.float32) for a in (p, q, w)))
    want = np.linalg.svd(reference.covariance(p, q, w)[0], compute_uv=False)
    assert float(got.s2) > 0
    np.testing.assert_allclose(got.s2, want[1], rtol=0.2)


line = np.c_[np.arange(N, dtype=np.float32), np.zeros(N, np.float32)]
still = np.zeros((N, 2), np.float32)
few = np.zeros(N, bool)
few[:2] = True
DEGENERATE = {
    "standing still": (still, line, None),
    "one distinct anchor": (line, still + 7.0, None),
    "two supported frames": (line, line, few),
    "no supported frame": (line, line, np.zeros(N, bool)),
    "mirror symmetry": (
        np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], np.float32),
        np.array([[1, 0], [0, -1], [-1, 0], [0, 1]], np.float32),
        None,
    ),
}


@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_windows_are_flagged_and_finite(kind):
    p, q, has = DEGENERATE[kind]
    settings = params(lam=0.0)
    got = cost(p, q, has=has, settings=settings)
    assert bool(got.is_degenerate)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(got))


def total(p, q, lam, gamma, delta, has):
    branch = Branch(q, jnp.full(len(p), 0.8), has)
    return branch_cost(params(lam, gamma, 1.0, delta), p, branch, jnp.full(len(p), 0.1)).total


gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3, 4)))


@pytest.mark.parametrize("kind", [*DEGENERATE, "perfect fit"])
def test_gradients_are_finite_everywhere(kind):
    p, q, has = DEGENERATE.get(kind, (line, line, None))

    has = np.ones(len(p), bool) if has is None else has
    for gradient in gradients(jnp.asarray(p), jnp.asarray(q), 1.0, 1.0, 3.0, jnp.asarray(has)):
        assert np.isfinite(gradient).all()


def hypotheses(rng, dtype, k=23):
    """A window and k branches of it, innermost: anchors far off, some frames without any."""
    p, q = window(rng)
    q = q[:, None] + rng.normal(0, rng.uniform(0, 30, (1, k, 1)), (N, k, 2))
    has = rng.random((N, k)) < rng.uniform(0, 1.2, k)
    branches = Branch(jnp.asarray(q, dtype), jnp.asarray(rng.random((N, k)), dtype), jnp.array(has))
    weight = rng.dirichlet(np.ones(N)) * (np.arange(N) > 1)
    return jnp.asarray(p, dtype), branches, jnp.asarray(weight / weight.sum(), dtype)


def both_forms(p, branches, weight):
    """The same branches by `vmap` over the function of one, and at once, branches innermost."""
    lifted = jax.vmap(branch_cost, in_axes=(None, None, 1, None))
    one_by_one = lifted(params(), p, branches, weight)
    at_once = branch_cost(params(), p, branches, weight)
    return one_by_one, eqx.tree_at(lambda c: c.is_inlier, at_once, at_once.is_inlier.T)


@pytest.mark.parametrize("trial", range(3))
def test_the_fast_form_is_vmap_over_one_branch_bit_for_bit(trial, rng, monkeypatch):
    # One operation at a time and sums frame by frame: no compiler orders the roundings anew.
    for module in (cost_module, procrustes):
        monkeypatch.setattr(module, "sum_over_frames", lambda x: functools.reduce(jnp.add, x))
    with jax.disable_jit():
        one_by_one, at_once = both_forms(*hypotheses(rng, jnp.float32))
    jax.tree.map(np.testing.assert_array_equal, one_by_one, at_once)


@pytest.mark.parametrize("trial", range(3))
def test_compiled_the_fast_form_is_vmap_over_one_branch_to_the_last_digits(trial, rng):
    with jax.enable_x64(True):
        one_by_one, at_once = jax.jit(both_forms)(*hypotheses(rng, jnp.float64))
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    jax.tree.map(close, one_by_one, at_once)


def test_one_hopeless_branch_does_not_disturb_its_neighbours(rng):
    p, q = (a.astype(np.float32) for a in window(rng))
    qs = jnp.stack([jnp.asarray(q), jnp.full((N, 2), jnp.nan)])
    has = jnp.array([[True] * N, [False] * N])
    weight = jnp.full(N, 1.0 / N)
    got = many(params(), jnp.asarray(p), Branch(qs, jnp.zeros((2, N)), has), weight)
    assert np.isfinite(got.total).all()
    alone = cost(p, q, np.zeros(N))
    np.testing.assert_allclose(got.total[0], alone.total, rtol=1e-5)


def test_a_second_fit_that_fixes_no_angle_is_not_taken():
    """Three frames at one place are inside the mask, two far ones that fix the angle are not."""
    p = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 0.0], [-10.0, 0.0], [0.0, 0.0]])
    q = np.array([[0.0, 0.0], [0.0, 60.0], [0.0, 0.0], [0.0, -60.0], [0.0, 0.0]])
    got = cost(p, q, settings=params(lam=0.0))
    np.testing.assert_allclose(got.T_map_odom, [0.0, 0.0, np.pi / 2], atol=1e-5)
    assert not got.is_degenerate
    np.testing.assert_array_equal(got.is_inlier, [True, False, True, False, True])


def test_a_frame_without_an_anchor_or_without_weight_is_no_inlier():
    p = np.c_[np.arange(N) - N + 1.0, np.zeros(N)]
    has, weight = np.arange(N) != 3, np.full(N, 1.0 / (N - 1))
    weight[7] = 0.0
    # Where an anchor is missing the place of the map's origin stands in, and p passes it.
    got = cost(p, p, has=has, weight=weight)
    want = has & (np.arange(N) != 7)
    np.testing.assert_array_equal(got.is_inlier, want)
