"""Poses in the plane: `(x [m], y [m], theta [rad])`, theta in [-pi, pi].

`T_a_b` takes coordinates in frame b to coordinates in frame a. Everything is written for one
element and broadcasts over leading axes (an angle given once is turned into sine and cosine once);
rotations are spelled out, because a float32 matmul may
run in TF32 on recent GPUs and lose centimetres over a 100 m lever arm.

Source: Sola, Deray and Atchuthan, "A micro Lie theory", 2018, section on SE(2).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def wrap(theta: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Return the same angle in [-pi, pi]."""
    return jnp.arctan2(jnp.sin(theta), jnp.cos(theta))


def rotate(theta: Float[Array, "*#b"], p: Float[Array, "*#b 2"]) -> Float[Array, "*b 2"]:
    """Turn points by an angle, counter-clockwise."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    x, y = p[..., 0], p[..., 1]
    return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)


def transform(T_a_b: Float[Array, "*#b 3"], p_b: Float[Array, "*#b 2"]) -> Float[Array, "*b 2"]:
    """Take points in frame b to frame a."""
    return rotate(T_a_b[..., 2], p_b) + T_a_b[..., :2]


def compose(T_a_b: Float[Array, "*b 3"], T_b_c: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Return `T_a_c`."""
    xy = transform(T_a_b, T_b_c[..., :2])
    theta = wrap(T_a_b[..., 2] + T_b_c[..., 2])
    return jnp.concatenate([xy, theta[..., None]], axis=-1)


def inverse(T_a_b: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Return `T_b_a`."""
    xy = rotate(-T_a_b[..., 2], -T_a_b[..., :2])
    return jnp.concatenate([xy, wrap(-T_a_b[..., 2])[..., None]], axis=-1)


def between(T_a_b: Float[Array, "*b 3"], T_a_c: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Return `T_b_c`: the motion from pose b to pose c, seen from b."""
    return compose(inverse(T_a_b), T_a_c)


def integrate(odometry: Float[Array, "t 3"]) -> Float[Array, "t 3"]:
    """Chain relative motions into poses in the frame of the first.

    Args:
        odometry: row i is the motion from i-1 to i in the body frame of i-1; row 0 is the motion
            into the first pose and is usually zero.

    Returns:
        `(t, 3)` poses; pose i is the product of rows 0..i.
    """

    def advance(
        pose: Float[Array, "3"], motion: Float[Array, "3"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        pose = compose(pose, motion)
        return pose, pose

    return jax.lax.scan(advance, jnp.zeros_like(odometry[0]), odometry)[1]
