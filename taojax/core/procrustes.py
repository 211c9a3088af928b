"""Closed-form SE(2) registration of paired points, and what its singular values tell."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from taojax.core.reductions import broadcast_frames, sum_over_frames


class VectorPairs(NamedTuple):
    """Weighted pairs of vectors: x in one frame, y in another. Branches, if any, trail."""

    x: Float[Array, "n *#k 2"]
    y: Float[Array, "n *k 2"]
    weight: Float[Array, "n *k"]


class AngleEvidence(NamedTuple):
    """What pairs of vectors say of the angle between them; sums of evidence add up."""

    dot: Float[Array, "*k"]
    """Sum of w x . y, the trace of the cross-covariance [m^2]."""

    cross: Float[Array, "*k"]
    """Sum of w x cross y, its antisymmetric part [m^2]."""

    scale: Float[Array, "*k"]
    """Upper bound of hypot(dot, cross), reached when all pairs agree [m^2]."""


class RigidFit(eqx.Module):
    """An alignment, and whether the pairs determine it."""

    shift: Float[Array, "*k 2"]
    """Where the local origin lies in the map [m]."""

    turn: Float[Array, "*k 2"]
    """Cosine and sine of the angle: what rotates points, without computing them again."""

    is_degenerate: Bool[Array, "*k"]

    @property
    def T_map_odom(self) -> Float[Array, "*k 3"]:
        """The alignment as a pose: x [m], y [m], theta [rad]."""
        theta = jnp.arctan2(self.turn[..., 1], self.turn[..., 0])
        return jnp.concatenate([self.shift, theta[..., None]], axis=-1)


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


def weighted_mean(p: Float[Array, "n *#k 2"], weight: Float[Array, "n *k"]) -> Float[Array, "*k 2"]:
    """Return the weighted mean of points, zero where there is no weight at all."""
    total = sum_over_frames(weight)
    share = 1.0 / jnp.where(total > 0, total, 1.0)
    axes = [share * sum_over_frames(weight * p[..., axis]) for axis in range(2)]
    return jnp.stack(axes, axis=-1)


def angle_evidence(*pairs: VectorPairs) -> AngleEvidence:
    """Sum what weighted pairs of vectors say of the rotation that takes x to y.

    Args:
        pairs: groups of equally many pairs; they are added before they are summed.
    """
    dot, cross, scale = 0.0, 0.0, 0.0
    for x, y, weight in pairs:
        (x0, x1), (y0, y1) = (x[..., 0], x[..., 1]), (y[..., 0], y[..., 1])
        dot = dot + weight * (x0 * y0 + x1 * y1)
        cross = cross + weight * (x0 * y1 - x1 * y0)
        scale = scale + weight * jnp.sqrt((x0**2 + x1**2) * (y0**2 + y1**2))
    return AngleEvidence(*(sum_over_frames(jnp.asarray(part)) for part in (dot, cross, scale)))


def fit_se2(
    p: Float[Array, "n 2"],
    q: Float[Array, "n *k 2"],
    weight: Float[Array, "n *k"],
    *more: VectorPairs,
) -> RigidFit:
    r"""Find the SE(2) transform that best carries local points p onto anchors q.

    Minimises $\tfrac12 \sum_i w_i \| q_i - (R p_i + t) \|^2$ plus any further terms that are linear
    in $(\cos\theta, \sin\theta)$: those enter as angle evidence. In the plane the rotation is one
    angle, so the SVD of the general problem collapses to an `atan2`; there is no reflection case.

    Args:
        p: `(n, 2)` points in the odometry frame, metres.
        q: `(n, 2)` the map position each one is believed to be at, metres; `(n, k, 2)` for k
            branches at once, which lie innermost in memory: XLA on a CPU vectorises over them.
        weight: `(n,)` or `(n, k)`, non-negative; 0 switches a pair off. Need not sum to one, but
            its scale sets the balance against what follows.
        more: n further pairs each that share the rotation but not the shift: the velocity term of
            Eq. 1 is the steps of p and q with weights 2 lambda / (number of steps).

    Returns:
        `T_map_odom` (x [m], y [m], theta [rad]) and `is_degenerate`: no weight, or nothing fixes
        the angle (one distinct point, perfect symmetry). A degenerate fit keeps the angle 0 and
        matches the centroids; it is finite, and so are its gradients.

    Source:
        Umeyama, IEEE TPAMI 13(4), 1991, specialised to dimension 2 and scale 1; paper, Eq. 1.
    """
    p = broadcast_frames(p, weight)
    p_mean, q_mean = weighted_mean(p, weight), weighted_mean(q, weight)
    centred = p - p_mean[None], q - q_mean[None]
    dot, cross, scale = angle_evidence(VectorPairs(*centred, weight), *more)
    # Relative, so that millimetres and kilometres are judged alike, and written so that NaN is bad.
    tolerance = 100.0 * jnp.finfo(p.dtype).eps
    strength = _safe_sqrt(dot**2 + cross**2)
    is_degenerate = ~((strength > tolerance * scale) & (sum_over_frames(weight) > 0))
    # A harmless division when degenerate, so that its gradient stays finite.
    unit = 1.0 / jnp.where(is_degenerate, 1.0, strength)
    c, s = jnp.where(is_degenerate, 1.0, dot * unit), jnp.where(is_degenerate, 0.0, cross * unit)
    x, y = p_mean[..., 0], p_mean[..., 1]
    shift = q_mean - jnp.stack([c * x - s * y, s * x + c * y], axis=-1)
    return RigidFit(shift, jnp.stack([c, s], axis=-1), is_degenerate)


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
    x, y = p - weighted_mean(p, weight)[None], q - weighted_mean(q, weight)[None]
    (h00, h01), (h10, h11) = jnp.dot(x.T * weight[None], y, precision="highest")
    turn = _safe_sqrt((h00 + h11) ** 2 + (h10 - h01) ** 2)
    flip = _safe_sqrt((h00 - h11) ** 2 + (h10 + h01) ** 2)
    s1 = 0.5 * (turn + flip)
    c_geom = jnp.abs(h00 * h11 - h01 * h10)
    s2 = c_geom / jnp.where(s1 > 0, s1, 1.0)
    return Diagnostics(s1, s2, c_geom, s1 / (s2 + eps), -jnp.log(c_geom + eps))
