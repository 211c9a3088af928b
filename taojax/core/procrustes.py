"""Closed-form SE(2) registration of paired points, and what its singular values tell."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from taojax.core.se2 import rotate


class AngleEvidence(NamedTuple):
    """What pairs of vectors say of the angle between them; sums of evidence add up."""

    dot: Float[Array, ""]
    """Sum of w x . y, the trace of the cross-covariance [m^2]."""

    cross: Float[Array, ""]
    """Sum of w x cross y, its antisymmetric part [m^2]."""

    scale: Float[Array, ""]
    """Upper bound of hypot(dot, cross), reached when all pairs agree [m^2]."""


class RigidFit(eqx.Module):
    """An alignment, and whether the pairs determine it."""

    T_map_odom: Float[Array, "*k 3"]
    is_degenerate: Bool[Array, "*k"]


class Diagnostics(eqx.Module):
    """Singular values of the weighted cross-covariance H = X^T W Y (paper, section 3.2)."""

    s1: Float[Array, "*k"]
    """Larger singular value [m^2]."""

    s2: Float[Array, "*k"]
    """Smaller singular value [m^2]."""

    c_geom: Float[Array, "*k"]
    """s1 s2 = |det H| [m^4]: two-dimensional support."""

    a_aniso: Float[Array, "*k"]
    """s1 / (s2 + eps): large on straight windows."""

    h_proxy: Float[Array, "*k"]
    """-log(c_geom + eps)."""


def _safe_sqrt(x: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Square root whose gradient at 0 is 0 instead of infinite."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)


def weighted_mean(p: Float[Array, "n 2"], weight: Float[Array, " n"]) -> Float[Array, "2"]:
    """Return the weighted mean of points, zero where there is no weight at all."""
    total = jnp.sum(weight)
    return jnp.sum(weight[:, None] * p, axis=0) / jnp.where(total > 0, total, 1.0)


def angle_evidence(
    x: Float[Array, "n 2"], y: Float[Array, "n 2"], weight: Float[Array, " n"]
) -> AngleEvidence:
    """Sum what weighted pairs of vectors say of the rotation that takes x to y."""
    dot = jnp.sum(weight * (x[:, 0] * y[:, 0] + x[:, 1] * y[:, 1]))
    cross = jnp.sum(weight * (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]))
    lengths = jnp.sum(weight * jnp.sum(x**2, axis=-1)) * jnp.sum(weight * jnp.sum(y**2, axis=-1))
    return AngleEvidence(dot, cross, _safe_sqrt(lengths))


def fit_se2(
    p: Float[Array, "n 2"],
    q: Float[Array, "n 2"],
    weight: Float[Array, " n"],
    *more: AngleEvidence,
) -> RigidFit:
    r"""Find the SE(2) transform that best carries local points p onto anchors q.

    Minimises $\tfrac12 \sum_i w_i \| q_i - (R p_i + t) \|^2$ plus any further terms that are linear
    in $(\cos\theta, \sin\theta)$: those enter as angle evidence. In the plane the rotation is one
    angle, so the SVD of the general problem collapses to an `atan2`; there is no reflection case.

    Args:
        p: `(n, 2)` points in the odometry frame, metres.
        q: `(n, 2)` the map position each one is believed to be at, metres.
        weight: `(n,)` non-negative; 0 switches a pair off. Need not sum to one, but its scale sets
            the balance against `more`.
        more: further evidence on the angle: the velocity term of Eq. 1 contributes
            2 lambda mean(dp dq^T), a heading prior kappa (1 - cos(theta - theta0)) contributes
            kappa (cos theta0, sin theta0).

    Returns:
        `T_map_odom` (x [m], y [m], theta [rad]) and `is_degenerate`: no weight, or nothing fixes
        the angle (one distinct point, perfect symmetry). A degenerate fit keeps the angle 0 and
        matches the centroids; it is finite, and so are its gradients.

    Source:
        Umeyama, IEEE TPAMI 13(4), 1991, specialised to dimension 2 and scale 1; paper, Eq. 1.
    """
    p_mean, q_mean = weighted_mean(p, weight), weighted_mean(q, weight)
    pairs = angle_evidence(p - p_mean[None, :], q - q_mean[None, :], weight)
    dot = sum((e.dot for e in more), pairs.dot)
    cross = sum((e.cross for e in more), pairs.cross)
    scale = sum((e.scale for e in more), pairs.scale)
    # Relative, so that millimetres and kilometres are judged alike, and written so that NaN is bad.
    tolerance = 100.0 * jnp.finfo(p.dtype).eps
    strength = _safe_sqrt(dot**2 + cross**2)
    is_degenerate = ~((strength > tolerance * scale) & (jnp.sum(weight) > 0))
    # Give atan2 a harmless point when degenerate, so that its gradient stays finite.
    theta = jnp.arctan2(jnp.where(is_degenerate, 0.0, cross), jnp.where(is_degenerate, 1.0, dot))
    xy = q_mean - rotate(theta, p_mean)
    return RigidFit(jnp.concatenate([xy, theta[None]]), is_degenerate)


def diagnose(
    p: Float[Array, "n 2"],
    q: Float[Array, "n 2"],
    weight: Float[Array, " n"],
    eps: float | Float[Array, ""] = 1e-12,
) -> Diagnostics:
    """Return the singular-value diagnostics of one branch.

    Args:
        p: `(n, 2)` local points, metres.
        q: `(n, 2)` anchors, metres.
        weight: `(n,)` non-negative.
        eps: keeps ratio and logarithm finite.

    Returns:
        Diagnostics of the plain cross-covariance, without the velocity term. s2 is |det H| / s1:
        the textbook difference of two nearly equal numbers returns 0 on straight windows in
        float32.

    Source:
        Paper, section 3.2; closed form of the 2 x 2 singular values.
    """
    x = p - weighted_mean(p, weight)[None, :]
    y = q - weighted_mean(q, weight)[None, :]
    h00, h01 = jnp.sum(weight * x[:, 0] * y[:, 0]), jnp.sum(weight * x[:, 0] * y[:, 1])
    h10, h11 = jnp.sum(weight * x[:, 1] * y[:, 0]), jnp.sum(weight * x[:, 1] * y[:, 1])
    turn = _safe_sqrt((h00 + h11) ** 2 + (h10 - h01) ** 2)
    flip = _safe_sqrt((h00 - h11) ** 2 + (h10 + h01) ** 2)
    s1 = 0.5 * (turn + flip)
    c_geom = jnp.abs(h00 * h11 - h01 * h10)
    s2 = c_geom / jnp.where(s1 > 0, s1, 1.0)
    return Diagnostics(s1, s2, c_geom, s1 / (s2 + eps), -jnp.log(c_geom + eps))
