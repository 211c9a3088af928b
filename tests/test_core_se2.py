"""Poses form a group, and jaxlie agrees."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from taojax.core import se2

compose, inverse, between = (jax.jit(f) for f in (se2.compose, se2.inverse, se2.between))

metres = st.floats(-100, 100, width=32, allow_subnormal=False)
# A third of the angles are near the identity, where formulas like to break.
TINY = 2.0**-20
angles = st.one_of(
    st.floats(-3.125, 3.125, width=32, allow_subnormal=False),
    st.floats(-TINY, TINY, width=32, allow_subnormal=False),
)
poses = st.tuples(metres, metres, angles).map(lambda t: jnp.array(t, jnp.float32))
IDENTITY = jnp.zeros(3)
LAWS = settings(max_examples=60, deadline=None)


@jax.jit
def jaxlie_compose(a, b):
    # jaxlie multiplies float32 by weakly typed numbers, which strict promotion would refuse.
    with jax.numpy_dtype_promotion("standard"):
        return jaxlie.SE2.from_xy_theta(*a) @ jaxlie.SE2.from_xy_theta(*b)


def close(a, b):
    np.testing.assert_allclose(a[:2], b[:2], atol=2e-4)
    turn = float(a[2]) - float(b[2])
    assert abs(np.angle(np.exp(1j * turn))) < 1e-5


@LAWS
@given(poses)
def test_identity_changes_nothing(a):
    close(compose(a, IDENTITY), a)
    close(compose(IDENTITY, a), a)


@LAWS
@given(poses)
def test_inverse_undoes_a_pose_from_both_sides(a):
    close(compose(a, inverse(a)), IDENTITY)
    close(compose(inverse(a), a), IDENTITY)


@LAWS
@given(poses, poses, poses)
def test_composition_is_associative(a, b, c):
    close(compose(compose(a, b), c), compose(a, compose(b, c)))


@LAWS
@given(poses, poses)
def test_between_is_the_motion_that_leads_from_one_to_the_other(a, b):
    close(compose(a, between(a, b)), b)


@LAWS
@given(poses, poses)
def test_composition_agrees_with_jaxlie(a, b):
    want = jaxlie_compose(a, b)
    xy, theta = want.translation(), want.rotation().as_radians()
    close(compose(a, b), np.array([*xy, theta]))


def test_integration_follows_a_known_square():
    corner = jnp.array([1.0, 0.0, jnp.pi / 2])
    poses = se2.integrate(jnp.stack([IDENTITY, corner, corner, corner, corner]))
    np.testing.assert_allclose(poses[:, 0], [0, 1, 1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(poses[:, 1], [0, 0, 1, 1, 0], atol=1e-6)


def test_geometry_never_uses_a_matrix_product():
    # A float32 matrix product may run in TF32 on a GPU and lose centimetres.
    a = jnp.ones((4, 3))
    assert "dot_general" not in str(jax.make_jaxpr(se2.compose)(a, a))
