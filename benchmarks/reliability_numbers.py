"""Hostile windows through the cost, held against a float64 rewrite; hostile frames in a stream.

Stated tolerance of a fit: no window frame is moved by more than
16 eps (largest |p| + largest |q|) / strength [m], where strength in (0, 1] is how well the pairs
agree on the angle (1 on a rigid window) and eps that of the float in use. Windows whose residual
mask is decided by less than that are counted apart.
"""

from collections import Counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.reliability_targets import from_tests
from taojax.core.cost import Branch, BranchCost, CostParams, branch_cost

N_FRAMES, N_BRANCHES, BATCH = 12, 10, 500
EPS_SHARE = 16.0
KINDS = (
    "noisy", "rigid", "identical anchors", "standing still", "collinear", "weightless", "outliers",
    "few anchors", "nothing", "shuffled",
)  # fmt: skip
DEGENERATE = {"identical anchors", "standing still", "nothing"}
"""Kinds that no method can align."""


class Windows(NamedTuple):
    """A batch of windows; one kind per window, branches differ by their noise."""

    kind: np.ndarray
    scale_m: np.ndarray
    p: np.ndarray
    q: np.ndarray
    similarity: np.ndarray
    has: np.ndarray
    weight: np.ndarray


def make_windows(rng: np.random.Generator, n: int, dtype: type) -> Windows:
    """Draw windows of 1e-6 to 1e6 m, half of them up to 1e5 m from the origin of the map."""
    kind = rng.integers(len(KINDS), size=n)
    is_kind = {name: kind == at for at, name in enumerate(KINDS)}
    scale = 10.0 ** rng.uniform(-6, 6, n)
    turns = np.cumsum(rng.normal(0, 0.2, (n, N_FRAMES)), axis=1)
    steps = np.stack([np.cos(turns), np.sin(turns)], axis=-1) * rng.uniform(
        0.2, 2, (n, N_FRAMES, 1)
    )
    steps[is_kind["collinear"]] = [1.0, 0.0]
    steps[is_kind["standing still"]] = 0.0
    p = np.cumsum(steps, axis=1) * scale[:, None, None]
    p -= p[:, -1:]
    angle = rng.uniform(-np.pi, np.pi, (n, 1, N_BRANCHES))
    c, s = np.cos(angle), np.sin(angle)
    x, y = p[:, :, :1], p[:, :, 1:]
    q = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    noise = rng.normal(0, 0.3, q.shape) * scale[:, None, None, None]
    noise[is_kind["rigid"] | is_kind["collinear"] | is_kind["identical anchors"]] = 0.0
    q += noise
    q[is_kind["identical anchors"]] = q[is_kind["identical anchors"]][:, :1]
    order = rng.permutation(N_FRAMES)
    q[is_kind["shuffled"]] = q[is_kind["shuffled"]][:, order]
    wild = rng.random((n, N_FRAMES, N_BRANCHES)) < 0.3
    wild &= is_kind["outliers"][:, None, None]
    q[wild] += (rng.normal(size=(int(wild.sum()), 2)) * scale[np.nonzero(wild)[0], None]) * 1e3
    far_m = np.where(rng.random(n) < 0.5, 10.0 ** rng.uniform(0, 5, n), 0.0)
    q += (rng.uniform(-1, 1, (n, 1, 1, 2)) + 1.0) * far_m[:, None, None, None]
    has = rng.random(q.shape[:3]) < 0.9
    has[is_kind["few anchors"]] = rng.random(has[is_kind["few anchors"]].shape) < 0.2
    has[is_kind["nothing"]] = False
    weight = rng.uniform(0.1, 1, (n, N_FRAMES))
    weight[is_kind["weightless"], : N_FRAMES // 2] = 0.0
    weight /= weight.sum(axis=1, keepdims=True)
    # What is masked out may hold anything.
    q[~has] = 1e30
    similarity = rng.uniform(-1, 1, has.shape)
    similarity[~has] = 1.0
    scale, p, q, similarity, weight = (a.astype(dtype) for a in (scale, p, q, similarity, weight))
    return Windows(kind, scale, p, q, similarity, has, weight)


@jax.jit
def _costs(*arrays: Array) -> BranchCost:
    def one(scale_m: Array, p: Array, q: Array, s: Array, has: Array, weight: Array) -> BranchCost:
        params = CostParams(1.0, 1.0, 4.0 * scale_m**2, 3.0 * scale_m, 9.0 * scale_m)
        return branch_cost(params, p, Branch(q, s, has), weight)

    return jax.vmap(one)(*arrays)


class Verdict(NamedTuple):
    """One window against the oracle."""

    outcome: str
    """ok, undecided, not finite, wrong status, wrong fit or wrong cost."""

    error: float
    """Movement of the worst frame, in units of the tolerance; NaN where nothing is compared."""


def _strength(p: np.ndarray, q: np.ndarray, weight: np.ndarray) -> float:
    """Return how well pairs of points and of steps agree on an angle, in [0, 1]."""
    reference = from_tests("reference")
    h, pm, qm = reference.covariance(p, q, weight)
    scale = np.sum(
        weight / weight.sum() * np.linalg.norm(p - pm, axis=1) * np.linalg.norm(q - qm, axis=1)
    )
    pair = (weight[1:] > 0) & (weight[:-1] > 0)
    if pair.any():
        dp, dq = np.diff(p, axis=0)[pair], np.diff(q, axis=0)[pair]
        h = h + 2.0 * dp.T @ dq / pair.sum()
        scale += 2.0 * np.sum(np.linalg.norm(dp, axis=1) * np.linalg.norm(dq, axis=1)) / pair.sum()
    both = np.hypot(h[0, 0] + h[1, 1], h[0, 1] - h[1, 0])
    return float(both / scale) if scale > 0 else 0.0


def judge(w: Windows, at: int, k: int, found: BranchCost, eps: float) -> Verdict:
    """Hold one branch of one window against the oracle."""
    reference, kind = from_tests("reference"), KINDS[int(w.kind[at])]
    has, weight = w.has[at, :, k], w.weight[at].astype(float)
    p, q = w.p[at].astype(float), np.where(has[:, None], w.q[at, :, k].astype(float), 0.0)
    pose, is_degenerate = (
        np.asarray(found.T_map_odom[at, k], float),
        bool(found.is_degenerate[at, k]),
    )
    total = float(found.geom[at, k]) + float(found.vel[at, k]) + float(found.sim[at, k])
    if not (np.isfinite(pose).all() and np.isfinite(total)):
        return Verdict("not finite", np.nan)
    on = has & (weight > 0)
    if on.sum() < 3 or kind in DEGENERATE:
        return Verdict("ok" if is_degenerate else "wrong status", np.nan)
    own = np.where(on, weight, 0.0)
    delta, mask = 3.0 * float(w.scale_m[at]), 9.0 * float(w.scale_m[at])
    size = np.abs(p[on]).max() + np.abs(q[on]).max()
    first = _strength(p, q, own)
    near_m = EPS_SHARE * eps * size / max(first, eps)
    residual = reference.residuals(reference.fit(p, q, own, 1.0), p, q)
    spread = max(np.ptp(q[on], axis=0).max(), 1e-30)
    if first < 1e3 * eps * (1.0 + size / spread) or (np.abs(residual[on] - mask) <= near_m).any():
        return Verdict("undecided", np.nan)
    if is_degenerate:
        return Verdict("wrong status", np.nan)
    kept = np.where(residual <= mask, own, 0.0)
    last = _strength(p, q, kept) if (kept > 0).sum() >= 3 else first
    if last < 1e3 * eps * (1.0 + size / spread):
        return Verdict("undecided", np.nan)
    geom, vel, sim, want = reference.masked_cost(
        p, q, np.where(on, w.similarity[at, :, k].astype(float), 0.0), on, weight,
        lam=1.0, gamma=1.0, tau=4.0 * float(w.scale_m[at]) ** 2, delta=delta, mask=mask,
    )  # fmt: skip
    turn = lambda x: np.array([[np.cos(x), -np.sin(x)], [np.sin(x), np.cos(x)]])
    moved = p @ (turn(pose[2]) - turn(want[2])).T + pose[:2] - want[:2]
    tolerance_m = EPS_SHARE * eps * size / min(first, last)
    error = float(np.linalg.norm(moved[on], axis=1).max() / tolerance_m)
    if error > 1.0:
        return Verdict("wrong fit", error)
    cost = geom + vel + sim
    slack = 5.0 * tolerance_m * (np.sqrt(2.0 * cost) + delta + tolerance_m) + 100.0 * eps * (
        cost + 2.0
    )
    return Verdict("ok" if abs(total - cost) <= slack else "wrong cost", error)


def windows(n: int, dtype: type, seed: int = 0) -> tuple[Counter[str], float]:
    """Judge n branches of random hostile windows.

    Returns:
        How many came to which outcome, as "kind: outcome"; and the worst error in tolerances.
    """
    rng, found, worst = np.random.default_rng(seed), Counter[str](), 0.0
    with jax.enable_x64(dtype is np.float64):
        while found.total() < n:
            batch = make_windows(rng, BATCH, dtype)
            costs = jax.tree.map(np.asarray, _costs(*map(jnp.asarray, batch[1:])))
            for at, k in np.ndindex(BATCH, N_BRANCHES):
                verdict = judge(batch, at, k, costs, float(np.finfo(dtype).eps))
                found[f"{KINDS[int(batch.kind[at])]}: {verdict.outcome}"] += 1
                worst = max(worst, 0.0 if np.isnan(verdict.error) else verdict.error)
                if found.total() >= n:
                    break
    return found, worst
