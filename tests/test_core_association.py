"""Joint association: one objective that no half step raises; finite; finds the place."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop
from hypothesis import given, settings
from hypothesis import strategies as st

from taojax.core.anchors import look_up, pool
from taojax.core.association import (
    JointParams,
    JointWindow,
    associate,
    evaluate,
    find,
    joint_branch,
    objective,
    refit,
)
from taojax.core.se2 import inverse, transform
from taojax.runtime.maps import map_tables

M, N = 50, 10
# One map for all: another one would have another grid, and compile everything again.
PLACES = loop(M)
GRID = map_tables(PLACES).grid
SPACING_M = float(map_tables(PLACES).spacing_m)
start, half_a, half_b = (eqx.filter_jit(f) for f in (find, associate, refit))
follow = eqx.filter_jit(jax.vmap(joint_branch, in_axes=(None, None, None, 0)))
pools = eqx.filter_jit(jax.vmap(pool, in_axes=(None, None, None, None, 0)))


@eqx.filter_jit
def value(params, window, pairing, pose, theta0):
    return objective(params, window, evaluate(params, window, pairing, pose), pose, theta0)


def scene(seed, noise=0.3):
    """A map, a window that starts at a known pose, and noisy similarities."""
    rng = np.random.default_rng(seed)
    places, grid = PLACES, GRID
    start = rng.integers(N, M)
    truth = jnp.asarray(places[start], jnp.float32)
    past = jnp.asarray(places[start - N + 1 : start + 1, :2], jnp.float32)
    back = jnp.broadcast_to(inverse(truth), (N, 3))
    p = transform(back, past) + jnp.asarray(rng.normal(0, 0.2, (N, 2)), jnp.float32)
    distance = np.linalg.norm(np.asarray(past)[:, None] - places[None, :, :2], axis=-1)
    rows = np.exp(-distance / 8) + rng.normal(0, noise, (N, M))
    rows = jnp.asarray(np.clip(rows, 0, 1), jnp.float32)
    weight = jnp.asarray(rng.dirichlet(np.ones(N)), jnp.float32)
    # Arrays, not Python numbers: those would be compile-time constants.
    values = (rng.uniform(3, 20), 1.0, rng.uniform(0.01, 0.5))
    params = JointParams(*(jnp.asarray(v, jnp.float32) for v in values))
    # Every anchor is listed, in an order that is not the map's.
    listed = jnp.asarray(rng.permutation(M), jnp.int32)
    rows = rows[:, listed]
    pooled = pools(grid, params.gamma, params.delta_m, listed, rows)
    window = JointWindow(p, weight, jnp.broadcast_to(listed, (N, M)), rows, pooled)
    seed_pose = truth + jnp.asarray(rng.normal(0, [3, 3, 0.5]), jnp.float32)
    return params, grid, window, truth, seed_pose


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 10**6), st.floats(0, 0.75, allow_subnormal=False))
def test_no_half_step_raises_the_truncated_objective(seed, noise):
    params, grid, window, _, pose = scene(seed, noise)
    theta0, pairing = pose[2], start(params, grid, window, pose)
    before = float(value(params, window, pairing, pose, theta0))
    for _ in range(4):
        pairing = half_a(params, grid, window, pairing, pose)
        middle = float(value(params, window, pairing, pose, theta0))
        assert middle <= before + 1e-5
        pose = half_b(params, window, pairing, pose, theta0)
        after = float(value(params, window, pairing, pose, theta0))
        assert after <= middle + 1e-5
        before = after


@pytest.mark.parametrize("seed", range(5))
def test_a_branch_near_the_truth_ends_at_the_truth(seed):
    params, grid, window, truth, _ = scene(seed, noise=0.02)
    # As in the stream: the seed is the map pose of an anchor beside the robot.
    beside = jnp.argsort(jnp.sum((grid.xy - truth[None, :2]) ** 2, axis=1))[1]
    pose = jnp.concatenate([grid.xy[beside], grid.theta[beside][None]])
    got = follow(params, grid, window, pose[None])
    assert np.hypot(*(got.T_map_odom[0, :2] - truth[:2])) < 2 * SPACING_M
    assert got.is_inlier[0].mean() > 0.7


def test_the_cost_is_the_objective_at_the_end_and_bounded():
    params, grid, window, _, pose = scene(3)
    got = follow(params, grid, window, pose[None])
    # Written out anew from the anchors alone.
    similarity = np.zeros((N, M))
    np.put_along_axis(similarity, np.asarray(window.listed), np.asarray(window.similarity), axis=1)
    anchor, (x, y, theta) = np.asarray(got.anchor[0]), np.asarray(got.T_map_odom[0], float)
    p, q = np.asarray(window.p, float), np.asarray(grid.xy, float)[anchor]
    c, s = np.cos(theta), np.sin(theta)
    r = np.hypot(*(q - np.c_[c * p[:, 0] - s * p[:, 1] + x, s * p[:, 0] + c * p[:, 1] + y]).T)
    r = r / float(params.delta_m)
    rho = np.where(r <= 1, 0.5 * r**2, r - 0.5)
    each = rho + float(params.gamma) * (1 - similarity[np.arange(N), anchor])
    each = np.minimum(float(params.gamma), np.where(anchor >= 0, each, np.inf))
    prior = float(params.kappa) * (1 - np.cos(theta - float(pose[2])))
    want = np.sum(np.asarray(window.weight) * each) + prior
    np.testing.assert_allclose(got.cost[0], want, rtol=1e-5)
    assert 0 <= float(got.cost[0]) <= params.gamma + 2 * params.kappa


def test_terms_truncated_share_and_prior_add_up_to_the_cost():
    params, grid, window, _, pose = scene(5)
    got = follow(params, grid, window, pose[None])
    missing = jnp.sum(jnp.where(got.is_inlier[0], 0.0, window.weight)) * params.gamma
    prior = params.kappa * (1 - jnp.cos(got.T_map_odom[0, 2] - pose[2]))
    np.testing.assert_allclose(got.geom[0] + got.sim[0] + missing + prior, got.cost[0], rtol=1e-4)


def test_permuting_seeds_permutes_outputs(rng):
    params, grid, window, _, pose = scene(7)
    seeds = pose[None] + jnp.asarray(rng.normal(0, 5, (6, 3)), jnp.float32)
    order = rng.permutation(6)
    a, b = follow(params, grid, window, seeds), follow(params, grid, window, seeds[order])
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[order], y), a, b)


def test_the_order_of_the_window_does_not_matter(rng):
    params, grid, window, _, pose = scene(8)
    order = rng.permutation(N)
    a = follow(params, grid, window, pose[None])
    b = follow(params, grid, jax.tree.map(lambda leaf: leaf[order], window), pose[None])
    np.testing.assert_allclose(a.cost, b.cost, rtol=1e-5)


@pytest.mark.parametrize("deltas", [0.5, 3.0])
@pytest.mark.parametrize("n_listed", [3, 20, M])
def test_pooling_a_list_is_the_argmin_over_every_neighbourhood(n_listed, deltas, rng):
    index = rng.permutation(M)[:n_listed]
    similarity = rng.uniform(0, 1, n_listed).astype(np.float32)
    index[1], similarity[2] = -1, 0.0
    row = np.zeros(M + 1, np.float32)
    row[index] = similarity
    row[-1] = 0.0
    neighbour = np.asarray(GRID.neighbour)
    r = np.linalg.norm(PLACES[neighbour, :2] - PLACES[None, :, :2], axis=2) / (deltas * SPACING_M)
    best = np.argmin(np.where(r <= 1, 0.5 * r**2, r - 0.5) + 1.0 - row[:-1][neighbour], axis=0)
    want = neighbour[best, np.arange(M)]
    place = np.asarray(pool(GRID, 1.0, deltas * SPACING_M, *map(jnp.asarray, (index, similarity))))
    place = place.astype(int)
    got = np.where(place < n_listed, np.append(index, -1)[place], np.arange(M))
    np.testing.assert_array_equal(got, want)


def test_look_up_finds_the_nearest_anchor_within_a_cell(rng):
    grid = map_tables(loop(M)).grid
    xy = rng.uniform(-60, 60, (200, 2)).astype(np.float32)
    got = np.asarray(look_up(grid, jnp.asarray(xy)))
    distance = np.linalg.norm(xy[:, None] - np.asarray(grid.xy)[None], axis=-1)
    found = got >= 0
    # The cell's centre is at most half a diagonal away, so the answer is off by at most one.
    slack = float(grid.cell_m) * 1.5
    assert (distance[found, got[found]] <= distance[found].min(axis=1) + slack).all()
    assert found.mean() > 0.3


def test_positions_far_outside_the_grid_have_no_anchor():
    grid = map_tables(loop(M)).grid
    far = jnp.array([[1e30, 0.0], [-1e9, 1e9], [0.0, 4e4]])
    np.testing.assert_array_equal(look_up(grid, far), [-1, -1, -1])


DEGENERATE = {
    "standing still": lambda w: eqx.tree_at(lambda x: x.p, w, jnp.zeros_like(w.p)),
    "no similarity": lambda w: eqx.tree_at(lambda x: x.similarity, w, jnp.zeros_like(w.similarity)),
    "no weight": lambda w: eqx.tree_at(lambda x: x.weight, w, jnp.zeros_like(w.weight)),
    "far away": lambda w: eqx.tree_at(lambda x: x.p, w, w.p * 1e6),
}


@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_windows_give_finite_branches(kind):
    params, grid, window, _, pose = scene(2)
    got = follow(params, grid, DEGENERATE[kind](window), pose[None])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(got))


@pytest.mark.parametrize("n", [3, 4, 12])
def test_tiny_and_coincident_maps_have_tables(n):
    for poses in (loop(n), np.zeros((n, 3))):
        tables = map_tables(poses)
        assert tables.grid.neighbour.shape == (min(12, n), n)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tables))
