"""Plain NumPy re-writes in float64: the textbook routes the library is held against."""

import numpy as np


def svd_angle(h):
    """Rotation angle that maximises trace(R H), by SVD with the reflection fixed."""
    u, _, vt = np.linalg.svd(h)
    d = np.diag([1.0, np.linalg.det(vt.T @ u.T)])
    r = vt.T @ d @ u.T
    return np.arctan2(r[1, 0], r[0, 0])


def covariance(p, q, w):
    """Weighted, centred cross-covariance X^T W Y and both means."""
    w = w / w.sum()
    pm, qm = w @ p, w @ q
    return (w[:, None] * (p - pm)).T @ (q - qm), pm, qm


def fit(p, q, w, lam):
    """Minimise 1/2 sum w |q - Rp - t|^2 + lam mean |dq - R dp|^2 by SVD; pairs need both ends."""
    w = w / w.sum()
    h, pm, qm = covariance(p, q, w)
    pair = (w[1:] > 0) & (w[:-1] > 0)
    if pair.any():
        dp, dq = np.diff(p, axis=0)[pair], np.diff(q, axis=0)[pair]
        h = h + 2.0 * lam * dp.T @ dq / pair.sum()
    theta = svd_angle(h)
    c, s = np.cos(theta), np.sin(theta)
    return np.array([*(qm - np.array([[c, -s], [s, c]]) @ pm), theta])


def residuals(pose, p, q):
    """Distances of anchors from the moved trajectory."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.linalg.norm(q - p @ np.array([[c, -s], [s, c]]).T - pose[:2], axis=1)


def quadratic(pose, p, q, w, lam):
    """The surrogate objective that the closed form minimises."""
    r = residuals(pose, p, q)
    step = residuals(np.array([0.0, 0.0, pose[2]]), np.diff(p, axis=0), np.diff(q, axis=0))
    return 0.5 * np.sum(w * r**2) + lam * np.mean(step**2)


def masked_cost(p, q, s, has, w, *, lam, gamma, tau, delta, mask):  # noqa: PLR0913
    """Eq. 1 with residual mask, written as plain loops would be."""
    pose = fit(p, q, np.where(has, w, 0.0), lam)
    keep = np.where(has & (residuals(pose, p, q) <= mask), w, 0.0)
    if (keep > 0).sum() >= 3:
        pose = fit(p, q, keep, lam)
    r = residuals(pose, p, q)
    rho = np.where(r <= delta, r**2 / 2, delta * (r - delta / 2))
    pair = has[1:] & has[:-1]
    step = residuals(np.array([0.0, 0.0, pose[2]]), np.diff(p, axis=0), np.diff(q, axis=0))
    geom = np.sum(w * np.where(has, rho, tau))
    vel = lam * np.mean(step[pair] ** 2) if pair.any() else 0.0
    sim = gamma * np.sum(w * np.where(has, 1 - s, 1.0))
    return geom, vel, sim, pose
