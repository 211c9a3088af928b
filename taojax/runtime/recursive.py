"""A recursive filter on the map's own graph: evidence that persists, beside windows that forget.

Hidden states are every anchor in both travel directions and one state off the map. The robot moves
by odometry, positions spread over neighbouring anchors, a little mass always leaks off the map, and
an answer multiplies each anchor's mass by exp(EVIDENCE s), where s is its similarity on the fixed
scale; off the map nothing is expected. No number here is fitted.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from taojax.core.anchors import AnchorGrid, look_up
from taojax.core.se2 import rotate
from taojax.core.sums import least
from taojax.runtime.maps import MapTables

EVIDENCE = 8.0
"""Log likelihood ratio of a strong match against background."""

LEAK = 0.02
"""Probability per frame of leaving the map."""

STAY_OFF = 0.9
"""Probability per frame of staying off the map."""

START_OFF = 0.3
"""Probability of starting off the map."""

LOCAL_SPACINGS = 6.0
"""Mass within so many map spacings of the likeliest anchor counts as one place."""

REACH_SPACINGS = 2.0
"""A predicted position farther than this from every anchor has left the map."""


class RecursiveState(eqx.Module):
    """The belief; sums to one together with `off`."""

    mass: Float[Array, "2 m"]
    """Anchors, facing as the map does and the other way."""

    off: Float[Array, ""]


def init_recursive(tables: MapTables) -> RecursiveState:
    """Return the belief before the first frame: anywhere on the map."""
    # Explicit types: a weakly typed start would compile the second step again.
    n_anchors, n = tables.grid.xy.shape[0], tables.places.n_known
    is_known = (jnp.arange(n_anchors, dtype=jnp.float32) < n).astype(jnp.float32)
    mass = jnp.broadcast_to(is_known * ((1.0 - START_OFF) / (2 * n)), (2, n_anchors))
    return RecursiveState(mass, jnp.full((), START_OFF, jnp.float32))


def _spread(
    grid: AnchorGrid, variance: Float[Array, ""], mass: Float[Array, "2 m"]
) -> Float[Array, "2 m"]:
    """Return the mass after positions spread over the neighbours.

    Neighbour by neighbour: summing a gathered `(2, m, b)` array takes seven times as long.
    """
    weight, spread = jnp.zeros_like(mass[0]), jnp.zeros_like(mass)
    for b in range(grid.neighbour.shape[0]):
        kernel = jnp.exp(-0.5 * grid.neighbour_m2[b] / variance)
        weight = weight + kernel
        spread = spread + kernel[None] * mass[:, grid.neighbour[b]]
    return spread / weight[None]


def recursive_step(
    tables: MapTables,
    state: RecursiveState,
    odometry: Float[Array, "3"],
    index: Int[Array, " c"],
    scaled: Float[Array, " c"],
) -> tuple[RecursiveState, Float[Array, ""]]:
    """Advance the belief by one frame.

    Args:
        tables: the map.
        state: the belief.
        odometry: motion into this frame, finite.
        index: `(c,)` candidates, -1 = none.
        scaled: `(c,)` their similarities on the fixed scale.

    Returns:
        The belief, and the probability of not being where the belief is strongest.
    """
    grid, spacing_m = tables.grid, tables.spacing_m
    m = grid.xy.shape[0]
    driven = jnp.hypot(odometry[0], odometry[1])
    # Half a spacing of doubt once the robot has moved half a spacing, and 15 % of the distance.
    doubt = 0.5 * spacing_m * jnp.minimum(1.0, driven / (0.5 * spacing_m))
    variance = doubt**2 + (0.1 * spacing_m) ** 2 + (0.15 * driven) ** 2
    spread = _spread(grid, variance, state.mass)

    # Whoever faced the other way came from the other side. Coordinates are gathered one by one:
    # pairs of them, gathered and multiplied, take ten times as long on a CPU.
    x, y = grid.xy[:, 0], grid.xy[:, 1]
    c, s = grid.facing[:, 0], grid.facing[:, 1]
    turned = rotate(-odometry[2], grid.facing)
    cos, sin = turned[:, 0], turned[:, 1]
    dx, dy = odometry[0] * cos - odometry[1] * sin, odometry[0] * sin + odometry[1] * cos
    before_x, before_y = jnp.stack([x - dx, x + dx]), jnp.stack([y - dy, y + dy])
    source = look_up(grid, jnp.stack([before_x, before_y], axis=-1))
    known = jnp.maximum(source, 0)
    gap = (x[known] - before_x) ** 2 + (y[known] - before_y) ** 2
    is_linked = (source >= 0) & (gap < (REACH_SPACINGS * spacing_m) ** 2)
    # A loop driven the other way later has anchors that face against their neighbours.
    is_same = c[known] * cos[None] + s[known] * sin[None] >= 0
    direction = jnp.array([[0], [1]])
    arriving = spread[jnp.where(is_same, direction, 1 - direction), known]
    arriving = jnp.where(is_linked, (1.0 - LEAK) * arriving, 0.0)
    gone = jnp.maximum(1.0 - state.off - jnp.sum(arriving), 0.0)
    off = STAY_OFF * state.off + gone
    n = tables.places.n_known
    anywhere = (1.0 - STAY_OFF) * state.off / (2 * n)
    mass = arriving + jnp.where(jnp.arange(m, dtype=jnp.float32) < n, anywhere, 0.0)[None]

    # An anchor that the list lacks looks like background, whose evidence is 1.
    listed = jnp.where(index >= 0, index, m)
    evidence = jnp.ones(m).at[listed].set(jnp.exp(EVIDENCE * scaled), mode="drop")
    mass = mass * evidence[None]
    total = jnp.sum(mass) + off
    mass, off = mass / total, off / total
    here = least(-(mass[0] + mass[1]))
    is_local = (x - x[here]) ** 2 + (y - y[here]) ** 2 < (LOCAL_SPACINGS * spacing_m) ** 2
    return RecursiveState(mass, off), 1.0 - jnp.sum(jnp.where(is_local[None], mass, 0.0))
